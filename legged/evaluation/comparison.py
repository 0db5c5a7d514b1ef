"""Several evaluations next to each other, as tables and as curves. Evaluations of one task in one engine under one condition
are its seeds.
"""

from collections.abc import Sequence
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
from rich.table import Table

from legged.errors import ConfigError, suggest
from legged.evaluation.engines import engine_of
from legged.evaluation.reports.charts import Line, draw_charts
from legged.evaluation.result_file import changes_text, grid_text, has_tracking, tracking_of
from legged.evaluation.success_report import success_chart, types_in
from legged.evaluation.tables import screen_table

Key = tuple[str, str, str]
"""Task, engine, and conditions that differ from the policy's own or between evaluations."""
Evaluations = dict[Key, list[dict[str, Any]]]
"""Key -> results, one for each seed."""
FIGURES = (
    ("velocity RMSE, mean [m/s]", "rmse_lin", "mean", 1.0, ".3f"),
    ("velocity RMSE, worst cell [m/s]", "rmse_lin", "worst", 1.0, ".3f"),
    ("yaw rate RMSE, mean [rad/s]", "rmse_ang", "mean", 1.0, ".3f"),
    ("yaw rate RMSE, worst cell [rad/s]", "rmse_ang", "worst", 1.0, ".3f"),
    ("falls [%]", "falls", None, 100.0, ".2f"),
)
"""Label, place in a result, factor, format."""


def keep_types(results: Sequence[dict[str, Any]], types: Sequence[str]) -> None:
    """Keep only the terrain types `types` in the results, in that order.

    Raises:
        ConfigError: no result has a type.
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
    """Return the results in groups of the same task, engine, changed fields and grid of commands, in the order of the first
    result of each group.
    """
    grids = [grid_text(result) for result in results]
    told = len(set(grids) - {""}) > 1
    groups: Evaluations = {}
    for result, grid in zip(results, grids, strict=True):
        conditions = ", ".join(text for text in (changes_text(result), grid if told else "") if text)
        groups.setdefault((result["task"], result["physics"], conditions), []).append(result)
    return groups


def spread(values: Sequence[float]) -> float:
    """Return the largest distance of a value from the mean, as a share of the mean; 0 if all values are 0."""
    middle = mean(values)
    return max(abs(value - middle) for value in values) / middle if middle else 0.0


def tracking_table(groups: Evaluations) -> Table:
    """Return a table with one column for each group: the mean over its seeds, and the distance of the farthest seed from
    it.
    """
    rows = []
    for label, name, part, factor, form in FIGURES:
        row = [label]
        for results in groups.values():
            found = [tracking_of(result)[name] for result in results if has_tracking(result)]
            every = [value if part is None else value[part] for value in found]
            values = [factor * value for value in every if value is not None]  # null if every robot fell
            row.append(_mean_text(values, len(results), form, f"{100 * spread(values):.0f} %") if values else "none")
        rows.append(row)
    return screen_table("following commands: mean of seeds (farthest from it)", ["measure", *_heads(groups)], rows)


def episodes_comparison(groups: Evaluations) -> Table:
    """Return a table of evaluations of episodes with one column for each group: the mean over its seeds and their range."""
    found = [[_episode_figures(result["episodes"]) for result in results] for results in groups.values()]
    rows = []
    for label in dict.fromkeys(label for seeds in found for seed in seeds for label in seed):
        columns = [[seed[label] for seed in seeds if label in seed] for seeds in found]
        forms = [".1f" if values and abs(mean(values)) >= 100 else ".2f" for values in columns]
        texts = [_range_text(values, len(values), form, form) for values, form in zip(columns, forms, strict=True)]
        rows.append([label, *texts])
    return screen_table("episodes: mean of seeds (lowest to highest)", ["measure", *_heads(groups)], rows)


def _heads(groups: Evaluations) -> list[str]:
    return [heading(key, len(results)) for key, results in groups.items()]


def _mean_text(values: Sequence[float], seeds: int, form: str, spread_text: str) -> str:
    """Return a mean as text. Brackets hold the spread of several values, and their number if some seeds lack a value."""
    notes = [spread_text] if len(values) > 1 else []
    notes += [f"of {len(values)} of {seeds} seeds"] if len(values) < seeds else []
    return f"{mean(values):{form}}" + (f" ({', '.join(notes)})" if notes else "")


def _range_text(values: Sequence[float], seeds: int, form: str, range_form: str) -> str:
    """Return a mean with the range of the values; an empty text without values."""
    return _mean_text(values, seeds, form, f"{min(values):{range_form}} to {max(values):{range_form}}") if values else ""


def _episode_figures(episodes: dict[str, Any]) -> dict[str, float]:
    """Return label -> number of the compared figures of an evaluation of episodes."""
    return {
        "return": episodes["return"]["mean"],
        "standard deviation of the return": episodes["return"]["std"],
        "least return": episodes["return"]["min"],
        "episode length [steps]": episodes["length"]["mean"],
        "episodes that ended in a failure [%]": 100.0 * episodes["failures"],
        **{f"return of {name}": value for name, value in episodes["terms"].items()},
        **episodes["metrics"],
    }


def heading(key: Key, seeds: int) -> str:
    """Return the heading of a group."""
    task, physics, conditions = key
    text = f"{task}\n{engine_of(physics).label}, {seeds} seed{'s' if seeds > 1 else ''}"
    return f"{text}\n{conditions}" if conditions else text


def shares(results: Sequence[dict[str, Any]], terrain: str) -> dict[float, list[float]]:
    """Return size -> success of every seed that was measured on a type, for the sizes that these seeds share."""
    entries = [types_in(result)[terrain] for result in results if terrain in types_in(result)]
    found = [{point["size"]: point["share"] for point in entry["points"]} for entry in entries]
    common = set.intersection(*(set(one) for one in found)) if found else set()
    return {size: [one[size] for one in found] for size in sorted(common)}


def types_of(groups: Evaluations) -> dict[str, dict[str, Any]]:
    """Return terrain type -> one of its entries, for all types that were measured."""
    entries = [types_in(result) for results in groups.values() for result in results]
    return {name: entry for one in entries for name, entry in one.items()}


def success_table(groups: Evaluations) -> Table:
    """Return a table with one line for each type and size: the mean success over seeds and their range."""
    rows: list[list[str] | None] = []
    for name, entry in types_of(groups).items():
        columns = [
            {size: [100 * value for value in found] for size, found in shares(results, name).items()}
            for results in groups.values()
        ]
        for i, size in enumerate(sorted(set().union(*columns))):
            each = zip(columns, groups.values(), strict=True)
            cells = [_range_text(column.get(size, []), len(seeds), ".1f", ".0f") for column, seeds in each]
            rows.append([name if i == 0 else "", f"{size:g} {entry['unit']}", *cells])
        rows.append(None)
    return screen_table("success [%]: mean of seeds (lowest to highest)", ["terrain", "size", *_heads(groups)], rows)


def draw_comparison(groups: Evaluations, path: Path) -> None:
    """Draw success into a PNG file: a panel for each terrain type, a line for each group, with a band from the worst to the
    best seed.
    """
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
