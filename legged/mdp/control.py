"""Action -> joint torque."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from legged.config.schema import LeggedControlConfig
from legged.math import masked_set_
from legged.robots.robot import Robot


class Control:
    """Explicit control laws, evaluated at every physics step and clipped to the motors' effort limits.

    P: stiffness * (action_scale * action + default - q) - damping * dq
    V: stiffness * (action_scale * action - dq) - damping * ddq, with ddq over one physics step
    T: action_scale * action
    """

    STATE = ("_last_dof_vel",)

    def __init__(self, robot: Robot, cfg: LeggedControlConfig, torques: Tensor, sim_dt: float) -> None:
        """Write torques to `torques` (N, D), the physics' own tensor, which takes their device along. Gains come
        from `cfg` if it names any, else from the robot.

        Raises:
            ConfigError: a gain pattern that matches no joint, or a joint without a gain.
        """

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=torques.device)

        self.control_type, self.action_scale, self.sim_dt = cfg.control_type, cfg.action_scale, sim_dt
        stiffness, damping = control_gains(robot, cfg)
        self.stiffness, self.damping = tensor(stiffness), tensor(damping)
        """(D,) gains [N m/rad], [N m s/rad]."""
        self.default_dof_pos = tensor(robot.default_dof_pos)
        self.torque_limits = tensor(robot.torque_limits)
        self._lowest_torques = -self.torque_limits
        self.torques = torques
        """(N, D) torques of the last physics step [N m]."""
        self._target = torch.zeros_like(self.torques)  # joint angles, velocities or torques
        self._last_dof_vel = torch.zeros_like(self.torques)

    def set_actions(self, actions: Tensor) -> None:
        """Take the actions (N, D) that the following calls of `compute` realise."""
        torch.mul(actions, self.action_scale, out=self._target)
        if self.control_type == "P":
            self._target.add_(self.default_dof_pos)

    def compute(self, dof_pos: Tensor, dof_vel: Tensor) -> Tensor:
        """Compute torques (N, D) [N m] at joint angles [rad] and velocities [rad/s], each (N, D), for one physics step."""
        if self.control_type == "P":
            torques = torch.addcmul(self.stiffness * (self._target - dof_pos), self.damping, dof_vel, value=-1.0)
        elif self.control_type == "V":
            acceleration = (dof_vel - self._last_dof_vel) / self.sim_dt
            torques = self.stiffness * (self._target - dof_vel) - self.damping * acceleration
            self._last_dof_vel.copy_(dof_vel)
        else:
            torques = self._target
        return torch.clamp(torques, self._lowest_torques, self.torque_limits, out=self.torques)

    def reset(self, mask: Tensor) -> None:
        """Forget the past of the robots in `mask`, for the law that has one."""
        if self.control_type == "V":
            masked_set_(self._last_dof_vel, mask, 0.0)


def control_gains(robot: Robot, cfg: LeggedControlConfig, where: Callable[[str], str] = str) -> tuple[np.ndarray, np.ndarray]:
    """Return stiffness and damping of a task, (D,): its own tables where it has them, else the robot's. `where` makes of a
    dotted path how an error begins.
    """

    def gains(name: str, own: dict[str, float], of_robot: np.ndarray) -> np.ndarray:
        return robot.gains(own, where(f"control.{name}")) if own else of_robot

    return gains("stiffness", cfg.stiffness, robot.stiffness), gains("damping", cfg.damping, robot.damping)
