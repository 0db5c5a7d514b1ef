"""The interface that every physics engine is put behind."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING

import mujoco
import torch
from torch import Tensor

from legged.physics.quantities import found
from legged.physics.robot_state import RobotState
from legged.state import take

if TYPE_CHECKING:
    from legged.physics.warp.task_kernels import TaskKernels


class Physics(ABC):
    """N independent worlds in one engine, in MuJoCo's generalised coordinates. Back-ends convert their engine's
    conventions; nobody else sees them. All tensors are allocated once and written in place.
    """

    num_envs: int
    dt: float
    """Physics step [s]."""
    device: torch.device
    capturable: bool
    """Whether step, refresh, write and push may run inside a CUDA graph capture."""
    model: mujoco.MjModel
    """One world in MuJoCo: names, masses, joints, actuators, pictures."""
    qpos: Tensor
    """(N, nq) float32 positions in MuJoCo's layout: [m] and [rad]; of a free joint the position, world frame, and the
    orientation (w, x, y, z). Live after a step, and after a refresh what was written."""
    qvel: Tensor
    """(N, nv) float32 velocities in MuJoCo's layout: [m/s] and [rad/s]; of a free joint the linear one of its origin, world
    frame, then the angular one, body frame. Live as `qpos`."""
    ctrl: Tensor
    """(N, nu) float32 controls, in the unit that the model's actuators take ([N m] for motors of gear 1); the task writes
    them in place before a step, and they are held until written again."""
    forces: Tensor | None = None
    """(N, B, 6) forces and torques on the bodies of `model` [N], [N m], world frame, at their centres of mass, which the task
    writes in place; held until written again, or until a world is. None where the physics was not told of any."""
    robot_state: RobotState | None = None
    """What is seen of a robot with a floating base and feet; None for any other model."""
    why_library: str = ""
    """Why some of a step are an engine's own launches, where ours could take their place; empty where they do, or where there
    are none."""
    why_c_engine: str = ""
    """Why it is the C engine, where `auto` would take our own step for so many worlds; empty elsewhere."""
    fitted: str = ""
    """Which simple shapes stand for meshes, because the collider of the terrain knows none; empty if none do."""
    compiled: int = 0
    """Modules of kernels that were compiled when it was built, because the cache lacked them."""
    overflowed: Tensor
    """(N,) bool: worlds that lost contacts or constraint rows for want of memory since the last refresh."""
    kernels: "TaskKernels | None" = None
    """What parts of a task take in place of torch's launches, where an engine can launch its own."""
    library_step: Callable[[], None] | None = None
    """A physics step as the engine's library makes it by itself, to compare with, where ours is another one."""
    _quantities: dict[str, Tensor]
    """Those that were asked for, by name."""

    @abstractmethod
    def step(self) -> None:
        """Advance by dt under `ctrl`; `qpos` and `qvel` are live afterwards, the rest after refresh."""

    @abstractmethod
    def refresh(self) -> None:
        """Make all that is seen agree with the engine: kinematics, no dynamics; forces stay those of the last step."""

    @abstractmethod
    def write(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put the worlds of `mask` (N,) into a state: `qpos` (N, nq) and `qvel` (N, nv), layout and frames as those here.

        Clears their controls, activations, contact forces and the solver's warm start; other worlds stay bit-identical.
        """

    @abstractmethod
    def push(self, mask: Tensor, delta: Tensor) -> None:
        """Add `delta` (N, K) to the first K of `qvel` in the worlds of `mask` (N,): with a floating base, to its linear
        velocity, world frame [m/s], first.
        """

    @abstractmethod
    def randomize(self, field: str, values: Tensor) -> None:
        """Give a field of the table `fields.FIELDS` its values, at start-up: (N,), one per world, or (N, rows), one for each
        thing that has the property. They take the place of values given before.

        Raises:
            ValueError: the field is none of those that the physics was made for, or the values have another shape.
        """

    @abstractmethod
    def prepare_redraws(self, drawn: Tensor, columns: Mapping[str, slice], fields: Collection[str]) -> None:
        """Prepare for `redraw` of `fields`, none of them one that others are derived from: `columns` says where in `drawn`
        (N, V), always the same tensor, the values of each field are, one for a world or one for each row. Those of all
        fields are there that `fields` share an array with.
        """

    @abstractmethod
    def redraw(self, mask: Tensor) -> None:
        """Let the worlds of `mask` (N,) have what is in `drawn` now: within a step, which may be captured."""

    @abstractmethod
    def set_variants(self, values: Mapping[str, Tensor]) -> None:
        """Derive the constants of K models, each with the `values` (K, 1) or (K, rows) of fields from which others are
        derived: C MuJoCo does it for all engines, within some 0.05 ms each.
        """

    @abstractmethod
    def choose_variants(self, mask: Tensor, chosen: Tensor) -> None:
        """Let the worlds of `mask` (N,) have the masses, inertias and constants of the models `chosen` (N,) int64: within a
        step, which may be captured.
        """

    def quantity(self, name: str) -> Tensor:
        """Return a derived array of MuJoCo's data by its name there, (N, ...) float32 in MuJoCo's layout, frames and units
        (`quantities.STAGES` and `LAST_STEP`); always the same tensor, current after a refresh.

        Raises:
            ValueError: it was not asked for when the physics was made.
        """
        return found(name, self._quantities)

    @abstractmethod
    def state_tensors(self) -> dict[str, Tensor]:
        """Return the engine's own arrays of which a step is a function, (N, ...) each, beside `ctrl`, and what is
        seen of the last step: copies of them put back by `load_state` give the same steps again, bit by bit on a CPU.
        """

    def load_state(self, saved: Mapping[str, Tensor]) -> None:
        """Put all worlds into a state that was copied from `state_tensors`, and refresh.

        Raises:
            StateError: it is of another engine, model or number of worlds.
        """
        take(self.state_tensors(), saved, type(self).__name__)
        self.refresh()
        if self.robot_state is not None:  # the engine still has the forces of its own last step
            self.robot_state.contact_forces.copy_(saved["contact_forces"])

    @abstractmethod
    def copy_to(self, env_id: int, data: mujoco.MjData) -> None:
        """Put one world's positions and velocities into a C MjData, and compute its kinematics, for rendering."""
