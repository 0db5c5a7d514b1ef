"""Success over difficulty as a table and as curves."""

import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from legged.evaluation.engines import ENGINES
from legged.evaluation.result_file import check_success, file_name
from legged.figures import COLORS, figure
from legged.terrain import TERRAIN_TYPES

PANELS = {
    "stairs": ("stairs_up", "stairs_down"),
    "narrow stairs": ("narrow_stairs_up", "narrow_stairs_down"),
    "obstacles": ("obstacles",),
    "slopes": ("slope_up", "slope_down"),
    "rough slopes": ("rough_slope_up", "rough_slope_down"),
}
"""Types that share a panel; every other type has one of its own."""
TRAINED: dict[str, Any] = {"color": "0.25", "ls": ":", "lw": 1.4, "zorder": 2}
"""The line where training ended."""
TRAINED_LABEL = "hardest of training"


def print_success(success: dict[str, Any]) -> None:
    """Print one line a point; sizes beyond those of training are marked."""
    rule = success["definition"]
    head = f"success: {rule['distance_m']:.3g} m from the start within {rule['time_s']:g} s, asked for {rule['vx']:.3g} m/s"
    table = Table(title=escape(head), title_justify="left")
    for name in ("terrain", "size", "success", "95 % interval", "fell", "stuck", "time to success"):
        table.add_column(name, justify="left" if name == "terrain" else "right")
    beyond = False
    for name, entry in success["types"].items():
        for i, point in enumerate(entry["points"]):
            mark = is_beyond(name, point["size"], entry["trained_to"])
            beyond |= mark
            time_s = point["mean_time_s"]
            table.add_row(
                escape(name) if i == 0 else "",
                f"{point['size']:.3g} {entry['unit']}{' *' if mark else '  '}",
                f"{point['successes']}/{point['robots']} = {100 * point['share']:.0f} %",
                f"{100 * point['low']:.0f} to {100 * point['high']:.0f} %",
                str(point["fell"]),
                str(point["stuck"]),
                "" if time_s is None else f"{time_s:.1f} s",
            )
        table.add_section()
    Console(width=110).print(table)
    if beyond:
        print("* harder than in training")


def is_beyond(name: str, size: float, trained_to: float | None) -> bool:
    """Say whether a size is harder than the hardest of training; never where the type was not trained on."""
    if trained_to is None:
        return False
    kind = TERRAIN_TYPES[name]
    grows = kind.size(1.0) >= kind.size(0.0)  # stepping stones get smaller
    return size > trained_to + 1e-9 if grows else size < trained_to - 1e-9


def with_other_engines(result: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    """Return `result`, and those of other engines that lie beside `path` (evaluation_<physics>.json), are of the same
    checkpoint and were measured with the same fields changed.
    """
    found = [result]
    for engine in ENGINES:
        other = path.with_name(file_name(engine))
        if engine == result["physics"] or not other.is_file():
            continue
        try:
            saved = json.loads(other.read_text(encoding="utf-8"))
            check_success(saved, str(other))
            points = [point for entry in saved["success"]["types"].values() for point in entry["points"]]
            drawable = "robots_per_point" in saved["success"] and all({"low", "high"} <= point.keys() for point in points)
            same = all(saved.get(key) == result.get(key) for key in ("task", "checkpoint", "changes"))
            if drawable and saved["physics"] == engine and same:
                found.append(saved)
        except (OSError, ValueError, KeyError):  # not a file of ours: nothing to show
            continue
    return sorted(found, key=lambda one: list(ENGINES).index(one["physics"]))


def draw_success(results: list[dict[str, Any]], path: Path) -> None:
    """Draw success over size with its intervals: a panel a kind of terrain, a colour a type, a line style an engine. A dotted
    line is where training ended.
    """
    panels = panels_of([name for result in results for name in result["success"]["types"]])
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    with figure(path, (4.8 * columns + 0.2, 2.9 * rows + 1.0), rows, columns, share_y=True) as (drawn, axes):
        from matplotlib.lines import Line2D

        for axis in axes.flat[len(panels) :]:
            axis.set_visible(False)
        for axis, (title, names) in zip(axes.flat, panels.items(), strict=False):
            axis.set_title(title if len(names) > 1 else names[0].replace("_", " "))
            _draw_panel(axis, results, names)
        for axis in axes[:, 0]:
            axis.set_ylabel("success")
        keys = []
        for result in results:
            engine = ENGINES[result["physics"]]
            text = f"{engine.label}, {result['success']['robots_per_point']} robots a point"
            keys.append(Line2D([], [], color="0.3", ls=engine.line, marker=engine.marker, ms=4, label=text))
        if any(entry["trained_to"] is not None for result in results for entry in result["success"]["types"].values()):
            keys.append(Line2D([], [], **TRAINED, label=TRAINED_LABEL))
        drawn.legend(handles=keys, loc="outside lower center", ncols=len(keys) if columns > 1 else 1, frameon=False)
        rule = results[0]["success"]["definition"]
        text = (
            f"{results[0]['task']}: robots that get {rule['distance_m']:.3g} m from their start within {rule['time_s']:g} s"
        )
        size = "medium" if columns == 1 else "large"
        drawn.suptitle(text if columns > 1 else text.replace(": ", "\n"), fontsize=size)


def as_success(axis: Any, entry: dict[str, Any]) -> None:
    """Label the axes of a panel of success over the size of a terrain type, and scale success from 0 to 100 %."""
    from matplotlib.ticker import PercentFormatter

    axis.set_xlabel(f"{entry['what']} [{entry['unit']}]")
    axis.set_ylim(0.0, 1.04)
    axis.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


def _draw_panel(axis: Any, results: list[dict[str, Any]], names: tuple[str, ...]) -> None:
    """Draw the curves of some types, of all engines."""
    from matplotlib.patches import Patch
    from matplotlib.ticker import MultipleLocator

    for color, name in zip(COLORS, names, strict=False):
        for result in results:
            entry = result["success"]["types"].get(name)
            if entry is None:
                continue
            engine = ENGINES[result["physics"]]
            size, share, low, high = ([point[key] for point in entry["points"]] for key in ("size", "share", "low", "high"))
            axis.plot(size, share, engine.line, marker=engine.marker, ms=4, color=color, clip_on=False, zorder=3)
            if len(size) > 1:
                axis.fill_between(size, low, high, color=color, alpha=0.12, lw=0)
            else:  # a band has no width there
                axis.vlines(size, low, high, color=color, lw=1.0)
            as_success(axis, entry)
            if entry["unit"] == "degrees":
                axis.xaxis.set_major_locator(MultipleLocator(5))
            if entry["trained_to"] is not None:
                axis.axvline(entry["trained_to"], **TRAINED)
    if len(names) > 1:
        patches = [Patch(color=color, label=name.replace("_", " ")) for color, name in zip(COLORS, names, strict=False)]
        axis.legend(handles=patches, loc="best", frameon=False, handlelength=1.0)


def panels_of(names: list[str]) -> dict[str, tuple[str, ...]]:
    """Return title -> the types of a panel, of those that were measured."""
    there = dict.fromkeys(names)
    shared = {title: tuple(name for name in types if name in there) for title, types in PANELS.items()}
    panels = {title: types for title, types in shared.items() if types}
    grouped = {name for types in panels.values() for name in types}
    return panels | {name.replace("_", " "): (name,) for name in there if name not in grouped}
