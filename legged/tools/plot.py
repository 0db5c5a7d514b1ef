"""Learning curves of runs: `python -m legged.tools.plot logs/anymal_c_flat/<run> [<run> ...] --out curve.png`.

Reads the TensorBoard files; draws tracking error, return and falls over iterations, one line a run, and a time axis
from the first run's iteration times. Of runs on terrain, also the mean level of each type and the shares of episodes after
which robots moved up and down, as means over the runs.
"""

import argparse
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged.commandline.command import run_main
from legged.config.loader import read_yaml
from legged.errors import ConfigError
from legged.learning.run_folder import CONFIG_FILE
from legged.process.paths import make_folder, ready_to_write_file, relative, replacing

CURVES = (
    ("Metrics/lin_vel_rmse", "velocity error in training [m/s]", 1.0),
    ("Metrics/ang_vel_rmse", "yaw rate error in training [rad/s]", 1.0),
    ("Train/mean_reward", "return of an episode", 1.0),
    ("Metrics/falls", "episodes that end in a fall [%]", 100.0),
)


LEVEL = "Terrain/level_"
Scalars = dict[str, tuple[np.ndarray, np.ndarray]]
"""Tag -> (iterations, values)."""


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(prog="plot", description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, help="run folders")
    parser.add_argument("--out", type=Path, default=Path("learning_curve.png"), help="PNG file")
    args = parser.parse_args(argv)
    ready_to_write_file("--out", args.out)
    runs = [read_scalars(run) for run in args.runs]
    configs = [read_config(run) for run in args.runs]
    named = dict(zip(labels(args.runs, configs), runs, strict=True))
    draw(named, args.out, {level for config in configs if (level := always_promoted(config)) is not None})
    print(f"written: {relative(args.out)}")
    return 0


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
    """What each run is: its task, its own name and its seed; the name of its folder where no configuration says that, and
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
    """Give the mean level of robots that are always promoted, over the R rows of a run's terrain: 2 (R - 1) / 3. From the top
    they go to a random row, so that they are on row r in proportion to r + 1. None where no configuration says how many rows
    there are.
    """
    rows = _at(config, "terrain", "num_rows")
    return 2.0 * (rows - 1) / 3.0 if isinstance(rows, int) else None


def _at(config: Any, *keys: str) -> Any:
    """The value in a nested mapping; None where there is none."""
    for key in keys:
        config = config.get(key) if isinstance(config, dict) else None
    return config


def smooth(values: np.ndarray, width: int = 9) -> np.ndarray:
    """Running mean over `width` values, shorter at the ends."""
    width = min(width, len(values))
    kernel = np.ones(width)
    return np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same")


def draw(runs: dict[str, Scalars], path: Path, always: Collection[float] = ()) -> None:
    """Draw one panel a curve, one line a run; and, on terrain, one panel for levels and one for moves, one line a type.
    `always` are mean levels of robots that are always promoted.
    """
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    first = next(iter(runs.values()))
    types = [tag.removeprefix(LEVEL) for tag in first if tag.startswith(LEVEL)]
    rows = 3 if types else 2
    figure, axes = plt.subplots(rows, 2, figsize=(10, 3 * rows), layout="constrained")
    for axis, (tag, label, factor) in zip(axes.flat, CURVES, strict=False):
        for name, scalars in runs.items():
            if tag in scalars:
                steps, values = scalars[tag]
                axis.plot(steps + 1, smooth(factor * values), label=name, linewidth=1.5)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
    axes[0, 0].legend(fontsize="small")
    if types:
        _draw_levels(axes[2, 0], axes[2, 1], list(runs.values()), types, always)
    for axis in axes.flat:
        axis.set_xlabel("iteration")
        if axis.get_xlim()[0] >= axis.get_xlim()[1] or max(len(steps) for steps, _ in first.values()) < 2:
            axis.set_xlim(0.0, 2.0)  # one iteration has no extent
        axis.grid(alpha=0.3)
        _time_axis(axis, first)
    make_folder(path.parent)
    with replacing(path) as part:
        figure.savefig(part, dpi=110, format="png")
    plt.close(figure)


def _draw_levels(levels: Axes, moves: Axes, runs: list[Scalars], types: list[str], always: Collection[float]) -> None:
    """Mean level, and shares of episodes after which robots moved up (solid) and down (dashed), of each type."""
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
    """Iterations, counted from 1, and the mean of the runs over those that all of them have."""
    found = [dict(zip(*run[tag], strict=True)) for run in runs if tag in run]
    steps = sorted(set.intersection(*(set(values) for values in found))) if found else []
    return np.array(steps) + 1, np.array([np.mean([values[step] for values in found]) for step in steps])


def _time_axis(axis: Axes, scalars: Scalars) -> None:
    """A second axis on top: seconds of training loop at the mean time of an iteration."""
    if not {"Perf/collection_time", "Perf/learning_time"} <= scalars.keys():  # of a run that was killed in between
        return
    per_iteration = float(np.mean(scalars["Perf/collection_time"][1]) + np.mean(scalars["Perf/learning_time"][1]))

    if not per_iteration > 0.0:
        return

    def seconds(iterations: np.ndarray) -> np.ndarray:
        return iterations * per_iteration

    def iterations(seconds: np.ndarray) -> np.ndarray:
        return seconds / per_iteration

    top = axis.secondary_xaxis("top", functions=(seconds, iterations))  # type: ignore[arg-type]
    top.set_xlabel("training loop [s]", fontsize="small")
    top.tick_params(labelsize="small")


if __name__ == "__main__":
    sys.exit(main())
