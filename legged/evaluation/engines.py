"""The physics engines in which policies are measured."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, get_args

from legged.config.world import NewtonSolver


class Engine(NamedTuple):
    """An engine, or Newton with one solver. `label` is its name in tables, and `overrides` select it in a configuration."""

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
"""Name from `legged.physics.engine_name` -> engine."""


def engine_of(name: str) -> Engine:
    """Return the engine called `name`. An unknown engine gets its name as the label."""
    return ENGINES.get(name, Engine(name))


def by_engine(results: Iterable[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return name of an engine -> the result in it, in the order of ENGINES. Engines that are not in ENGINES come last."""
    found = {result["physics"]: result for result in results}
    return {name: found[name] for name in sorted(found, key=lambda name: [*ENGINES, name].index(name))}
