"""Arrays of MuJoCo's data that a task may request, and the computation that each one needs."""

from collections.abc import Collection

import mujoco

from legged.errors import suggest

STAGES = {
    "xpos": mujoco.mjtStage.mjSTAGE_POS,
    "xquat": mujoco.mjtStage.mjSTAGE_POS,
    "subtree_com": mujoco.mjtStage.mjSTAGE_POS,
    "cinert": mujoco.mjtStage.mjSTAGE_POS,
    "cvel": mujoco.mjtStage.mjSTAGE_VEL,
}
"""Quantity -> forward stage that updates it. All are (N, nbody, ...) in the world frame: positions [m] and orientations (w,
x, y, z) of bodies; centres of mass of subtrees [m]; inertias (10) and velocities (6: angular, linear) of bodies about the
centre of mass of their kinematic tree."""
LAST_STEP = ("qfrc_actuator",)
"""Quantities that a step computes and `Physics.write` clears: (N, nv) generalised actuator forces [N m] or [N]."""


def check_quantities(names: Collection[str]) -> None:
    """Check that all `names` are quantities.

    Raises:
        ValueError: a name is not in `STAGES` or `LAST_STEP`.
    """
    for name in names:
        if name not in STAGES and name not in LAST_STEP:
            raise ValueError(f"there is no quantity '{name}'{suggest(name, (*STAGES, *LAST_STEP), 'quantities')}")


def stage_of(names: Collection[str]) -> int:
    """Return the last forward stage that `names` need, or 0 if they need no stage."""
    return max((int(STAGES[name]) for name in names if name in STAGES), default=0)
