"""Actuators between joint targets and joint torques. To add a model: `ActuatorModel` and `register_actuator` (model.py)."""

from legged.mdp.actuators.model import ActuatorModel, JointStep, Motors, register_actuator

__all__ = ["ActuatorModel", "JointStep", "Motors", "register_actuator"]
