"""Several evaluations side by side, as tables and as curves; those of one task in one engine, made alike, are its seeds."""

from collections.abc import Sequence
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from legged.errors import ConfigError, suggest
from legged.evaluation.engines import engine_of
from legged.evaluation.reports.charts import Line, draw_charts
from legged.evaluation.result_file import changes_text, grid_text, tracking_of
from legged.evaluation.success_report import success_chart, types_in

Key = tuple[str, str, str]
"""Task, physics, and under what conditions it was measured where those are not the policy's own or not the same for all."""
Evaluations = dict[Key, list[dict[str, Any]]]
"""What evaluations have in common -> results, one a seed."""
FIGURES = (
    ("velocity RMSE, mean [m/s]", "rmse_lin", "mean", 1.0, 3),
    ("velocity RMSE, worst cell [m/s]", "rmse_lin", "worst", 1.0, 3),
    ("yaw rate RMSE, mean [rad/s]", "rmse_ang", "mean", 1.0, 3),
    ("yaw rate RMSE, worst cell [rad/s]", "rmse_ang", "worst", 1.0, 3),
    ("falls [%]", "falls", None, 100.0, 2),
)
"""Label, where it is in a result, factor, decimals."""


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
    """Return the seeds of the same task in the same engine together, in the order of their first: those that were measured
    with the same fields changed, and on the same grid of commands.
    """
    grids = [grid_text(result) for result in results]
    told = len(set(grids) - {""}) > 1
    groups: Evaluations = {}
    for result, grid in zip(results, grids, strict=True):
        conditions = ", ".join(text for text in (changes_text(result), grid if told else "") if text)
        groups.setdefault((result["task"], result["physics"], conditions), []).append(result)
    return groups


def spread(values: Sequence[float]) -> float:
    """Return how far the farthest value is from the mean, as a share of it; 0 where all are 0."""
    middle = mean(values)
    return max(abs(value - middle) for value in values) / middle if middle else 0.0


def tracking_table(groups: Evaluations) -> Table:
    """Return a column a group: mean over its seeds, the spread where there are several, and how many of them have the number
    where not all do.
    """
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
            told = [f"{100 * spread(values):.0f} %"] if len(values) > 1 else []
            if len(values) < len(results):  # of the others every robot fell
                told.append(f"of {len(values)} of {len(results)} seeds")
            cells.append(f"{mean(values):.{decimals}f}" + (f" ({', '.join(told)})" if told else ""))
        table.add_row(escape(label), *cells)
    return table


def episodes_comparison(groups: Evaluations) -> Table:
    """Return a column a group of evaluations of episodes: mean over its seeds, and the range where there are several."""
    table = Table(title="episodes: mean of seeds (lowest to highest)", title_justify="left")
    table.add_column("measure")
    for key, results in groups.items():
        table.add_column(escape(heading(key, len(results))), justify="right")
    found = [[_episode_figures(result["episodes"]) for result in results] for results in groups.values()]
    for label in dict.fromkeys(label for seeds in found for seed in seeds for label in seed):
        columns = [[seed[label] for seed in seeds if label in seed] for seeds in found]
        table.add_row(escape(label), *(_mean_and_range(values) for values in columns))
    return table


def _episode_figures(episodes: dict[str, Any]) -> dict[str, float]:
    """Return label -> number of what is compared of an evaluation of episodes."""
    return {
        "return": episodes["return"]["mean"],
        "standard deviation of the return": episodes["return"]["std"],
        "least return": episodes["return"]["min"],
        "episode length [steps]": episodes["length"]["mean"],
        "episodes that ended in a failure [%]": 100.0 * episodes["failures"],
        **{f"return of {name}": value for name, value in episodes["terms"].items()},
        **episodes["metrics"],
    }


def _mean_and_range(values: Sequence[float]) -> str:
    """Return numbers in words; nothing of none."""
    if not values:
        return ""
    decimals = 1 if abs(mean(values)) >= 100 else 2
    text = f"{mean(values):.{decimals}f}"
    return f"{text} ({min(values):.{decimals}f} to {max(values):.{decimals}f})" if len(values) > 1 else text


def heading(key: Key, seeds: int) -> str:
    """Return a group in words."""
    task, physics, conditions = key
    text = f"{task}\n{engine_of(physics).label}, {seeds} seed{'s' if seeds > 1 else ''}"
    return f"{text}\n{conditions}" if conditions else text


def shares(results: Sequence[dict[str, Any]], terrain: str) -> dict[float, list[float]]:
    """Return size -> success of every seed that was measured on that type, for the sizes that all of those have."""
    entries = [types_in(result)[terrain] for result in results if terrain in types_in(result)]
    found = [{point["size"]: point["share"] for point in entry["points"]} for entry in entries]
    common = set.intersection(*(set(one) for one in found)) if found else set()
    return {size: [one[size] for one in found] for size in sorted(common)}


def types_of(groups: Evaluations) -> dict[str, dict[str, Any]]:
    """Return terrain type -> one of its entries, of all types that were measured."""
    entries = [types_in(result) for results in groups.values() for result in results]
    return {name: entry for one in entries for name, entry in one.items()}


def success_table(groups: Evaluations) -> Table:
    """Return a line a type and size: mean success over seeds, the range where there are several, and of how many they are
    where not all were measured on that type.
    """
    table = Table(title="success [%]: mean of seeds (lowest to highest)", title_justify="left")
    table.add_column("terrain")
    table.add_column("size", justify="right")
    for key, results in groups.items():
        table.add_column(escape(heading(key, len(results))), justify="right")
    for name, entry in types_of(groups).items():
        columns = [shares(results, name) for results in groups.values()]
        for i, size in enumerate(sorted(set().union(*columns))):
            cells = [_share(column.get(size, []), len(seeds)) for column, seeds in zip(columns, groups.values(), strict=True)]
            table.add_row(escape(name if i == 0 else ""), escape(f"{size:g} {entry['unit']}"), *cells)
        table.add_section()
    return table


def _share(values: Sequence[float], seeds: int) -> str:
    if not values:
        return ""
    told = [f"{100 * min(values):.0f} to {100 * max(values):.0f}"] if len(values) > 1 else []
    if len(values) < seeds:
        told.append(f"of {len(values)} of {seeds} seeds")
    return f"{100 * mean(values):.1f}" + (f" ({', '.join(told)})" if told else "")


def draw_comparison(groups: Evaluations, path: Path) -> None:
    """Draw success into a PNG file: a panel a terrain type, a line a group, with a band from the worst to the best seed."""
    charts = []
    for name in types_of(groups):
        lines = []
        for key, results in groups.items():
            found, entries = shares(results, name), [types_in(result)[name] for result in results if name in types_in(result)]
            if found:
                worst, middle, best = (np.array([of(values) for values in found.values()]) for of in (min, mean, max))
                label = heading(key, sum("success" in result for result in results))
                lines.append((entries[0], Line(label, np.array(list(found)), middle, (worst, best), markers=True)))
        if lines:
            charts.append(success_chart(name.replace("_", " "), lines))
    draw_charts(charts, path)
