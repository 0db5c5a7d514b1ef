"""Commands: `python -m legged.tools.<name>`, and nothing else."""
