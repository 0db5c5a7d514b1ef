"""Actuators fitted to logs of a robot: how a log is read, what is fitted to it, and how well that fits."""
