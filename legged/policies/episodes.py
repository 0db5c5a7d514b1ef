"""Measurements of a policy over full episodes, in any task: returns (in total and by term), lengths and failures."""

from collections.abc import Callable
from typing import Any

import torch
from rich.table import Table
from tensordict import TensorDict
from torch import Tensor

from legged.config import TaskConfig
from legged.envs import BaseTask
from legged.policies.restore import undisturbed
from legged.tables import screen_table

Policy = Callable[[TensorDict], Tensor]
"""Observations -> actions (N, D)."""


def for_episodes(cfg: TaskConfig, episodes: int) -> list[tuple[str, Any]]:
    """Return overrides with which each of `episodes` undisturbed environments runs one episode. Metrics are logged once, at
    the end.
    """
    steps = round(cfg.env.episode_length_s / cfg.dt)
    return [*undisturbed(cfg, episodes), ("train.runner.num_steps_per_env", steps + 1)]


def unit_of(task: BaseTask) -> float:
    """Return the divisor that converts rewards to the task's unit, in which a term adds scale * value in each step."""
    return task.dt if task.cfg.rewards.times_dt else 1.0


@torch.inference_mode()
def measure_episodes(task: BaseTask, act: Policy, after_step: Callable[[int, float], None] | None = None) -> dict[str, Any]:
    """Run every environment through its first episode, from a reset to a failure or to the end of its time. Return plain
    numbers: `return`, `terms` (return by reward term), `length` [steps], `failures` (share), `metrics` (means over all
    environments and steps) and `contact_overflows`.

    The return is the undiscounted sum of scale * term over steps. It does not depend on `rewards.times_dt`. `after_step`
    gets the number of the step, from 0, and the first environment's return so far.
    """
    observations = task.reset()
    device = torch.device(task.device)
    running = torch.ones(task.num_envs, dtype=torch.bool, device=device)
    failed, length = torch.zeros_like(running), torch.zeros(task.num_envs, device=device)
    total, terms = torch.zeros(task.num_envs, device=device), torch.zeros_like(task.rewards.last)
    unit = unit_of(task)
    for step in range(task.max_episode_length):
        observations, rewards, dones, _ = task.step(act(observations))
        total += torch.where(running, rewards, 0.0) / unit
        terms += torch.where(running, task.rewards.last, 0.0) / unit
        length += running
        failed |= running & task.terminated_buf
        running &= ~dones
        if after_step is not None:
            after_step(step, float(total[0]))
    logged = {name: float(value) for name, value in task.metrics.flush().items()}
    own = [f"Metrics/{name}" for name in sorted(task.terms("_metric_"))]
    return {
        "count": task.num_envs,
        "return": spread_of(total.tolist()),
        "terms": {name: float(row.mean()) for name, row in zip(task.rewards.names, terms, strict=True)},
        "length": spread_of(length.tolist()),
        "failures": float(failed.float().mean()),
        "metrics": {name.removeprefix("Metrics/"): logged[name] for name in own},
        "contact_overflows": int(logged["Metrics/contact_overflows"]),
    }


def spread_of(values: list[float]) -> dict[str, float]:
    """Return mean, standard deviation (the squares are divided by N, not by N - 1), smallest and largest of N values."""
    numbers = torch.tensor(values, dtype=torch.float64)
    return {
        "mean": float(numbers.mean()),
        "std": float(numbers.std(correction=0)),
        "min": float(numbers.min()),
        "max": float(numbers.max()),
    }


def episodes_table(episodes: dict[str, Any], title: str) -> Table:
    """Return a table with one row for each measure: return, its terms, lengths, failures, metrics."""
    rows = [
        [label, *(f"{episodes[name][key]:.1f}" for key in ("mean", "std", "min", "max"))]
        for name, label in (("return", "return"), ("length", "episode length [steps]"))
    ]
    rows += [[f"return of {name}", f"{value:.1f}"] for name, value in episodes["terms"].items()]
    rows.append(["episodes that ended in a failure", f"{100 * episodes['failures']:.1f} %"])
    rows += [[name, f"{value:.3f}"] for name, value in episodes["metrics"].items()]
    heads = ("measure", "mean", "standard deviation", "least", "greatest")
    return screen_table(f"{title}: {episodes['count']} episodes", heads, rows)
