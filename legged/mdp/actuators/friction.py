"""Friction of joints.

Friction is Coulomb and viscous friction with the Stribeck effect, after Armstrong-Helouvry, Dupont, Canudas de Wit, "A survey
of models, analysis tools and compensation methods for the control of machines with friction", Automatica 30 (1994). This
module also smooths friction near zero speed.
"""

from collections.abc import Callable
from typing import Self

import numpy as np
import torch
from torch import Tensor

from legged.config.actuator import ActuatorConfig
from legged.errors import ConfigError
from legged.mdp.actuators.model import ActuatorModel, JointStep, Motors, by_joint
from legged.robots.robot import Robot


class Friction(ActuatorModel):
    """Friction torque of D joints: Coulomb, Stribeck and viscous friction."""

    def __init__(
        self, coulomb: Tensor, breakaway: Tensor, viscous: Tensor, stribeck_velocity: float, smoothing: float
    ) -> None:
        """Set the coefficients, (D,) each: `coulomb` is the friction of a moving joint [N m], `breakaway` the friction at the
        start of a motion [N m], and `viscous` a factor on the speed [N m s/rad]. Friction falls from `breakaway` to `coulomb`
        over `stribeck_velocity`, and fades to zero below the speed `smoothing` [rad/s].
        """
        self.coulomb, self.extra, self.viscous = coulomb, breakaway - coulomb, viscous
        self.stribeck_velocity, self.smoothing = stribeck_velocity, smoothing

    @classmethod
    def of(cls, motors: Motors) -> Self:
        """Return the friction that the settings define.

        Raises:
            ConfigError: as for `friction_numbers`.
        """
        found = friction_numbers(motors.robot, motors.cfg, motors.where)
        coulomb, breakaway, viscous = map(motors.tensor, found)
        return cls(coulomb, breakaway, viscous, motors.cfg.stribeck_velocity, motors.cfg.friction_smoothing)

    def resistance(self, dof_vel: Tensor) -> Tensor:
        """Return the friction (N, D) [N m], with the sign of the velocities (N, D) [rad/s]."""
        slow = torch.exp(-(dof_vel / self.stribeck_velocity).square())
        return (self.coulomb + self.extra * slow) * torch.tanh(dof_vel / self.smoothing) + self.viscous * dof_vel

    def torques(self, torques: Tensor, step: JointStep) -> Tensor:
        return torques - self.resistance(step.dof_vel)

    def describe(self, joint: int) -> str:
        dry, extra, viscous = (float(of[joint]) for of in (self.coulomb, self.extra, self.viscous))
        if not (dry or extra or viscous):
            return ""
        return f"friction {dry:g} N m ({dry + extra:g} to break away) + {viscous:g} N m s/rad"


def friction_numbers(
    robot: Robot, cfg: ActuatorConfig, where: Callable[[str], str] = str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Coulomb and breakaway friction [N m] and viscous friction [N m s/rad] of all joints, (D,) each. `where` turns a
    dotted path into the beginning of an error message.

    Raises:
        ConfigError: a pattern matches no joint, or breakaway friction is below Coulomb friction.
    """
    nothing = np.zeros(robot.num_dof)
    coulomb = by_joint(cfg.coulomb_friction, robot, where("control.actuator.coulomb_friction"), nothing)
    breakaway = by_joint(cfg.breakaway_friction, robot, where("control.actuator.breakaway_friction"), coulomb)
    viscous = by_joint(cfg.viscous_friction, robot, where("control.actuator.viscous_friction"), nothing)
    if (breakaway < coulomb).any():
        joint = int(np.argmax(breakaway < coulomb))
        least = f"its coulomb_friction of {coulomb[joint]:g} N m"
        raise ConfigError(
            f"{where('control.actuator.breakaway_friction')}: {breakaway[joint]:g} N m for '{robot.joint_names[joint]}' is"
            f" less than {least}; breakaway friction must be at least Coulomb friction"
        )
    return coulomb, breakaway, viscous
