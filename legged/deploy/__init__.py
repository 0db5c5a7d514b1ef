"""The program that runs an exported policy on a robot. It needs numpy and onnxruntime. From other parts of legged it
imports only `legged.errors` and `legged.process`.
"""
