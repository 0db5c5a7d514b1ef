"""Learning curves: what TensorBoard files of runs hold, averaged and drawn."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged.config.loader import read_yaml
from legged.errors import ConfigError
from legged.figures import STYLES, figure
from legged.learning.run_folder import CONFIG_FILE

CURVES = (
    ("Metrics/lin_vel_rmse", "velocity error in training [m/s]", 1.0),
    ("Metrics/ang_vel_rmse", "yaw rate error in training [rad/s]", 1.0),
    ("Train/mean_reward", "return of an episode", 1.0),
    ("Metrics/falls", "episodes that end in a fall [%]", 100.0),
)
"""Tag, label, factor: of runs whose robots follow commands."""
OF_EVERY_TASK = (
    ("Train/mean_reward", "return of an episode", 1.0),
    ("Metrics/episode_length", "length of an episode [steps]", 1.0),
)
"""Tag, label, factor: of all other runs, before the metrics of their task."""
NO_CURVES = ("Metrics/episode_length", "Metrics/contact_overflows", "Metrics/non_finite_worlds")
"""Metrics that say nothing of what a task is about."""
LEVEL = "Terrain/level_"
SAME_TIME = 0.05
"""Share by which times of an iteration may differ for runs to have one axis of time."""
Scalars = dict[str, tuple[np.ndarray, np.ndarray]]
"""Tag -> (iterations, values)."""


def read_scalars(run: Path) -> Scalars:
    """Read all scalars of a run folder.

    Raises:
        ConfigError: it holds no TensorBoard file, or one without values.
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
    """Read the configuration in a run folder as it stands there: what an older version wrote need not fit this one's schema.
    Empty where there is none that can be read.
    """
    try:
        return read_yaml(run / CONFIG_FILE)
    except ConfigError:
        return {}


def labels(folders: Sequence[Path], configs: Sequence[dict[str, Any]]) -> list[str]:
    """Say what each run is: its task, its own name and its seed; the name of its folder where no configuration says that, and
    beside it where two would be called the same.
    """
    found = []
    for folder, config in zip(folders, configs, strict=True):
        name, seed = _at(config, "train", "runner", "run_name"), _at(config, "env", "seed")
        parts = [str(config["task"])] if config.get("task") else []
        parts += [str(name)] if name else []
        parts += [f"seed {seed}"] if seed is not None else []
        found.append(", ".join(parts) if config.get("task") else folder.resolve().name)
    twice = {label for label in found if found.count(label) > 1}
    names = [folder.resolve().name for folder in folders]
    named = [f"{text} ({name})" if text in twice else text for text, name in zip(found, names, strict=True)]
    return [f"{text} [{i}]" if named.count(text) > 1 else text for i, text in enumerate(named, start=1)]


def always_promoted(config: dict[str, Any]) -> float | None:
    """Return the mean level of robots that are always promoted, over the R rows of a run's terrain: 2 (R - 1) / 3. From the
    top they go to a random row, so that they are on row r in proportion to r + 1. None where no configuration says how many
    rows there are.
    """
    rows = _at(config, "terrain", "num_rows")
    return 2.0 * (rows - 1) / 3.0 if isinstance(rows, int) else None


def _at(config: Any, *keys: str) -> Any:
    """Return the value in a nested mapping; None where there is none."""
    for key in keys:
        config = config.get(key) if isinstance(config, dict) else None
    return config


def smooth(values: np.ndarray, width: int = 9) -> np.ndarray:
    """Return the running mean over `width` values, shorter at the ends; of no values, none. What is no finite number is left
    out, so that it does not spread; where nothing else is near, there is none.
    """
    if not len(values):
        return values
    kernel, good = np.ones(min(width, len(values))), np.isfinite(values)
    sums = np.convolve(np.where(good, values, 0.0), kernel, "same")
    counts = np.convolve(good.astype(float), kernel, "same").round()
    return np.where(counts > 0.0, sums / np.maximum(counts, 1.0), np.nan)


def curves_of(runs: Collection[Scalars]) -> tuple[tuple[str, str, float], ...]:
    """Return the curves worth drawing of runs: tag, label, factor."""
    tags = list(dict.fromkeys(tag for scalars in runs for tag in scalars))
    if not any(tag.startswith("Metrics/") for tag in tags) or any(tag in tags for tag, _, _ in CURVES[:2]):
        return CURVES
    own = [tag for tag in tags if tag.startswith("Metrics/") and tag not in NO_CURVES]
    first = tuple(curve for curve in OF_EVERY_TASK if curve[0] in tags)
    return first + tuple((tag, tag.removeprefix("Metrics/").replace("_", " "), 1.0) for tag in own)


def draw_runs(runs: dict[str, Scalars], path: Path, always: Collection[float] = ()) -> None:
    """Draw one panel a curve, one line a run; and, on terrain, one panel for levels and one for moves, one line a type.
    `always` are mean levels of robots that are always promoted.
    """
    first = next(iter(runs.values()))
    types = [tag.removeprefix(LEVEL) for tag in first if tag.startswith(LEVEL)]
    curves = curves_of(runs.values())
    per_iteration = common_time(runs.values())
    rows = -(-len(curves) // 2) + bool(types)
    with figure(path, (10.0, 3.0 * rows), rows, 2) as (_, axes):
        for axis, (tag, label, factor) in zip(axes.flat, curves, strict=False):
            for i, (name, scalars) in enumerate(runs.items()):
                if tag in scalars:
                    steps, values = scalars[tag]
                    look = {"color": f"C{i}", "linestyle": STYLES[i % len(STYLES)], "linewidth": 1.5}
                    axis.plot(steps + 1, smooth(factor * values), label=name, **look)
            axis.set_ylabel(label)
            axis.set_ylim(bottom=0.0 if axis.dataLim.y0 >= 0.0 else None)
        if axes[0, 0].lines:  # a run that was killed early may lack the first curve
            axes[0, 0].legend(fontsize="small")
        if len(types) == 1:
            _draw_ways_out(axes[-1, 0], runs, types[0])
            axes[-1, 1].set_visible(False)
        elif types:
            _draw_levels(axes[-1, 0], axes[-1, 1], list(runs.values()), types, always)
        for axis in axes.flat[len(curves) : 2 * (rows - bool(types))]:
            axis.set_visible(False)
        for axis in axes.flat:
            axis.set_xlabel("iteration")
            if axis.get_xlim()[0] >= axis.get_xlim()[1] or max(len(steps) for steps, _ in first.values()) < 2:
                axis.set_xlim(0.0, 2.0)  # one iteration has no extent
            axis.grid(alpha=0.3)
            if per_iteration is not None:
                _time_axis(axis, per_iteration)


def _draw_ways_out(axis: Any, runs: dict[str, Scalars], name: str) -> None:
    """Draw the share of episodes that got out of their tile, of the only type there is, one line a run."""
    for i, scalars in enumerate(runs.values()):
        if f"Terrain/promoted_{name}" in scalars:
            steps, share = scalars[f"Terrain/promoted_{name}"]
            axis.plot(steps + 1, smooth(100.0 * share), color=f"C{i}", linewidth=1.5)
    axis.set_ylabel(f"got out of '{name.replace('_', ' ')}' [% of episodes]")
    axis.set_ylim(0.0, 100.0)


def _draw_levels(levels: Any, moves: Any, runs: list[Scalars], types: list[str], always: Collection[float]) -> None:
    """Draw the mean level, and shares of episodes after which robots moved up (solid) and down (dashed), of each type."""
    for i, name in enumerate(types):
        colour = f"C{i}"
        levels.plot(*mean_of(runs, LEVEL + name), color=colour, label=name.replace("_", " "), linewidth=1.2)
        for what, line in (("promoted", "-"), ("demoted", "--")):
            steps, share = mean_of(runs, f"Terrain/{what}_{name}")
            moves.plot(steps, smooth(100.0 * share, 25), line, color=colour, linewidth=1.2)
    for level in always:
        levels.axhline(level, color="0.3", linestyle=":", linewidth=1.4)
    levels.set_ylabel("mean terrain level" + (" (dotted: always up)" if always else ""))
    levels.set_ylim(bottom=0.0)
    levels.legend(fontsize="small", ncols=2)
    moves.set_ylabel("moved up, dashed: down [% of episodes]")
    moves.set_ylim(0.0, 100.0)


def mean_of(runs: list[Scalars], tag: str) -> tuple[np.ndarray, np.ndarray]:
    """Return iterations, counted from 1, and the mean of the runs over those that all of them have."""
    found = [dict(zip(*run[tag], strict=True)) for run in runs if tag in run]
    steps = sorted(set.intersection(*(set(values) for values in found))) if found else []
    return np.array(steps) + 1, np.array([np.mean([values[step] for values in found]) for step in steps])


def common_time(runs: Collection[Scalars]) -> float | None:
    """Return the mean time of an iteration of the first run that has times [s]. There is none in common where another takes
    more or less than that by more than `SAME_TIME`, nor where no run has times, as one that was killed in between.
    """
    parts = ("Perf/collection_time", "Perf/learning_time")
    found = [sum(float(np.mean(scalars[part][1])) for part in parts) for scalars in runs if set(parts) <= scalars.keys()]
    alike = bool(found) and min(found) > 0.0 and max(found) <= (1.0 + SAME_TIME) * min(found)
    return found[0] if alike else None


def _time_axis(axis: Any, per_iteration: float) -> None:
    """Add a second axis on top: seconds of training loop, where an iteration takes so long."""

    def seconds(iterations: np.ndarray) -> np.ndarray:
        return iterations * per_iteration

    def iterations(seconds: np.ndarray) -> np.ndarray:
        return seconds / per_iteration

    top = axis.secondary_xaxis("top", functions=(seconds, iterations))
    top.set_xlabel("training loop [s]", fontsize="small")
    top.tick_params(labelsize="small")
