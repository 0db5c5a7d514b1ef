"""The part of a report on evaluations: tables, heat maps over commands, success over difficulty, returns."""

import math
from collections.abc import Callable, Sequence
from typing import Any

from legged.evaluation.engines import ENGINES, engine_of
from legged.evaluation.intervals import wilson
from legged.evaluation.reports.charts import curves, heat_map
from legged.evaluation.reports.document import Cell, Figures, Heading, Number, Paragraph, Part, Table
from legged.evaluation.result_file import changes_text, has_tracking, tracking_of
from legged.evaluation.success_report import success_charts
from legged.evaluation.tracking_report import PANELS, grid_means
from legged.evaluation.velocity_grid import AXES

BROKEN = (KeyError, TypeError, ValueError, IndexError, AttributeError)
"""Errors raised by a file that lacks a part of an evaluation."""


def number(value: float | None, form: str = ".3f", unit: str = "") -> Number:
    """Return a number as a cell; a dash, which is not sorted, for None and for values that are not finite."""
    return Number("-", None) if value is None or not math.isfinite(value) else Number(f"{value:{form}}{unit}", value)


def between(interval: tuple[float, float], factor: float = 1.0, form: str = ".1f") -> str:
    """Return an interval as text."""
    return f"{factor * interval[0]:{form}} to {factor * interval[1]:{form}}"


def falls_of(tracking: dict[str, Any]) -> tuple[int, int] | None:
    """Return the number of robots of a command grid that fell, and of all; None if the file lacks them."""
    try:
        robots = len(tracking["cells"]) * int(tracking["robots_per_cell"])
        return (round(tracking["falls"] * robots), robots) if robots > 0 else None
    except BROKEN:
        return None


def evaluation_parts(
    results: Sequence[dict[str, Any]], another_policy: Callable[[dict[str, Any]], str] = lambda _: ""
) -> list[Part]:
    """Return the part of a report on evaluations, by engine; no part without results. `another_policy` names the checkpoint
    of an evaluation that is not of the run's last policy.
    """
    if not results:
        return []
    results = sorted(results, key=lambda one: [*ENGINES, one["physics"]].index(one["physics"]))
    of_episodes = [result for result in results if "episodes" in result]
    following = [result for result in results if "episodes" not in result]
    parts: list[Part] = [Heading("Evaluation")]
    for result in results:
        if another_policy(result):
            label = engine_of(result["physics"]).label
            parts.append(Paragraph(f"In {label} it is of `{another_policy(result)}`, which is not the last policy."))
        if result.get("changes"):
            parts.append(Paragraph(f"In {engine_of(result['physics']).label} it was made with {changes_text(result)}."))
    if following:
        parts += _following(following)
    for result in of_episodes:
        parts += _episodes(result)
    return parts


def _following(results: Sequence[dict[str, Any]]) -> list[Part]:
    """Return tables and drawings of robots that follow commands."""
    rows: list[list[Cell]] = []
    drawings = []
    for result in filter(has_tracking, results):
        tracking, label = tracking_of(result), engine_of(result["physics"]).label
        counted = falls_of(tracking)
        rows.append(
            [
                label,
                *(number(tracking[name][part]) for name in ("rmse_lin", "rmse_ang") for part in ("mean", "worst")),
                number(100.0 * tracking["falls"], ".2f"),
                "-" if counted is None else between(wilson(*counted), 100.0, ".2f"),
                number(tracking.get("cost_of_transport"), ".2f"),
            ]
        )
        drawings += _heat_maps(tracking, label)
    head = [
        "engine",
        "velocity RMSE [m/s]",
        "worst cell",
        "yaw rate RMSE [rad/s]",
        "worst cell",
        "falls [%]",
        "95 % interval",
        "cost of transport",
    ]
    parts: list[Part] = [
        Paragraph(
            "Without noise and pushes, on a grid of commands: root mean square of the error over time, mean of the cells. The"
            " interval of falls is Wilson's. A cell of the maps is the mean over the third command."
        ),
        Table(head, rows),
    ]
    if not rows:
        parts = []
    if drawings:
        parts.append(Figures("tracking", drawings, "velocity and yaw rate errors over commands"))
    success = [curves(chart) for chart in success_charts(results)]
    if success:
        parts += [
            Paragraph(
                "Robots that get out of a tile of each size, with Wilson's interval of 95 %; a dotted line is the hardest of"
                " training."
            ),
            Figures("success", success, "success over difficulty"),
        ]
    return parts


def _heat_maps(tracking: dict[str, Any], label: str) -> list[str]:
    """Return maps of errors over commands; none if the file lacks the cells."""
    try:
        grid, found = tracking["grid"], []
        for name, over, other, title in PANELS:
            values = grid_means(tracking, name, over)
            where = (f"commanded vx [{AXES['vx']}]", f"commanded {other} [{AXES[other]}]")
            found.append(heat_map(f"{title}, {label}", *where, grid["vx"], grid[other], values))
        return found
    except BROKEN:
        return []


def _episodes(result: dict[str, Any]) -> list[Part]:
    """Return a table of full episodes."""
    episodes = result["episodes"]
    rows: list[list[Cell]] = []
    for label, key in (("return", "return"), ("length [control steps]", "length")):
        rows.append([label, *(number(episodes[key][part], ".1f") for part in ("mean", "std", "min", "max"))])
    blank = [number(None)] * 3
    rows += [[f"return of {name}", number(value, ".1f"), *blank] for name, value in episodes["terms"].items()]
    rows.append(["ended in a failure [%]", number(100.0 * episodes["failures"], ".1f"), *blank])
    rows += [[name.replace("_", " "), number(value), *blank] for name, value in episodes["metrics"].items()]
    label = engine_of(result["physics"]).label
    return [
        Paragraph(f"{episodes['count']:.0f} full episodes without noise, in {label}."),
        Table(["measure", "mean", "standard deviation", "least", "greatest"], rows),
    ]
