"""rsl-rl's PPO and its training loop, and the same without the host in it; runs, checkpoints and what is shown of them."""
