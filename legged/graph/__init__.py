"""The control step as one CUDA graph, and a guard that checks on a CPU if the step can be captured."""
