"""Time of a control step, and how much of it is physics: `python -m legged.tools.benchmark --task anymal_c`.

With `--grounds` the task is timed on a plane, on its terrain met by our collider, and by mujoco-warp's general one.

On a GPU it also proves that the step never waits for the host: the timed steps run under torch's sync debug mode
"error", which raises at any synchronisation.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from legged.config import ConfigError, override
from legged.envs import LeggedRobot
from legged.physics import resolve_physics
from legged.registry import make_task, task_config
from legged.rl.arguments import add_task_arguments, import_and_check, overrides, pick_device, run_main
from legged.rl.runs import write_text

GROUNDS: dict[str, list[tuple[str, Any]]] = {
    "plane": [("terrain.mesh_type", "plane")],
    "terrain, our collider": [("sim.terrain_collider", "cells")],
    # It needs room for its candidate pairs and for more contacts.
    "terrain, general collider": [("sim.terrain_collider", "convex"), ("sim.nconmax", 64), ("sim.njmax", 256)],
}
"""What --grounds compares."""


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(prog="benchmark", description=__doc__)
    add_task_arguments(parser)
    parser.add_argument("--steps", type=int, default=200, help="control steps per measurement")
    parser.add_argument("--repeats", type=int, default=5, help="measurements; the median is reported")
    parser.add_argument("--grounds", action="store_true", help="compare plane, our terrain collider and the general one")
    parser.add_argument("--json", type=Path, help="also write the result to this file")
    args = parser.parse_intermixed_args(argv)
    import_and_check(args)
    device = pick_device(args.sim_device)
    cfg = task_config(args.task, overrides(args), on_cpu=device.type == "cpu")
    if device.type == "cpu":
        torch.set_num_threads(1)
    if args.grounds and resolve_physics(cfg.sim.physics, device) != "mujoco_warp":
        raise ConfigError("--grounds: compares colliders of mujoco_warp; add sim.physics=mujoco_warp")
    if args.grounds and cfg.terrain.mesh_type == "plane":
        raise ConfigError(f"--grounds: the task '{cfg.task}' has no terrain (terrain.mesh_type is plane)")
    results = {}
    for name, changes in (GROUNDS if args.grounds else {"": []}).items():
        start = time.perf_counter()
        task = make_task(override(cfg, changes), device, graph=not args.no_graph)
        _synchronize(device)
        result = measure(task, args.steps, args.repeats)
        result["build_s"] = time.perf_counter() - start - result.pop("measuring_s")
        print((f"{name}: " if name else "") + report(task, result), flush=True)
        results[name] = result
    if args.json:
        write_text(args.json, json.dumps(results if args.grounds else results[""], indent=1))
    return 0


@torch.inference_mode()
def measure(task: LeggedRobot, steps: int, repeats: int) -> dict[str, float]:
    """Milliseconds per control step: the task's step, and the physics in it alone.

    Physics alone is `decimation` engine steps of the same model under the torques of the moment; on a GPU it is one
    graph too. The two are timed in turns, step by step, so that both meet the states, contacts and clock rates of a
    rollout: run by itself, physics without a controller or resets would soon simulate heaps of fallen robots.
    """
    begin = time.perf_counter()
    device = torch.device(task.device)
    actions = 0.3 * torch.randn(32, task.num_envs, task.num_actions, device=device)
    for i in range(50):  # robots land and spread over the states of a training
        task.step(actions[i % 32])
    physics_only = _physics_step(task)
    turns = (lambda i: task.step(actions[i % 32]), lambda i: physics_only())
    results = [_time_in_turns(turns, steps, device) for _ in range(repeats)]
    control_ms, physics_ms = (sorted(times)[repeats // 2] for times in zip(*results, strict=True))
    return {
        "num_envs": task.num_envs,
        "control_step_ms": control_ms,
        "physics_ms": physics_ms,
        "ratio": control_ms / physics_ms,
        "env_steps_per_s": task.num_envs / control_ms * 1e3,
        "captured": float(task.captured),
        "overflows": float(task.statistics.flush()["Metrics/contact_overflows"]),
        "measuring_s": time.perf_counter() - begin,
    }


def _physics_step(task: LeggedRobot) -> Callable[[], None]:
    """The engine steps of one control step, as a graph where the task's step is one."""

    def run() -> None:
        for _ in range(task.cfg.control.decimation):
            task.physics.step()

    if not task.captured:
        return run
    from legged.graph import StepGraph

    return StepGraph(run, torch.device(task.device), enabled=True)


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


def report(task: LeggedRobot, result: dict[str, float]) -> str:
    """The result in words."""
    device = torch.device(task.device)
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    how = "one CUDA graph, no host synchronisation in the timed steps" if task.captured else "eager"
    return (
        f"{task.cfg.task}, {task.num_envs} robots, {where}, {how}\n"
        f"  control step  {result['control_step_ms']:.3f} ms  ({result['env_steps_per_s']:,.0f} robot steps/s)\n"
        f"  physics alone {result['physics_ms']:.3f} ms  (control step = {result['ratio']:.3f} x physics)\n"
        f"  steps of a robot that lost contacts for want of memory: {result['overflows']:.0f}\n"
        f"  build, with kernel compilation where not cached: {result['build_s']:.1f} s"
    )


if __name__ == "__main__":
    sys.exit(main())
