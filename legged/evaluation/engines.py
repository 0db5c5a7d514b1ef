"""The physics engines in which policies are measured: settings, labels and line styles."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

from legged.config.schema import NewtonSolver


@dataclass(frozen=True)
class Engine:
    """An engine, or a solver of Newton."""

    label: str
    line: str
    """Line style of the engine's curves, as in matplotlib."""
    marker: str
    overrides: Sequence[tuple[str, Any]] = ()
    """Settings that choose it."""


ENGINES = {
    "mujoco_warp": Engine("mujoco-warp", "-", "o", [("sim.physics", "mujoco_warp")]),
    "mujoco": Engine("C MuJoCo", "--", "s", [("sim.physics", "mujoco")]),
    **{
        f"newton_{name}": Engine(f"Newton, {name}", "-.", "^", [("sim.physics", "newton"), ("sim.solver", name)])
        for name in get_args(NewtonSolver)
    },
}
"""Every engine, by its name from `legged.physics.engine_name`."""


def engine_of(name: str) -> Engine:
    """Return the engine of that name; an unknown engine is labelled by its name."""
    return ENGINES.get(name, Engine(name, ":", "x"))
