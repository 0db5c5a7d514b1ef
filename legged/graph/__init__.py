"""The control step as one CUDA graph. A guard checks on any machine whether the step can be captured."""
