"""Training and playing: what rsl-rl does not do."""
