"""Trainings that are ended at random moments, start-up included: what was saved is whole, and training goes on from it."""

import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from helpers import HANG_S, TASK, TINY_TRAINING, checkpoints, run_folders

from legged.learning.captured import CapturedRunner
from legged.learning.run_folder import run_config
from legged.learning.run_state import state_path
from legged.registry import make_task

CASES = int(os.environ.get("FUZZ_KILLS", "1"))
"""Moments for each signal; FUZZ_KILLS=50 for a night."""
LONGEST_S = 9.0
"""Start-up takes half of it, and iterations of some milliseconds the rest [s]."""
REPOSITORY = Path(__file__).parents[2]

pytestmark = [pytest.mark.usefixtures("workplace"), pytest.mark.slow]


def end_a_training(number: signal.Signals, after_s: float) -> tuple[int, str]:
    """Exit code and output of a training that gets a signal after a time."""
    command = [sys.executable, str(REPOSITORY / "train.py"), "--task", TASK, "--sim_device", "cpu", "--num_envs", "8"]
    command += [*TINY_TRAINING, "train.runner.save_interval=1", "--max_iterations", "100000"]
    with Path("out.txt").open("w") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env={**os.environ, "COLUMNS": "200"})
        time.sleep(after_s)
        process.send_signal(number)
        try:
            code = process.wait(timeout=HANG_S)
        finally:
            process.kill()
    return code, Path("out.txt").read_text()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda n: n.name)
@pytest.mark.parametrize("case", range(CASES))
def test_nothing_that_was_saved_is_lost(number, case):
    moment = random.Random(f"{number} {case}").uniform(0.05, LONGEST_S)
    code, out = end_a_training(number, moment)
    assert "Traceback" not in out, f"after {moment:.3f} s: {out}"
    folders = run_folders() if Path("logs").is_dir() else []
    assert len(folders) <= 1
    reached = [int(done) for done in re.findall(r"^it (\d+)/", out, re.MULTILINE)]
    if number != signal.SIGKILL and not out.strip():
        assert code in (-number, 128 + number), out  # Python had not begun to listen
    elif number != signal.SIGKILL:
        assert code in (-number, 128 + number, 130), f"code {code} after {moment:.3f} s: {out}"
    if not folders:
        assert not reached
        return
    (folder,) = folders
    saved = checkpoints(folder)
    for iteration in saved:
        assert torch.load(folder / f"model_{iteration}.pt", weights_only=True)["iter"] == iteration
    if number != signal.SIGKILL:
        assert [path.name for path in folder.iterdir() if path.name.startswith(".")] == []
        if stopped := re.search(r"stopped after (\d+) iterations", out):
            assert max(saved) == int(stopped.group(1)) - 1
    if not saved:
        assert not reached
        return
    newest = folder / f"model_{max(saved)}.pt"
    assert max(saved) >= max(reached, default=1) - 2  # a line is printed just before its checkpoint is written
    runner = CapturedRunner(make_task(run_config(folder)))
    why = runner.resume(str(newest))
    assert why == "", f"the state beside {newest} is lost: {why}"
    assert state_path(newest).is_file()
    runner.learn(1)
    assert runner.current_learning_iteration == max(saved) + 1
