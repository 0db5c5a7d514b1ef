"""rsl-rl's PPO and distillation, in rsl-rl's training loop or one that keeps the host out; runs, checkpoints and their
display.
"""
