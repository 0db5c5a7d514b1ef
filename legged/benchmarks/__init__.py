"""Measurements of the benchmark command."""
