"""Success over difficulty as a table and as curves."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from legged.evaluation.engines import ENGINES, engine_of
from legged.evaluation.json_forms import check_form
from legged.evaluation.reports.charts import Chart, Line, draw_charts
from legged.evaluation.result_file import SUCCESS, file_name
from legged.evaluation.tables import screen_table
from legged.terrain import TERRAIN_TYPES

PANELS = {
    "stairs": ("stairs_up", "stairs_down"),
    "narrow stairs": ("narrow_stairs_up", "narrow_stairs_down"),
    "obstacles": ("obstacles",),
    "slopes": ("slope_up", "slope_down"),
    "rough slopes": ("rough_slope_up", "rough_slope_down"),
}
"""Types that share a panel; every other type has its own."""
TRAINED_LABEL = "hardest of training"


def print_success(success: dict[str, Any]) -> None:
    """Print a table with a line for each point; sizes harder than those of training are marked."""
    rule, beyond = success["definition"], False
    title = f"success: {rule['distance_m']:.3g} m from the start within {rule['time_s']:g} s, asked for {rule['vx']:.3g} m/s"
    rows: list[list[str] | None] = []
    for name, entry in success["types"].items():
        for i, point in enumerate(entry["points"]):
            mark = is_beyond(name, point["size"], entry["trained_to"])
            beyond |= mark
            time_s = point["mean_time_s"]
            row = [name if i == 0 else "", f"{point['size']:.3g} {entry['unit']}{' *' if mark else '  '}"]
            row.append(f"{point['successes']}/{point['robots']} = {100 * point['share']:.0f} %")
            row += [f"{100 * point['low']:.0f} to {100 * point['high']:.0f} %", str(point["fell"]), str(point["stuck"])]
            rows.append([*row, "" if time_s is None else f"{time_s:.1f} s"])
        rows.append(None)
    heads = ("terrain", "size", "success", "95 % interval", "fell", "stuck", "time to success")
    Console(width=110).print(screen_table(title, heads, rows))
    if beyond:
        print("* harder than in training")


def is_beyond(name: str, size: float, trained_to: float | None) -> bool:
    """Return whether a size is harder than the hardest of training; False if the type was not trained on."""
    if trained_to is None:
        return False
    kind = TERRAIN_TYPES[name]
    grows = kind.size(1.0) >= kind.size(0.0)  # stepping stones get smaller
    return size > trained_to + 1e-9 if grows else size < trained_to - 1e-9


def with_other_engines(result: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    """Return `result`, and the results of other engines next to `path` (evaluation_<physics>.json) that are of the same
    checkpoint and were measured with the same fields changed.
    """
    found = [result]
    for engine in ENGINES:
        other = path.with_name(file_name(engine))
        if engine == result["physics"] or not other.is_file():
            continue
        try:
            saved = json.loads(other.read_text(encoding="utf-8"))
            check_form(saved, SUCCESS, str(other))
            points = [point for entry in saved["success"]["types"].values() for point in entry["points"]]
            drawable = "robots_per_point" in saved["success"] and all({"low", "high"} <= point.keys() for point in points)
            same = all(saved.get(key) == result.get(key) for key in ("task", "checkpoint", "changes"))
            if drawable and saved["physics"] == engine and same:
                found.append(saved)
        except (OSError, ValueError, KeyError):  # not a file of ours: nothing to show
            continue
    return sorted(found, key=lambda one: list(ENGINES).index(one["physics"]))


def draw_success(results: list[dict[str, Any]], path: Path) -> None:
    """Draw success over size with its intervals into a PNG file: a panel for each kind of terrain, a line for each type and
    engine.
    """
    rule, robots = results[0]["success"]["definition"], results[0]["success"]["robots_per_point"]
    text = (
        f"{results[0]['task']}: robots that get {rule['distance_m']:.3g} m from their start within {rule['time_s']:g} s"
        f"\n{robots} robots a point"
    )
    draw_charts(success_charts(results), path, text)


def success_charts(results: Sequence[dict[str, Any]]) -> list[Chart]:
    """Return a chart for each kind of terrain: success over size, with one line for each type and engine."""
    found = []
    for title, types in panels_of([name for result in results for name in types_in(result)]).items():
        entries = {
            _label(name, result["physics"], types, results): types_in(result)[name]
            for name in types
            for result in results
            if name in types_in(result)
        }
        found.append(success_chart(title, [(entry, success_line(label, entry)) for label, entry in entries.items()]))
    return found


def types_in(result: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return terrain type -> its measurements; an empty mapping for an evaluation without success."""
    found: dict[str, dict[str, Any]] = result.get("success", {}).get("types", {})
    return found


def _label(name: str, physics: str, types: Sequence[str], results: Sequence[dict[str, Any]]) -> str:
    """Return the words that tell a line from the others of its chart."""
    words = [name.replace("_", " ")] if len(types) > 1 else []
    return ", ".join([*words, *([engine_of(physics).label] if len(results) > 1 else [])])


def success_line(label: str, entry: dict[str, Any]) -> Line:
    """Return success over size of one terrain type, with its intervals where the file has them."""
    points = sorted(entry["points"], key=lambda point: point["size"])
    size, share = (np.array([point[key] for point in points], dtype=float) for key in ("size", "share"))
    band = None
    if all(isinstance(point.get(key), int | float) for point in points for key in ("low", "high")):
        band = (np.array([point["low"] for point in points]), np.array([point["high"] for point in points]))
    return Line(label, size, share, band, markers=True)


def success_chart(title: str, lines: Sequence[tuple[dict[str, Any], Line]]) -> Chart:
    """Return the chart of success over the size of a terrain type, from entries of results and their lines. A dotted line
    marks the hardest size of training; it names its runs where they differ in it.
    """
    ends: dict[float, list[str]] = {}
    for entry, line in lines:
        if entry["trained_to"] is not None:
            ends.setdefault(float(entry["trained_to"]), []).append(line.name)
    several = len(ends) > 1
    walls = tuple((f"{TRAINED_LABEL}: {', '.join(names)}" if several else TRAINED_LABEL, end) for end, names in ends.items())
    what, unit = lines[0][0]["what"], lines[0][0]["unit"]
    drawn = [line for _, line in lines]
    return Chart(f"success: {title}", f"{what} [{unit}]", drawn, unit=what, high=1.0, percent=True, walls=walls)


def panels_of(names: list[str]) -> dict[str, tuple[str, ...]]:
    """Return title -> types of a panel, for the types in `names`."""
    there = dict.fromkeys(names)
    shared = {title: tuple(name for name in types if name in there) for title, types in PANELS.items()}
    panels = {title: types for title, types in shared.items() if types}
    grouped = {name for types in panels.values() for name in types}
    return panels | {name.replace("_", " "): (name,) for name in there if name not in grouped}
