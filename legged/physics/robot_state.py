"""State of a robot with a floating base and feet, as the task reads it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from legged.robots.robot import Robot


@dataclass(frozen=True)
class RobotState:
    """State of N robots, as the task reads it: float32 tensors, allocated once, which the physics engine writes in place.
    Fields that are views of `Physics.qpos` or `Physics.qvel` are up to date after a step; all others are up to date after a
    refresh.

    D joints and F feet are in the robot's order; B is the number of contacts (`Robot.contact_names`).
    """

    base_pos: Tensor
    """(N, 3) origin of the base, world frame [m]."""
    base_quat: Tensor
    """(N, 4) orientation of the base, (w, x, y, z)."""
    base_lin_vel: Tensor
    """(N, 3) velocity of the base's origin, base frame [m/s]."""
    base_lin_vel_w: Tensor
    """(N, 3) velocity of the base's origin, world frame [m/s]."""
    base_ang_vel: Tensor
    """(N, 3) angular velocity of the base, base frame [rad/s]."""
    projected_gravity: Tensor
    """(N, 3) unit vector of gravity, base frame; (0, 0, -1) when level."""
    dof_pos: Tensor
    """(N, D) joint angles [rad]."""
    dof_vel: Tensor
    """(N, D) joint velocities [rad/s]."""
    feet_pos: Tensor
    """(N, F, 3) centres of the feet, world frame [m]. The centre of a foot of several shapes is the mean of their centres."""
    feet_vel: Tensor
    """(N, F, 3) velocities of the feet's centres, world frame [m/s]."""
    contact_forces: Tensor
    """(N, B, 3) contact force [N] on each collision shape, or on all shapes of a foot together, world frame, in the last
    physics step; zero after a reset."""


class DrivenJoints:
    """Copies angles and velocities of driven joints from the generalised coordinates if passive joints lie between driven
    ones. For all other robots, RobotState has views, and nothing is copied.
    """

    def __init__(self, qpos: Tensor, qvel: Tensor, state: RobotState, robot: Robot) -> None:
        """Prepare to copy columns of `qpos` (N, nq) and `qvel` (N, nv) into `state`."""
        pairs = ((qpos, state.dof_pos, robot.qpos_columns), (qvel, state.dof_vel, robot.qvel_columns))
        self._pairs = [
            (source, target, torch.tensor(columns, device=source.device))
            for source, target, columns in pairs
            if source.untyped_storage().data_ptr() != target.untyped_storage().data_ptr()
        ]

    def read(self) -> None:
        """Copy the current angles and velocities."""
        for source, target, columns in self._pairs:
            torch.index_select(source, 1, columns, out=target)


def robot_state(qpos: Tensor, qvel: Tensor, robot: Robot) -> RobotState:
    """Return the state of robots with generalised positions `qpos` (N, nq) and velocities `qvel` (N, nv). Its fields are
    views of `qpos` and `qvel` where possible, and zeroed tensors otherwise.
    """

    def zeros(*shape: int) -> Tensor:
        return torch.zeros(len(qpos), *shape, device=qpos.device)

    feet, shapes = len(robot.feet_indices), len(robot.contact_names)
    return RobotState(
        base_pos=qpos[:, :3],
        base_quat=qpos[:, 3:7],
        base_lin_vel=zeros(3),
        base_lin_vel_w=qvel[:, :3],
        base_ang_vel=qvel[:, 3:6],
        projected_gravity=zeros(3),
        dof_pos=_view(qpos, robot.qpos_columns),
        dof_vel=_view(qvel, robot.qvel_columns),
        feet_pos=zeros(feet, 3),
        feet_vel=zeros(feet, 3),
        contact_forces=zeros(shapes, 3),
    )


def _view(array: Tensor, columns: tuple[int, ...]) -> Tensor:
    """Return columns of an array (N, K) as a view if they are contiguous; otherwise return zeros of the same shape."""
    first, count = columns[0], len(columns)
    if columns == tuple(range(first, first + count)):
        return array[:, first : first + count]
    return torch.zeros(len(array), count, device=array.device)
