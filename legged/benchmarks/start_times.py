"""Start-up time of a training, compared with the time to import torch; both are measured in new processes."""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from legged.benchmarks.scale import without
from legged.errors import RunError
from legged.process.startup import STAGES_FILE

ENDS = "first iteration"
CAPTURES = ("step captured", "training captured")
"""Stages that end when a CUDA graph is captured, or on the CPU when the step is checked."""


def time_start(given: Sequence[str], repeats: int) -> dict[str, Any]:
    """Return medians of `repeats` runs, after one run that fills caches: `torch_s`, the time of `import torch`; `stages`, the
    end of each stage of a training with the arguments `given`, since the start of its process; `capture_s`; the `ratio` of
    the end of the first iteration to `torch_s`; and `ratio_without_capture`. Times are in seconds.

    Raises:
        RunError: a process fails; the message is the last line of its error output.
    """
    torch_s, stages = [], []
    for _ in range(repeats + 1):
        torch_s.append(_run([sys.executable, "-c", "import torch"], {})["end"])
        command = [sys.executable, "-m", "legged", "train", *without(given, "--out", "--repeats")]
        command += ["--max-iterations", "1", "train.runner.film=false"]
        with tempfile.NamedTemporaryFile() as file:
            stages.append(_run(command, {STAGES_FILE: file.name}))
    found = {name: statistics.median(run[name] for run in stages[1:]) for name in stages[0]}
    names = list(found)
    capture_s = sum(found[name] - found[names[names.index(name) - 1]] for name in CAPTURES if name in found)
    alone = statistics.median(torch_s[1:])
    return {
        "torch_s": alone,
        "stages": found,
        "capture_s": capture_s,
        "ratio": found[ENDS] / alone,
        "ratio_without_capture": (found[ENDS] - capture_s) / alone,
    }


def start_report(times: dict[str, Any]) -> str:
    """Return the times as lines of text."""
    return "\n".join(
        [
            f"import torch: {times['torch_s']:.2f} s",
            "a training, seconds since its process was started:",
            *(f"  {seconds:7.2f}  {name}" for name, seconds in times["stages"].items()),
            f"to the first iteration: {times['ratio']:.2f} x import torch; less {times['capture_s']:.2f} s of capturing"
            f" graphs: {times['ratio_without_capture']:.2f} x",
        ]
    )


def _run(command: list[str], environment: dict[str, str]) -> dict[str, float]:
    """Run a process in an empty folder; return the end of each stage, and of the process as `end` [s]."""
    # The process finds this package as this process did, even if it is not installed.
    path = os.pathsep.join(str(Path(entry or ".").resolve()) for entry in sys.path)
    with tempfile.TemporaryDirectory() as folder:
        start = time.time()
        everything = {**os.environ, "PYTHONPATH": path, **environment}
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, env=everything)
        end = time.time()
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise RunError(f"startup: {said[-1].removeprefix('error: ')}")
    lines = Path(environment[STAGES_FILE]).read_text(encoding="utf-8").splitlines() if environment else []
    stages = {name: float(when) - start for when, name in (text.split(" ", 1) for text in lines)}
    return {**stages, "end": end - start}
