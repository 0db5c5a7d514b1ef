"""What the task sees of a robot with a floating base and feet."""

from dataclasses import dataclass

import torch
from torch import Tensor

from legged.robots.robot import Robot


@dataclass(frozen=True)
class RobotState:
    """What the task sees of N robots: float32 tensors, allocated once, written in place by the physics engine. Those that
    `Physics.qpos` and `Physics.qvel` hold are views of them, live after a step; the others are current after a refresh.

    D joints and F feet in the robot's order, B contacts (`Robot.contact_names`).
    """

    base_pos: Tensor
    """(N, 3) origin of the base, world frame [m]."""
    base_quat: Tensor
    """(N, 4) orientation of the base, (w, x, y, z)."""
    base_lin_vel: Tensor
    """(N, 3) velocity of the base's origin, base frame [m/s]."""
    base_lin_vel_w: Tensor
    """(N, 3) the same, world frame [m/s]."""
    base_ang_vel: Tensor
    """(N, 3) angular velocity of the base, base frame [rad/s]."""
    projected_gravity: Tensor
    """(N, 3) unit vector of gravity, base frame; (0, 0, -1) when level."""
    dof_pos: Tensor
    """(N, D) joint angles [rad]."""
    dof_vel: Tensor
    """(N, D) joint velocities [rad/s]."""
    feet_pos: Tensor
    """(N, F, 3) centres of the feet, world frame [m]: of a foot of several shapes the mean of theirs."""
    feet_vel: Tensor
    """(N, F, 3) velocities of those points, world frame [m/s]."""
    contact_forces: Tensor
    """(N, B, 3) sum of contact forces on each collision shape, or on all of a foot, world frame, at the last physics step
    [N]; zero after a reset."""


class DrivenJoints:
    """Angles and velocities of the joints with a motor, copied out of the generalised coordinates where passive joints lie
    between them. Where none does, RobotState has views, and there is nothing to copy.
    """

    def __init__(self, qpos: Tensor, qvel: Tensor, state: RobotState, robot: Robot) -> None:
        """Copy from `qpos` (N, nq) and `qvel` (N, nv) into `state`, in place."""
        pairs = ((qpos, state.dof_pos, robot.qpos_columns), (qvel, state.dof_vel, robot.qvel_columns))
        self._pairs = [
            (source, target, torch.tensor(columns, device=source.device))
            for source, target, columns in pairs
            if source.untyped_storage().data_ptr() != target.untyped_storage().data_ptr()
        ]

    def read(self) -> None:
        """Bring them up to date."""
        for source, target, columns in self._pairs:
            torch.index_select(source, 1, columns, out=target)


def robot_state(qpos: Tensor, qvel: Tensor, robot: Robot) -> RobotState:
    """Return the state of robots whose generalised positions are `qpos` (N, nq) and velocities `qvel` (N, nv): views of them
    where they hold a field, zeroed tensors elsewhere.
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
    """Return those columns of an array (N, K) as a view, if they lie side by side, else zeros of their shape."""
    first, count = columns[0], len(columns)
    if columns == tuple(range(first, first + count)):
        return array[:, first : first + count]
    return torch.zeros(len(array), count, device=array.device)
