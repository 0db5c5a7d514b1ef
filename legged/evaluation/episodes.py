"""Evaluation of tasks without commands: full episodes are measured, printed and written."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from legged.config import override
from legged.evaluation.overflows import warn_of_overflows
from legged.evaluation.result_file import changes_of, device_name, file_name, write_result
from legged.physics import engine_name
from legged.policies.episodes import episodes_table, for_episodes, measure_episodes
from legged.policies.restore import TrainedPolicy, restore
from legged.process.paths import relative

MOST_EPISODES = 2**16
"""Most episodes at once."""


def evaluate_episodes(
    policy: TrainedPolicy,
    episodes: int,
    asked: list[tuple[str, Any]],
    device: torch.device,
    graph: bool,
    folder: Path,
    where: str = "sim.physics",
) -> int:
    """Run `episodes` robots through their first full episode, without noise and randomisation; print a table and write
    evaluation_<physics>.json into `folder`. Return the exit code. `where` names the setting of the engine in errors.
    """
    start = time.perf_counter()
    calm, changes = for_episodes(policy, episodes)
    engine = engine_name(override(policy.cfg, asked).sim, device, where)
    task, act = restore(calm, [*changes, *asked], device, graph)
    measured = measure_episodes(task, act)
    result = {
        **header(policy, engine, device_name(device), asked),
        "wall_s": time.perf_counter() - start,
        "episodes": measured,
    }
    code = report(result, folder)
    warn_of_overflows("episodes", measured["contact_overflows"])
    return code


def header(policy: TrainedPolicy, engine: str, device: str, asked: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Return the fields that every result has; `asked` holds the overrides. The result names those that change the
    conditions.
    """
    what = {"task": policy.cfg.task, "checkpoint": policy.checkpoint.name, "physics": engine, "device": device}
    changes = changes_of(asked)
    return {**what, "changes": changes} if changes else what


def report(result: dict[str, Any], folder: Path) -> int:
    """Print the table of a result, then write its file; return the exit code.

    Raises:
        RunError: the file can't be written.
    """
    title = f"{result['task']} ({result['checkpoint']}) in {result.get('environment', result['physics'])}"
    Console(width=110).print(episodes_table(result["episodes"], title))
    path = folder / file_name(result["physics"])
    write_result(path, result)
    print(f"written: {relative(path)}")
    return 0
