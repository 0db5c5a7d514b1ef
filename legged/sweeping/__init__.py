"""Sweeps: many trainings that differ in a few settings. Results of earlier trainings guide the choice of the settings."""
