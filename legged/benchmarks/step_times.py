"""How long a control step takes, and the physics in it."""

import time
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

import torch

from legged.envs import BaseTask
from legged.graph.step_graph import StepGraph


@torch.inference_mode()
def time_steps(task: BaseTask, steps: int, repeats: int) -> dict[str, Any]:
    """Return milliseconds per control step: the task's step, and the physics in it alone.

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
    library = task.physics.library_step
    if library is not None and (device.type == "cuda" or task.cfg.sim.physics != "auto"):  # on a CPU it takes minutes
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
        "overflows": float(task.metrics.flush()["Metrics/contact_overflows"]),
    }


def _control_period(task: BaseTask, step: Callable[[], None]) -> Callable[[], None]:
    """Return the engine steps of one control step, as a graph where the task's step is one."""

    def run() -> None:
        for _ in range(task.cfg.control.decimation):
            step()

    return StepGraph(run, torch.device(task.device), enabled=True) if task.captured else run


def _time_in_turns(functions: Sequence[Callable[[int], object]], steps: int, device: torch.device) -> list[float]:
    """Return mean milliseconds per call of each function, called in turns; on a GPU, waiting for the host raises."""
    totals = [0.0] * len(functions)
    if device.type != "cuda":
        for i in range(steps):
            for k, function in enumerate(functions):
                start = time.perf_counter()
                function(i)
                totals[k] += time.perf_counter() - start
        return [total / steps * 1e3 for total in totals]
    events = [[torch.cuda.Event(enable_timing=True) for _ in range(len(functions) + 1)] for _ in range(steps)]
    synchronize(device)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for i in range(steps):
            events[i][0].record()
            for k, function in enumerate(functions):
                function(i)
                events[i][k + 1].record()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    synchronize(device)
    for marks in events:
        for k in range(len(functions)):
            totals[k] += marks[k].elapsed_time(marks[k + 1])
    return [total / steps for total in totals]


def synchronize(device: torch.device) -> None:
    """Wait until a GPU has done all that it was asked for."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
