"""The physics engines in which policies are measured."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, get_args

from legged.config.schema import NewtonSolver


class Engine(NamedTuple):
    """An engine, or a solver of Newton: its name in tables, and the settings that choose it."""

    label: str
    overrides: Sequence[tuple[str, Any]] = ()


ENGINES = {
    "mujoco_warp": Engine("mujoco-warp", [("sim.physics", "mujoco_warp")]),
    "mujoco": Engine("C MuJoCo", [("sim.physics", "mujoco")]),
    **{
        f"newton_{name}": Engine(f"Newton, {name}", [("sim.physics", "newton"), ("sim.solver", name)])
        for name in get_args(NewtonSolver)
    },
}
"""Every engine, by its name from `legged.physics.engine_name`."""


def engine_of(name: str) -> Engine:
    """Return the engine of that name; an unknown engine is labelled by its name."""
    return ENGINES.get(name, Engine(name))


def by_engine(results: Iterable[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return engine -> its result, in the order of ENGINES, others last."""
    found = {result["physics"]: result for result in results}
    return {name: found[name] for name in sorted(found, key=lambda name: [*ENGINES, name].index(name))}
