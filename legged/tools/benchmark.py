"""Time of a control step, and how much of it is physics: `python -m legged.tools.benchmark --task anymal_c_flat`.

On a GPU it also proves that the step never waits for the host: the timed steps run under torch's sync debug mode
"error", which raises at any synchronisation.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from legged.envs import LeggedRobot
from legged.registry import make_task, task_config
from legged.rl.arguments import add_task_arguments, import_and_check, overrides, pick_device, run_main
from legged.rl.runs import write_text


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(prog="benchmark", description=__doc__)
    add_task_arguments(parser)
    parser.add_argument("--steps", type=int, default=200, help="control steps per measurement")
    parser.add_argument("--repeats", type=int, default=5, help="measurements; the median is reported")
    parser.add_argument("--json", type=Path, help="also write the result to this file")
    args = parser.parse_intermixed_args(argv)
    import_and_check(args)
    device = pick_device(args.sim_device)
    cfg = task_config(args.task, overrides(args), on_cpu=device.type == "cpu")
    if device.type == "cpu":
        torch.set_num_threads(1)
    start = time.perf_counter()
    task = make_task(cfg, device, graph=not args.no_graph)
    _synchronize(device)
    result = measure(task, args.steps, args.repeats)
    result["build_s"] = time.perf_counter() - start - result.pop("measuring_s")
    print(report(task, result))
    if args.json:
        write_text(args.json, json.dumps(result, indent=1))
    return 0


@torch.inference_mode()
def measure(task: LeggedRobot, steps: int, repeats: int) -> dict[str, float]:
    """Milliseconds per control step: the task's step, and the physics in it alone, in the same states.

    Physics alone is `decimation` engine steps of the same model, sensors and states under the torques of the moment;
    on a GPU it is one graph too.
    """
    begin = time.perf_counter()
    device = torch.device(task.device)
    actions = 0.3 * torch.randn(32, task.num_envs, task.num_actions, device=device)
    for i in range(50):  # robots land and spread over the states of a training
        task.step(actions[i % 32])
    physics_only = _physics_step(task)
    control, physics = [], []
    for _ in range(repeats):  # taken in turns, so that a change of clock or load meets both
        control.append(_time(lambda i: task.step(actions[i % 32]), steps, device))
        physics.append(_time(lambda i: physics_only(), steps, device))
        for i in range(10):
            task.step(actions[i])
    control_ms, physics_ms = sorted(control)[repeats // 2], sorted(physics)[repeats // 2]
    return {
        "num_envs": task.num_envs,
        "control_step_ms": control_ms,
        "physics_ms": physics_ms,
        "ratio": control_ms / physics_ms,
        "env_steps_per_s": task.num_envs / control_ms * 1e3,
        "captured": float(task.captured),
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


def _time(function: Callable[[int], object], steps: int, device: torch.device) -> float:
    """Mean milliseconds per call. Device events bracket the calls; the host must not wait in between."""
    if device.type != "cuda":
        start = time.perf_counter()
        for i in range(steps):
            function(i)
        return (time.perf_counter() - start) / steps * 1e3
    first, last = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    _synchronize(device)
    torch.cuda.set_sync_debug_mode("error")
    try:
        first.record()
        for i in range(steps):
            function(i)
        last.record()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    _synchronize(device)
    return first.elapsed_time(last) / steps


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
        f"  build, with kernel compilation where not cached: {result['build_s']:.1f} s"
    )


if __name__ == "__main__":
    sys.exit(main())
