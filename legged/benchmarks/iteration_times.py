"""Duration of training iterations in each training loop."""

import contextlib
import io
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from legged.config import TaskConfig
from legged.envs import BaseTask
from legged.learning.captured import CapturedRunner
from legged.learning.display import Progress
from legged.learning.runner import Runner
from legged.learning.student_runner import StudentRunner
from legged.learning.teacher import Teacher

LOOPS: dict[str, Callable[..., Runner]] = {"stock": Runner, "captured": CapturedRunner}
"""Training loops by name."""


def loops_of(cfg: TaskConfig, teacher: Teacher | None, asked: str | None) -> dict[str, Callable[..., Runner]]:
    """Return the runners to time, by name of the loop: the loop `asked`, or else all. Students of a `teacher` and policies
    with an estimator have only the loop of the configuration.
    """
    own = cfg.train.runner.loop
    if teacher is not None:
        return {own: partial(StudentRunner, teacher=teacher)}
    one = own if cfg.train.policy.estimator.targets else asked
    return {one: LOOPS[one]} if one else LOOPS


class Recorder:
    """Replacement for the display of a training that keeps the times of iterations."""

    def __init__(self) -> None:
        self.progress: list[Progress] = []

    def show(self, progress: Progress) -> None:
        """Keep the progress of an iteration."""
        self.progress.append(progress)


def time_iterations(kind: Callable[..., Runner], task: BaseTask, count: int) -> dict[str, Any]:
    """Return the medians of rollout, update and iteration times [ms] and the range of the latter, over `count` iterations of
    a training with new networks, after a first iteration that is left out.
    """
    recorder = Recorder()
    with tempfile.TemporaryDirectory() as folder:
        runner = kind(task, log_dir=Path(folder), device=str(task.device), display=recorder)
        with contextlib.redirect_stdout(io.StringIO()) as said:
            runner.learn(count + 1, init_at_random_ep_len=True)
    seen = recorder.progress[1:]
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
