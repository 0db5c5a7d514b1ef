"""Trained policies: restored from checkpoints, exported, described."""
