"""Training with rsl-rl's PPO or distillation, in rsl-rl's own loop or in a loop whose steps do not wait for
values from the GPU. Also run folders, checkpoints and the console display.
"""
