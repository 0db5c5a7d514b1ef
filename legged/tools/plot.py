"""Learning curves of runs: `python -m legged.tools.plot logs/anymal_c_flat/<run> [<run> ...] --out curve.png`.

Reads the TensorBoard files; draws tracking error, return and falls over iterations, one line a run, and a time axis
from the first run's iteration times. Of runs on terrain, also the mean level of each type and the shares of episodes after
which robots moved up and down, as means over the runs.
"""

import argparse
import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged.errors import ConfigError
from legged.paths import relative, replacing
from legged.rl.arguments import run_main

CURVES = (
    ("Metrics/lin_vel_rmse", "velocity error in training [m/s]", 1.0),
    ("Metrics/ang_vel_rmse", "yaw rate error in training [rad/s]", 1.0),
    ("Train/mean_reward", "return of an episode", 1.0),
    ("Metrics/falls", "episodes that end in a fall [%]", 100.0),
)


LEVEL = "Terrain/level_"
ALWAYS_PROMOTED = 6.0
"""Mean level over ten rows of robots that are always promoted: from the top they go to a random row."""
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
    draw({run.name: read_scalars(run) for run in args.runs}, args.out)
    print(f"written: {relative(args.out)}")
    return 0


def read_scalars(run: Path) -> Scalars:
    """All scalars of a run folder.

    Raises:
        ConfigError: it holds no TensorBoard file.
    """
    if not list(run.glob("events.out.tfevents.*")):
        raise ConfigError(f"{run}: holds no TensorBoard file")
    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    found = {}
    for tag in events.Tags()["scalars"]:
        entries = events.Scalars(tag)
        found[tag] = (np.array([e.step for e in entries]), np.array([e.value for e in entries]))
    return found


def smooth(values: np.ndarray, width: int = 9) -> np.ndarray:
    """Running mean over `width` values, shorter at the ends."""
    width = min(width, len(values))
    kernel = np.ones(width)
    return np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same")


def draw(runs: dict[str, Scalars], path: Path) -> None:
    """One panel a curve, one line a run; and, on terrain, one panel for levels and one for moves, one line a type."""
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
        _draw_levels(axes[2, 0], axes[2, 1], list(runs.values()), types)
    for axis in axes.flat:
        axis.set_xlabel("iteration")
        axis.grid(alpha=0.3)
        _time_axis(axis, first)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        figure.savefig(part, dpi=110, format="png")
    plt.close(figure)


def _draw_levels(levels: Axes, moves: Axes, runs: list[Scalars], types: list[str]) -> None:
    """Mean level, and shares of episodes after which robots moved up (solid) and down (dashed), of each type."""
    for i, name in enumerate(types):
        colour = f"C{i}"
        levels.plot(*mean_of(runs, LEVEL + name), color=colour, label=name.replace("_", " "), linewidth=1.2)
        for what, line in (("promoted", "-"), ("demoted", "--")):
            steps, share = mean_of(runs, f"Terrain/{what}_{name}")
            moves.plot(steps, smooth(100.0 * share, 25), line, color=colour, linewidth=1.2)
    levels.axhline(ALWAYS_PROMOTED, color="0.3", linestyle=":", linewidth=1.4)
    levels.set_ylabel("mean terrain level (dotted: always up)")
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
    if "Perf/collection_time" not in scalars:
        return
    per_iteration = float(np.mean(scalars["Perf/collection_time"][1]) + np.mean(scalars["Perf/learning_time"][1]))

    def seconds(iterations: np.ndarray) -> np.ndarray:
        return iterations * per_iteration

    def iterations(seconds: np.ndarray) -> np.ndarray:
        return seconds / per_iteration

    top = axis.secondary_xaxis("top", functions=(seconds, iterations))  # type: ignore[arg-type]
    top.set_xlabel("training loop [s]", fontsize="small")
    top.tick_params(labelsize="small")


if __name__ == "__main__":
    sys.exit(main())
