"""Robots as data: a folder with robot.yaml and MJCF."""
