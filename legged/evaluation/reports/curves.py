"""The learning curves of one run or of several as charts."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from legged.config.dotted import value_at
from legged.evaluation.learning_curves import Log, Scalars, always_promoted, mean_of, smooth
from legged.evaluation.reports.charts import Chart, Line, curves, stacked
from legged.figures import COLORS

MOST_PARTS = len(COLORS) - 1
"""Reward parts with their own colour; the smaller ones are summed."""
EPISODE, LENGTH, LEVEL, WATCHED = "Episode/rew_", "Metrics/episode_length", "Terrain/level_", "Evaluation/"
"""Beginnings of tags; `WATCHED` begins those of evaluations during training."""
Named = Sequence[tuple[str, Log]]
"""Runs with their labels."""
SINGLE = (
    ("Metrics/lin_vel_rmse", "velocity error [m/s]", 1.0),
    ("Metrics/ang_vel_rmse", "yaw rate error [rad/s]", 1.0),
    ("Metrics/falls", "episodes that end in a fall [%]", 100.0),
)
"""Tag, title, factor."""
CURRICULUM = (
    ("Metrics/command_vx", "largest commanded vx [m/s]", 1.0),
    ("Metrics/command_vy", "largest commanded vy [m/s]", 1.0),
    ("Metrics/command_yaw", "largest commanded yaw rate [rad/s]", 1.0),
)
"""Tag, title and factor of the ranges of a curriculum of commands."""
LEARNER = (
    ("Policy/mean_std", "standard deviation of actions (noise)", 1.0),
    ("Loss/value", "loss of the value function", 1.0),
    ("Loss/behavior", "behaviour loss: student's actions against its teacher's", 1.0),
)
NOT_OF_THE_TASK = (LENGTH, "Metrics/contact_overflows", "Metrics/non_finite_worlds")
OF_EVALUATION = {
    "lin_vel_rmse": ("velocity RMSE [m/s]", 1.0),
    "ang_vel_rmse": ("yaw rate RMSE [rad/s]", 1.0),
    "falls": ("robots that fell [%]", 100.0),
    "return": ("return of an episode", 1.0),
    "episode_length": ("length of an episode [control steps]", 1.0),
}
"""Titles and factors of figures of evaluations; other figures are metrics of the task."""


def curves_of_run(log: Log) -> list[str]:
    """Return the drawings of one run."""
    run, parts = [("", log)], _parts(log.scalars)
    drawings = [curves(chart) for chart in (*outcomes(run), *_learner(run), *levels([log]))]
    return [*drawings[:1], *([parts] if parts else []), *drawings[1:]]


def curves_of_runs(runs: Named) -> list[str]:
    """Return the drawings of several runs laid over each other."""
    charts = [*outcomes(runs), *_learner(runs), *_one("Terrain/level", "mean terrain level", runs)]
    return [curves(chart) for chart in charts]


def outcomes(runs: Named) -> list[Chart]:
    """Return charts of what robots do: returns, errors, falls and metrics of the task."""
    found = _returns(runs) + [chart for tag, title, factor in SINGLE for chart in _one(tag, title, runs, factor)]
    steps = {log.dt for _, log in runs}
    dt = next(iter(steps)) if len(steps) == 1 else None
    found += _one(LENGTH, f"length of an episode [{'control steps' if dt is None else 's'}]", runs, dt or 1.0)
    named = (*NOT_OF_THE_TASK, *(tag for tag, _, _ in SINGLE + CURRICULUM))
    for tag in _tags(runs, "Metrics/"):
        found += [] if tag in named else _one(tag, _title(tag), runs)
    return found


def _learner(runs: Named) -> list[Chart]:
    """Return charts of the curriculum of commands, of evaluations during training and of the optimiser."""
    found = [chart for tag, title, factor in CURRICULUM for chart in _one(tag, title, runs, factor)]
    for tag in _tags(runs, WATCHED):
        title, factor = OF_EVALUATION.get(tag.removeprefix(WATCHED), (_title(tag), 1.0))
        found += _one(tag, f"evaluated: {title}", runs, factor, exact=True, markers=True)
    found += _one("Loss/learning_rate", "learning rate", runs, exact=True, log=True)
    found += [chart for tag, title, factor in LEARNER for chart in _one(tag, title, runs, factor)]
    wanted = {value_at(log.config, "train.algorithm.desired_kl") for _, log in runs} - {None}
    level = ("desired_kl", float(next(iter(wanted)))) if len(wanted) == 1 else None
    return found + _one("Loss/kl", "divergence (KL) within an update [nat]", runs, level=level)


def _tags(runs: Named, beginning: str) -> list[str]:
    return list(dict.fromkeys(tag for _, log in runs for tag in log.scalars if tag.startswith(beginning)))


def _title(tag: str) -> str:
    return tag.partition("/")[2].replace("_", " ")


def _one(
    tag: str,
    title: str,
    runs: Named,
    factor: float = 1.0,
    exact: bool = False,
    markers: bool = False,
    log: bool = False,
    level: tuple[str, float] | None = None,
) -> list[Chart]:
    """Return the chart of one quantity, a line for each run, as running means unless `exact`; no chart if no run logged
    it.
    """
    lines = []
    for i, (label, run) in enumerate(runs):
        steps, values = run.scalars.get(tag, (np.array([]), np.array([])))
        if len(steps):
            y = factor * values if exact else smooth(factor * values)
            lines.append(Line(label if len(runs) > 1 else "", steps + 1, y, markers=markers, style=i))
    return [Chart(title, "iteration", lines, log=log, level=level)] if lines else []


def _returns(runs: Named) -> list[Chart]:
    """Return the chart of returns; of one run with the standard deviation over episodes as a band."""
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
    """Return the drawing of the parts of the reward on top of each other; an empty text if none was logged."""
    tags = [tag for tag in scalars if tag.startswith(EPISODE)]
    steps = sorted(set.intersection(*(set(scalars[tag][0].tolist()) for tag in tags))) if tags else []
    parts = {}
    for tag in tags:
        of = dict(zip(*scalars[tag], strict=True))
        parts[tag.removeprefix(EPISODE)] = smooth(np.array([of[step] for step in steps]))
    known = np.isfinite(list(parts.values())).all(axis=0)
    if not steps or not known.any():
        return ""
    parts = {name: values[known] for name, values in parts.items()}
    order = sorted(parts, key=lambda name: -float(np.abs(parts[name]).mean()))
    shown, rest = {name: parts[name] for name in order[:MOST_PARTS]}, order[MOST_PARTS:]
    if rest:
        shown[f"{len(rest)} more"] = np.sum([parts[name] for name in rest], axis=0)
    chart = Chart("parts of the reward, per second of a full episode", "iteration")
    return stacked(chart, np.array(steps)[known] + 1.0, shown)


def levels(logs: Sequence[Log]) -> list[Chart]:
    """Return charts of the terrain levels by type, and of the shares of episodes after which robots move up or down, as means
    over the runs; no chart without a curriculum of terrain.
    """
    scalars = [log.scalars for log in logs]
    types = [tag.removeprefix(LEVEL) for tag in _tags([("", log) for log in logs], LEVEL)]
    if not types:
        return []
    always = {always_promoted(log.config) for log in logs} - {None}
    highest = always.pop() if len(always) == 1 else None

    def lines(beginning: str, width: int) -> list[Line]:
        means = [mean_of(scalars, beginning + name) for name in types]
        each = enumerate(zip(types, means, strict=True))
        return [Line(name.replace("_", " "), steps, smooth(values, width), style=i) for i, (name, (steps, values)) in each]

    level = None if highest is None else ("always promoted", highest)
    found = [Chart("mean terrain level by type", "iteration", lines(LEVEL, 1), level=level)]
    for moved, way in (("promoted", "up"), ("demoted", "down")):
        shares = lines(f"Terrain/{moved}_", 25)
        found.append(Chart(f"episodes after which a robot moves {way}", "iteration", shares, high=1.0, percent=True))
    return [chart for chart in found if any(len(line.x) for line in chart.lines)]
