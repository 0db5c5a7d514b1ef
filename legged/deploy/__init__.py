"""The program that runs an exported policy on a robot. It needs numpy and onnxruntime. Of this package it imports the module
`errors` only.
"""
