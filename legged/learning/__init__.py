"""rsl-rl's PPO, its runner, and the same without the host in the loop."""
