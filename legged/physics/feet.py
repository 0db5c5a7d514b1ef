"""Where the feet of a robot are, and how fast, from its joints: the chains of hinges, and their kinematics in torch."""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor

from legged.errors import ConfigError
from legged.math import quat_to_matrix
from legged.physics.robot_state import RobotState
from legged.robots.robot import Robot


@dataclass(frozen=True)
class FootChains:
    """The hinges between each foot and the base. Arrays are (levels, F, ...), from the foot's body up to the base's
    child; lengths in metres, frames and axes in the body's own frame.
    """

    offset: np.ndarray
    """(F, 3) mean of the centres of the foot's shapes, in their body."""
    joint: np.ndarray
    """(levels, F) index of the hinge among the robot's joints."""
    axis: np.ndarray
    anchor: np.ndarray
    body_pos: np.ndarray
    body_quat: np.ndarray

    @classmethod
    def of(cls, model: mujoco.MjModel, robot: Robot) -> "FootChains":
        """The chains of a robot.

        Raises:
            ConfigError: feet at different depths, or a body in between without exactly one hinge.
        """
        feet = [[model.geom(name) for name in shapes] for shapes in robot.feet_shapes]
        base = model.body(robot.file.base).id
        bodies = [_chain(model, int(geoms[0].bodyid[0]), base) for geoms in feet]
        if len({len(chain) for chain in bodies}) != 1:
            raise ConfigError(f"{robot.folder}: feet: all feet must hang on the same number of bodies")
        body = np.array(bodies, dtype=int).T
        if (model.body_jntnum[body] != 1).any():
            raise ConfigError(f"{robot.folder}: feet: every body between base and foot needs exactly one hinge")
        joint = model.body_jntadr[body]
        return cls(
            offset=np.array([np.mean([geom.pos for geom in geoms], axis=0) for geoms in feet]),
            joint=model.jnt_dofadr[joint] - 6,
            axis=model.jnt_axis[joint],
            anchor=model.jnt_pos[joint],
            body_pos=model.body_pos[body],
            body_quat=model.body_quat[body],
        )


@dataclass(frozen=True)
class _Level:
    """One hinge of each chain, as matrices on vectors in columns."""

    joint: Tensor
    """(F,) index of the hinge."""
    anchor: Tensor
    """(F, 3, 1) [m]"""
    along: Tensor
    """(F, 3, 3) projection on the axis a: a a^T."""
    across: Tensor
    """(F, 3, 3) cross product with it: a x."""
    mount: Tensor | None
    """(F, 3, 3) orientation of the body in its parent; none if all frames are parallel."""
    pos: Tensor
    """(F, 3, 1) place of the body in its parent [m]."""


class FeetKinematics:
    """Forward kinematics of the feet in torch.

    Engines compute them at the start of a step; computed here from the live joint state they are never stale, and
    cost no engine call. Worlds are the last dimension, along which memory runs: with vectors last it takes twice as long.
    """

    def __init__(self, model: mujoco.MjModel, robot: Robot) -> None:
        chains = FootChains.of(model, robot)

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32)

        self._offset = tensor(chains.offset).unsqueeze(2)  # (F, 3, 1)
        columns = np.eye(3)
        self._levels = [
            _Level(
                joint=torch.tensor(joint),
                anchor=tensor(anchor).unsqueeze(2),
                along=tensor(axis[:, :, None] * axis[:, None, :]),
                across=tensor(np.cross(axis[:, None, :], columns).transpose(0, 2, 1)),
                mount=None if np.allclose(quat, [1.0, 0.0, 0.0, 0.0]) else quat_to_matrix(tensor(quat)),
                pos=tensor(pos).unsqueeze(2),
            )
            for joint, anchor, axis, quat, pos in zip(
                chains.joint, chains.anchor, chains.axis, chains.body_quat, chains.body_pos, strict=True
            )
        ]

    def write(self, state: RobotState) -> None:
        """The live base and joint state -> state.feet_pos [m] and state.feet_vel [m/s], (N, F, 3), world frame."""
        feet, worlds = len(self._offset), len(state.base_pos)
        angles, rates = state.dof_pos.t().contiguous(), state.dof_vel.t().contiguous()
        moved = torch.zeros(feet, 3, 2, worlds)  # points and their velocities, in the base frame at the end
        moved[:, :, 0] = self._offset
        for level in self._levels:
            moved[:, :, 0] -= level.anchor
            angle = angles[level.joint].view(feet, 1, 1, worlds)
            along, across = (_apply(matrix, moved) for matrix in (level.along, level.across))
            moved = along + torch.cos(angle) * (moved - along) + torch.sin(angle) * across  # Rodrigues' formula
            rate = rates[level.joint].unsqueeze(1)
            moved[:, :, 1] += rate * (level.across @ moved[:, :, 0])
            moved[:, :, 0] += level.anchor
            if level.mount is not None:
                moved = _apply(level.mount, moved)
            moved[:, :, 0] += level.pos
        point, velocity = moved.unbind(2)
        omega = state.base_ang_vel.t().contiguous().expand_as(point)
        velocity += state.base_lin_vel.t() + torch.linalg.cross(omega, point, dim=1)
        turn = quat_to_matrix(state.base_quat).permute(1, 2, 0)  # (3, 3, N)
        moved = (turn[:, :, None] * moved.unsqueeze(1)).sum(dim=2)
        position, velocity = moved.permute(2, 3, 0, 1)
        torch.add(state.base_pos.unsqueeze(1), position, out=state.feet_pos)
        state.feet_vel.copy_(velocity)


def _apply(matrix: Tensor, moved: Tensor) -> Tensor:
    """(F, 3, 3) on the second dimension of (F, 3, 2, N)."""
    return (matrix @ moved.flatten(2)).view_as(moved)


def _chain(model: mujoco.MjModel, body: int, base: int) -> list[int]:
    """Bodies from `body` up to the child of `base`."""
    chain = []
    while body not in (0, base):
        chain.append(body)
        body = int(model.body_parentid[body])
    return chain
