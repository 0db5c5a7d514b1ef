"""Learning curves: scalars from the TensorBoard files of runs, and charts of these scalars for one run or several runs."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged.config.dotted import value_at
from legged.config.loader import read_yaml
from legged.errors import ConfigError
from legged.evaluation.reports.charts import Chart, Line, curves, stacked
from legged.figures import COLORS
from legged.learning.run_folder import CONFIG_FILE

SAME_TIME = 0.05
"""Runs share a time axis if their mean times of an iteration differ by at most this share."""
MOST_PARTS = len(COLORS) - 1
"""Largest number of parts of the reward that have their own colour. Smaller parts are summed."""
EPISODE, LENGTH, LEVEL, WATCHED = "Episode/rew_", "Metrics/episode_length", "Terrain/level_", "Evaluation/"
"""Prefixes of tags, and the tag LENGTH. Tags of evaluations during training begin with WATCHED."""
SINGLE = ("Metrics/lin_vel_rmse", "Metrics/ang_vel_rmse", "Metrics/falls")
CURRICULUM = ("Metrics/command_vx", "Metrics/command_vy", "Metrics/command_yaw")
LEARNER = ("Policy/mean_std", "Loss/value", "Loss/behavior")
NOT_OF_THE_TASK = (LENGTH, "Metrics/contact_overflows", "Metrics/non_finite_worlds")
TITLES = {
    "Metrics/lin_vel_rmse": ("velocity error [m/s]", 1.0),
    "Metrics/ang_vel_rmse": ("yaw rate error [rad/s]", 1.0),
    "Metrics/falls": ("episodes that end in a fall [%]", 100.0),
    "Metrics/command_vx": ("largest commanded vx [m/s]", 1.0),
    "Metrics/command_vy": ("largest commanded vy [m/s]", 1.0),
    "Metrics/command_yaw": ("largest commanded yaw rate [rad/s]", 1.0),
    "Policy/mean_std": ("standard deviation of actions (noise)", 1.0),
    "Loss/value": ("loss of the value function", 1.0),
    "Loss/behavior": ("behaviour loss: student's actions against its teacher's", 1.0),
    "Evaluation/lin_vel_rmse": ("evaluated: velocity RMSE [m/s]", 1.0),
    "Evaluation/ang_vel_rmse": ("evaluated: yaw rate RMSE [rad/s]", 1.0),
    "Evaluation/falls": ("evaluated: robots that fell [%]", 100.0),
    "Evaluation/return": ("evaluated: return of an episode", 1.0),
    "Evaluation/episode_length": ("evaluated: length of an episode [control steps]", 1.0),
}
"""Tag -> title of its chart and factor on its values. The chart of any other tag has the tag's name as its title."""
Curve = tuple[np.ndarray, np.ndarray]
"""Iterations and values."""
Scalars = dict[str, Curve]
"""Tag -> curve."""


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


Named = Sequence[tuple[str, Log]]
"""Runs with their labels."""


def read_scalars(run: Path) -> Scalars:
    """Read all scalars of a run folder.

    Raises:
        ConfigError: the folder holds no TensorBoard file, or its file has no values.
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
        raise ConfigError(f"{run}: its TensorBoard file holds no values, because the training ended in its first iteration")
    return found


def read_config(run: Path) -> dict[str, Any]:
    """Return the configuration in a run folder. It is not checked, because an older version may have written it. Return an
    empty mapping if it can't be read.
    """
    try:
        return read_yaml(run / CONFIG_FILE)
    except ConfigError:
        return {}


def labels(folders: Sequence[Path], configs: Sequence[dict[str, Any]]) -> list[str]:
    """Return a label for each run: task, run name and seed, or the folder's name if the configuration is empty. If two labels
    are equal, the folder's name is added to both, and then a number if they are still equal.
    """
    found, names = [], [folder.resolve().name for folder in folders]
    for folder, config in zip(names, configs, strict=True):
        task, name, seed = (value_at(config, path) for path in ("task", "train.runner.run_name", "env.seed"))
        parts = [str(task), *([str(name)] if name else []), *([f"seed {seed}"] if seed is not None else [])]
        found.append(", ".join(parts) if task else folder)
    named = [f"{text} ({name})" if found.count(text) > 1 else text for text, name in zip(found, names, strict=True)]
    return [f"{text} [{i}]" if named.count(text) > 1 else text for i, text in enumerate(named, start=1)]


def always_promoted(config: dict[str, Any]) -> float | None:
    """Return the mean terrain level of robots that are promoted after every episode: 2 (R - 1) / 3 for R rows. Robots that
    finish the last row start again in a random row, so the number of robots in row r is proportional to r + 1. Return None
    if R is not known.
    """
    rows = value_at(config, "terrain.num_rows")
    return 2.0 * (rows - 1) / 3.0 if isinstance(rows, int) else None


def smooth(values: np.ndarray, width: int = 9) -> np.ndarray:
    """Return the running mean (n,) of `values` (n,) in a window of `width` values, which is shorter at the ends. Values that
    are not finite are left out. Where the window has no finite value, the mean is NaN.
    """
    if not len(values):
        return values
    kernel, good = np.ones(min(width, len(values))), np.isfinite(values)
    sums = np.convolve(np.where(good, values, 0.0), kernel, "same")
    counts = np.convolve(good.astype(float), kernel, "same").round()
    return np.where(counts > 0.0, sums / np.maximum(counts, 1.0), np.nan)


def common(curves_of: Sequence[Curve]) -> tuple[np.ndarray, np.ndarray]:
    """Return the iterations (I,) that all C curves have, and the values (C, I) of the curves at these iterations."""
    found = [dict(zip(*curve, strict=True)) for curve in curves_of]
    steps = sorted(set.intersection(*map(set, found))) if found else []
    return np.array(steps), np.array([[values[step] for step in steps] for values in found]).reshape(len(found), len(steps))


def mean_of(runs: list[Scalars], tag: str) -> Curve:
    """Return the mean curve of all runs that logged `tag`, at the iterations that these runs share, counted from 1."""
    steps, values = common([run[tag] for run in runs if tag in run])
    return steps + 1, values.mean(axis=0) if len(steps) else steps


def times_of(scalars: Scalars) -> Curve:
    """Return the curve of the time that each iteration takes [s]; the curve is empty if times were not logged."""
    parts = [scalars[tag] for tag in ("Perf/collection_time", "Perf/learning_time") if tag in scalars]
    steps, seconds = common(parts if len(parts) == 2 else [])
    return steps, seconds.sum(axis=0)


def common_time(runs: Collection[Scalars]) -> float | None:
    """Return the mean time of an iteration [s] in the first run that logged times. Return None if no run logged times, or if
    the runs' mean times differ by more than the share `SAME_TIME`.
    """
    found = [float(seconds.mean()) for _, seconds in map(times_of, runs) if seconds.size]
    alike = bool(found) and min(found) > 0.0 and max(found) <= (1.0 + SAME_TIME) * min(found)
    return found[0] if alike else None


# ---- charts ----------------------------------------------------------------------------------------------------------


def curves_of_run(log: Log) -> list[str]:
    """Return all charts of one run, each as an SVG."""
    run, parts = [("", log)], _parts(log.scalars)
    drawings = [curves(chart) for chart in (*outcomes(run), *_learner(run), *levels([log]))]
    return [*drawings[:1], *([parts] if parts else []), *drawings[1:]]


def curves_of_runs(runs: Named) -> list[str]:
    """Return charts, each as an SVG, that show the curves of several runs in the same axes."""
    return [curves(chart) for chart in (*outcomes(runs), *_learner(runs), *_one("Terrain/level", "mean terrain level", runs))]


def outcomes(runs: Named) -> list[Chart]:
    """Return charts of the robots' performance: returns, errors, falls and metrics of the task."""
    steps = {log.dt for _, log in runs}
    dt = next(iter(steps)) if len(steps) == 1 else None
    others = [tag for tag in _tags(runs, "Metrics/") if tag not in (*NOT_OF_THE_TASK, *SINGLE, *CURRICULUM)]
    return [
        *_returns(runs),
        *_several(SINGLE, runs),
        *_one(LENGTH, f"length of an episode [{'control steps' if dt is None else 's'}]", runs, dt or 1.0),
        *_several(others, runs),
    ]


def _learner(runs: Named) -> list[Chart]:
    """Return charts of the command curriculum, of evaluations during training, and of the learning algorithm."""
    wanted = {value_at(log.config, "train.algorithm.desired_kl") for _, log in runs} - {None}
    level = ("desired_kl", float(wanted.pop())) if len(wanted) == 1 else None
    return [
        *_several(CURRICULUM, runs),
        *_several(_tags(runs, WATCHED), runs, exact=True, markers=True),
        *_one("Loss/learning_rate", "learning rate", runs, exact=True, log=True),
        *_several(LEARNER, runs),
        *_one("Loss/kl", "divergence (KL) within an update [nat]", runs, level=level),
    ]


def _tags(runs: Named, beginning: str) -> list[str]:
    return list(dict.fromkeys(tag for _, log in runs for tag in log.scalars if tag.startswith(beginning)))


def _several(tags: Sequence[str], runs: Named, **how: Any) -> list[Chart]:
    names = {tag: "evaluated: " * tag.startswith(WATCHED) + tag.partition("/")[2].replace("_", " ") for tag in tags}
    titles = {tag: TITLES.get(tag, (name, 1.0)) for tag, name in names.items()}
    return [chart for tag, (title, factor) in titles.items() for chart in _one(tag, title, runs, factor, **how)]


def _one(
    tag: str, title: str, runs: Named, factor: float = 1.0, exact: bool = False, markers: bool = False, **look: Any
) -> list[Chart]:
    """Return a list with one chart, which has a line for each run that logged `tag`; an empty list if no run logged it. Lines
    are running means unless `exact` is set.
    """
    lines = []
    for i, (label, run) in enumerate(runs):
        steps, values = run.scalars.get(tag, (np.array([]), np.array([])))
        if len(steps):
            y = factor * values if exact else smooth(factor * values)
            lines.append(Line(label if len(runs) > 1 else "", steps + 1, y, markers=markers, style=i))
    return [Chart(title, "iteration", lines, **look)] if lines else []


def _returns(runs: Named) -> list[Chart]:
    """Return a list with the chart of returns. If there is one run, a band shows the standard deviation over episodes."""
    charts = _one("Train/mean_reward", "return of an episode", runs)
    std = runs[0][1].scalars.get("Train/std_reward")
    if not charts or len(runs) > 1 or std is None:
        return charts
    (line,) = charts[0].lines
    of = dict(zip(std[0] + 1, std[1], strict=True))
    width = np.nan_to_num(smooth(np.array([of.get(step, np.nan) for step in line.x])))
    lines = [replace(line, band=(line.y - width, line.y + width))]
    return [replace(charts[0], title=f"{charts[0].title}, and standard deviation over episodes", lines=lines)]


def _parts(scalars: Scalars) -> str:
    """Return an SVG of the parts of the reward as stacked areas; an empty text if no part was logged."""
    names = [tag.removeprefix(EPISODE) for tag in scalars if tag.startswith(EPISODE)]
    steps, values = common([scalars[EPISODE + name] for name in names])
    smoothed = [smooth(part) for part in values]
    known = np.isfinite(smoothed).all(axis=0)
    if not len(steps) or not known.any():
        return ""
    parts = {name: part[known] for name, part in zip(names, smoothed, strict=True)}
    order = sorted(parts, key=lambda name: -float(np.abs(parts[name]).mean()))
    shown, rest = {name: parts[name] for name in order[:MOST_PARTS]}, order[MOST_PARTS:]
    if rest:
        shown[f"{len(rest)} more"] = np.sum([parts[name] for name in rest], axis=0)
    chart = Chart("parts of the reward, per second of a full episode", "iteration")
    return stacked(chart, steps[known] + 1.0, shown)


def levels(logs: Sequence[Log]) -> list[Chart]:
    """Return charts of the mean terrain level, and of the shares of episodes after which a robot moves up or down. Each chart
    has a line for each terrain type. Values are means over the runs. The list is empty without a terrain curriculum.
    """
    scalars = [log.scalars for log in logs]
    types = [tag.removeprefix(LEVEL) for tag in _tags([("", log) for log in logs], LEVEL)]
    if not types:
        return []
    always = {highest for log in logs if (highest := always_promoted(log.config)) is not None}
    level = ("always promoted", always.pop()) if len(always) == 1 else None

    def lines(beginning: str, width: int) -> list[Line]:
        means = {name: mean_of(scalars, beginning + name) for name in types}
        each = enumerate(means.items())
        return [Line(name.replace("_", " "), steps, smooth(values, width), style=i) for i, (name, (steps, values)) in each]

    found = [Chart("mean terrain level by type", "iteration", lines(LEVEL, 1), level=level)]
    for moved, way in (("promoted", "up"), ("demoted", "down")):
        shares = lines(f"Terrain/{moved}_", 25)
        found.append(Chart(f"episodes after which a robot moves {way}", "iteration", shares, percent=True))
    return [chart for chart in found if any(len(line.x) for line in chart.lines)]
