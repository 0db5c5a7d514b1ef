"""Joint statistics of one policy or of two: tables, a page and a figure."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legged.episodes.joint_statistics import MEASURED, PHASES, SETTLE_S, JointStatistics
from legged.evaluation.reports.document import Cell, Heading, Number, Paragraph, Part, Picture, Table, write_pages
from legged.figures import COLORS, STYLES, figure
from legged.process.paths import relative

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME = "joint_statistics"
"""Name of the files, before their endings."""
PANEL_INCHES = 3.6, 1.45
"""Width and height of a panel of the figure."""
Found = Mapping[str, JointStatistics]
"""Statistics of policies by their labels."""


def write_statistics(folder: Path, found: Found, title: str) -> list[Path]:
    """Write the statistics of policies into `folder`, as Markdown, HTML and PNG; return the paths.

    Raises:
        RunError: a file can't be written.
    """
    text, page, picture = (folder / f"{NAME}{ending}" for ending in (".md", ".html", ".png"))
    draw_statistics(found, picture)
    parts: list[Part] = [Paragraph(notes_of(found))]
    for heading, table in tables_of(found).items():
        parts += [Heading(heading), table]
    write_pages(folder / NAME, title, [*parts, Heading("Figure"), Picture(picture, "joint statistics")])
    for path in (text, page, picture):
        print(f"written: {relative(path)}")
    return [text, page, picture]


def tables_of(found: Found) -> dict[str, Table]:
    """Return title -> table, one table for each quantity, with one line for each joint: mean and standard deviation of each
    policy, and for two policies the difference of their means. The last table is on gait cycles, if there are any.
    """
    several, tables = list(found.values()), {}
    for name, title in _measured(found):
        heads = ["joint", *(f"{what}{_of(label, found)}" for label in found for what in ("mean", "standard deviation"))]
        columns = [values for one in several for values in (one.mean[name], one.std[name])]
        rows: list[list[Cell]] = [
            [joint, *(_number(column[i]) for column in columns)] for i, joint in enumerate(several[0].joints)
        ]
        if len(several) == 2:
            heads.append("difference of the means")
            moved = several[1].mean[name] - several[0].mean[name]
            rows = [[*row, _number(moved[i], "+.3f")] for i, row in enumerate(rows)]
        tables[f"{title} [{_unit(found, name)}]"] = Table(heads, rows)
    if any(len(one.cycle_s) for one in several):
        lines = {"cycles": [_number(len(one.cycle_s), ".0f") for one in several]}
        for label, of in (("mean", np.mean), ("standard deviation", np.std)):
            lines[f"length, {label} [s]"] = [_number(of(one.cycle_s) if len(one.cycle_s) else None) for one in several]
        for foot in dict.fromkeys(foot for one in several for foot in one.duty):
            lines[f"{foot} in contact [%]"] = [
                _number(100.0 * one.duty[foot] if foot in one.duty else None, ".0f") for one in several
            ]
        tables["gait cycle"] = Table(["measure", *found], [[label, *cells] for label, cells in lines.items()])
    return tables


def _measured(found: Found) -> list[tuple[str, str]]:
    """Return name and title of the quantities that all policies have."""
    return [(name, title) for name, title in MEASURED if all(name in one.mean for one in found.values())]


def _unit(found: Found, name: str) -> str:
    return " or ".join(dict.fromkeys(next(iter(found.values())).units[name]))


def _number(value: Any, form: str = ".3f") -> Number:
    return Number("none", None) if value is None else Number(f"{value:{form}}", float(value))


def _of(label: str, found: Found) -> str:
    return f", {label}" if len(found) > 1 else ""


def notes_of(found: Found) -> str:
    """Return sentences on the episodes and steps behind the statistics."""
    parts = []
    for label, one in found.items():
        lost = f"; {one.lost} more are left out because physics blew up in them" if one.lost else ""
        parts.append(f"{label}: {one.episodes} episodes, {one.steps} control steps{lost}.")
    parts.append(f"The first {SETTLE_S:g} s of an episode are left out. Standard deviations are those of single steps.")
    feet = {one.foot for one in found.values() if len(one.cycle_s)}
    if feet:
        parts.append(f"A gait cycle goes from one touch-down of {' or '.join(sorted(feet))} to its next.")
    return " ".join(parts)


def draw_statistics(found: Found, path: Path) -> None:
    """Draw every joint over the gait cycle, as mean and a band of one standard deviation; without cycles, mean and standard
    deviation of all joints side by side. Each policy has its own colour and line style.
    """
    draw = _draw_cycles if all(len(one.cycle_s) for one in found.values()) else _draw_means
    names, joints = _measured(found), next(iter(found.values())).joints
    width, height = PANEL_INCHES
    rows, tall = (len(joints), height * len(joints) + 0.9) if draw is _draw_cycles else (1, 0.34 * len(joints) + 1.6)
    with figure(path, (width * len(names) + 0.6, tall), rows, len(names)) as (drawn, axes):
        for column, (name, title) in enumerate(names):
            draw(axes[:, column], found, name, column == 0)
            axes[0, column].set_title(title, fontsize="medium")
        if len(found) > 1:
            _legend(drawn, list(found))


def _draw_cycles(axes: np.ndarray, found: Found, name: str, labelled: bool) -> None:
    """Draw one quantity over the gait cycle, one panel for each joint."""
    first, phase = next(iter(found.values())), 100.0 * np.arange(PHASES) / PHASES
    for k, one in enumerate(found.values()):
        mean, std = one.over_cycle(name)
        for i, axis in enumerate(axes):
            axis.plot(phase, mean[:, i], STYLES[k], color=COLORS[k], lw=1.4)
            axis.fill_between(phase, mean[:, i] - std[:, i], mean[:, i] + std[:, i], color=COLORS[k], alpha=0.2, lw=0)
    for i, axis in enumerate(axes):
        axis.set_xlim(0, 100)
        axis.tick_params(labelsize="small", labelbottom=i == len(axes) - 1)
        axis.set_ylabel(f"{first.joints[i]}\n" * labelled + f"[{first.units[name][i]}]", fontsize="small")
    axes[-1].set_xlabel("gait cycle [%]", fontsize="small")


def _draw_means(axes: np.ndarray, found: Found, name: str, labelled: bool) -> None:
    """Draw mean and standard deviation of one quantity, one line for each joint."""
    (axis,), joints = axes, next(iter(found.values())).joints
    at = np.arange(len(joints))
    for k, one in enumerate(found.values()):
        shift = 0.22 * (k - 0.5 * (len(found) - 1))
        axis.errorbar(one.mean[name], at + shift, xerr=one.std[name], fmt="os"[k], color=COLORS[k], ms=4, capsize=2)
    axis.set_yticks(at, joints if labelled else [""] * len(at), fontsize="small")
    axis.invert_yaxis()
    axis.set_xlabel(f"mean and standard deviation [{_unit(found, name)}]", fontsize="small")


def _legend(drawn: "Figure", labels: list[str]) -> None:
    from matplotlib.lines import Line2D

    keys = [Line2D([], [], color=COLORS[k], ls=STYLES[k], label=label) for k, label in enumerate(labels)]
    drawn.legend(handles=keys, loc="outside lower center", ncols=2, frameon=False)
