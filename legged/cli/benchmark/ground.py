"""Speed on different ground: `legged benchmark ground anymal_c`.

The task is timed on a plane, on its terrain with this package's collider, and on its terrain with mujoco-warp's general one.
"""

from typing import Any

from legged.benchmarks.step_times import report
from legged.cli.benchmark.common import add_arguments, add_memory, measure, settle, write
from legged.commandline.arguments import settle_on
from legged.commandline.command import command
from legged.config import LeggedConfig, override
from legged.errors import ConfigError
from legged.physics import resolve_physics
from legged.process.command_parser import CommandParser

GROUNDS: dict[str, list[tuple[str, Any]]] = {
    "plane": [("terrain.mesh_type", "plane")],
    "terrain, our collider": [("sim.terrain_collider", "cells")],
    # The general collider needs room for its candidate pairs and for more contacts.
    "terrain, general collider": [("sim.terrain_collider", "convex"), ("sim.nconmax", 64), ("sim.njmax", 256)],
}


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged benchmark ground",
        __doc__,
        "legged benchmark ground anymal_c",
        "legged benchmark ground go2 --num-envs 2048 --out times",
    )
    add_arguments(parser)
    parser.add_argument("--steps", type=int, default=200, help="control steps of a measurement; 200 by default")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    cfg, device = settle(args)
    where = cfg.origins.where("sim.physics")
    if resolve_physics(cfg.sim.physics, device, where, cfg.env.num_envs) != "mujoco_warp":
        raise ConfigError(f"{where}: colliders of mujoco_warp are compared; add sim.physics=mujoco_warp")
    if not isinstance(cfg, LeggedConfig) or cfg.terrain.mesh_type == "plane":
        raise ConfigError(f"TASK: '{cfg.task}' has no terrain")
    settle_on(device)
    results = {}
    for name, changes in GROUNDS.items():
        task, results[name] = measure(override(cfg, changes), device, args, None)
        add_memory(results[name], device)
        print(f"{name}: {report(task, results[name])}", flush=True)
    write(args, results)
    return 0
