"""The program that runs an exported policy on a robot. It needs numpy and onnxruntime, and no other part of legged."""
