"""Sweeps: many trainings that differ in a few settings, chosen from the results of earlier ones."""
