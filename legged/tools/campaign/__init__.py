"""Trainings and evaluations of many tasks, as processes side by side, for the zoo command."""
