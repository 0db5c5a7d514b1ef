"""Models of motors that are not ideal: delay of targets, torque-speed line, friction of joints, actuators learned from data.

The torque-speed line is that of a direct-current motor: its torque falls from the stall torque at rest to zero at the no-load
speed (any textbook; Isaac Lab's DCMotor, mjlab's dc_actuator and Newton's ClampingDCMotor have the same line).
Friction is Coulomb and viscous friction with the Stribeck effect, after Armstrong-Helouvry, Dupont, Canudas de Wit, "A survey
of models, analysis tools and compensation methods for the control of machines with friction", Automatica 30 (1994). This
module also smooths friction near zero speed.
"""

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from legged.config.actuator import ActuatorConfig
from legged.config.legged import LeggedControlConfig
from legged.config.origins import Origins
from legged.errors import ConfigError
from legged.math import masked_set_
from legged.mdp.actuator_network import ActuatorNetwork, NetworkWeights
from legged.mdp.random_pool import RandomPool
from legged.robots.patterns import match_names
from legged.robots.robot import Robot

if TYPE_CHECKING:
    from legged.physics.warp.task_kernels import TaskKernels

LARGEST_GAIN = 2.0
"""Largest stable gain of a torque-speed line. At full torque, the motor changes a joint's speed in a physics step by the gain
times the difference between no-load speed and joint speed. With a larger gain the speed diverges."""


def is_ideal(cfg: ActuatorConfig) -> bool:
    """Return True if motors give the torque of the control law without delay and losses, up to their effort limit."""
    friction = any(any(table.values()) for table in (cfg.coulomb_friction, cfg.breakaway_friction, cfg.viscous_friction))
    return cfg.model == "ideal" and not friction and cfg.delay == (0, 0) and not cfg.network


class MotorCurve:
    """Torque-speed lines of the motors of D joints. They limit the torque at each velocity."""

    def __init__(self, stall_torque: Tensor, no_load_speed: Tensor) -> None:
        """Set the torque at rest [N m] and the speed at which the torque is zero [rad/s], (D,) each. If both are infinite the
        motor is ideal, and only the effort limit of the joint limits its torque.
        """
        self.stall_torque, self.no_load_speed = stall_torque, no_load_speed
        """(D,) each. No-load speeds become (N, D) at the first call of `vary`."""
        self.nominal_speed = no_load_speed

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


class Friction:
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

    def torques(self, dof_vel: Tensor) -> Tensor:
        """Return the friction (N, D) [N m], with the sign of the velocities (N, D) [rad/s]."""
        slow = torch.exp(-(dof_vel / self.stribeck_velocity).square())
        return (self.coulomb + self.extra * slow) * torch.tanh(dof_vel / self.smoothing) + self.viscous * dof_vel


class Actuator:
    """Actuators of N robots with D joints: delay, motor and friction between targets and joint torques.

    A target is set once per control step. The target reaches the control law after the robot's delay, a number of physics
    steps. Until the first target arrives, joints have the target of action 0. The torque of the law is limited to what the
    motor can give, then friction is subtracted.
    """

    STATE: tuple[str, ...] = ("targets", "delay")

    def __init__(
        self,
        robot: Robot,
        cfg: LeggedControlConfig,
        middle: Tensor,
        shape: tuple[int, int],
        sim_dt: float,
        numbers: RandomPool,
        kernels: "TaskKernels | None" = None,
    ) -> None:
        """Build actuators of `shape` (N, D) on the device of `middle`. `middle`, (D,) or (), is the joint target when all
        actions are zero. Delays are drawn from the pool `numbers`.

        Raises:
            ConfigError: as for `check_actuator`.
        """
        check_actuator(robot, cfg, sim_dt)
        actuator, device = cfg.actuator, middle.device
        n, joints = shape

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.decimation, self._kernels = cfg.decimation, kernels
        stall, fastest = map(tensor, motor_numbers(robot, actuator))
        self.curve = MotorCurve(torch.where(fastest.isfinite(), stall, torch.inf), fastest)
        coulomb, breakaway, viscous = map(tensor, friction_numbers(robot, actuator))
        speeds = (actuator.stribeck_velocity, actuator.friction_smoothing)
        self.friction = Friction(coulomb, breakaway, viscous, *speeds)
        self._has_friction = bool(self.friction.coulomb.any() | self.friction.extra.any() | self.friction.viscous.any())
        self._has_curve = actuator.model == "dc_motor"
        low, high = actuator.delay
        self.shortest, self.longest = low, high
        """Shortest and longest delay, in physics steps."""
        kept = 1 + math.ceil(high / cfg.decimation)
        self.targets = middle.expand(kept, n, joints).clone()
        """(K, N, D) targets of the last K control steps, newest first."""
        self.newest = self.targets[0]
        """(N, D) target of this control step, which the control law writes."""
        self.delay = torch.full((n,), high, dtype=torch.int32, device=device)
        """(N,) delay of each robot, in physics steps."""
        self._varies = actuator.delay_varies and low < high
        self._drawn = numbers.between(float(low), float(high + 1), 1) if low < high else None
        self._steps = 0  # physics steps since the newest target
        self.network: ActuatorNetwork | None = None
        if actuator.network:
            of = modelled_joints(robot, actuator)
            self.network = ActuatorNetwork(NetworkWeights.load(actuator.network), n, joints, sim_dt, device, kernels)
            self._by_network = torch.tensor([i in of for i in range(joints)], device=device)
            self._error = torch.zeros(n, joints, device=device)
            self.STATE = (*self.STATE, "past")

    def describe(self, joint: int) -> str:
        """Describe in a few words how a joint's motor differs from an ideal motor."""
        curve, friction, parts = self.curve, self.friction, []
        if self.network is not None and bool(self._by_network[joint]):
            parts.append(f"torque by a network ({self.network.kind})")
        stall, fastest = float(curve.stall_torque[joint]), float(curve.nominal_speed[joint])
        if math.isfinite(fastest):
            parts.append(f"{stall:g} N m at rest, none at {fastest:g} rad/s")
        dry, extra, viscous = (float(of[joint]) for of in (friction.coulomb, friction.extra, friction.viscous))
        if dry or extra or viscous:
            parts.append(f"friction {dry:g} N m ({dry + extra:g} to break away) + {viscous:g} N m s/rad")
        if self.longest:
            parts.append(f"delay {self.shortest} to {self.longest} physics steps")
        return ", ".join(parts) or "ideal motor"

    @property
    def past(self) -> Tensor:
        """State of the network. Saved states hold it under the name `past`."""
        assert self.network is not None
        return self.network.state

    def advance(self) -> None:
        """Shift the targets by one control step. Afterwards the new target must be written to `newest`."""
        if len(self.targets) > 1:
            self.targets[1:].copy_(self.targets[:-1].clone())
        self._steps = 0

    def delayed(self) -> Tensor:
        """Return the targets (N, D) that have reached the control law at this physics step."""
        if not self.longest:
            return self.newest
        late = (self.delay - self._steps).clamp_(min=0) + (self.decimation - 1)
        age = torch.div(late, self.decimation, rounding_mode="floor").long()
        return self.targets.gather(0, age.view(1, -1, 1).expand(1, *self.newest.shape))[0]

    def drive(
        self,
        dof_pos: Tensor,
        dof_vel: Tensor,
        law: Callable[[Tensor], Tensor],
        gains: tuple[Tensor, Tensor] | None,
        effort: Tensor,
        out: Tensor,
    ) -> None:
        """Write to `out` the torques (N, D) [N m] of one physics step, at joint angles [rad] and velocities [rad/s], (N, D)
        each.

        `law` computes the commanded torques (N, D) from targets (N, D). For the P law, `gains` are its stiffness and damping.
        `effort` holds the effort limits of the joints [N m]. Gains and limits are (D,) or (N, D).
        """
        if self._kernels is not None and gains is not None and self.network is None:
            curve, friction = self.curve, self.friction
            by_robot = (each.expand_as(out) for each in (*gains, effort))
            now: tuple[Tensor | float, ...] = (self.targets, self.delay, self._steps, self.decimation, dof_pos, dof_vel)
            rough = (friction.coulomb, friction.extra, friction.viscous, friction.stribeck_velocity, friction.smoothing)
            motor = (curve.stall_torque, curve.no_load_speed.expand_as(out))
            self._kernels.drive_joints(tuple(out.shape), *now, *by_robot, *motor, *rough, self._has_friction, out)
            self._steps += 1
            return
        target = self.delayed()
        asked = law(target)
        if self.network is not None:
            torch.sub(target, dof_pos, out=self._error)
            asked = torch.where(self._by_network, self.network.torques(self._error, dof_vel), asked)
        self._limit(asked, dof_vel, effort, out)
        self._steps += 1

    def _limit(self, asked: Tensor, dof_vel: Tensor, effort: Tensor, out: Tensor) -> None:
        """Limit the torques `asked` (N, D) to those of the motors, subtract friction, and write to `out` (N, D) [N m]."""
        if self._has_curve:
            low, high = self.curve.limits(dof_vel, effort)
            asked = torch.minimum(torch.maximum(asked, low), high)
        elif self._has_friction:
            asked = torch.clamp(asked, -effort, effort)
        if self._has_friction:
            asked = asked - self.friction.torques(dof_vel)
        torch.clamp(asked, -effort, effort, out=out)

    def reset(self, mask: Tensor, middle: Tensor) -> None:
        """Reset the robots in `mask` (N,) and draw new delays for them; with delay_varies, draw new delays for all robots.
        `middle`, (D,), (N, D) or (), is the joint target when all actions are zero.
        """
        if self._drawn is not None:
            drawn = self._drawn.values[:, 0].clamp(max=float(self.longest)).int()
            if self._varies:  # limited, so that no older target replaces one that has arrived
                latest = (torch.div(self.delay, self.decimation, rounding_mode="floor") + 1) * self.decimation
                torch.where(mask, drawn, torch.minimum(drawn, latest), out=self.delay)
            else:
                masked_set_(self.delay, mask, drawn)
        if self.longest:
            torch.where(mask.view(1, -1, 1), middle, self.targets, out=self.targets)
        if self.network is not None:
            self.network.reset(mask)


def modelled_joints(robot: Robot, cfg: ActuatorConfig, where: Callable[[str], str] = str) -> tuple[int, ...]:
    """Return the indices of the joints in control.actuator.joints, or of all joints if it is empty. The motor model and the
    network apply to these joints. `where` turns a dotted path into the beginning of an error message.

    Raises:
        ConfigError: a pattern matches no joint.
    """
    if not cfg.joints:
        return tuple(range(robot.num_dof))
    return match_names(cfg.joints, robot.joint_names, where("control.actuator.joints"))


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


def by_joint(table: Mapping[str, float], robot: Robot, where: str, otherwise: np.ndarray) -> np.ndarray:
    """Return a number for each joint, (D,). The keys of `table` are patterns. The longest pattern in a joint's name decides.
    A joint whose name contains no pattern gets its number from `otherwise` (D,).

    Raises:
        ConfigError: a pattern matches no joint.
    """
    match_names(tuple(table), robot.joint_names, where)
    found = [max((p for p in table if p in name), key=len, default=None) for name in robot.joint_names]
    return np.array([otherwise[i] if p is None else table[p] for i, p in enumerate(found)], dtype=float)


def check_actuator(robot: Robot, cfg: LeggedControlConfig, sim_dt: float, where: Callable[[str], str] = str) -> None:
    """Check that the actuators fit the robot, its control law and the physics step `sim_dt` [s]. `where` turns a dotted path
    into the beginning of an error message.

    Raises:
        ConfigError: a pattern matches no joint, a no-load speed is missing, a motor is too strong for the physics step, or
            the network's file is missing or invalid, or the network needs law P or another physics step.
    """
    actuator = cfg.actuator
    _check_line(with_rotors(robot, actuator, where), *motor_numbers(robot, actuator, where), sim_dt, where)
    friction_numbers(robot, actuator, where)
    if actuator.network:
        path = where("control.actuator.network")
        laws = robot.each(cfg.control_type, where("control.control_type"))
        for law in laws[list(modelled_joints(robot, actuator, where))]:
            if law != "P":
                raise ConfigError(f"{path}: a learned actuator needs control_type P (joint angles), not {law}")
        NetworkWeights.load(actuator.network, path).steps_between(sim_dt, path)


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
        where = f"control.actuator.{name}"
        if told == "the default" or (origins.of(where) == "command line" and told != "command line"):
            raise ConfigError(
                f"{origins.where(where)}: only motors with a torque-speed line use it, but these motors are ideal; "
                f"set {path} to dc_motor, or to ideal to ignore it"
            )


def check_slowest(
    robot: Robot, cfg: LeggedControlConfig, sim_dt: float, lowest: float, where: Callable[[str], str] = str
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


def _check_line(robot: Robot, stall: np.ndarray, speed: np.ndarray, sim_dt: float, where: Callable[[str], str]) -> None:
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
