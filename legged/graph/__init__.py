"""The control step as one CUDA graph, and a guard that checks, also without a GPU, if the step can be captured."""
