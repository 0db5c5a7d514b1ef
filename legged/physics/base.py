"""The interface every physics engine is put behind, and the state it keeps for the task."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from legged.config.loader import ConfigError
from legged.math import quat_rotate
from legged.robot import Robot

RandomizedField = Literal["friction", "added_base_mass"]


@dataclass(frozen=True)
class RobotState:
    """What the task sees of N robots: float32 tensors, allocated once, written in place by the physics back-end.

    D joints and F feet in the robot's order, B tracked collision shapes (`Robot.contact_names`).
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
    """(N, F, 3) centres of the foot shapes, world frame [m]."""
    feet_vel: Tensor
    """(N, F, 3) velocities of those points, world frame [m/s]."""
    contact_forces: Tensor
    """(N, B, 3) sum of contact forces on each tracked shape, world frame, at the last physics step [N]; zero after a
    reset."""


class Physics(ABC):
    """N independent worlds with one robot each. Back-ends convert their engine's conventions; nobody else sees them."""

    num_envs: int
    dt: float
    """Physics step [s]."""
    device: torch.device
    state: RobotState
    capturable: bool
    """Whether step, refresh, write_state and push may run inside a CUDA graph capture."""
    torques: Tensor
    """(N, D) joint torques [N m]; written by the task before a step, in place, and held until written again."""
    overflowed: Tensor
    """(N,) bool: worlds that lost contacts or constraint rows for want of memory since the last refresh."""

    @abstractmethod
    def step(self) -> None:
        """Advance by dt under `torques`; dof_pos and dof_vel are live afterwards, the rest after refresh."""

    @abstractmethod
    def refresh(self) -> None:
        """Make all of `state` agree with the engine: kinematics, no dynamics; forces stay those of the last step."""

    @abstractmethod
    def write_state(
        self,
        mask: Tensor,
        base_pos: Tensor,
        base_quat: Tensor,
        base_lin_vel: Tensor,
        base_ang_vel: Tensor,
        dof_pos: Tensor,
        dof_vel: Tensor,
    ) -> None:
        """Put the worlds of `mask` (N,) into a state given in the frames of RobotState.

        Clears their torques, contact forces and the solver's warm start; other worlds stay bit-identical.
        """

    @abstractmethod
    def push(self, mask: Tensor, lin_vel_xy: Tensor) -> None:
        """Change the base's horizontal velocity by lin_vel_xy (N, 2), world frame [m/s], in the worlds of `mask`."""

    @abstractmethod
    def randomize(self, field: RandomizedField, values: Tensor) -> None:
        """Set a property per world, (N,), at start-up: `friction` of the robot's shapes [-], `added_base_mass` [kg]."""

    @abstractmethod
    def copy_to(self, env_id: int, data: mujoco.MjData) -> None:
        """One world's positions and velocities into a C MjData, with kinematics computed, for rendering."""


def allocate_state(num_envs: int, robot: Robot, device: torch.device) -> RobotState:
    """Zeroed tensors for every field."""

    def zeros(*shape: int) -> Tensor:
        return torch.zeros(num_envs, *shape, device=device)

    dofs, feet, shapes = robot.num_dof, len(robot.feet_indices), len(robot.contact_names)
    return RobotState(
        base_pos=zeros(3),
        base_quat=zeros(4),
        base_lin_vel=zeros(3),
        base_lin_vel_w=zeros(3),
        base_ang_vel=zeros(3),
        projected_gravity=zeros(3),
        dof_pos=zeros(dofs),
        dof_vel=zeros(dofs),
        feet_pos=zeros(feet, 3),
        feet_vel=zeros(feet, 3),
        contact_forces=zeros(shapes, 3),
    )


@dataclass(frozen=True)
class FootChains:
    """The hinges between each foot and the base. Arrays are (levels, F, ...), from the foot's body up to the base's
    child; lengths in metres, frames and axes in the body's own frame.
    """

    offset: np.ndarray
    """(F, 3) centre of the foot shape in its body."""
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
        geoms = [model.geom(name) for name in robot.feet_names]
        base = model.body(robot.file.base).id
        bodies = [_chain(model, int(geom.bodyid[0]), base) for geom in geoms]
        if len({len(chain) for chain in bodies}) != 1:
            raise ConfigError(f"{robot.folder}: feet: all feet must hang on the same number of bodies")
        body = np.array(bodies, dtype=int).T
        if (model.body_jntnum[body] != 1).any():
            raise ConfigError(f"{robot.folder}: feet: every body between base and foot needs exactly one hinge")
        joint = model.body_jntadr[body]
        return cls(
            offset=np.array([geom.pos for geom in geoms]),
            joint=model.jnt_dofadr[joint] - 6,
            axis=model.jnt_axis[joint],
            anchor=model.jnt_pos[joint],
            body_pos=model.body_pos[body],
            body_quat=model.body_quat[body],
        )


class FeetKinematics:
    """Forward kinematics of the feet in torch.

    Engines compute them at the start of a step; computed here from the live joint state they are never stale, and
    cost no engine call.
    """

    def __init__(self, model: mujoco.MjModel, robot: Robot) -> None:
        chains = FootChains.of(model, robot)

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32)

        self.offset = tensor(chains.offset)
        tables = (chains.axis, chains.anchor, chains.body_pos, chains.body_quat)
        self.levels = list(zip(torch.tensor(chains.joint), *map(tensor, tables), strict=True))
        self.turned = not np.allclose(chains.body_quat, [1.0, 0.0, 0.0, 0.0])

    def write(self, state: RobotState) -> None:
        """The live base and joint state -> state.feet_pos, state.feet_vel."""
        worlds, feet = state.feet_pos.shape[:2]
        point = self.offset.expand(worlds, feet, 3)
        velocity = torch.zeros_like(point)
        for joint, axis, anchor, pos, quat in self.levels:
            angle, rate = state.dof_pos[:, joint].unsqueeze(2), state.dof_vel[:, joint].unsqueeze(2)
            axis = axis.expand_as(point)
            point = _turn(point - anchor, axis, angle)
            velocity = _turn(velocity, axis, angle) + rate * torch.linalg.cross(axis, point)
            point = point + anchor
            if self.turned:
                flat = quat.repeat(worlds, 1)
                point = quat_rotate(flat, point.reshape(-1, 3)).view_as(point)
                velocity = quat_rotate(flat, velocity.reshape(-1, 3)).view_as(point)
            point = point + pos
        omega = state.base_ang_vel.unsqueeze(1).expand_as(point)
        velocity = velocity + state.base_lin_vel.unsqueeze(1) + torch.linalg.cross(omega, point)
        quat = state.base_quat.repeat_interleave(feet, dim=0)
        position = quat_rotate(quat, point.reshape(-1, 3)).view_as(point)
        torch.add(state.base_pos.unsqueeze(1), position, out=state.feet_pos)
        state.feet_vel.copy_(quat_rotate(quat, velocity.reshape(-1, 3)).view_as(point))


def _chain(model: mujoco.MjModel, body: int, base: int) -> list[int]:
    """Bodies from `body` up to the child of `base`."""
    chain = []
    while body not in (0, base):
        chain.append(body)
        body = int(model.body_parentid[body])
    return chain


def _turn(vec: Tensor, axis: Tensor, angle: Tensor) -> Tensor:
    """Rodrigues' formula: `vec` turned by `angle` about the unit vector `axis`."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    along = (axis * vec).sum(dim=2, keepdim=True)
    return cos * vec + sin * torch.linalg.cross(axis, vec) + (1.0 - cos) * along * axis
