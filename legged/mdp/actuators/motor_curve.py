"""Torque-speed lines of motors.

The line is that of a direct-current motor: its torque falls from the stall torque at rest to zero at the no-load speed (any
textbook; Isaac Lab's DCMotor, mjlab's dc_actuator and Newton's ClampingDCMotor have the same line).
"""

import math
from collections.abc import Callable
from typing import Self

import numpy as np
import torch
from torch import Tensor

from legged.config.actuator import ActuatorConfig
from legged.config.origins import Origins
from legged.config.robot import RobotControlConfig
from legged.errors import ConfigError
from legged.mdp.actuators.model import ActuatorModel, JointStep, Motors, by_joint, modelled_joints
from legged.robots.robot import Robot

LARGEST_GAIN = 2.0
"""Largest stable gain of a torque-speed line. At full torque, the motor changes a joint's speed in a physics step by the gain
times the difference between no-load speed and joint speed. With a larger gain the speed diverges."""


class MotorCurve(ActuatorModel):
    """Torque-speed lines of the motors of D joints. They limit the torque at each velocity."""

    def __init__(self, stall_torque: Tensor, no_load_speed: Tensor) -> None:
        """Set the torque at rest [N m] and the speed at which the torque is zero [rad/s], (D,) each. If both are infinite the
        motor is ideal, and only the effort limit of the joint limits its torque.
        """
        self.stall_torque, self.no_load_speed = stall_torque, no_load_speed
        """(D,) each. No-load speeds become (N, D) at the first call of `vary`."""
        self.nominal_speed = no_load_speed

    @classmethod
    def of(cls, motors: Motors) -> Self:
        """Return the lines that the settings define.

        Raises:
            ConfigError: as for `motor_numbers`.
        """
        stall, fastest = map(motors.tensor, motor_numbers(motors.robot, motors.cfg, motors.where))
        return cls(torch.where(fastest.isfinite(), stall, torch.inf), fastest)

    def vary(self, factor: Tensor) -> None:
        """Set no-load speeds to their nominal values times `factor`, (N, 1) or (N, D). The first call allocates a tensor, and
        later calls write in place.
        """
        if self.no_load_speed is self.nominal_speed:
            self.no_load_speed = factor * self.nominal_speed
            return
        torch.mul(self.nominal_speed, factor, out=self.no_load_speed)

    def limits(self, dof_vel: Tensor, effort: Tensor) -> tuple[Tensor, Tensor]:
        """Return the lowest and the highest torque (N, D) [N m] at velocities (N, D) [rad/s], within the effort limits
        `effort`, (D,) or (N, D) [N m].
        """
        share = dof_vel / self.no_load_speed
        high = torch.minimum(torch.maximum(self.stall_torque * (1.0 - share), -effort), effort)
        low = torch.maximum(torch.minimum(self.stall_torque * (-1.0 - share), effort), -effort)
        return low, high

    def torques(self, torques: Tensor, step: JointStep) -> Tensor:
        low, high = self.limits(step.dof_vel, step.effort)
        return torch.minimum(torch.maximum(torques, low), high)

    def describe(self, joint: int) -> str:
        stall, fastest = float(self.stall_torque[joint]), float(self.nominal_speed[joint])
        return f"{stall:g} N m at rest, none at {fastest:g} rad/s" if math.isfinite(fastest) else ""


class IdealMotor(ActuatorModel):
    """Motors that give any torque within the effort limits, at any speed."""

    def torques(self, torques: Tensor, step: JointStep) -> Tensor:
        return torch.clamp(torques, -step.effort, step.effort)


def motor_numbers(robot: Robot, cfg: ActuatorConfig, where: Callable[[str], str] = str) -> tuple[np.ndarray, np.ndarray]:
    """Return stall torque [N m] and no-load speed [rad/s] of all joints, (D,) each. Ideal motors have an infinite no-load
    speed. `where` turns a dotted path into the beginning of an error message.

    Raises:
        ConfigError: a pattern matches no joint, or a motor has neither a no-load speed nor a velocity limit.
    """
    stall = by_joint(cfg.stall_torque, robot, where("control.actuator.stall_torque"), robot.torque_limits)
    speed = by_joint(cfg.no_load_speed, robot, where("control.actuator.no_load_speed"), robot.dof_vel_limits)
    driven = np.isin(np.arange(robot.num_dof), modelled_joints(robot, cfg, where)) & (cfg.model == "dc_motor")
    if not np.all(np.isfinite(speed[driven]) & (speed[driven] > 0.0)):
        name = robot.joint_names[int(np.flatnonzero(driven & ~(np.isfinite(speed) & (speed > 0.0)))[0])]
        raise ConfigError(f"{where('control.actuator.no_load_speed')}: '{name}' has no velocity limit; give its speed here")
    return np.where(driven, stall, robot.torque_limits), np.where(driven, speed, np.inf)


def with_rotors(robot: Robot, cfg: ActuatorConfig, where: Callable[[str], str] = str) -> Robot:
    """Return the robot with the rotor inertias of control.actuator.armature. Without such a setting, return the same robot.
    `where` turns a dotted path into the beginning of an error message.

    Raises:
        ConfigError: a pattern matches no joint.
    """
    if not cfg.armature:
        return robot
    return robot.with_armature(by_joint(cfg.armature, robot, where("control.actuator.armature"), robot.armature))


def check_motor_model(actuator: ActuatorConfig, origins: Origins) -> None:
    """Check that stall_torque and no_load_speed are not given for ideal motors by mistake. Ideal motors ignore these numbers.
    If a file gives them, the command line may still set control.actuator.model to `ideal`.

    Raises:
        ConfigError: the numbers are given but no motor model is set, or the command line gives the numbers but the model is
            set only in a file.
    """
    path, told = "control.actuator.model", origins.of("control.actuator.model")
    for name in ("stall_torque", "no_load_speed"):
        if actuator.model == "dc_motor" or not getattr(actuator, name):
            continue
        setting = f"control.actuator.{name}"
        if told == "the default" or (origins.of(setting) == "command line" and told != "command line"):
            unused = "only motors with a torque-speed line use it, but these motors are ideal"
            raise origins.error(setting, f"{unused}; set {path} to dc_motor, or to ideal to ignore it")


def check_slowest(
    robot: Robot, cfg: RobotControlConfig, sim_dt: float, lowest: float, where: Callable[[str], str] = str
) -> None:
    """Check that no torque-speed line is too steep for the physics step if randomisation multiplies no-load speeds by
    `lowest`. `where` turns a dotted path into the beginning of an error message.

    Raises:
        ConfigError: a line is too steep.
    """
    gain = _line_gains(with_rotors(robot, cfg.actuator, where), *motor_numbers(robot, cfg.actuator, where), sim_dt)
    i = int(np.argmax(gain))
    if gain[i] > LARGEST_GAIN * lowest:
        least = math.ceil(100.0 * gain[i] / LARGEST_GAIN) / 100.0
        raise ConfigError(
            f"{where('domain_rand.ranges.velocity_limit')}: its lowest value, {lowest:g}, makes the torque-speed line of "
            f"'{robot.joint_names[i]}' so steep that in physics steps of {sim_dt:g} s the motor would push and brake "
            f"in turn (control.actuator.model dc_motor); the lowest value must be at least {least:g}"
        )


def _line_gains(robot: Robot, stall: np.ndarray, speed: np.ndarray, sim_dt: float) -> np.ndarray:
    """Return the gain (see LARGEST_GAIN) of each torque-speed line, (D,), for joints of legs in the air. It is 0 for ideal
    motors, because their no-load speed is infinite.
    """
    return sim_dt * stall / (robot.inertia * speed)


def check_line(robot: Robot, stall: np.ndarray, speed: np.ndarray, sim_dt: float, where: Callable[[str], str]) -> None:
    """Check that no torque-speed line is too steep for the physics step.

    With a gain above LARGEST_GAIN, the speed of a joint in the air overshoots the no-load speed in each physics step, and is
    farther from it than before. The motor then pushes and brakes in turn.

    Raises:
        ConfigError: a line is too steep.
    """
    gain = _line_gains(robot, stall, speed, sim_dt)
    i = int(np.argmax(gain))
    if gain[i] <= LARGEST_GAIN:
        return
    name, inertia = robot.joint_names[i], robot.inertia[i]
    rotor = robot.armature[i] + stall[i] * sim_dt / (LARGEST_GAIN * speed[i]) - inertia
    raise ConfigError(
        f"{where('control.actuator.stall_torque')}: '{name}' turns {inertia:.2g} kg m^2 with the leg in the air, too little "
        f"for a motor of {stall[i]:g} N m at rest and 0 N m at {speed[i]:g} rad/s: in physics steps of {sim_dt:g} s it would "
        f"push and brake in turn. Give its rotor's inertia (control.actuator.armature, {1.06 * rotor:.2g} kg m^2 or more), "
        f"or make sim.dt {0.94 * sim_dt * LARGEST_GAIN / gain[i]:.2g} s or less"  # 1.06 and 0.94 allow for rounding
    )
