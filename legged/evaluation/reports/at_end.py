"""The report on a run that has just ended: whatever goes wrong with it is a line, because the run itself is done."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from legged.evaluation.reports.run_report import write_report
from legged.process import headless
from legged.process.paths import relative
from legged.process.processes import child_environment

LOG = "film.log"
"""File in a run's folder that keeps what the process that films it says."""
NICENESS = 10
FILMING: list[subprocess.Popen] = []
"""Processes that this one has started to film; the finished ones leave with the next."""


def report_at_end(folder: Path, film_with: Sequence[str] | None) -> None:
    """Write the report on a run, and say where it is or why there is none. With `film_with`, the flags by which another
    process finds the run's task, such a process then films the policy, and writes the report again with the film. Nothing
    waits for it: it outlives this process, and what goes wrong with it is in the run's film.log.
    """
    start = time.perf_counter()
    try:
        page = write_report(folder)
        says = "" if film_with is None else f"; {_film(folder, film_with)}"
    except KeyboardInterrupt:
        print(f"{relative(folder)}: interrupted before its report was written", file=sys.stderr, flush=True)
    except Exception as error:  # a report must not spoil a run
        said = " ".join(str(error).split())[:300] or type(error).__name__
        print(f"warning: {relative(folder)}: no report: {said}", file=sys.stderr, flush=True)
    else:
        print(f"report {relative(page)} ({time.perf_counter() - start:.1f} s{says})", flush=True)


def _film(folder: Path, flags: Sequence[str]) -> str:
    """Let another process film the policy; return a few words on that."""
    if headless.NO_PICTURES:
        return "no film: nothing can be drawn"
    command = [sys.executable, "-m", "legged", "runs", "report", str(folder), "--film", *flags]
    alone = {name: text for name, text in child_environment().items() if name not in ("RANK", "LOCAL_RANK", "WORLD_SIZE")}
    alone["CUDA_VISIBLE_DEVICES"] = ""  # it draws on the CPU, and a GPU's memory may be full
    alone["LP_NUM_THREADS"] = "1"  # of Mesa, which draws where there is no GPU
    FILMING[:] = [process for process in FILMING if process.poll() is None]
    try:
        with (folder / LOG).open("wb") as log:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=alone, start_new_session=True
            )
        if hasattr(os, "setpriority"):
            os.setpriority(os.PRIO_PROCESS, process.pid, NICENESS)
    except OSError as error:
        return f"no film: {error}"
    FILMING.append(process)
    return f"a film follows, or {LOG} says why not"
