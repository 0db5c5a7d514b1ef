"""Training with rsl-rl's PPO or distillation, in rsl-rl's own loop or in one without host reads. Also run folders,
checkpoints and the console display.
"""
