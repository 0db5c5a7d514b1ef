"""Fitting of actuators to logs of a robot: reading logs, fitting models and measuring their errors."""
