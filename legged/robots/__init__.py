"""Robots as data: each is a folder with robot.yaml and an MJCF model."""
