"""Time of a control step, of the physics in it, and of a training iteration around it:
`python -m legged.tools.benchmark --task anymal_c [--num_envs 8192]`.

With `--grounds` the task is timed on a plane, on its terrain met by our collider, and by mujoco-warp's general one; with
`--scale 1024,4096,16384` with each of these numbers of robots, in a process of its own.

On a GPU it also proves that the step never waits for the host: the timed steps run under torch's sync debug mode
"error", which raises at any synchronisation.
"""

import argparse
import contextlib
import io
import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import torch

from legged.benchmarks.kernel_times import kernel_times, table
from legged.benchmarks.scale import scale
from legged.commandline.arguments import add_task_arguments, import_and_check, overrides, pick_device, settle_on
from legged.commandline.command import run_main
from legged.config import override
from legged.envs import LeggedRobot
from legged.errors import ConfigError
from legged.graph.step_graph import StepGraph
from legged.learning.captured import CapturedRunner
from legged.learning.display import Progress
from legged.learning.runner import Runner
from legged.physics import resolve_physics
from legged.process.paths import make_folder, ready_to_write_file, write_text
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

LOOPS: dict[str, type[Runner]] = {"stock": Runner, "captured": CapturedRunner}
"""Training loops that are timed."""


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(prog="benchmark", description=__doc__)
    add_task_arguments(parser)
    parser.add_argument("--steps", type=int, default=200, help="control steps per measurement")
    parser.add_argument("--repeats", type=int, default=5, help="measurements; the median is reported")
    parser.add_argument("--iterations", type=int, help="of each training loop; 20 by default, 3 on the CPU, 0 for none")
    parser.add_argument("--grounds", action="store_true", help="compare plane, our terrain collider and the general one")
    parser.add_argument("--scale", help="numbers of robots to compare, e.g. 1024,4096,16384; runs one training loop")
    parser.add_argument("--runner", choices=list(LOOPS), help="time this training loop only (train.runner.loop)")
    parser.add_argument("--kernels", type=int, metavar="COUNT", help="also list this many kernels that take longest (GPU)")
    parser.add_argument("--json", type=Path, help="also write the result to this file")
    args = parser.parse_intermixed_args(argv)
    import_and_check(args)
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
    if args.scale is not None:
        # In processes of their own: this one must not take memory.
        return scale(args, sys.argv[1:] if argv is None else argv, cfg, device)
    settle_on(device)
    if args.grounds and resolve_physics(cfg.sim.physics, device, cfg.origins.where("sim.physics")) != "mujoco_warp":
        raise ConfigError("--grounds: compares colliders of mujoco_warp; add sim.physics=mujoco_warp")
    if args.grounds and cfg.terrain.mesh_type == "plane":
        raise ConfigError(f"--grounds: the task '{cfg.task}' has no terrain (terrain.mesh_type is plane)")
    count = args.iterations if args.iterations is not None else (3 if device.type == "cpu" else 20)
    results = {}
    for name, changes in (GROUNDS if args.grounds else {"": []}).items():
        start = time.perf_counter()
        task = make_task(override(cfg, changes), device, graph=not args.no_graph)
        _synchronize(device)
        build_s = time.perf_counter() - start
        result = {**measure(task, args.steps, args.repeats), "build_s": build_s}
        if args.kernels is not None:
            times = kernel_times(task, KERNEL_STEPS)
            result["kernels"] = [vars(time) for time in times]
            print(table(times, args.kernels), flush=True)
        if not args.grounds and count > 0:
            loops = {args.runner: LOOPS[args.runner]} if args.runner else LOOPS
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


@torch.inference_mode()
def measure(task: LeggedRobot, steps: int, repeats: int) -> dict[str, Any]:
    """Milliseconds per control step: the task's step, and the physics in it alone.

    Physics alone is `decimation` engine steps of the same model under the torques of the moment; on a GPU it is one
    graph too, and so are as many of mujoco-warp's own steps, where ours are made of its parts. All are timed in turns,
    step by step, so that they meet the states, contacts and clock rates of a rollout: run by itself, physics without a
    controller or resets would soon simulate heaps of fallen robots.
    """
    device = torch.device(task.device)
    actions = 0.3 * torch.randn(32, task.num_envs, task.num_actions, device=device)
    for i in range(50):  # robots land and spread over the states of a training
        task.step(actions[i % 32])
    steps_of = {"physics": task.physics.step}
    if library := getattr(task.physics, "library_step", None):
        steps_of["library"] = library
    alone = {name: _control_period(task, step) for name, step in steps_of.items()}
    turns = [lambda i: task.step(actions[i % 32]), *(lambda _, run=run: run() for run in alone.values())]
    results = [_time_in_turns(turns, steps, device) for _ in range(repeats)]
    control, *others = (sorted(times) for times in zip(*results, strict=True))
    control_ms = median(control)
    times: dict[str, Any] = {}
    for name, measured in zip(alone, others, strict=True):
        times |= {f"{name}_ms": median(measured), f"{name}_ms_range": [measured[0], measured[-1]]}
    return {
        "num_envs": task.num_envs,
        "control_step_ms": control_ms,
        "control_step_ms_range": [control[0], control[-1]],
        **times,
        "ratio": control_ms / times["physics_ms"],
        "env_steps_per_s": task.num_envs / control_ms * 1e3,
        "captured": float(task.captured),
        "overflows": float(task.statistics.flush()["Metrics/contact_overflows"]),
    }


def _control_period(task: LeggedRobot, step: Callable[[], None]) -> Callable[[], None]:
    """The engine steps of one control step, as a graph where the task's step is one."""

    def run() -> None:
        for _ in range(task.cfg.control.decimation):
            step()

    return StepGraph(run, torch.device(task.device), enabled=True) if task.captured else run


def _time_in_turns(functions: Sequence[Callable[[int], object]], steps: int, device: torch.device) -> list[float]:
    """Mean milliseconds per call of each function, called in turns. On a GPU, waiting for the host in between raises."""
    totals = [0.0] * len(functions)
    if device.type != "cuda":
        for i in range(steps):
            for k, function in enumerate(functions):
                start = time.perf_counter()
                function(i)
                totals[k] += time.perf_counter() - start
        return [total / steps * 1e3 for total in totals]
    events = [[torch.cuda.Event(enable_timing=True) for _ in range(len(functions) + 1)] for _ in range(steps)]
    _synchronize(device)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for i in range(steps):
            events[i][0].record()
            for k, function in enumerate(functions):
                function(i)
                events[i][k + 1].record()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    _synchronize(device)
    for marks in events:
        for k in range(len(functions)):
            totals[k] += marks[k].elapsed_time(marks[k + 1])
    return [total / steps for total in totals]


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class Recorder:
    """Stands in for the display of a training and keeps its times."""

    def __init__(self) -> None:
        self.progress: list[Progress] = []

    def show(self, progress: Progress) -> None:
        """Keep an iteration."""
        self.progress.append(progress)


def time_iterations(kind: type[Runner], task: LeggedRobot, count: int) -> dict[str, Any]:
    """Train for `count` iterations with a training loop, from new networks; milliseconds of rollout, update and both
    (medians, and the range of both), the first iteration left out.
    """
    recorder = Recorder()
    with tempfile.TemporaryDirectory() as folder:
        runner = kind(task, Path(folder), str(task.device), recorder)  # type: ignore[arg-type]
        with contextlib.redirect_stdout(io.StringIO()) as said:
            runner.learn(count + 1, init_at_random_ep_len=True)
    seen = recorder.progress[1:]
    whole = sorted(1e3 * (progress.collect_s + progress.learn_s) for progress in seen)
    steps = task.cfg.train.runner.num_steps_per_env
    return {
        "rollout_ms": 1e3 * median([progress.collect_s for progress in seen]),
        "update_ms": 1e3 * median([progress.learn_s for progress in seen]),
        "iteration_ms": median(whole),
        "iteration_ms_range": [whole[0], whole[-1]],
        "steps_per_iteration": steps,
        "robot_steps_per_s": task.num_envs * steps / median(whole) * 1e3,
        "note": said.getvalue().strip(),
    }


def report(task: LeggedRobot, result: dict[str, Any]) -> str:
    """The result in words."""
    device = torch.device(task.device)
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    how = "one CUDA graph, no host synchronisation in the timed steps" if task.captured else "eager"
    lines = [
        f"{task.cfg.task}, {task.num_envs} robots, {where}, {how}",
        f"  control step  {result['control_step_ms']:.3f} ms  ({result['env_steps_per_s']:,.0f} robot steps/s)",
        f"  physics alone {result['physics_ms']:.3f} ms  (control step = {result['ratio']:.3f} x physics)",
        *([f"  mujoco_warp.step alone {result['library_ms']:.3f} ms"] if "library_ms" in result else []),
        f"  steps of a robot that lost contacts for want of memory: {result['overflows']:.0f}",
        f"  build, with kernel compilation where not cached: {result['build_s']:.1f} s",
    ]
    for loop, times in result.get("iterations", {}).items():
        beyond = times["iteration_ms"] - times["steps_per_iteration"] * result["physics_ms"]
        lines.append(
            f"  {loop} training: rollout {times['rollout_ms']:.1f} + update {times['update_ms']:.1f} ms = iteration"
            f" {times['iteration_ms']:.1f} ms, {beyond:.1f} ms beyond its physics ({times['robot_steps_per_s']:,.0f} robot"
            " steps/s)" + (f"; {times['note']}" if times["note"] else "")
        )
    if "gpu_memory_gib" in result:
        lines.append(f"  GPU memory in use: {result['gpu_memory_gib']:.1f} GiB")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
