"""Fitting of actuator models to logs of a robot."""
