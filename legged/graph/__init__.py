"""A step as one CUDA graph, and the guard that checks on the CPU that it could be one."""
