"""The interface of all physics engines."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from typing import Any

import mujoco
import torch
from torch import Tensor

from legged.errors import suggest
from legged.physics.robot_state import RobotState
from legged.state import take


class Physics(ABC):
    """N independent worlds in one engine, in MuJoCo's generalised coordinates. Each subclass converts between its engine's
    conventions and MuJoCo's. All tensors are allocated once and written in place.
    """

    num_envs: int
    dt: float
    """Duration of a physics step [s]."""
    device: torch.device
    capturable: bool
    """True if step, refresh, write and push may run inside a CUDA graph capture."""
    model: mujoco.MjModel
    """MuJoCo model of one world: names, masses, joints, actuators, geometry for rendering."""
    qpos: Tensor
    """(N, nq) float32 positions in MuJoCo's layout, [m] and [rad]. A free joint has seven numbers: its position in the
    world frame, then its orientation (w, x, y, z). `qpos` is up to date after `step`. After `write`, it is up to date once
    `refresh` has run."""
    qvel: Tensor
    """(N, nv) float32 velocities in MuJoCo's layout, [m/s] and [rad/s]. A free joint has six numbers: the linear velocity of
    its origin in the world frame, then its angular velocity in the body frame. `qvel` is up to date whenever `qpos` is."""
    ctrl: Tensor
    """(N, nu) float32 controls, in the unit of the model's actuators ([N m] for motors of gear 1). The task writes them in
    place before a step; they keep their values until written again."""
    group_forces: dict[str, Tensor]
    """Name of two groups of shapes (`Scene.contact_groups`) -> (N, K) largest force [N] of a contact between the groups in
    each of the last K physics steps, the last step first; zero after a reset. It is up to date after `step`."""
    forces: Tensor | None = None
    """(N, B, 6) external forces [N] and torques [N m] at the centres of mass of the B bodies of `model`, in the world frame.
    The task writes them in place; they keep their values until written again or until `write` resets the world. None if the
    task applies no external forces (`make_physics(pushed=False)`)."""
    robot_state: RobotState | None = None
    """State of a robot with a floating base and feet; None for any other model."""
    why_library: str = ""
    """Reason why the engine's library (mujoco-warp), not legged's fused step, computes parts of a step. Empty if the fused
    step computes all parts, or if the engine has no fused step."""
    why_c_engine: str = ""
    """Reason why `sim.physics=auto` chose the C engine for `MANY_WORLDS` or more worlds. Empty in all other cases."""
    compiled: int = 0
    """Number of kernel modules that were not in the cache and were compiled for this physics."""
    overflowed: Tensor
    """(N,) bool: True for worlds that lost contacts or constraint rows since the last refresh, for lack of memory."""
    on_device: Callable[[], AbstractContextManager[Any]] | None = None
    """Function that returns a context in which Warp launches on the engine's device and torch's current stream; None if the
    engine does not use Warp."""
    library_step: Callable[[], None] | None = None
    """Physics step of the engine's library, for comparison with the fused step; None if `step` is the library's step."""
    _quantities: dict[str, Tensor]
    """Name -> tensor that `quantity` returns."""

    @abstractmethod
    def step(self) -> None:
        """Advance by dt with the controls `ctrl`. This updates `qpos` and `qvel`; `refresh` updates all other outputs."""

    @abstractmethod
    def refresh(self) -> None:
        """Compute all outputs from the engine's state, by kinematics alone. Contact forces remain those of the last step."""

    @abstractmethod
    def write(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Set the state of the worlds in `mask` (N,) to `qpos` (N, nq) and `qvel` (N, nv), with the layout and frames of the
        attributes `qpos` and `qvel`.

        This clears the controls, activations, contact forces and warm starts of these worlds. Other worlds do not change.
        """

    @abstractmethod
    def push(self, mask: Tensor, delta: Tensor) -> None:
        """Add `delta` (N, K) to the first K columns of `qvel` in the worlds of `mask` (N,). If the model has a
        floating base, the first three columns are the base's linear velocity in the world frame [m/s].
        """

    @abstractmethod
    def randomize(self, field: str, values: Tensor) -> None:
        """Set a field of the table `fields.FIELDS` at start-up. `values` holds one number for each world, (N,), or one
        for each body, joint or shape that the field changes, (N, rows). They replace earlier values of the field.

        Raises:
            ValueError: the physics was not made for this field, or the values have another shape.
        """

    @abstractmethod
    def prepare_redraws(self, drawn: Tensor, columns: Mapping[str, slice], fields: Collection[str]) -> None:
        """Prepare `redraw` for `fields`, which must not be derived fields (`Field.derived`). Every `redraw` reads the random
        values in `drawn` (N, V). `columns` maps a field to its columns of `drawn`: one for all bodies, joints or shapes that
        the field changes, or one for each. `columns` must also contain other randomised fields that change the same arrays.
        """

    @abstractmethod
    def redraw(self, mask: Tensor) -> None:
        """Apply the current values of `drawn` (see `prepare_redraws`) to the model arrays of the worlds in `mask` (N,). If
        the engine is `capturable`, a CUDA graph may capture this.
        """

    @abstractmethod
    def set_variants(self, values: Mapping[str, Tensor]) -> None:
        """Prepare K variants of the model. For each derived field (`Field.derived`), `values` holds numbers: (K, 1), or
        (K, rows) with one for each body or joint that the field changes. For all engines, C MuJoCo computes the constants
        `fields.DERIVED`, in about 0.05 ms for each variant.
        """

    @abstractmethod
    def choose_variants(self, mask: Tensor, chosen: Tensor) -> None:
        """Give each world in `mask` (N,) the masses, inertias and derived constants of a variant; `chosen` (N,) int64 holds
        the variant's index for each world. If the engine is `capturable`, a CUDA graph may capture this.
        """

    def quantity(self, name: str) -> Tensor:
        """Return the array of MuJoCo's data named `name`: (N, ...) float32 in MuJoCo's layout, frames and units. The tables
        `quantities.STAGES` and `LAST_STEP` list the names. Every call returns the same tensor; `refresh` updates it.

        Raises:
            ValueError: the physics was not made for this quantity.
        """
        if name not in self._quantities:
            hint = suggest(name, self._quantities, "it was made for")
            raise ValueError(f"quantity: the physics was not made for '{name}'{hint}")
        return self._quantities[name]

    @abstractmethod
    def state_tensors(self) -> dict[str, Tensor]:
        """Return the arrays (N, ...) that, with `ctrl`, determine the following steps. Outputs of the last step are included.
        After `load_state` with copies of these arrays, the engine repeats the same steps; on a CPU they are bit-identical.
        """

    def _shared_state(self) -> dict[str, Tensor]:
        """Return those of `state_tensors` that do not depend on the engine."""
        state = {f"forces_{name}": forces for name, forces in self.group_forces.items()}
        if self.robot_state is not None:
            state["contact_forces"] = self.robot_state.contact_forces
        if self.forces is not None:
            state["forces"] = self.forces
        return state

    def _clear_groups(self, mask: Tensor) -> None:
        """Set `group_forces` to zero in the worlds of `mask` (N,)."""
        for forces in self.group_forces.values():
            forces.masked_fill_(mask.view(-1, 1), 0.0)

    def load_state(self, saved: Mapping[str, Tensor]) -> None:
        """Set all worlds to the state `saved` (a copy of `state_tensors`), and call `refresh`.

        Raises:
            StateError: the state belongs to another engine, another model, or another number of worlds.
        """
        take(self.state_tensors(), saved, type(self).__name__)
        self.refresh()
        if self.robot_state is not None:  # `refresh` may have written contact forces of another step
            self.robot_state.contact_forces.copy_(saved["contact_forces"])

    @abstractmethod
    def copy_to(self, env_id: int, data: mujoco.MjData) -> None:
        """Copy the positions and velocities of one world into a C MjData, and compute its kinematics, for rendering."""
