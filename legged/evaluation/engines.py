"""The physics engines in which policies are measured: how each is asked for, what it is called and how its curves look."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

from legged.config.schema import NewtonSolver


@dataclass(frozen=True)
class Engine:
    """An engine, or a solver of Newton's."""

    label: str
    line: str
    """Line style of its curves, as matplotlib writes it."""
    marker: str
    overrides: Sequence[tuple[str, Any]] = ()
    """Settings that ask for it."""


ENGINES = {
    "mujoco_warp": Engine("mujoco-warp", "-", "o", [("sim.physics", "mujoco_warp")]),
    "mujoco": Engine("C MuJoCo", "--", "s", [("sim.physics", "mujoco")]),
    **{
        f"newton_{name}": Engine(f"Newton, {name}", "-.", "^", [("sim.physics", "newton"), ("sim.solver", name)])
        for name in get_args(NewtonSolver)
    },
}
"""Every engine, by the name that `legged.physics.engine_name` gives it."""


def engine_of(name: str) -> Engine:
    """Return the engine of that name; one of which this version knows nothing is called by its name."""
    return ENGINES.get(name, Engine(name, ":", "x"))
