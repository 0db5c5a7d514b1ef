"""The curves of a report: which there are of a run or of several, and how they are drawn."""

from collections.abc import Sequence

import numpy as np

from legged.evaluation.learning_curves import LEVEL, Scalars, always_promoted, smooth
from legged.evaluation.reports.record import Record
from legged.evaluation.reports.svg import Axes, Line, curves, stacked
from legged.figures import COLORS

MOST_PARTS = len(COLORS) - 1
"""Reward parts with a colour of their own; all smaller ones are one."""
EPISODE, LENGTH = "Episode/rew_", "Metrics/episode_length"
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
"""As far as a curriculum of commands has got; the same."""
LEARNER = (
    ("Policy/mean_std", "standard deviation of actions (noise)", 1.0),
    ("Loss/value", "loss of the value function", 1.0),
    ("Loss/behavior", "behaviour loss: student's actions against its teacher's", 1.0),
)
NOT_OF_THE_TASK = (LENGTH, "Metrics/contact_overflows", "Metrics/non_finite_worlds")
WATCHED = "Evaluation/"
"""Section of what was measured without noise during training."""
OF_EVALUATION = {
    "lin_vel_rmse": ("velocity RMSE [m/s]", 1.0),
    "ang_vel_rmse": ("yaw rate RMSE [rad/s]", 1.0),
    "falls": ("robots that fell [%]", 100.0),
    "return": ("return of an episode", 1.0),
    "episode_length": ("length of an episode [control steps]", 1.0),
}
"""Title and factor of its figures; others are metrics of the task, called what they are."""


def curves_of_run(record: Record) -> list[str]:
    """Return the drawings of one run, those that it has values for."""
    scalars = record.scalars
    found = [*_returns(scalars, record), *_parts(scalars), *_several([("", record)])]
    return found + _levels(record)


def curves_of_runs(records: Sequence[tuple[str, Record]]) -> list[str]:
    """Return the drawings of several runs laid over each other, by their labels."""
    return [
        *_one("Train/mean_reward", "return of an episode", records),
        *_several(records),
        *_one("Terrain/level", "mean terrain level", records),
    ]


def _several(records: Sequence[tuple[str, Record]]) -> list[str]:
    """Return one drawing a quantity, one line a run."""
    tags = dict.fromkeys(tag for _, record in records for tag in record.scalars)
    named = (*NOT_OF_THE_TASK, *(tag for tag, _, _ in SINGLE + CURRICULUM))
    own = [tag for tag in tags if tag.startswith("Metrics/") and tag not in named]
    found = [drawing for tag, title, factor in SINGLE for drawing in _one(tag, title, records, factor)]
    found += _lengths(records)
    found += [drawing for tag, title, factor in CURRICULUM for drawing in _one(tag, title, records, factor)]
    for tag in own:
        found += _one(tag, tag.removeprefix("Metrics/").replace("_", " "), records)
    for tag in (tag for tag in tags if tag.startswith(WATCHED)):
        name = tag.removeprefix(WATCHED)
        title, factor = OF_EVALUATION.get(name, (name.replace("_", " "), 1.0))
        found += _one(tag, f"evaluated: {title}", records, factor, markers=True)
    found += _one("Loss/learning_rate", "learning rate", records, log=True)
    found += [drawing for tag, title, factor in LEARNER for drawing in _one(tag, title, records, factor)]
    wanted = {record.at("train.algorithm.desired_kl") for _, record in records} - {None}
    level = ("desired_kl", float(next(iter(wanted)))) if len(wanted) == 1 else None
    return found + _one("Loss/kl", "divergence (KL) within an update [nat]", records, level=level)


def _one(
    tag: str,
    title: str,
    records: Sequence[tuple[str, Record]],
    factor: float = 1.0,
    log: bool = False,
    markers: bool = False,
    level: tuple[str, float] | None = None,
) -> list[str]:
    """Return the drawing of one quantity; none where no run has it."""
    lines = []
    for i, (label, record) in enumerate(records):
        steps, values = record.scalars.get(tag, (np.array([]), np.array([])))
        if len(steps):
            exact = log or markers
            y = factor * values if exact else smooth(factor * values)
            lines.append(Line(label or title, steps + 1, y, markers=markers, style=i))
    if not lines:
        return []
    if len(records) == 1:
        lines = [Line("", line.x, line.y, line.band, line.markers, 0) for line in lines]
    return [curves(Axes(title, "iteration", log=log, level=level), lines)]


def _lengths(records: Sequence[tuple[str, Record]]) -> list[str]:
    """Return the drawing of how long episodes are: in seconds where a run says how long a step is."""
    dt = [record.dt for _, record in records]
    known = [one for one in dt if one is not None]
    if len(known) < len(dt) or len(set(known)) > 1 or not known:
        return _one(LENGTH, "length of an episode [control steps]", records)
    return _one(LENGTH, "length of an episode [s]", records, known[0])


def _returns(scalars: Scalars, record: Record) -> list[str]:
    """Return the drawing of returns, with the standard deviation over episodes as a band."""
    if "Train/mean_reward" not in scalars:
        return []
    steps, values = scalars["Train/mean_reward"]
    mean, band = smooth(values), None
    if "Train/std_reward" in scalars:
        of = dict(zip(*scalars["Train/std_reward"], strict=True))
        std = smooth(np.array([of.get(step, np.nan) for step in steps]))
        std = np.where(np.isfinite(std), std, 0.0)
        band = (mean - std, mean + std)
    title = "return of an episode" + (", and standard deviation over episodes" if band else "")
    return [curves(Axes(title, "iteration"), [Line("", steps + 1, mean, band)])]


def _parts(scalars: Scalars) -> list[str]:
    """Return the drawing of the parts of the reward on top of each other."""
    tags = [tag for tag in scalars if tag.startswith(EPISODE)]
    if not tags:
        return []
    steps = sorted(set.intersection(*(set(scalars[tag][0].tolist()) for tag in tags)))
    if not steps:
        return []
    parts = {}
    for tag in tags:
        of = dict(zip(*scalars[tag], strict=True))
        parts[tag.removeprefix(EPISODE)] = smooth(np.array([of[step] for step in steps]))
    known = np.isfinite(list(parts.values())).all(axis=0)
    if not known.any():
        return []
    parts = {name: values[known] for name, values in parts.items()}
    order = sorted(parts, key=lambda name: -float(np.abs(parts[name]).mean()))
    shown = {name: parts[name] for name in order[:MOST_PARTS]}
    rest = order[MOST_PARTS:]
    if rest:
        shown[f"{len(rest)} more"] = np.sum([parts[name] for name in rest], axis=0)
    return [
        stacked(Axes("parts of the reward, per second of a full episode", "iteration"), np.array(steps)[known] + 1.0, shown)
    ]


def _levels(record: Record) -> list[str]:
    """Return the drawings of terrain levels by type, and of the shares of episodes after which robots moved up."""
    scalars = record.scalars
    types = [tag.removeprefix(LEVEL) for tag in scalars if tag.startswith(LEVEL)]
    if not types:
        return []
    lines, up = [], []
    for i, name in enumerate(types):
        steps, values = scalars[LEVEL + name]
        lines.append(Line(name.replace("_", " "), steps + 1, values, style=i))
        if f"Terrain/promoted_{name}" in scalars:
            steps, values = scalars[f"Terrain/promoted_{name}"]
            up.append(Line(name.replace("_", " "), steps + 1, smooth(values, 25), style=i))
    always = always_promoted(record.config)
    level = None if always is None else ("always promoted", always)
    found = [curves(Axes("mean terrain level by type", "iteration", level=level), lines)]
    return found + [curves(Axes("episodes after which a robot moves up", "iteration", high=1.0, percent=True), up)] * bool(up)
