"""A comparison of runs: differing settings, curves, and evaluations with intervals."""

from collections.abc import Sequence
from math import sqrt
from typing import Any

import numpy as np

from legged.config.dotted import differences
from legged.evaluation.engines import ENGINES, engine_of
from legged.evaluation.intervals import Interval, bootstrap_mean, newcombe, normal_mean, welch, wilson
from legged.evaluation.learning_curves import labels
from legged.evaluation.reports.charts import curves
from legged.evaluation.reports.curves import curves_of_runs
from legged.evaluation.reports.document import Cell, Figures, Heading, Mono, Paragraph, Part, Table
from legged.evaluation.reports.evaluation_part import BROKEN, between, falls_of, number
from legged.evaluation.reports.record import Record, words
from legged.evaluation.result_file import changes_text, grid_text, tracking_of
from legged.evaluation.success_report import success_chart, success_line, types_in

Measured = tuple[str, Interval | None] | None
"""Text of a figure and its interval, if it has one; None if a run lacks the figure."""


def comparison_parts(records: Sequence[Record]) -> list[Part]:
    """Return the page on some runs, which compares all with the first."""
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
    parts += [Table(head, rows), Heading("Settings that differ"), _settings(names, records)]
    drawings = curves_of_runs([(name, record.log) for name, record in zip(names, records, strict=True)])
    if drawings:
        parts += [Heading("Curves"), Figures("curves", drawings, "learning curves of the runs")]
    return parts + _evaluations(names, records)


def apart(names: Sequence[str]) -> tuple[str, list[str]]:
    """Return the common parts of runs' labels, and the rest of each label; no common parts if a label would become empty."""
    parts = [name.split(", ") for name in names]
    common = [part for part in parts[0] if all(part in one for one in parts)]
    rest = [", ".join(part for part in one if part not in common) for one in parts]
    return (", ".join(common), rest) if all(rest) else ("", list(names))


def _settings(names: Sequence[str], records: Sequence[Record]) -> Part:
    """Return a table of the settings that are not the same in all runs."""
    found = differences([record.config for record in records])
    if not found:
        return Paragraph("None.")
    rows: list[list[Cell]] = [[Mono(path), *(Mono(words(value)) for value in values)] for path, values in found.items()]
    return Table(["setting", *names], rows)


def _evaluations(names: Sequence[str], records: Sequence[Record]) -> list[Part]:
    """Return tables and drawings of the engines in which at least two runs were evaluated."""
    by_engine = [{result["physics"]: result for result in record.results} for record in records]
    engines = dict.fromkeys(name for one in by_engine for name in one)
    parts: list[Part] = []
    for engine in sorted(engines, key=lambda name: [*ENGINES, name].index(name)):
        results = [one.get(engine) for one in by_engine]
        if sum(result is not None for result in results) < 2:
            continue
        parts += [Heading(f"Evaluation in {engine_of(engine).label}"), _table(names, results)]
        others = [(name, record.another_policy(one)) for name, record, one in zip(names, records, results, strict=True)]
        parts += [Paragraph(f"{name}: of `{file}`, which is not its last policy.") for name, file in others if file]
        parts += [Paragraph(f"{name}: {text}.") for name, text in zip(names, conditions_of(results), strict=True) if text]
        drawings = _success(names, results)
        if drawings:
            parts.append(Figures(f"success_{engine}", drawings, f"success over difficulty in {engine_of(engine).label}"))
    if not parts:
        return [Heading("Evaluation"), Paragraph("No two of the runs were evaluated in the same engine.")]
    text = (
        "Brackets hold intervals of 95 %: Wilson's for shares, Newcombe's for their differences, a bootstrap over the"
        " commands of the grid for errors, Welch's for returns. They describe one policy; another seed may differ by more."
        " A * marks differences whose interval excludes 0. A single command or episode has no interval."
    )
    return [*parts, Paragraph(text)]


def conditions_of(results: Sequence[dict[str, Any] | None]) -> list[str]:
    """Return for each evaluation its changed fields, and its grid of commands if the grids differ."""
    found = [result or {} for result in results]
    grids = [grid_text(one) for one in found]
    told = len(set(grids) - {""}) > 1
    changes = [changes_text(one) for one in found]
    return [
        "; ".join([*([f"made with {changed}"] if changed else []), *([f"on {grid}"] if told and grid else [])])
        for changed, grid in zip(changes, grids, strict=True)
    ]


def _table(names: Sequence[str], results: Sequence[dict[str, Any] | None]) -> Table:
    """Return the table of one engine: a line for each measure, a column for each run, and a column for each difference from
    the first run.
    """
    rows: list[list[Cell]] = []
    for label, measure, difference in _measures(results):
        found = [measure(result) if result is not None else None for result in results]
        row: list[Cell] = [label, *(_words(one) for one in found)]
        for result in results[1:]:
            both = results[0] is not None and result is not None
            row.append(_words(difference(results[0], result) if both else None, marked=True))
        rows.append(row)
    return Table(["measure", *names, *(f"{name} - {names[0]}" for name in names[1:])], rows)


def _words(found: Measured, marked: bool = False) -> str:
    if found is None:
        return "-"
    text, interval = found
    return f"{text}{' *' if marked and interval is not None and not interval[0] <= 0.0 <= interval[1] else ''}"


def _with_interval(value: float, form: str, interval: Interval | None, factor: float = 1.0) -> Measured:
    """Return a figure with its interval in brackets."""
    around = "" if interval is None else f" ({between(interval, factor, form)})"
    return f"{factor * value:{form}}{around}", interval


def _measures(results: Sequence[dict[str, Any] | None]) -> list[tuple[str, Any, Any]]:
    """Return the compared measures: label, figure of a run, and difference of two."""
    if any(result is not None and "episodes" in result for result in results):
        return [
            ("return", *_figure(_spread, lambda mean, _std, _count: mean, normal_mean, welch, ".1f")),
            ("episodes that ended in a failure [%]", *_share(_failures)),
        ]
    return [
        ("velocity RMSE [m/s]", *_error("rmse_lin")),
        ("yaw rate RMSE [rad/s]", *_error("rmse_ang")),
        ("falls [%]", *_share(lambda result: falls_of(tracking_of(result)))),
    ]


def _error(name: str) -> tuple[Any, Any]:
    """Return functions for the mean of an error over the grid, and for the difference of two on the same grid."""

    def cells(result: dict[str, Any]) -> dict[tuple[float, ...], float]:
        try:
            found = tracking_of(result)["cells"]
            return {tuple(cell["command"]): float(cell[name]) for cell in found if cell[name] is not None}
        except BROKEN:
            return {}

    def of(result: dict[str, Any]) -> Measured:
        values = list(cells(result).values())
        if not values:
            mean = tracking_of(result).get(name, {}).get("mean")
            return None if mean is None else (f"{mean:.3f}", None)
        return _with_interval(float(np.mean(values)), ".3f", bootstrap_mean(values))

    def more(first: dict[str, Any], second: dict[str, Any]) -> Measured:
        a, b = cells(first), cells(second)
        common = [command for command in a if command in b]
        if not common:
            return None
        moved = [b[command] - a[command] for command in common]
        return _with_interval(float(np.mean(moved)), "+.3f", bootstrap_mean(moved))

    return of, more


def _figure(read: Any, value: Any, interval: Any, of_difference: Any, form: str, factor: float = 1.0) -> tuple[Any, Any]:
    """Return functions for a figure and for the difference of two. `read` finds values in a result, or None; `value` and
    `interval` compute the figure and its interval from them, `of_difference` the interval of a difference.
    """

    def of(result: dict[str, Any]) -> Measured:
        found = read(result)
        if found is None:
            return None
        return _with_interval(value(*found), form, interval(*found), factor)

    def more(first: dict[str, Any], second: dict[str, Any]) -> Measured:
        a, b = read(first), read(second)
        if a is None or b is None:
            return None
        return _with_interval(value(*b) - value(*a), f"+{form}", of_difference(a, b), factor)

    return of, more


def _share(counted: Any) -> tuple[Any, Any]:
    """Return functions for a share and for the difference of two; `counted` returns (number, total) of a result, or None."""
    return _figure(counted, lambda some, of_all: some / of_all, wilson, newcombe, ".2f", 100.0)


def _failures(result: dict[str, Any]) -> tuple[int, int] | None:
    count = int(result["episodes"]["count"]) if "episodes" in result else 0
    return (round(result["episodes"]["failures"] * count), count) if count > 0 else None


def _spread(result: dict[str, Any]) -> tuple[float, float, int] | None:
    """Return mean and sample standard deviation of returns, and the number of episodes. The file holds the population's
    standard deviation, which is a little smaller.
    """
    episodes = result.get("episodes")
    if episodes is None or int(episodes["count"]) < 1:
        return None
    count = int(episodes["count"])
    return episodes["return"]["mean"], episodes["return"]["std"] * sqrt(count / max(count - 1, 1)), count


def _success(names: Sequence[str], results: Sequence[dict[str, Any] | None]) -> list[str]:
    """Return a drawing for each terrain type that at least two of the runs have crossed."""
    entries = [types_in(result or {}) for result in results]
    found = []
    for kind in dict.fromkeys(kind for one in entries for kind in one):
        there = [(one[kind], success_line(name, one[kind])) for name, one in zip(names, entries, strict=True) if kind in one]
        if len(there) > 1:
            found.append(curves(success_chart(kind.replace("_", " "), there)))
    return found
