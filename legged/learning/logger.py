"""rsl-rl's logger for TensorBoard, extended by this package's display on the console. The logger also decides when a training
stops.
"""

import contextlib
import io
import math
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rsl_rl.utils.logger import Logger
from torch.utils.tensorboard import SummaryWriter

from legged.learning.display import Display, Progress
from legged.learning.distributed import any_rank
from legged.learning.divergence import FAULT, MINI_BATCHES, Diverged, DivergenceDetector
from legged.learning.estimator import SECTION as ESTIMATES
from legged.learning.evaluations import SECTION, Ended
from legged.learning.kl_meter import KLMeter
from legged.learning.report_process import wait_for_reports
from legged.learning.trackers import Tracker, open_writer
from legged.process.neighbours import Neighbours


class Interrupted(Exception):
    """Error that stops a training on request. It is raised between iterations, when networks and optimiser are consistent."""


class QuietLogger(Logger):
    """Logger of iterations. At the end of an iteration it stops the training on request, or if the training has diverged."""

    device: str

    def __init__(self, *args: Any, display: Display | None = None, left_out: Callable[[], float], **kwargs: Any) -> None:
        """Take `left_out`, which returns the share of the last update's mini-batches that were skipped. `args` and `kwargs`
        are rsl-rl's arguments.
        """
        super().__init__(*args, **kwargs)
        self.display, self._left_out = display, left_out
        self.divergence = DivergenceDetector(self.cfg["num_steps_per_env"] * self.num_envs)
        self.stop_requested = False
        self.evaluate: Callable[[int, int], dict[str, float]] = lambda _iterations, _total: {}
        """Function of the number of finished iterations and the total number. It evaluates the policy if an evaluation is
        due, and returns the figures."""
        self.why_end: Callable[[], str] | None = None
        """Function that returns the reason to end the training, or an empty text. It is None if no process evaluates."""
        self.neighbours: Neighbours | None = None
        """Counter of other trainings on this device, which slow this one down. It is None in all processes but the first."""
        self.loop_s = 0.0
        """Time that this process has spent in iterations [s]."""
        self.return_std: float | None = None
        """Standard deviation of the episodes' returns in the last rollout in which an episode ended. If it is None, the
        standard deviation of rsl-rl's buffer of returns is logged."""
        self.kl_meter: KLMeter | None = None
        """Recorder of the KL divergence in rsl-rl's own update."""
        self.latest: dict[str, float] = {}
        """Last value of each log entry of the task. An entry without a value so far is NaN, for example an episode mean
        before the first episode has ended."""

    @property
    def steps_per_iteration(self) -> int:
        """Control steps of all robots on all GPUs in one iteration."""
        return self.cfg["num_steps_per_env"] * self.num_envs * self.gpu_world_size

    def init_logging_writer(self) -> None:
        """Open TensorBoard's file, and the tracker if there is one.

        Raises:
            RunError: the tracker does not start.
        """
        self.writer = None
        if self.log_dir is not None and not self.disable_logs:
            self.writer = open_writer(self.env_cfg, self.log_dir)  # type: ignore[assignment,arg-type]

    def stop_logging_writer(self) -> None:
        """Close TensorBoard's writer and its thread, which rsl-rl leaves open. A tracker stays open until `hand_over`."""
        if isinstance(self.writer, SummaryWriter | Tracker):
            self.writer.close()

    def hand_over(self, iteration: int) -> None:
        """Give the videos and reports in the run folder to the tracker, if there is one, and close the tracker. Wait for the
        report first.
        """
        if isinstance(self.writer, Tracker):
            wait_for_reports()
            self.writer.hand_over(Path(self.log_dir), iteration)

    def log(self, it: int, start_it: int, total_it: int, collect_time: float, learn_time: float, **kwargs: Any) -> None:
        """Write and show one iteration. Stop the training if any process was asked to stop or has a reason to stop.

        Raises:
            Interrupted: a process was asked to stop.
            Ended: an evaluation ended the training.
            Diverged: numbers have been NaN or infinite for too long.
        """
        # An episode mean is NaN in a rollout in which no episode ended. Such entries are left out.
        values: dict[str, float] = {}
        names = dict.fromkeys((name for entry in self.ep_extras for name in entry if not name.startswith(FAULT)), math.nan)
        for entry in self.ep_extras:
            stacked = torch.stack([value.reshape(()) for value in entry.values()]).tolist()  # one transfer for all values
            values.update({key: value for key, value in zip(entry, stacked, strict=True) if value == value})
        evaluated = self.evaluate(it + 1, total_it)
        values.update({f"{SECTION}{name}": value for name, value in evaluated.items() if math.isfinite(value)})
        given = kwargs.pop("loss_dict")
        estimated = {name: error for name, error in given.items() if name.startswith(ESTIMATES)}
        values.update({name: error for name, error in estimated.items() if math.isfinite(error)})
        left_out = self._left_out()
        if left_out > 0.0:
            values[MINI_BATCHES] = left_out
        self.ep_extras[:] = [dict(values)] if values else []  # rsl-rl adds tensors to this copy of `values`
        kl = self.kl_meter.flush() if self.kl_meter else None
        losses = {name: loss for name, loss in given.items() if name not in estimated} | ({} if kl is None else {"kl": kl})
        losses = {name: loss for name, loss in losses.items() if math.isfinite(loss)}
        self._log_return_std(it)
        device, self.device = self.device, "cpu"  # the numbers are on the host, and should stay there
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                super().log(it, start_it, total_it, collect_time, learn_time, loss_dict=losses, **kwargs)
        finally:
            self.device = device
        self.ep_extras.clear()  # rsl-rl clears them only in the first process
        self.divergence.update(values, left_out)
        self.latest = names | {name: value for name, value in self.latest.items() if not name.startswith(FAULT)} | values
        self.loop_s += collect_time + learn_time
        if self.neighbours is not None:
            self.neighbours.glance()
        if self.display is not None:
            self.display.show(
                Progress(
                    iteration=it + 1,
                    total=total_it,
                    elapsed_s=self.loop_s,
                    eta_s=self.loop_s / (it + 1 - start_it) * (total_it - it - 1),
                    steps_per_s=self.steps_per_iteration / (collect_time + learn_time),
                    collect_s=collect_time,
                    learn_s=learn_time,
                    reward=sum(self.rewbuffer) / len(self.rewbuffer) if self.rewbuffer else float("nan"),
                    action_std=float(kwargs["action_std"].detach().mean()),
                    values=dict(self.latest),
                    behavior=losses.get("behavior"),
                )
            )
        why_end = self.why_end() if self.why_end is not None else ""
        diverged, ended, stopped = any_rank(bool(self.divergence.why_stop), bool(why_end), self.stop_requested)
        if diverged:
            raise Diverged(self.divergence.why_stop or "numbers of another process were NaN or infinite")
        if ended and it + 1 < total_it:
            raise Ended
        if stopped and it + 1 < total_it:
            raise Interrupted

    def _log_return_std(self, it: int) -> None:
        """Write the standard deviation of the episodes' returns, which rsl-rl does not log."""
        if self.writer is not None and self.rewbuffer:
            std = statistics.pstdev(self.rewbuffer) if self.return_std is None else self.return_std
            if math.isfinite(std):
                self.writer.add_scalar("Train/std_reward", std, it)  # type: ignore[attr-defined]
