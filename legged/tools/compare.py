"""Several evaluations side by side: `python -m legged.tools.compare logs/anymal_c/<run> [<run> ...] [--out success.png]`.

Takes evaluation files, or folders that hold them. Evaluations of one task in one engine are its seeds: the tables give their
mean and how far the farthest is from it, the picture their mean and range.
"""

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

import matplotlib
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from legged.commandline.command import run_main
from legged.errors import ConfigError, suggest
from legged.evaluation.evaluation_file import check, tracking_of
from legged.evaluation.success_report import ENGINES, TRAINED
from legged.process.paths import make_folder, ready_to_write_file, relative, replacing

Evaluations = dict[tuple[str, str], list[dict[str, Any]]]
"""(task, physics) -> results, one a seed."""
FIGURES = (
    ("velocity RMSE, mean [m/s]", "rmse_lin", "mean", 1.0, 3),
    ("velocity RMSE, worst cell [m/s]", "rmse_lin", "worst", 1.0, 3),
    ("yaw rate RMSE, mean [rad/s]", "rmse_ang", "mean", 1.0, 3),
    ("yaw rate RMSE, worst cell [rad/s]", "rmse_ang", "worst", 1.0, 3),
    ("falls [%]", "falls", None, 100.0, 2),
)
"""Label, where it is in a result, factor, decimals."""
COLORS = ("#1f6fb4", "#d9541e", "#3a923a", "#8a56b8", "#6b5b4b")


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(prog="compare", description=__doc__)
    parser.add_argument("paths", nargs="+", type=Path, help="evaluation_<physics>.json files, or folders that hold them")
    parser.add_argument("--types", help="terrain types to show, e.g. stairs_up,slope_up; all by default")
    parser.add_argument("--out", type=Path, help="also draw success against difficulty into this PNG file")
    args = parser.parse_args(argv)
    if args.out:
        ready_to_write_file("--out", args.out)
    results = read(args.paths)
    if args.types:
        keep_types(results, [name.strip() for name in args.types.split(",")])
    groups = grouped(results)
    console = Console(width=130)
    console.print(tracking_table(groups))
    with_success = {key: results for key, results in groups.items() if all("success" in result for result in results)}
    if not types_of(with_success):
        with_success = {}
    if with_success:
        console.print(success_table(with_success))
    if args.out:
        if not with_success:
            raise ConfigError("--out: draws success against difficulty, and none of the evaluations holds that")
        draw(with_success, args.out)
        print(f"written: {relative(args.out)}")
    return 0


def read(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """The results in files and folders.

    Raises:
        ConfigError: a path is not there, holds no evaluation, or is none.
    """
    results = []
    for path in paths:
        files = sorted(path.glob("evaluation_*.json")) if path.is_dir() else [path]
        if not files or not all(file.is_file() for file in files):
            raise ConfigError(f"{path}: holds no evaluation_<physics>.json; python -m legged.tools.evaluate writes it")
        for file in files:
            try:
                result = json.loads(file.read_text(encoding="utf-8"))
            except (OSError, ValueError, RecursionError) as error:
                raise ConfigError(f"{file}: is not the result of an evaluation ({error})") from error
            check(result, str(file))
            results.append(result)
    return results


def keep_types(results: Sequence[dict[str, Any]], types: Sequence[str]) -> None:
    """Leave only some terrain types in `results`, in the order given.

    Raises:
        ConfigError: a type is in none of them.
    """
    there = {name for result in results for name in result.get("success", {}).get("types", {})}
    for name in types:
        if name not in there:
            raise ConfigError(f"--types: {name}: none of the evaluations holds it{suggest(name, there)}")
    for result in results:
        if "success" in result:
            found = result["success"]["types"]
            result["success"]["types"] = {name: found[name] for name in types if name in found}


def grouped(results: Sequence[dict[str, Any]]) -> Evaluations:
    """Seeds of the same task in the same engine together, in the order of their first."""
    groups: Evaluations = {}
    for result in results:
        groups.setdefault((result["task"], result["physics"]), []).append(result)
    return groups


def spread(values: Sequence[float]) -> float:
    """How far the farthest value is from the mean, as a share of it; 0 where all are 0."""
    middle = mean(values)
    return max(abs(value - middle) for value in values) / middle if middle else 0.0


def tracking_table(groups: Evaluations) -> Table:
    """A column a group: mean over its seeds, and the spread where there are several."""
    table = Table(title="following commands: mean of seeds (farthest from it)", title_justify="left")
    table.add_column("measure")
    for key, results in groups.items():
        table.add_column(escape(heading(key, len(results))), justify="right")
    for label, name, part, factor, decimals in FIGURES:
        cells = []
        for results in groups.values():
            found = [tracking_of(result)[name] for result in results]
            every = [value if part is None else value[part] for value in found]
            values = [factor * value for value in every if value is not None]
            if not values:  # every robot fell before it was measured
                cells.append("none")
                continue
            text = f"{mean(values):.{decimals}f}"
            cells.append(f"{text} ({100 * spread(values):.0f} %)" if len(values) > 1 else text)
        table.add_row(escape(label), *cells)
    return table


def heading(key: tuple[str, str], seeds: int) -> str:
    """A group in words."""
    task, physics = key
    return f"{task}\n{drawn(physics)[0]}, {seeds} seed{'s' if seeds > 1 else ''}"


def drawn(physics: str) -> tuple[str, str, str]:
    """Label, line and marker of an engine; one of which this version knows nothing has its own name."""
    return ENGINES.get(physics, (physics, ":", "x"))


def shares(results: Sequence[dict[str, Any]], terrain: str) -> dict[float, list[float]]:
    """Size -> success of every seed, for the sizes that all of them were measured at."""
    found = [
        {point["size"]: point["share"] for point in result["success"]["types"][terrain]["points"]}
        for result in results
        if terrain in result["success"]["types"]
    ]
    common = set.intersection(*(set(one) for one in found)) if found else set()
    return {size: [one[size] for one in found] for size in sorted(common)}


def types_of(groups: Evaluations) -> dict[str, dict[str, Any]]:
    """Terrain type -> one of its entries, of all types that were measured."""
    entries = [result["success"]["types"] for results in groups.values() for result in results]
    return {name: entry for one in entries for name, entry in one.items()}


def success_table(groups: Evaluations) -> Table:
    """A line a type and size: mean success over seeds, and the range where there are several."""
    table = Table(title="success [%]: mean of seeds (lowest to highest)", title_justify="left")
    table.add_column("terrain")
    table.add_column("size", justify="right")
    for key, results in groups.items():
        table.add_column(escape(heading(key, len(results))), justify="right")
    for name, entry in types_of(groups).items():
        columns = [shares(results, name) for results in groups.values()]
        for i, size in enumerate(sorted(set().union(*columns))):
            cells = [_share(column.get(size, [])) for column in columns]
            table.add_row(escape(name if i == 0 else ""), escape(f"{size:g} {entry['unit']}"), *cells)
        table.add_section()
    return table


def _share(values: Sequence[float]) -> str:
    if not values:
        return ""
    text = f"{100 * mean(values):.1f}"
    return f"{text} ({100 * min(values):.0f} to {100 * max(values):.0f})" if len(values) > 1 else text


def draw(groups: Evaluations, path: Path) -> None:
    """A panel a terrain type: a colour a task, a line style an engine, a band from the worst to the best seed."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import PercentFormatter

    names = types_of(groups)
    tasks = list(dict.fromkeys(task for task, _ in groups))
    columns = min(2, len(names))
    rows = -(-len(names) // columns)
    size = (4.8 * columns + 0.2, 2.6 * rows + 1.0)
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False, sharey=True)
    for axis in axes.flat[len(names) :]:
        axis.set_visible(False)
    for axis, (name, entry) in zip(axes.flat, names.items(), strict=False):
        for (task, physics), results in groups.items():
            found = shares(results, name)
            color, (_, line, marker) = COLORS[tasks.index(task) % len(COLORS)], drawn(physics)
            axis.plot(list(found), [mean(v) for v in found.values()], line, marker=marker, ms=3, color=color, clip_on=False)
            low, high = ([pick(values) for values in found.values()] for pick in (min, max))
            axis.fill_between(list(found), low, high, color=color, alpha=0.15, lw=0)
        ends = {
            r["success"]["types"][name]["trained_to"] for rs in groups.values() for r in rs if name in r["success"]["types"]
        }
        for end in ends - {None}:
            axis.axvline(end, **TRAINED)
        axis.set_title(name.replace("_", " "), fontsize="medium")
        axis.set_xlabel(f"{entry['what']} [{entry['unit']}]")
        axis.set_ylim(0.0, 1.04)
        axis.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    keys = []
    for (task, physics), results in groups.items():
        color, (label, line, marker) = COLORS[tasks.index(task) % len(COLORS)], drawn(physics)
        text = f"{task}, {label}" + (f", {len(results)} seeds" if len(results) > 1 else "")
        keys.append(plt.Line2D([], [], color=color, ls=line, marker=marker, ms=4, label=text))
    keys.append(plt.Line2D([], [], **TRAINED, label="hardest of training"))
    figure.legend(handles=keys, loc="outside lower center", ncols=2, frameon=False)
    make_folder(path.parent)
    with replacing(path) as part:
        figure.savefig(part, dpi=110, format="png")
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
