"""Tables for the screen that compare evaluations, and a page that compares settings, curves and evaluations of runs. In the
tables, evaluations with the same task, engine and conditions are assumed to be of policies trained with different seeds.
"""

from collections.abc import Callable, Sequence
from functools import partial
from math import sqrt
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
from rich.table import Table as ScreenTable

from legged.config.dotted import differences, value_at
from legged.errors import ConfigError, suggest
from legged.evaluation.engines import by_engine, engine_of
from legged.evaluation.intervals import Interval, bootstrap_mean, newcombe, normal_mean, welch, wilson
from legged.evaluation.learning_curves import curves_of_runs, labels
from legged.evaluation.reports.charts import Line, curves, draw_charts
from legged.evaluation.reports.document import (
    Cell,
    Figures,
    Heading,
    Mono,
    Paragraph,
    Part,
    Table,
    between,
    number,
)
from legged.evaluation.reports.record import Record, words
from legged.evaluation.result_file import BROKEN, changes_text, falls_of, grid_text, has_tracking, tracking_of
from legged.evaluation.success import success_chart, success_line, types_in
from legged.tables import screen_table

Key = tuple[str, str, str]
"""(task, engine, conditions). The conditions are the changed fields and, if the grids of the results differ, the grid."""
Evaluations = dict[Key, list[dict[str, Any]]]
"""Key -> results, one for each seed."""
FIGURES = {
    "velocity RMSE, mean [m/s]": ("rmse_lin.mean", 1.0, ".3f"),
    "velocity RMSE, worst cell [m/s]": ("rmse_lin.worst", 1.0, ".3f"),
    "yaw rate RMSE, mean [rad/s]": ("rmse_ang.mean", 1.0, ".3f"),
    "yaw rate RMSE, worst cell [rad/s]": ("rmse_ang.worst", 1.0, ".3f"),
    "falls [%]": ("falls", 100.0, ".2f"),
}
"""Label -> path in a result, factor, format."""
Counted = dict[tuple[float, ...], float] | tuple[float, float, int] | tuple[int, int] | float | None
"""A figure of a run: {command: error}, (mean, sample standard deviation, count), (successes, trials), a number, or None."""
Measured = tuple[float, Interval | None] | None
"""A figure and its confidence interval, which may be None. If a run lacks the figure, the whole pair is None."""


def keep_types(results: Sequence[dict[str, Any]], types: Sequence[str]) -> None:
    """Change the results in place: keep only the terrain types in `types`, in the order of `types`.

    Raises:
        ConfigError: one of the types is in no result.
    """
    there = {name for result in results for name in types_in(result)}
    for name in types:
        if name not in there:
            raise ConfigError(f"--types: {name}: none of the evaluations holds it{suggest(name, there)}")
    for result in results:
        if "success" in result:
            found = result["success"]["types"]
            result["success"]["types"] = {name: found[name] for name in types if name in found}


def grouped(results: Sequence[dict[str, Any]]) -> Evaluations:
    """Return the results in groups of the same task, engine, changed fields and grid of commands. The groups are in the order
    of their first results.
    """
    groups: Evaluations = {}
    for result, differing in zip(results, conditions_of(results), strict=True):
        conditions = ", ".join(filter(None, differing))
        groups.setdefault((result["task"], result["physics"], conditions), []).append(result)
    return groups


def conditions_of(results: Sequence[dict[str, Any] | None]) -> list[tuple[str, str]]:
    """Return two texts for each evaluation: its changed fields, and its grid of commands if the grids differ."""
    grids = [grid_text(result or {}) for result in results]
    told = len(set(grids) - {""}) > 1
    return [(changes_text(result or {}), grid if told else "") for result, grid in zip(results, grids, strict=True)]


def spread(values: Sequence[float]) -> float:
    """Return the largest deviation of a value from the mean, relative to the mean; 0 if all values are 0."""
    middle = mean(values)
    return max(abs(value - middle) for value in values) / middle if middle else 0.0


def tracking_table(groups: Evaluations) -> ScreenTable:
    """Return a table with one column for each group: the mean over the seeds, and the largest deviation of a seed from the
    mean.
    """
    rows = []
    for label, (path, factor, form) in FIGURES.items():
        row = [label]
        for results in groups.values():
            found = [value_at(tracking_of(result), path) for result in results if has_tracking(result)]
            values = [factor * value for value in found if value is not None]  # a value is None if every robot fell
            row.append(_mean_text(values, len(results), form, f"{100 * spread(values):.0f} %") if values else "none")
        rows.append(row)
    return screen_table("following commands: mean of seeds (largest deviation)", ["measure", *_heads(groups)], rows)


def episodes_comparison(groups: Evaluations) -> ScreenTable:
    """Return a table of evaluations of episodes. It has a column for each group, with the mean and the range over seeds."""
    found = [[_episode_figures(result["episodes"]) for result in results] for results in groups.values()]
    rows = []
    for label in dict.fromkeys(label for seeds in found for seed in seeds for label in seed):
        row = [label]
        for seeds in found:
            values = [seed[label] for seed in seeds if label in seed]
            form = ".1f" if values and abs(mean(values)) >= 100 else ".2f"
            row.append(_range_text(values, len(values), form, form))
        rows.append(row)
    return screen_table("episodes: mean of seeds (lowest to highest)", ["measure", *_heads(groups)], rows)


def _heads(groups: Evaluations) -> list[str]:
    return [heading(key, len(results)) for key, results in groups.items()]


def _mean_text(values: Sequence[float], seeds: int, form: str, spread_text: str) -> str:
    """Return the mean of `values` as text. Brackets hold `spread_text`, and the number of values if some seeds have none."""
    notes = [spread_text] if len(values) > 1 else []
    notes += [f"of {len(values)} of {seeds} seeds"] if len(values) < seeds else []
    return f"{mean(values):{form}}" + (f" ({', '.join(notes)})" if notes else "")


def _range_text(values: Sequence[float], seeds: int, form: str, range_form: str) -> str:
    return _mean_text(values, seeds, form, f"{min(values):{range_form}} to {max(values):{range_form}}") if values else ""


def _episode_figures(episodes: dict[str, Any]) -> dict[str, float]:
    """Return label -> number, for the figures by which evaluations of episodes are compared."""
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
    """Return the heading of a group's column."""
    task, physics, conditions = key
    text = f"{task}\n{engine_of(physics).label}, {seeds} seed{'s' if seeds > 1 else ''}"
    return f"{text}\n{conditions}" if conditions else text


def shares(results: Sequence[dict[str, Any]], terrain: str) -> dict[float, list[float]]:
    """Return size -> shares of successful robots, one share for each seed that was measured on `terrain`. Sizes that one of
    these seeds lacks are left out.
    """
    entries = [types_in(result)[terrain] for result in results if terrain in types_in(result)]
    found = [{point["size"]: point["share"] for point in entry["points"]} for entry in entries]
    common = set.intersection(*(set(one) for one in found)) if found else set()
    return {size: [one[size] for one in found] for size in sorted(common)}


def types_of(groups: Evaluations) -> dict[str, dict[str, Any]]:
    """Return terrain type -> its entry in the last result that has the type, for all types in the results."""
    entries = [types_in(result) for results in groups.values() for result in results]
    return {name: entry for one in entries for name, entry in one.items()}


def success_table(groups: Evaluations) -> ScreenTable:
    """Return a table with a line for each terrain type and size: the mean success of each group's seeds, and its range."""
    rows: list[list[str] | None] = []
    for name, entry in types_of(groups).items():
        columns = [(shares(results, name), len(results)) for results in groups.values()]
        for i, size in enumerate(sorted(set().union(*(found for found, _ in columns)))):
            percent = [([100 * value for value in found.get(size, [])], seeds) for found, seeds in columns]
            cells = [_range_text(values, seeds, ".1f", ".0f") for values, seeds in percent]
            rows.append([name if i == 0 else "", f"{size:g} {entry['unit']}", *cells])
        rows.append(None)
    return screen_table("success [%]: mean of seeds (lowest to highest)", ["terrain", "size", *_heads(groups)], rows)


def draw_comparison(groups: Evaluations, path: Path) -> None:
    """Draw success over size into a PNG file, with a panel for each terrain type. A panel has a line for each group, with a
    band from the group's worst to its best seed.
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


# ---- the page on runs ------------------------------------------------------------------------------------------------


def comparison_parts(records: Sequence[Record]) -> list[Part]:
    """Return the parts of a page that compares runs with the first of them."""
    common, names = apart(labels([record.folder for record in records], [record.config for record in records]))
    noted = any(record.note for record in records)
    rows: list[list[Cell]] = []
    for name, record in zip(names, records, strict=True):
        timing = record.timing
        row: list[Cell] = [name, Mono(record.name), record.status, record.why, number(record.robots, ",.0f")]
        row += [number(timing.loop_s if timing else None, ".1f"), number(timing.steps_per_s if timing else None, ",.0f")]
        rows.append([*row, record.code.summary, *([record.note] if noted else [])])
    head = ["run", "folder", "status", "", "robots", "loop [s]", "steps/s", "commit", *(["note"] if noted else [])]
    parts: list[Part] = [Paragraph(f"All runs: {common}.")] if common else []
    found = differences([record.config for record in records])
    settings: list[list[Cell]] = [[Mono(path), *(Mono(words(value)) for value in values)] for path, values in found.items()]
    told = Table(["setting", *names], settings) if settings else Paragraph("None.")
    parts += [Table(head, rows), Heading("Settings that differ"), told]
    drawings = curves_of_runs([(name, record.log) for name, record in zip(names, records, strict=True)])
    if drawings:
        parts += [Heading("Curves"), Figures("curves", drawings, "learning curves of the runs")]
    return parts + _evaluations(names, records)


def apart(names: Sequence[str]) -> tuple[str, list[str]]:
    """Split labels into their common parts and the rest of each label. If the rest of a label is empty, split nothing."""
    parts = [name.split(", ") for name in names]
    common = [part for part in parts[0] if all(part in one for one in parts)]
    rest = [", ".join(part for part in one if part not in common) for one in parts]
    return (", ".join(common), rest) if all(rest) else ("", list(names))


def _evaluations(names: Sequence[str], records: Sequence[Record]) -> list[Part]:
    """Return tables and drawings of the evaluations, for each engine that has evaluations of at least two runs."""
    parts: list[Part] = []
    for engine in by_engine(result for record in records for result in record.results.values()):
        results = [record.results.get(engine) for record in records]
        if sum(result is not None for result in results) < 2:
            continue
        parts += [Heading(f"Evaluation in {engine_of(engine).label}"), _table(names, results)]
        others = [(name, record.another_policy(one)) for name, record, one in zip(names, records, results, strict=True)]
        parts += [Paragraph(f"{name}: the evaluation is of `{file}`, not the last policy.") for name, file in others if file]
        for name, (changed, grid) in zip(names, conditions_of(results), strict=True):
            told = "; ".join([*([f"made with {changed}"] if changed else []), *([f"on {grid}"] if grid else [])])
            parts += [Paragraph(f"{name}: {told}.")] if told else []
        drawings = []
        entries = [(name, types_in(result or {})) for name, result in zip(names, results, strict=True)]
        for kind in dict.fromkeys(kind for _, one in entries for kind in one):
            there = [(one[kind], success_line(name, one[kind])) for name, one in entries if kind in one]
            if len(there) > 1:
                drawings.append(curves(success_chart(kind.replace("_", " "), there)))
        if drawings:
            parts.append(Figures(f"success_{engine}", drawings, f"success over difficulty in {engine_of(engine).label}"))
    if not parts:
        return [Heading("Evaluation"), Paragraph("No two of the runs were evaluated in the same engine.")]
    text = (
        "Brackets hold 95 % confidence intervals: Wilson's for shares, Newcombe's for their differences, a bootstrap over the"
        " commands of the grid for errors, Welch's for returns. They describe one policy; another seed may differ by more."
        " A * marks differences whose interval excludes 0. A single command or episode has no interval."
    )
    return [*parts, Paragraph(text)]


def _table(names: Sequence[str], results: Sequence[dict[str, Any] | None]) -> Table:
    """Return the table of one engine: a line for each measure, a column for each run, and a column for each difference from
    the first run.
    """
    measures: dict[str, tuple[Callable[[dict[str, Any]], Counted], str, float]] = {
        "velocity RMSE [m/s]": (partial(_errors, "rmse_lin"), ".3f", 1.0),
        "yaw rate RMSE [rad/s]": (partial(_errors, "rmse_ang"), ".3f", 1.0),
        "falls [%]": (lambda result: falls_of(tracking_of(result)), ".2f", 100.0),
    }
    if any("episodes" in (result or {}) for result in results):
        measures = {"return": (_returns, ".1f", 1.0), "episodes that ended in a failure [%]": (_failures, ".2f", 100.0)}
    rows: list[list[Cell]] = []
    for label, (read, form, factor) in measures.items():
        found = [None if result is None else read(result) for result in results]
        row: list[Cell] = [label, *(_text(_figure(one), form, factor) for one in found)]
        for one in found[1:]:
            more = _difference(found[0], one)
            clear = more is not None and more[1] is not None and not more[1][0] <= 0.0 <= more[1][1]
            row.append(_text(more, f"+{form}", factor) + " *" * clear)
        rows.append(row)
    return Table(["measure", *names, *(f"{name} - {names[0]}" for name in names[1:])], rows)


def _text(measured: Measured, form: str, factor: float) -> str:
    if measured is None:
        return "-"
    value, interval = measured
    return f"{factor * value:{form}}" + ("" if interval is None else f" ({between(interval, factor, form)})")


def _figure(found: Counted) -> Measured:
    match found:
        case dict():
            return float(np.mean(list(found.values()))), bootstrap_mean(list(found.values()))
        case (successes, trials):
            return successes / trials, wilson(successes, trials)
        case (middle, std, count):
            return middle, normal_mean(middle, std, count)
        case None:
            return None
    return found, None


def _difference(first: Counted, second: Counted) -> Measured:
    """Return `second` - `first` with its interval. Errors are compared over the commands that both have."""
    match first, second:
        case dict(), dict():
            moved = {command: second[command] - error for command, error in first.items() if command in second}
            return _figure(moved) if moved else None
        case (some, of_first), (more, of_second):
            return more / of_second - some / of_first, newcombe((some, of_first), (more, of_second))
        case (middle, _, _), (other, _, _):
            return other - middle, welch(first, second)  # type: ignore[arg-type]
    return None


def _errors(name: str, result: dict[str, Any]) -> Counted:
    """Return command -> error, or the mean error if the result has no cells."""
    tracking = tracking_of(result)
    try:
        cells = {tuple(cell["command"]): float(cell[name]) for cell in tracking["cells"] if cell[name] is not None}
    except BROKEN:
        cells = {}
    return cells or value_at(tracking, f"{name}.mean")  # type: ignore[no-any-return]


def _failures(result: dict[str, Any]) -> Counted:
    count = int(value_at(result, "episodes.count") or 0)
    return (round(result["episodes"]["failures"] * count), count) if count > 0 else None


def _returns(result: dict[str, Any]) -> Counted:
    """Return the mean and the sample standard deviation of returns, and the number of episodes. The sample standard deviation
    is computed from the population standard deviation in the file.
    """
    count = int(value_at(result, "episodes.count") or 0)
    if count < 1:
        return None
    returns = result["episodes"]["return"]
    return returns["mean"], returns["std"] * sqrt(count / max(count - 1, 1)), count
