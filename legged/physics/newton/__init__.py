"""Newton's solvers behind the interface."""
