"""The interface every physics engine is put behind, and the state it keeps for the task."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import mujoco
import torch
from torch import Tensor

from legged.errors import suggest
from legged.robots.robot import Robot
from legged.state import take

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
        """Set a property per world, (N,), at start-up: `friction` of the robot's shapes [-], `added_base_mass` [kg].

        Raises:
            ValueError: no such field.
        """

    @abstractmethod
    def state_tensors(self) -> dict[str, Tensor]:
        """The engine's own arrays of which a step is a function, (N, ...) each, beside `torques`, and the contact forces:
        copies of them put back by `load_state` give the same steps again, bit by bit on a CPU.
        """

    def load_state(self, saved: Mapping[str, Tensor]) -> None:
        """Put all worlds into a state that was copied from `state_tensors`, and refresh.

        Raises:
            StateError: it is of another engine, robot or number of worlds.
        """
        take(self.state_tensors(), saved, type(self).__name__)
        self.refresh()
        self.state.contact_forces.copy_(saved["contact_forces"])  # the engine still has those of its own last step

    @abstractmethod
    def copy_to(self, env_id: int, data: mujoco.MjData) -> None:
        """One world's positions and velocities into a C MjData, with kinematics computed, for rendering."""


def setter_of(field: str, **setters: Callable[[Tensor], None]) -> Callable[[Tensor], None]:
    """What sets the property `field`, out of a back-end's setters by name.

    Raises:
        ValueError: the back-end cannot randomise that.
    """
    if field not in setters:
        raise ValueError(f"randomize: there is no property '{field}'{suggest(field, setters, 'properties')}")
    return setters[field]


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
