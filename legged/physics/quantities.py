"""Arrays of MuJoCo's data that a task may ask for, and what must be computed for each."""

from collections.abc import Collection, Mapping

import mujoco
from torch import Tensor

from legged.errors import suggest

STAGES = {
    "xpos": mujoco.mjtStage.mjSTAGE_POS,
    "xquat": mujoco.mjtStage.mjSTAGE_POS,
    "subtree_com": mujoco.mjtStage.mjSTAGE_POS,
    "cinert": mujoco.mjtStage.mjSTAGE_POS,
    "cvel": mujoco.mjtStage.mjSTAGE_VEL,
}
"""Quantity -> the forward stage that brings it up to date. (N, nbody, ...): positions of bodies [m] and orientations
(w, x, y, z), world frame; centres of mass of subtrees [m]; inertias (10) and velocities (6: angular, linear) about the centre
of mass of the kinematic tree, world frame."""
LAST_STEP = ("qfrc_actuator",)
"""Quantities of the last step, zero after a write: (N, nv) generalised forces of actuators [N m] or [N]."""


def check_quantities(names: Collection[str]) -> None:
    """Raises ValueError where one of `names` is none of those above."""
    for name in names:
        if name not in STAGES and name not in LAST_STEP:
            raise ValueError(f"there is no quantity '{name}'{suggest(name, (*STAGES, *LAST_STEP), 'quantities')}")


def stage_of(names: Collection[str]) -> int:
    """Return the last forward stage that `names` need; 0 for none."""
    return max((int(STAGES[name]) for name in names if name in STAGES), default=0)


def found(name: str, quantities: Mapping[str, Tensor]) -> Tensor:
    """Return the tensor of a quantity.

    Raises:
        ValueError: it was not asked for when the physics was made.
    """
    if name not in quantities:
        raise ValueError(f"quantity: make_physics was not told of '{name}'{suggest(name, quantities, 'it was of')}")
    return quantities[name]
