"""Speed and memory by number of robots, each measured in a new process so that sizes do not share memory."""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from legged.commandline.command import EXIT_WRONG_INPUT, LACKS_MEMORY
from legged.config import TaskConfig
from legged.errors import ConfigError

KILLED = -9
"""Exit code of a process that Linux ended because memory ran out."""
NO_ROOM = "out of memory"
"""Result of a size that does not fit into memory."""
COLUMNS: tuple[tuple[str, int, Callable[[dict[str, Any]], str]], ...] = (
    ("robots", 12, lambda row: f"{row['num_envs']:,}"),
    ("control step", 14, lambda row: f"{row['control_step_ms']:.2f} ms"),
    ("steps/s", 13, lambda row: f"{row['env_steps_per_s']:,.0f}"),
    ("iteration", 13, lambda row: f"{row['iteration_ms']:.1f} ms" if "iteration_ms" in row else "-"),
    ("training steps/s", 18, lambda row: f"{row['robot_steps_per_s']:,.0f}" if "robot_steps_per_s" in row else "-"),
    ("GPU memory", 12, lambda row: f"{row['gpu_memory_gib']:.1f} GiB" if "gpu_memory_gib" in row else "-"),
)
"""Columns of the table: heading, width, text."""


@dataclass(frozen=True)
class Scale:
    """Figures by number of robots."""

    found: dict[str, Any]
    code: int
    """Exit code: 1 if a size failed for another reason than too little memory."""


def scale(sizes: Sequence[int], loop: str, given: Sequence[str], cfg: TaskConfig, device: torch.device) -> Scale:
    """Print a row for each number of robots in `sizes`, and return all figures. `given` is the command line of every size. A
    size that fails has a row with the reason.

    Raises:
        ConfigError: the configuration does not allow that many robots.
    """
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print(f"{cfg.task}, {where}, {loop} training", flush=True)
    print("".join(f"{name:>{width}}" for name, width, _ in COLUMNS), flush=True)
    rows = []
    for size in sizes:
        rows.append(measure_apart(without(given, "--robots", "--out", "--num-envs", "--runner"), size, loop))
        print(line(rows[-1]), flush=True)
    failed = any(row.get("failed", NO_ROOM) != NO_ROOM for row in rows)
    return Scale({"task": cfg.task, "device": where, "loop": loop, "sizes": rows}, int(failed))


def numbers(text: str) -> list[int]:
    """Return the numbers of a list: '1024,4096' -> [1024, 4096].

    Raises:
        ConfigError: the text is not a list of numbers above 0.
    """
    parts = [part.strip().replace("_", "") for part in text.split(",")]
    if not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise ConfigError(f"--robots: '{text}' is not a list of numbers of robots, like 1024,4096,16384")
    return [int(part) for part in parts]


def measure_apart(arguments: Sequence[str], size: int, loop: str) -> dict[str, Any]:
    """Return the benchmark's results for `size` robots with these arguments; `failed` has the reason if they are missing.

    Raises:
        ConfigError: the configuration does not allow so many robots.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "legged", "benchmark", "step", *arguments]
        command += ["--num-envs", str(size), "--runner", loop, "--out", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == EXIT_WRONG_INPUT:
            said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
            raise ConfigError(said[-1].removeprefix("error: "))
        if done.returncode == KILLED or (done.returncode and LACKS_MEMORY.search(done.stderr)):
            return {"num_envs": size, "failed": NO_ROOM}
        if done.returncode:
            print(done.stderr, file=sys.stderr)
            said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
            return {"num_envs": size, "failed": said[-1]}
        result = json.loads((Path(folder) / "benchmark.json").read_text(encoding="utf-8"))
    iterations = result.pop("iterations", {}).get(loop, {})
    return {**result, **iterations}


def without(given: Sequence[str], *flags: str) -> list[str]:
    """Return a command line without some options and their values."""
    own = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for flag in flags:
        own.add_argument(flag)
    return own.parse_known_args(list(given))[1]


def line(row: dict[str, Any]) -> str:
    """Return a row of the table as text."""
    if "failed" in row:
        _, width, robots = COLUMNS[0]
        return f"{robots(row):>{width}}  {row['failed']}"
    return "".join(f"{text(row):>{width}}" for _, width, text in COLUMNS)
