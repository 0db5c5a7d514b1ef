"""Forward kinematics of a robot's feet: chains of hinges between base and feet, evaluated in torch."""

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
    """Driven and passive hinges between each foot and the base. Arrays are (levels, F, ...), with levels ordered from the
    foot to the base; lengths are in metres. Each hinge has its own frame, in which `axis` and `anchor` are given. `body_pos`
    and `body_quat` are the pose of this frame at angle 0 in the frame of the next hinge.
    """

    offset: np.ndarray
    """(F, 3) centre of the foot (the mean of its shapes' centres) in the frame of the hinge next to it."""
    position: np.ndarray
    """(levels, F) index of the hinge's angle in MuJoCo's generalised positions; `speed` is the index of its velocity."""
    speed: np.ndarray
    axis: np.ndarray
    anchor: np.ndarray
    body_pos: np.ndarray
    """(levels, F, 3) position of the hinge's frame; `body_quat` is the orientation of this frame."""
    body_quat: np.ndarray

    @classmethod
    def of(cls, model: mujoco.MjModel, robot: Robot) -> "FootChains":
        """Return the chains of hinges of a robot.

        Raises:
            ConfigError: the feet have different numbers of hinges, or a joint between base and foot is not a hinge.
        """
        base = model.body(robot.file.base).id
        feet, offsets = [], []
        for shapes in robot.feet_shapes:
            geoms = [model.geom(name) for name in shapes]
            offset = np.mean([geom.pos for geom in geoms], axis=0)
            chain, offset = _hinges(model, int(geoms[0].bodyid[0]), base, offset, f"{robot.folder}: feet")
            feet.append(chain)
            offsets.append(offset)
        if len({len(chain) for chain in feet}) != 1 or not feet[0]:
            raise ConfigError(
                f"{robot.folder}: feet: all feet must have the same number of hinges between foot and base, and at least one"
            )
        levels = list(zip(*feet, strict=True))
        return cls(
            offset=np.array(offsets),
            position=np.array([[model.jnt_qposadr[hinge.joint] for hinge in level] for level in levels]),
            speed=np.array([[model.jnt_dofadr[hinge.joint] for hinge in level] for level in levels]),
            axis=np.array([[model.jnt_axis[hinge.joint] for hinge in level] for level in levels]),
            anchor=np.array([[model.jnt_pos[hinge.joint] for hinge in level] for level in levels]),
            body_pos=np.array([[hinge.pos for hinge in level] for level in levels]),
            body_quat=np.array([[hinge.quat for hinge in level] for level in levels]),
        )


@dataclass
class _Hinge:
    """A hinge, and the pose of its frame at angle 0 in the frame of the next hinge towards the base."""

    joint: int
    pos: np.ndarray
    quat: np.ndarray


def _hinges(model: mujoco.MjModel, body: int, base: int, offset: np.ndarray, where: str) -> tuple[list[_Hinge], np.ndarray]:
    """Return the hinges from `body` up to `base`. Also convert the point `offset` from the frame of `body` to the frame of
    the first hinge, and return it. A body may have no hinge (if it is welded to its parent) or several. Error
    messages begin with `where`.

    Raises:
        ConfigError: a joint is not a hinge.
    """
    found: list[_Hinge] = []
    while body not in (0, base):
        for joint in reversed(range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])):
            if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
                raise ConfigError(f"{where}: joint '{model.joint(joint).name}' between base and foot is not a hinge")
            found.append(_Hinge(joint, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])))
            # A model gives the poses of bodies at the joints' reference angles.
            if model.qpos0[model.jnt_qposadr[joint]] != 0.0:
                _turn_back(model, found[-1])
        if found:
            found[-1].pos, found[-1].quat = _moved(model, body, found[-1].pos, found[-1].quat)
        else:
            offset, _ = _moved(model, body, offset, np.array([1.0, 0.0, 0.0, 0.0]))
        body = int(model.body_parentid[body])
    return found, offset


def _turn_back(model: mujoco.MjModel, hinge: _Hinge) -> None:
    """Rotate a hinge's frame about the hinge's anchor, from the reference angle to angle 0."""
    anchor, turned = model.jnt_pos[hinge.joint], np.zeros(3)
    reference = float(model.qpos0[model.jnt_qposadr[hinge.joint]])
    mujoco.mju_axisAngle2Quat(hinge.quat, model.jnt_axis[hinge.joint], -reference)
    mujoco.mju_rotVecQuat(turned, -anchor, hinge.quat)
    hinge.pos = anchor + turned


def _moved(model: mujoco.MjModel, body: int, pos: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert a pose from a body's frame to its parent's frame, at the joints' reference angles. The identity pose becomes
    exactly the body's pose in the model.
    """
    if not pos.any() and quat[0] == 1.0:
        return model.body_pos[body].copy(), model.body_quat[body].copy()
    turned, both = np.zeros(3), np.zeros(4)
    mujoco.mju_rotVecQuat(turned, pos, model.body_quat[body])
    mujoco.mju_mulQuat(both, model.body_quat[body], quat)
    return model.body_pos[body] + turned, both


@dataclass(frozen=True)
class _Level:
    """One hinge of every chain, as matrices that act on column vectors."""

    position: Tensor
    """(F,) index of the hinge's angle in the positions; `speed` is the index of its velocity."""
    speed: Tensor
    anchor: Tensor
    """(F, 3, 1) position of the hinge's anchor in the hinge's frame [m]."""
    along: Tensor
    """(F, 3, 3) projection on the axis a: a a^T."""
    across: Tensor
    """(F, 3, 3) matrix of the cross product with the axis a: it maps v to a x v."""
    mount: Tensor | None
    """(F, 3, 3) orientation of the hinge's frame in the next frame; None if all these frames are parallel."""
    pos: Tensor
    """(F, 3, 1) position of the hinge's frame in the next frame [m]."""


class FeetKinematics:
    """Forward kinematics of the feet in torch.

    After a step, an engine's own kinematics are those of the step's start. This class computes the kinematics from the
    current joint state, without a call of the engine. The last dimension of all arrays counts worlds, because the
    computation takes twice as long if the last dimension counts x, y and z.
    """

    def __init__(self, model: mujoco.MjModel, robot: Robot, qpos: Tensor, qvel: Tensor) -> None:
        """Prepare to read `qpos` (N, nq) and `qvel` (N, nv), the current coordinates in MuJoCo's layout."""
        self._qpos, self._qvel = qpos, qvel
        chains = FootChains.of(model, robot)

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32)

        self._offset = tensor(chains.offset).unsqueeze(2)  # (F, 3, 1)
        columns = np.eye(3)
        self._levels = [
            _Level(
                position=torch.tensor(position),
                speed=torch.tensor(speed),
                anchor=tensor(anchor).unsqueeze(2),
                along=tensor(axis[:, :, None] * axis[:, None, :]),
                across=tensor(np.cross(axis[:, None, :], columns).transpose(0, 2, 1)),
                mount=None if np.allclose(quat, [1.0, 0.0, 0.0, 0.0]) else quat_to_matrix(tensor(quat)),
                pos=tensor(pos).unsqueeze(2),
            )
            for position, speed, anchor, axis, quat, pos in zip(
                chains.position, chains.speed, chains.anchor, chains.axis, chains.body_quat, chains.body_pos, strict=True
            )
        ]

    def write(self, state: RobotState) -> None:
        """Compute `state.feet_pos` [m] and `state.feet_vel` [m/s], (N, F, 3), world frame, from the base and joint state."""
        feet, worlds = len(self._offset), len(state.base_pos)
        angles, rates = self._qpos.t().contiguous(), self._qvel.t().contiguous()
        moved = torch.zeros(feet, 3, 2, worlds)  # [:, :, 0]: positions, [:, :, 1]: velocities
        moved[:, :, 0] = self._offset
        for level in self._levels:
            moved[:, :, 0] -= level.anchor
            angle = angles[level.position].view(feet, 1, 1, worlds)
            along, across = (_apply(matrix, moved) for matrix in (level.along, level.across))
            moved = along + torch.cos(angle) * (moved - along) + torch.sin(angle) * across  # Rodrigues' formula
            rate = rates[level.speed].unsqueeze(1)
            moved[:, :, 1] += rate * (level.across @ moved[:, :, 0])
            moved[:, :, 0] += level.anchor
            if level.mount is not None:
                moved = _apply(level.mount, moved)
            moved[:, :, 0] += level.pos
        point, velocity = moved.unbind(2)  # in the base frame
        omega = state.base_ang_vel.t().contiguous().expand_as(point)
        velocity += state.base_lin_vel.t() + torch.linalg.cross(omega, point, dim=1)
        turn = quat_to_matrix(state.base_quat).permute(1, 2, 0)  # (3, 3, N)
        moved = (turn[:, :, None] * moved.unsqueeze(1)).sum(dim=2)
        position, velocity = moved.permute(2, 3, 0, 1)
        torch.add(state.base_pos.unsqueeze(1), position, out=state.feet_pos)
        state.feet_vel.copy_(velocity)


def _apply(matrix: Tensor, moved: Tensor) -> Tensor:
    """Apply matrices (F, 3, 3) to the second dimension of `moved` (F, 3, 2, N)."""
    return (matrix @ moved.flatten(2)).view_as(moved)
