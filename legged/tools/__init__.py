"""Commands beside train and play: `python -m legged.tools.<name>`."""
