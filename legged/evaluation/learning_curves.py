"""The TensorBoard files of runs: read, labelled and averaged."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged.config.dotted import value_at
from legged.config.loader import read_yaml
from legged.errors import ConfigError
from legged.learning.run_folder import CONFIG_FILE

SAME_TIME = 0.05
"""Share by which the iterations of runs may differ in time for the runs to have one time axis."""
Scalars = dict[str, tuple[np.ndarray, np.ndarray]]
"""Tag -> (iterations, values)."""


@dataclass(frozen=True)
class Log:
    """The logged values and the configuration of a run."""

    scalars: Scalars
    config: dict[str, Any]

    @property
    def dt(self) -> float | None:
        """Length of a control step [s]; None if the configuration lacks it."""
        dt, decimation = value_at(self.config, "sim.dt"), value_at(self.config, "control.decimation")
        return dt * decimation if isinstance(dt, int | float) and isinstance(decimation, int) else None


def read_scalars(run: Path) -> Scalars:
    """Read all scalars of a run folder.

    Raises:
        ConfigError: the folder holds no TensorBoard file, or one without values.
    """
    if not list(run.glob("events.out.tfevents.*")):
        raise ConfigError(f"{run}: holds no TensorBoard file")
    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    found = {}
    for tag in events.Tags()["scalars"]:
        entries = events.Scalars(tag)
        found[tag] = (np.array([e.step for e in entries]), np.array([e.value for e in entries]))
    if not found:
        raise ConfigError(f"{run}: its TensorBoard file holds no values; the training ended before its first iteration did")
    return found


def read_config(run: Path) -> dict[str, Any]:
    """Return the configuration in a run folder without checking it, because an older version may have written it; an empty
    mapping if it can't be read.
    """
    try:
        return read_yaml(run / CONFIG_FILE)
    except ConfigError:
        return {}


def labels(folders: Sequence[Path], configs: Sequence[dict[str, Any]]) -> list[str]:
    """Return a label for each run: task, run name and seed. Without a configuration the label is the folder's name; where two
    labels would be equal, the folder's name is added.
    """
    found = []
    for folder, config in zip(folders, configs, strict=True):
        name, seed = value_at(config, "train.runner.run_name"), value_at(config, "env.seed")
        parts = [str(config["task"])] if config.get("task") else []
        parts += [str(name)] if name else []
        parts += [f"seed {seed}"] if seed is not None else []
        found.append(", ".join(parts) if config.get("task") else folder.resolve().name)
    twice = {label for label in found if found.count(label) > 1}
    names = [folder.resolve().name for folder in folders]
    named = [f"{text} ({name})" if text in twice else text for text, name in zip(found, names, strict=True)]
    return [f"{text} [{i}]" if named.count(text) > 1 else text for i, text in enumerate(named, start=1)]


def always_promoted(config: dict[str, Any]) -> float | None:
    """Return the mean level of robots that are always promoted on terrain of R rows: 2 (R - 1) / 3. From the top row they
    move to a random one, so row r holds robots in proportion to r + 1. Return None if R is not known.
    """
    rows = value_at(config, "terrain.num_rows")
    return 2.0 * (rows - 1) / 3.0 if isinstance(rows, int) else None


def smooth(values: np.ndarray, width: int = 9) -> np.ndarray:
    """Return the running mean over `width` values; the window is shorter at the ends. Values that are not finite are left
    out; the mean is NaN where the window has no finite value.
    """
    if not len(values):
        return values
    kernel, good = np.ones(min(width, len(values))), np.isfinite(values)
    sums = np.convolve(np.where(good, values, 0.0), kernel, "same")
    counts = np.convolve(good.astype(float), kernel, "same").round()
    return np.where(counts > 0.0, sums / np.maximum(counts, 1.0), np.nan)


def mean_of(runs: list[Scalars], tag: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the iterations, counted from 1, that all runs with this tag have, and the mean over the runs."""
    found = [dict(zip(*run[tag], strict=True)) for run in runs if tag in run]
    steps = sorted(set.intersection(*(set(values) for values in found))) if found else []
    return np.array(steps) + 1, np.array([np.mean([values[step] for values in found]) for step in steps])


def common_time(runs: Collection[Scalars]) -> float | None:
    """Return the mean time of an iteration [s] of the first run that has logged times. Return None if no run has, or if times
    of runs differ by more than `SAME_TIME`.
    """
    parts = ("Perf/collection_time", "Perf/learning_time")
    found = [sum(float(np.mean(scalars[part][1])) for part in parts) for scalars in runs if set(parts) <= scalars.keys()]
    alike = bool(found) and min(found) > 0.0 and max(found) <= (1.0 + SAME_TIME) * min(found)
    return found[0] if alike else None
