"""A policy on show: its ground, its outing, films and the window."""
