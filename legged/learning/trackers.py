"""Experiment trackers, such as W&B. rsl-rl's writers send the log to a tracker. TensorBoard's file is written in any case.
Trackers are optional, and a failing tracker does not end a training.
"""

import inspect
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from rsl_rl.utils.log_writer import LogWriter
from torch.utils.tensorboard import SummaryWriter

from legged.config import TaskConfig, to_dict
from legged.config.checks import shown
from legged.errors import ConfigError, RunError, suggest
from legged.user_modules import find_modules_in

TENSORBOARD = "tensorboard"
FLUSH_S = 10
"""Interval at which TensorBoard's file is written [s]."""
SECONDS = "/time"
"""Ending of the tags that are logged over seconds instead of iterations. Trackers don't get these tags."""
FILES = ("config.yaml", "code.diff", "timing.json", "report.html", "report.md", "evaluation_*.json", "*.gif", "*.png")
"""Files of a run folder that a tracker gets at the end, in addition to videos."""


def check_tracker(cfg: TaskConfig) -> None:
    """Check that the configured tracker is available.

    Raises:
        ConfigError: the tracker is unknown or not installed, or its class is not a LogWriter.
    """
    if cfg.train.runner.logger != TENSORBOARD:
        _writer_class(cfg)


def _writer_class(cfg: TaskConfig) -> type[LogWriter]:
    """Return the class of the configured writer. Raises the errors of `check_tracker`."""
    from rsl_rl.utils import neptune_log_writer, wandb_log_writer  # these modules import their trackers if installed

    name, where = cfg.train.runner.logger, cfg.origins.where("train.runner.logger")
    known: dict[str, tuple[Any, str, type]] = {
        "wandb": (wandb_log_writer.wandb, "wandb", wandb_log_writer.WandbLogWriter),
        "neptune": (neptune_log_writer.neptune, "neptune", neptune_log_writer.NeptuneLogWriter),
    }
    if name in known:
        package, pip, kind = known[name]
        if package is None:
            raise ConfigError(f"{where}: '{name}' needs the package {pip}, which is not installed here: pip install {pip}")
        return kind
    module, colon, attribute = name.partition(":")
    if not colon:
        allowed = suggest(name[:100], (TENSORBOARD, *known))
        raise ConfigError(f"{where}: there is no tracker {shown(name)}{allowed}; give your own writer as module:Class")
    find_modules_in(str(Path.cwd()))
    try:
        found = getattr(import_module(module), attribute)
    except Exception as error:  # a user's module can raise anything
        raise ConfigError(f"{where}: {shown(name)} can't be imported ({type(error).__name__}: {error})") from error
    if not (isinstance(found, type) and issubclass(found, LogWriter)):
        raise ConfigError(f"{where}: {shown(name)} does not extend rsl_rl.utils.log_writer.LogWriter")
    return found


def open_writer(cfg: TaskConfig, folder: str) -> "SummaryWriter | Tracker":
    """Open the configured writers for a run folder: TensorBoard's, and that of a tracker if there is one.

    Raises:
        ConfigError: as in `check_tracker`.
        RunError: the tracker does not start, for example because a login is missing.
    """
    runner = cfg.train.runner
    if runner.logger == TENSORBOARD:
        return SummaryWriter(log_dir=folder, flush_secs=FLUSH_S)
    kind = _writer_class(cfg)
    given: dict[str, Any] = {"log_dir": folder}
    if "project_name" in inspect.signature(kind).parameters:
        given["project_name"] = runner.logger_project or runner.experiment_name or cfg.task
    try:
        writer = kind(**given)
        writer.store_config(_Plain(to_dict(cfg)), to_dict(cfg.train))
    except Exception as error:  # each tracker raises its own error types
        text = " ".join(str(error).split()) or type(error).__name__
        raise RunError(f"train.runner.logger: {runner.logger} does not start: {text[:300]}") from error
    return Tracker(writer, folder)


class _Plain:
    """Adapter that gives rsl-rl's writers the configuration as a dictionary."""

    def __init__(self, values: dict[str, Any]) -> None:
        self._values = values

    def to_dict(self) -> dict[str, Any]:
        return self._values


class Tracker(LogWriter):
    """Writer to TensorBoard and a tracker. After its first failure and a warning, a tracker is not used any more."""

    def __init__(self, writer: LogWriter, folder: str) -> None:
        """Take the tracker's `writer`, which may write TensorBoard's file itself, as rsl-rl's writers do."""
        self._writer = writer
        self._both = isinstance(writer, SummaryWriter)
        self._tensorboard = writer if isinstance(writer, SummaryWriter) else SummaryWriter(folder, flush_secs=FLUSH_S)
        self._failed = False

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        if not self._both or self._failed or tag.endswith(SECONDS):
            SummaryWriter.add_scalar(self._tensorboard, tag, scalar_value, global_step)
            if self._both or tag.endswith(SECONDS):
                return
        self._try(lambda: self._writer.add_scalar(tag, float(scalar_value), global_step))

    def save_model(self, model_path: str, it: int) -> None:
        self._try(lambda: self._writer.save_model(model_path, it))

    def save_file(self, path: str) -> None:
        self._try(lambda: self._writer.save_file(path))

    def save_video(self, video: Path, it: int) -> None:
        self._try(lambda: self._writer.save_video(video, it))

    def stop(self) -> None:
        self._try(self._writer.stop)

    def close(self) -> None:
        """Close TensorBoard's file. The tracker stays open for files written at the end of a run."""
        self._tensorboard.close()

    def hand_over(self, folder: Path, iteration: int) -> None:
        """Give the tracker the videos and reports of a run folder, then close the tracker."""
        for pattern in FILES:
            for path in sorted(folder.glob(pattern)):
                self.save_file(str(path))
        for video in sorted(folder.rglob("*.mp4")):
            self.save_video(video, iteration)
        self.stop()

    def _try(self, call: Callable[[], object]) -> None:
        """Call the tracker, unless it has failed before."""
        if self._failed:
            return
        try:
            call()
        except Exception as error:  # a lost connection or the tracker's code can raise anything
            self._failed = True
            text = " ".join(str(error).split()) or type(error).__name__
            print(f"warning: the tracker has failed and is no longer used: {text[:300]}", file=sys.stderr, flush=True)
