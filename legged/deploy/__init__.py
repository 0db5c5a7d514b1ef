"""The program that runs an exported policy on a robot. It needs numpy and onnxruntime. Of the rest of this package it imports
only `errors` and `process`.
"""
