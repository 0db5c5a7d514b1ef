"""The report on a run that has just ended: whatever goes wrong with it is a line, because the run itself is done."""

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from legged.evaluation.reports.run_report import write_report
from legged.process.paths import relative
from legged.process.processes import child_environment

LONGEST_FILM_S = 60.0
"""A film that takes longer is left out [s]."""


def report_at_end(folder: Path, film_with: Sequence[str] | None) -> None:
    """Write the report on a run, and say where it is or why there is none. With `film_with`, the flags by which another
    process finds the run's task, its policy is filmed first, by that process: what draws may fail in ways that no Python
    survives, and is told to stop if it takes too long.
    """
    start = time.perf_counter()
    try:
        why = "" if film_with is None else _film(folder, film_with)
        page = write_report(folder)
    except KeyboardInterrupt:
        print(f"{relative(folder)}: interrupted before its report was written", file=sys.stderr, flush=True)
    except Exception as error:  # a report must not spoil a run
        said = " ".join(str(error).split())[:300] or type(error).__name__
        print(f"warning: {relative(folder)}: no report: {said}", file=sys.stderr, flush=True)
    else:
        without = f"; no film: {why}" if why else ""
        print(f"report {relative(page)} ({time.perf_counter() - start:.1f} s{without})", flush=True)


def _film(folder: Path, flags: Sequence[str]) -> str:
    """Film the policy in another process; return why there is no film, nothing if there is."""
    command = [sys.executable, "-m", "legged", "runs", "report", str(folder), "--film", *flags]
    alone = {key: text for key, text in child_environment().items() if key not in ("RANK", "LOCAL_RANK", "WORLD_SIZE")}
    alone["CUDA_VISIBLE_DEVICES"] = ""  # it draws on the CPU, and a GPU's memory may be full
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, env=alone, timeout=LONGEST_FILM_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"it took longer than {LONGEST_FILM_S:g} s"
    except OSError as error:
        return str(error)
    if done.returncode == 0:
        return next((line.removeprefix("no film: ") for line in done.stdout.splitlines() if line.startswith("no film: ")), "")
    return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1][:200]
