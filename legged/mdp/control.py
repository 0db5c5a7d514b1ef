"""Control laws, which compute joint torques from actions."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import torch
from torch import Tensor

from legged.config.robot import RobotControlConfig
from legged.errors import ConfigError
from legged.math import masked_set_
from legged.mdp.actuators.actuator import Actuator, check_actuator, is_ideal
from legged.mdp.actuators.model import Motors
from legged.mdp.kernels import Kernels
from legged.mdp.random_pool import RandomPool
from legged.robots.patterns import match_names, match_values
from legged.robots.robot import Robot


class Control:
    """Explicit control laws, evaluated at every physics step and clipped to the motors' effort limits.

    P: stiffness * (action_scale * action + default - q) - damping * dq
    V: stiffness * (action_scale * action - dq) - damping * ddq, with the mean acceleration ddq of the last physics step
    T: action_scale * action

    Each joint has one of these laws. Of the D joints, A have an action. The other K joints are held: the law P holds them at
    their default angles, or at targets that move.
    """

    STATE = ("_last_dof_vel",)

    def __init__(
        self,
        robot: Robot,
        cfg: RobotControlConfig,
        torques: Tensor,
        sim_dt: float,
        kernels: Kernels | None = None,
        numbers: RandomPool | None = None,
        held_offsets: Tensor | None = None,
    ) -> None:
        """Build the control law. It writes to `torques` (N, D), a tensor of the physics, and uses the device of this tensor.
        Gains come from `cfg` if it names any, else from the robot. Delays of targets are drawn from the pool `numbers`.
        `held_offsets` (N, K) are the targets of held joints minus their default angles [rad], which their owner moves.

        Raises:
            ConfigError: a pattern matches no joint, a joint has no law, gain or scale, or joints are held by another law
                than P.
        """

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=torques.device)

        self.sim_dt, self._kernels = sim_dt, kernels
        self.laws = tuple(robot.each(cfg.control_type, "control.control_type").tolist())
        """(D,) law of each joint."""
        self.law = self.laws[0] if len(set(self.laws)) == 1 else ""
        """Law of all joints; empty if they have different ones."""
        self._has = {law: torch.tensor([own == law for own in self.laws], device=torques.device) for law in set(self.laws)}
        self.acted = acted_joints(robot, cfg)
        """(A,) index of each action's joint."""
        scales = action_scales(robot, cfg)
        self.action_scale = cfg.action_scale if isinstance(cfg.action_scale, float) else tensor(scales)
        """One scale for all actions, or (A,) one for each."""
        stiffness, damping = control_gains(robot, cfg)
        self.stiffness, self.damping = tensor(stiffness), tensor(damping)
        """(D,) gains [N m/rad] and [N m s/rad]. These gains and `torque_limits` [N m] become (N, D) once `vary` randomises
        any of them."""
        self.default_dof_pos = tensor(robot.default_dof_pos)
        self.torque_limits = tensor(robot.torque_limits)
        self._lowest_torques = -self.torque_limits
        self.torques = torques
        """(N, D) torques of the last physics step [N m]."""
        self._zero = torch.zeros((), device=torques.device)
        self.zero_dof_pos = self.default_dof_pos
        """(D,) or (N, D) true joint angles at which encoders show the default angles [rad]."""
        self.nominal = {"p_gain": self.stiffness, "d_gain": self.damping, "torque_limit": self.torque_limits}
        """Property that `vary` randomises -> its nominal values (D,), which `vary` multiplies by the drawn factors."""
        self._varied = False
        self._target = torch.zeros_like(self.torques)  # joint angles (P), velocities (V) or torques (T)
        self._columns = None if len(self.acted) == robot.num_dof else torch.tensor(self.acted, device=torques.device)
        self.held = tuple(i for i in range(robot.num_dof) if i not in self.acted)
        """(K,) index of each held joint."""
        self.held_offsets = torch.zeros(len(torques), len(self.held), device=torques.device)
        """(N, K) targets of held joints minus their default angles [rad]."""
        self._held_columns: Tensor | None = None
        if held_offsets is not None:
            self.held_offsets, self._held_columns = held_offsets, torch.tensor(self.held, device=torques.device)
        self._last_dof_vel = torch.zeros_like(self.torques)
        self.actuator: Actuator | None = None
        """Model of motors that are not ideal; None for ideal motors."""
        if not is_ideal(cfg.actuator):
            check_actuator(robot, cfg, sim_dt)
            n, device = len(torques), torques.device
            drawn = numbers or RandomPool(n, device)
            motors = Motors(robot, cfg.actuator, n, cfg.decimation, sim_dt, device, drawn, self._middle, kernels)
            self.actuator = Actuator(motors)
            self._target = self.actuator.line.newest

    def vary(self, drawn: Mapping[str, Tensor]) -> None:
        """Apply randomised properties, (N,) or (N, D) each: factors on gains and torque limits, and `joint_offset`, the error
        of the encoders [rad]. Other fields of `physics.FIELDS` in `drawn` are ignored. The first call allocates tensors, and
        later calls write in place.
        """
        each = {
            name: values.view(len(values), -1) for name, values in drawn.items() if name in (*self.nominal, "joint_offset")
        }
        if not each:
            return
        if not self._varied:
            self._varied = True
            self.stiffness, self.damping, self.torque_limits, self._lowest_torques = (
                torch.zeros_like(self.torques) + nominal for nominal in (*self.nominal.values(), self._lowest_torques)
            )
            self.zero_dof_pos = torch.zeros_like(self.torques) + self.default_dof_pos
        written = {"p_gain": self.stiffness, "d_gain": self.damping, "torque_limit": self.torque_limits}
        for name, values in each.items():
            if name in written:
                torch.mul(self.nominal[name], values, out=written[name])
        if "torque_limit" in each:
            torch.neg(self.torque_limits, out=self._lowest_torques)
        if "joint_offset" in each:
            # For a joint at q the law sees q + offset. A target that is smaller by the offset has the same effect.
            torch.sub(self.default_dof_pos, each["joint_offset"], out=self.zero_dof_pos)

    def set_actions(self, actions: Tensor) -> None:
        """Set the actions (N, A) that the following calls of `compute` carry out."""
        if self.actuator is not None:
            self.actuator.line.advance()
        middle = self._middle()
        if self._columns is None and isinstance(self.action_scale, float):
            torch.add(middle, actions, alpha=self.action_scale, out=self._target)
            return
        torch.add(middle, self.spread(actions), out=self._target)

    def aim(self, joints: Tensor, targets: Tensor) -> None:
        """Replace the targets of some joints, until the next `set_actions`: `targets` (N, K) [rad] for the joints with the
        indices `joints` (K,), whose law is P.
        """
        self._target.index_copy_(1, joints, targets)

    def _middle(self) -> Tensor:
        """Return the targets of action 0, (D,), (N, D) or ()."""
        if not self.law:
            return torch.where(self._has["P"], self.zero_dof_pos, self._zero) if "P" in self._has else self._zero
        return self.zero_dof_pos if self.law == "P" else self._zero

    def spread(self, actions: Tensor) -> Tensor:
        """Return actions (N, A) times their scales, by joint (N, D). Held joints have `held_offsets`."""
        scaled = actions * self.action_scale
        if self._columns is None:
            return scaled
        spread = torch.zeros_like(self.torques).index_copy_(1, self._columns, scaled)
        held = self._held_columns
        return spread if held is None else spread.index_copy_(1, held, self.held_offsets)

    def compute(self, dof_pos: Tensor, dof_vel: Tensor) -> Tensor:
        """Compute torques (N, D) [N m] at joint angles [rad] and velocities [rad/s], each (N, D), for one physics step."""
        if self.actuator is not None:
            of_law = (self.stiffness, self.damping) if self.law == "P" else None
            law = partial(self._law, dof_pos, dof_vel)
            self.actuator.drive(dof_pos, dof_vel, law, of_law, self.torque_limits, self.torques)
            return self.torques
        if self.law == "P" and self._kernels is not None:
            gains = (each.expand_as(self.torques) for each in (self.stiffness, self.damping, self.torque_limits))
            shape = tuple(self.torques.shape)
            self._kernels.launch("hold_joints", shape, self._target, dof_pos, dof_vel, *gains, self.torques)
            return self.torques
        asked = self._law(dof_pos, dof_vel, self._target)
        return torch.clamp(asked, self._lowest_torques, self.torque_limits, out=self.torques)

    def _law(self, dof_pos: Tensor, dof_vel: Tensor, target: Tensor) -> Tensor:
        """Return the torques (N, D) [N m] of the laws, before the limits of the motors."""
        torques = target
        if "V" in self._has:
            acceleration = (dof_vel - self._last_dof_vel) / self.sim_dt
            by_velocity = self.stiffness * (target - dof_vel) - self.damping * acceleration
            torques = by_velocity if self.law else torch.where(self._has["V"], by_velocity, torques)
            self._last_dof_vel.copy_(dof_vel)
        if "P" in self._has:
            by_angle = torch.addcmul(self.stiffness * (target - dof_pos), self.damping, dof_vel, value=-1.0)
            torques = by_angle if self.law else torch.where(self._has["P"], by_angle, torques)
        return torques

    def reset(self, mask: Tensor) -> None:
        """Reset the control law and the actuators of the robots in `mask` (N,)."""
        if "V" in self._has:
            masked_set_(self._last_dof_vel, mask, 0.0)
        if self.actuator is not None:
            self.actuator.reset(mask)


def check_wheels(robot: Robot, cfg: RobotControlConfig, where: Callable[[str], str] = str) -> None:
    """Check that all wheels with the law P are held, because P would turn them to an angle. `where` turns a dotted path into
    the beginning of an error message.

    Raises:
        ConfigError: a wheel has the law P and is not held.
    """
    laws, acted = robot.each(cfg.control_type, where("control.control_type")), acted_joints(robot, cfg, where)
    for i in acted:
        if robot.wheels[i] and laws[i] == "P":
            raise ConfigError(
                f"{where('control.control_type')}: '{robot.joint_names[i]}' of '{robot.name}' is a wheel, and law P would"
                " turn it to an angle that is not observed; give it law V or T in a table, or list it in control.held"
            )


def control_gains(robot: Robot, cfg: RobotControlConfig, where: Callable[[str], str] = str) -> tuple[np.ndarray, np.ndarray]:
    """Return stiffness and damping of a task, (D,) each: from the tables in `cfg` if it has any, else from the robot. `where`
    turns a dotted path into the beginning of an error message.

    Raises:
        ConfigError: a pattern matches no joint, or a joint has no gain.
    """

    def gains(name: str, own: dict[str, float], of_robot: np.ndarray) -> np.ndarray:
        return robot.each(own, where(f"control.{name}")) if own else of_robot

    return gains("stiffness", cfg.stiffness, robot.stiffness), gains("damping", cfg.damping, robot.damping)


def acted_joints(robot: Robot, cfg: RobotControlConfig, where: Callable[[str], str] = str) -> tuple[int, ...]:
    """Return the indices of the joints that have an action, (A,): all joints that are not held. `where` turns a dotted path
    into the beginning of an error message.

    Raises:
        ConfigError: a pattern matches no joint, all joints are held, or joints are held by another law than P.
    """
    if not cfg.held:
        return tuple(range(robot.num_dof))
    held = match_names(cfg.held, robot.joint_names, where("control.held"))
    for law in robot.each(cfg.control_type, where("control.control_type"))[list(held)]:
        if law != "P":
            raise ConfigError(f"{where('control.held')}: joints are held by control_type P only, not {law}")
    if len(held) == robot.num_dof:
        raise ConfigError(f"{where('control.held')}: every joint of '{robot.name}' is held, so there is no action")
    return tuple(i for i in range(robot.num_dof) if i not in held)


def action_scales(robot: Robot, cfg: RobotControlConfig, where: Callable[[str], str] = str) -> np.ndarray:
    """Return the scale of each action, (A,). `where` turns a dotted path into the beginning of an error message.

    Raises:
        ConfigError: as for `acted_joints`; or a pattern matches no joint with an action, or a joint with an action has no
            scale.
    """
    acted = acted_joints(robot, cfg, where)
    if not isinstance(cfg.action_scale, dict):
        return np.full(len(acted), cfg.action_scale)
    return match_values(cfg.action_scale, [robot.joint_names[i] for i in acted], where("control.action_scale"))
