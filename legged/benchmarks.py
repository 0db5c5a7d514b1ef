"""Measurements of the benchmark command: a control step, its physics and kernels, and training iterations."""

import io
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from statistics import median
from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config import TaskConfig
from legged.envs import BaseTask
from legged.graph.step_graph import StepGraph
from legged.learning.captured import CapturedRunner
from legged.learning.display import Progress
from legged.learning.runner import Runner
from legged.learning.student_runner import StudentRunner
from legged.learning.teacher import Teacher

Turn = tuple[Callable[[], object], Callable[[], object]]
"""Untimed preparation, and the timed function."""


LOOPS: dict[str, Callable[..., Runner]] = {"stock": Runner, "captured": CapturedRunner}
"""Training loops by name."""


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
    if library is not None and (device.type == "cuda" or task.cfg.sim.physics != "auto"):  # it takes minutes on a CPU
        steps_of["library"] = library
    alone = {name: _control_period(task, step) for name, step in steps_of.items()}
    turns: list[Turn] = [(driver.decide, lambda: task.step(driver.actions))]
    turns += [(driver.put_back if k else driver.keep, run) for k, run in enumerate(alone.values())]
    results = [_time_in_turns(turns, steps, device) for _ in range(repeats)]
    driver.put_back()
    times: dict[str, Any] = {"num_envs": task.num_envs}
    for name, measured in zip(("control_step", *alone), map(sorted, zip(*results, strict=True)), strict=True):
        times |= {f"{name}_ms": median(measured), f"{name}_ms_range": [measured[0], measured[-1]]}
    return {
        **times,
        "ratio": times["control_step_ms"] / times["physics_ms"],
        "env_steps_per_s": task.num_envs / times["control_step_ms"] * 1e3,
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
    on_gpu = device.type == "cuda"

    def mark() -> Any:
        if not on_gpu:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    synchronize(device)
    spans: list[list[tuple[Any, Any]]] = [[] for _ in turns]
    try:
        if on_gpu:
            torch.cuda.set_sync_debug_mode("error")
        for _ in range(steps):
            for (prepare, function), measured in zip(turns, spans, strict=True):
                prepare()
                first = mark()
                function()
                measured.append((first, mark()))
    finally:
        if on_gpu:
            torch.cuda.set_sync_debug_mode("default")
    synchronize(device)
    times = [[a.elapsed_time(b) if on_gpu else 1e3 * (b - a) for a, b in measured] for measured in spans]
    return [sum(each) / steps for each in times]


def device_name(device: torch.device) -> str:
    """Return the name of a device in results."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"


def synchronize(device: torch.device) -> None:
    """Wait until a GPU has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def loops_of(cfg: TaskConfig, teacher: Teacher | None, asked: str | None) -> dict[str, Callable[..., Runner]]:
    """Return the runners to time, by name of the loop: the loop `asked`, or else all. Students of a `teacher` and policies
    with an estimator have only the loop of the configuration.
    """
    own = cfg.train.runner.loop
    if teacher is not None:
        return {own: partial(StudentRunner, teacher=teacher)}
    one = own if cfg.train.policy.estimator.targets else asked
    return {one: LOOPS[one]} if one else LOOPS


def time_iterations(kind: Callable[..., Runner], task: BaseTask, count: int) -> dict[str, Any]:
    """Return the medians of rollout, update and iteration times [ms] and the range of the latter, over `count` iterations of
    a training with new networks, after a first iteration that is left out.
    """
    shown: list[Progress] = []
    display = SimpleNamespace(show=shown.append)
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()) as said:
        runner = kind(task, log_dir=Path(folder), device=str(task.device), display=display)
        runner.learn(count + 1, init_at_random_ep_len=True)
    seen = shown[1:]
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


def kernel_times(task: BaseTask, steps: int) -> list[dict[str, Any]]:
    """Return the kernels of a control step as the graph replays them, slowest first; means over `steps` steps with small
    random actions. `launches` is the number of launches in a control step, which varies with the iterations of solvers, and
    `total_us` their GPU time [us].
    """
    actions = 0.3 * torch.randn(task.num_envs, task.num_actions, device=torch.device(task.device))
    task.step(actions)
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for _ in range(steps):
            task.step(actions)
        torch.cuda.synchronize()
    seen = [e for e in profile.key_averages() if e.device_type == torch.autograd.DeviceType.CUDA]
    times = [{"name": e.key, "launches": e.count / steps, "total_us": e.device_time_total / steps} for e in seen]
    return sorted(times, key=lambda time: -time["total_us"])


def kernel_table(times: list[dict[str, Any]], longest: int) -> str:
    """Return the `longest` slowest kernels and the sum of all as lines of text."""
    launches, total = (sum(time[key] for time in times) for key in ("launches", "total_us"))
    whole = {"name": f"all {len(times)} kernels of a control step", "launches": launches, "total_us": total}
    rows = [f"{time['total_us']:9.1f} {time['launches']:9.1f}  {time['name'][:90]}" for time in (*times[:longest], whole)]
    return "\n".join([f"{'us':>9} {'launches':>9}  kernel", *rows])


def report(task: BaseTask, result: dict[str, Any]) -> str:
    """Return the results of a benchmark of a task as lines of text."""
    where = device_name(torch.device(task.device))
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
