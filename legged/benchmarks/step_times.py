"""Duration of a control step, and of its physics alone."""

import time
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.envs import BaseTask
from legged.graph.step_graph import StepGraph

Turn = tuple[Callable[[], object], Callable[[], object]]
"""Untimed preparation, and the timed function."""


class Driver:
    """Source of the robots' actions, random or from a policy; its time is not measured."""

    def __init__(self, task: BaseTask, act: Callable[[TensorDict], Tensor] | None) -> None:
        """Use the policy `act`, observations -> actions, or random actions without one."""
        self._task, self._act = task, act
        self._table = 0.3 * torch.randn(32, task.num_envs, task.num_actions, device=torch.device(task.device))
        self._made = 0
        self._kept: dict[str, Tensor] = {}
        self.actions = torch.zeros_like(self._table[0])
        """(N, D) actions of the next control step."""

    def decide(self) -> None:
        """Choose the `actions` of the next control step."""
        self.put_back()
        random = self._table[self._made % len(self._table)]
        self.actions.copy_(random if self._act is None else self._act(self._task.get_observations()))
        self._made += 1

    def keep(self) -> None:
        """Store the physics' state if a policy acts: the policy must not meet motion that it did not command."""
        if self._act is not None:
            self._kept = {name: tensor.clone() for name, tensor in self._task.physics.state_tensors().items()}

    def put_back(self) -> None:
        """Restore the state of the last `keep`."""
        if self._kept:
            self._task.physics.load_state(self._kept)


@torch.inference_mode()
def time_steps(task: BaseTask, steps: int, repeats: int, act: Callable[[TensorDict], Tensor] | None = None) -> dict[str, Any]:
    """Return milliseconds per control step: of the task's step, and of its physics alone, under random actions or those of a
    policy `act`, observations -> actions.

    Physics alone is `decimation` engine steps of the same model under the present torques. On a GPU it is one graph too. If
    the task's step consists of mujoco-warp's parts, as many of mujoco-warp's own steps are timed as well. All are timed in
    turns, step by step, so that they meet the states, contacts and clock rates of a rollout: without a controller or resets,
    the physics would soon simulate heaps of fallen robots.
    """
    device = torch.device(task.device)
    driver = Driver(task, act)
    for _ in range(50):  # robots land and spread over the states of a training
        driver.decide()
        task.step(driver.actions)
    steps_of = {"physics": task.physics.step}
    library = task.physics.library_step
    if library is not None and (device.type == "cuda" or task.cfg.sim.physics != "auto"):  # takes minutes on a CPU
        steps_of["library"] = library
    alone = {name: _control_period(task, step) for name, step in steps_of.items()}
    turns: list[Turn] = [(driver.decide, lambda: task.step(driver.actions))]
    turns += [(driver.put_back if k else driver.keep, run) for k, run in enumerate(alone.values())]
    results = [_time_in_turns(turns, steps, device) for _ in range(repeats)]
    driver.put_back()
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
    """Return a function that makes the engine steps of one control step; it is a CUDA graph if the task's step is one."""

    def run() -> None:
        for _ in range(task.cfg.control.decimation):
            step()

    return StepGraph(run, torch.device(task.device), enabled=True) if task.captured else run


def _time_in_turns(turns: Sequence[Turn], steps: int, device: torch.device) -> list[float]:
    """Return mean milliseconds per call of each turn's timed function. On a GPU, waiting for the host raises an error."""
    totals = [0.0] * len(turns)
    if device.type != "cuda":
        for _ in range(steps):
            for k, (prepare, function) in enumerate(turns):
                prepare()
                start = time.perf_counter()
                function()
                totals[k] += time.perf_counter() - start
        return [total / steps * 1e3 for total in totals]
    marks = [[[torch.cuda.Event(enable_timing=True) for _ in range(2)] for _ in turns] for _ in range(steps)]
    synchronize(device)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for step in range(steps):
            for (first, last), (prepare, function) in zip(marks[step], turns, strict=True):
                prepare()
                first.record()
                function()
                last.record()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    synchronize(device)
    for of_step in marks:
        for k, (first, last) in enumerate(of_step):
            totals[k] += first.elapsed_time(last)
    return [total / steps for total in totals]


def synchronize(device: torch.device) -> None:
    """Wait until a GPU has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def report(task: BaseTask, result: dict[str, Any]) -> str:
    """Return the results of a benchmark of a task as lines of text."""
    device = torch.device(task.device)
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    how = "one CUDA graph, no host synchronisation in the timed steps" if task.captured else "eager"
    lines = [
        f"{task.cfg.task}, {task.num_envs} robots, {where}, {how}",
        f"  control step  {result['control_step_ms']:.3f} ms  ({result['env_steps_per_s']:,.0f} robot steps/s)",
        *([f"  moved by {result['policy']}"] if "policy" in result else []),
        f"  physics alone {result['physics_ms']:.3f} ms  (control step = {result['ratio']:.3f} x physics)",
        *([f"  mujoco_warp.step alone {result['library_ms']:.3f} ms"] if "library_ms" in result else []),
        *([f"  mujoco-warp's own launches: {task.physics.why_library}"] if task.physics.why_library else []),
        f"  steps of a robot that lost contacts because memory was too small: {result['overflows']:.0f}",
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
