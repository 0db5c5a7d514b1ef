"""The process that writes the report on a run after its training. The training itself imports nothing of the report."""

import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from legged.learning.run_folder import REPORT
from legged.process.paths import relative
from legged.process.processes import start_apart

LOG = f"{REPORT}.log"
"""Name of the file in a run folder with the output of the process that writes the report."""
NICENESS = 10
STARTED: list[subprocess.Popen[bytes]] = []
"""Processes that this process has started and not waited for."""


def start_report(folder: Path, options: Sequence[str]) -> None:
    """Start `legged runs report` with `options` on a run that has just ended, and print where the report will be. A failure
    prints a warning and raises no error, because the run itself is complete.

    The film has to be made in another process, because a failing graphics driver may end or block a process.
    """
    command = [sys.executable, "-m", "legged", "runs", "report", str(folder), *options]
    try:
        # The film is drawn on the CPU, because a GPU's memory may be full. Mesa draws without a GPU, here with one thread.
        process = start_apart(command, folder / LOG, CUDA_VISIBLE_DEVICES="", LP_NUM_THREADS="1")
        STARTED.append(process)
        if hasattr(os, "setpriority"):
            os.setpriority(os.PRIO_PROCESS, process.pid, NICENESS)
    except OSError as error:
        print(f"warning: {relative(folder)}: no report: {error}", file=sys.stderr, flush=True)
    else:
        page = relative(folder / f"{REPORT}.html")
        print(f"report follows: {page} ({LOG} says why if it does not)", flush=True)


def wait_for_reports() -> None:
    """Wait until the processes that this process has started have ended. Ctrl-C ends the wait."""
    with suppress(KeyboardInterrupt):
        while STARTED:
            STARTED.pop().wait()
