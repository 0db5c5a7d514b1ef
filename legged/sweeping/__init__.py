"""Sweeps: many trainings that differ in a few settings, chosen by what those before them have found."""
