"""Time of a control step, of the physics in it, and of a training iteration around it:
`python -m legged.tools.benchmark --task anymal_c [--num_envs 8192]`.

Robots are moved by random actions, which flail their legs, or as `--policy` says by one that has learned to walk: of physics
that differs from robot to robot, or has dry friction, more is to be computed where they flail.

With `--grounds` the task is timed on a plane, on its terrain met by our collider, and by mujoco-warp's general one; with
`--scale 1024,4096,16384` with each of these numbers of robots, in a process of its own. With `--startup` nothing of this is
timed, but the way to the first iteration of a training, beside `import torch`.

On a GPU it also proves that the step never waits for the host: the timed steps run under torch's sync debug mode
"error", which raises at any synchronisation.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import torch

from legged.benchmarks.iteration_times import LOOPS, loops_of, time_iterations
from legged.benchmarks.kernel_times import kernel_times, table
from legged.benchmarks.scale import scale
from legged.benchmarks.start_times import start_report, time_start
from legged.benchmarks.step_times import report, synchronize, time_steps
from legged.commandline.arguments import add_task_arguments, overrides, pick_device, register_given, settle_on
from legged.commandline.command import run_main
from legged.commandline.parser import CommandParser
from legged.config import LeggedConfig, override
from legged.config.networks import learns_from_teacher
from legged.errors import ConfigError
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.teacher import find_teacher, with_teacher
from legged.physics import resolve_physics
from legged.policies.actor import Actor
from legged.policies.restore import policy_of
from legged.process.paths import make_folder, ready_to_write_file, relative, write_text
from legged.registry import make_task, task_config

GROUNDS: dict[str, list[tuple[str, Any]]] = {
    "plane": [("terrain.mesh_type", "plane")],
    "terrain, our collider": [("sim.terrain_collider", "cells")],
    # It needs room for its candidate pairs and for more contacts.
    "terrain, general collider": [("sim.terrain_collider", "convex"), ("sim.nconmax", 64), ("sim.njmax", 256)],
}
"""What --grounds compares."""

KERNEL_STEPS = 20
"""Control steps that --kernels looks at."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return what reads the command line."""
    parser = CommandParser(
        "benchmark",
        __doc__,
        "python -m legged.tools.benchmark --task anymal_c_flat --runner captured --json times.json",
        "python -m legged.tools.benchmark --task anymal_c --scale 1024,4096,16384",
    )
    add_task_arguments(parser)
    parser.add_argument("--steps", type=int, default=200, help="control steps per measurement")
    parser.add_argument("--repeats", type=int, default=5, help="measurements; the median is reported")
    parser.add_argument("--iterations", type=int, help="of each training loop; 20 by default, 3 on the CPU, 0 for none")
    parser.add_argument("--grounds", action="store_true", help="compare plane, our terrain collider and the general one")
    parser.add_argument("--scale", help="numbers of robots to compare, e.g. 1024,4096,16384; runs one training loop")
    parser.add_argument("--runner", choices=list(LOOPS), help="time this training loop only (train.runner.loop)")
    parser.add_argument("--kernels", type=int, metavar="COUNT", help="also list this many kernels that take longest (GPU)")
    parser.add_argument("--startup", action="store_true", help="time how a training begins, beside importing torch, instead")
    parser.add_argument("--policy", help="what moves the robots, a run folder or a task; random actions without it")
    parser.add_argument("--json", type=Path, help="also write the result to this file")
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_intermixed_args(argv)
    register_given(args)
    device = pick_device(args.sim_device)
    cfg = task_config(args.task, overrides(args), on_cpu=device.type == "cpu")
    for name, least in (("steps", 1), ("repeats", 1), ("iterations", 0), ("kernels", 1)):
        value = getattr(args, name)
        if value is not None and value < least:
            raise ConfigError(f"--{name}: must be at least {least}, got {value}")
    if args.json:
        ready_to_write_file("--json", args.json)
    if args.kernels is not None and device.type != "cuda":
        raise ConfigError(f"--kernels: needs a GPU, and the task is on {device}")
    if args.kernels is not None and args.policy is not None:
        raise ConfigError("--kernels: lists what is launched under random actions; leave it or --policy out")
    if args.startup:
        start_times = time_start(sys.argv[1:] if argv is None else argv, args.repeats)
        print(start_report(start_times), flush=True)
        if args.json:
            make_folder(args.json.parent)
            write_text(args.json, json.dumps(start_times, indent=1))
        return 0
    if args.scale is not None:
        # In processes of their own: this one must not take memory.
        return scale(args, sys.argv[1:] if argv is None else argv, cfg, device)
    settle_on(device)
    if (
        args.grounds
        and resolve_physics(cfg.sim.physics, device, cfg.origins.where("sim.physics"), cfg.env.num_envs) != "mujoco_warp"
    ):
        raise ConfigError("--grounds: compares colliders of mujoco_warp; add sim.physics=mujoco_warp")
    if args.grounds and (not isinstance(cfg, LeggedConfig) or cfg.terrain.mesh_type == "plane"):
        raise ConfigError(f"--grounds: the task '{cfg.task}' has no terrain")
    count = args.iterations if args.iterations is not None else (3 if device.type == "cpu" else 20)
    policy = None if args.policy is None else policy_of(args.policy, "--policy").checkpoint
    if policy is not None:
        check_fits(policy, read_checkpoint(policy), cfg)
    teacher = find_teacher(cfg) if learns_from_teacher(cfg) and count > 0 and not args.grounds else None
    cfg = cfg if teacher is None else with_teacher(cfg, teacher)
    results = {}
    for name, changes in (GROUNDS if args.grounds else {"": []}).items():
        start = time.perf_counter()
        task = make_task(override(cfg, changes), device, graph=not args.no_graph)
        synchronize(device)
        build_s = time.perf_counter() - start
        actor = None
        if policy is not None:
            actor = Actor(task, device)
            actor.load(policy)
        result = {**time_steps(task, args.steps, args.repeats, actor), "build_s": build_s}
        if policy is not None:
            result["policy"] = relative(policy)
        if args.kernels is not None:
            times = kernel_times(task, KERNEL_STEPS)
            result["kernels"] = [vars(time) for time in times]
            print(table(times, args.kernels), flush=True)
        if not args.grounds and count > 0:
            loops = loops_of(cfg, teacher, args.runner)
            result["iterations"] = {loop: time_iterations(kind, task, count) for loop, kind in loops.items()}
        if device.type == "cuda":
            free, whole = torch.cuda.mem_get_info(device)
            result["gpu_memory_gib"] = (whole - free) / 2**30
        print((f"{name}: " if name else "") + report(task, result), flush=True)
        results[name] = result
    if args.json:
        make_folder(args.json.parent)
        write_text(args.json, json.dumps(results if args.grounds else results[""], indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
