"""Joint statistics of one policy or several: tables for the screen, Markdown and HTML, and a figure."""

import base64
import html
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.markup import escape
from rich.table import Table

from legged.episodes.joint_statistics import MEASURED, PHASES, SETTLE_S, JointStatistics
from legged.episodes.ranking import markdown_table
from legged.figures import COLORS, STYLES, figure
from legged.process.paths import relative, write_text

NAME = "joint_statistics"
"""What the files are called, before their endings."""
PANEL_INCHES = 3.6, 1.45
"""Width and height of a panel of the figure."""
STYLE = """body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1100px; margin: 0 auto; padding: 12px 16px; }
h1 { font-size: 21px; } h2 { font-size: 17px; } img { max-width: 100%; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: 14px; }
th, td { border-bottom: 1px solid #d8d8d8; padding: 3px 10px 3px 0; text-align: right; font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; }"""


@dataclass(frozen=True)
class Rows:
    """A table, whatever it is written in."""

    title: str
    heads: list[str]
    rows: list[list[str]]


def write_statistics(folder: Path, found: Mapping[str, JointStatistics], title: str) -> list[Path]:
    """Write the statistics of each policy by its label into `folder`, as Markdown, HTML and PNG; return the paths.

    Raises:
        RunError: a file can't be written.
    """
    tables, notes = tables_of(found), notes_of(found)
    picture, page, text = (folder / f"{NAME}{ending}" for ending in (".png", ".html", ".md"))
    draw_statistics(found, picture)
    parts = [f"# {title}\n\n{notes}\n", f"![joint statistics]({picture.name})\n"]
    parts += [f"## {table.title}\n\n{markdown_table(table.heads, table.rows)}" for table in tables]
    write_text(text, "\n".join(parts))
    write_text(page, _page(title, notes, tables, picture))
    for path in (text, page, picture):
        print(f"written: {relative(path)}")
    return [text, page, picture]


def tables_of(found: Mapping[str, JointStatistics]) -> list[Rows]:
    """Return a table a quantity: a line a joint, mean and standard deviation of each policy, and with two of them the
    difference of the means, the second less the first; last, one about gait cycles, where there are any.
    """
    several = list(found.values())
    first = several[0]
    tables = []
    for name, title in MEASURED:
        if not all(name in one.mean for one in several):
            continue
        unit = " or ".join(dict.fromkeys(first.units[name]))
        heads = ["joint", *(f"{what}{_of(label, found)}" for label in found for what in ("mean", "standard deviation"))]
        rows = [
            [joint, *(f"{values[i]:.3f}" for one in several for values in (one.mean[name], one.std[name]))]
            for i, joint in enumerate(first.joints)
        ]
        if len(several) == 2:
            heads.append("difference of the means")
            difference = several[1].mean[name] - several[0].mean[name]
            rows = [[*row, f"{difference[i]:+.3f}"] for i, row in enumerate(rows)]
        tables.append(Rows(f"{title} [{unit}]", heads, rows))
    if any(len(one.cycle_s) for one in several):
        tables.append(_cycles_table(found))
    return tables


def _cycles_table(found: Mapping[str, JointStatistics]) -> Rows:
    several = list(found.values())
    rows = [
        ["cycles", *(str(len(one.cycle_s)) for one in several)],
        ["length, mean [s]", *(f"{one.cycle_s.mean():.3f}" if len(one.cycle_s) else "none" for one in several)],
        ["length, standard deviation [s]", *(f"{one.cycle_s.std():.3f}" if len(one.cycle_s) else "none" for one in several)],
    ]
    for foot in dict.fromkeys(foot for one in several for foot in one.duty):
        shares = (f"{100.0 * one.duty[foot]:.0f}" if foot in one.duty else "none" for one in several)
        rows.append([f"{foot} in contact [%]", *shares])
    return Rows("gait cycle", ["measure", *found], rows)


def _of(label: str, found: Mapping[str, JointStatistics]) -> str:
    return f", {label}" if len(found) > 1 else ""


def notes_of(found: Mapping[str, JointStatistics]) -> str:
    """Say of what the statistics are."""
    parts = []
    for label, one in found.items():
        lost = f"; {one.lost} more are left out, in which physics blew up" if one.lost else ""
        parts.append(f"{label}: {one.episodes} episodes, {one.steps} control steps{lost}.")
    parts.append(
        f"All steps after the first {SETTLE_S:g} s of an episode count alike; standard deviations are those of the steps."
    )
    feet = {one.foot for one in found.values() if len(one.cycle_s)}
    if feet:
        parts.append(f"A gait cycle goes from one touch-down of {' or '.join(sorted(feet))} to its next.")
    return " ".join(parts)


def screen_table(table: Rows) -> Table:
    """Return a table for the screen."""
    made = Table(title=escape(table.title), title_justify="left")
    for i, head in enumerate(table.heads):
        made.add_column(escape(head.replace(", ", ",\n")), justify="left" if i == 0 else "right")
    for row in table.rows:
        made.add_row(*(escape(cell) for cell in row))
    return made


def _page(title: str, notes: str, tables: list[Rows], picture: Path) -> str:
    """Return the page: the tables, and the figure within it."""
    parts = []
    for table in tables:
        heads = "".join(f"<th>{html.escape(head)}</th>" for head in table.heads)
        rows = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>\n" for row in table.rows)
        parts.append(
            f'<h2>{html.escape(table.title)}</h2>\n<div class="scroll"><table><tr>{heads}</tr>\n{rows}</table></div>\n'
        )
    image = base64.b64encode(picture.read_bytes()).decode("ascii")
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">\n'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head>\n<body><h1>{html.escape(title)}</h1>\n"
        f"<p>{html.escape(notes)}</p>\n{''.join(parts)}"
        f'<h2>Figure</h2><img alt="mean and standard deviation of every joint" src="data:image/png;base64,{image}">\n'
        "</body></html>\n"
    )


def draw_statistics(found: Mapping[str, JointStatistics], path: Path) -> None:
    """Draw every joint over the gait cycle, mean and a band of one standard deviation; without cycles, mean and standard
    deviation of all joints side by side. A colour and a line style a policy.
    """
    several = list(found.values())
    names = [(name, title) for name, title in MEASURED if all(name in one.mean for one in several)]
    if all(len(one.cycle_s) for one in several):
        _draw_cycles(found, names, path)
    else:
        _draw_means(found, names, path)


def _draw_cycles(found: Mapping[str, JointStatistics], names: list[tuple[str, str]], path: Path) -> None:
    joints, first = next(iter(found.values())).joints, next(iter(found.values()))
    width, height = PANEL_INCHES
    phase = 100.0 * np.arange(PHASES) / PHASES
    with figure(path, (width * len(names), height * len(joints) + 0.9), len(joints), len(names)) as (drawn, axes):
        for column, (name, title) in enumerate(names):
            for k, one in enumerate(found.values()):
                mean, std = one.over_cycle(name)
                for i in range(len(joints)):
                    axis = axes[i, column]
                    color = COLORS[k % len(COLORS)]
                    axis.plot(phase, mean[:, i], STYLES[k % len(STYLES)], color=color, lw=1.4)
                    axis.fill_between(phase, mean[:, i] - std[:, i], mean[:, i] + std[:, i], color=color, alpha=0.2, lw=0)
            for i, joint in enumerate(joints):
                axis = axes[i, column]
                axis.set_xlim(0, 100)
                axis.tick_params(labelsize="small", labelbottom=i == len(joints) - 1)
                axis.set_ylabel(f"{joint}\n[{first.units[name][i]}]" if column == 0 else f"[{first.units[name][i]}]")
                axis.yaxis.label.set_fontsize("small")
            axes[0, column].set_title(title, fontsize="medium")
            axes[-1, column].set_xlabel("gait cycle [%]", fontsize="small")
        _legend(drawn, found)


def _draw_means(found: Mapping[str, JointStatistics], names: list[tuple[str, str]], path: Path) -> None:
    first = next(iter(found.values()))
    at = np.arange(len(first.joints))
    width = PANEL_INCHES[0]
    with figure(path, (width * len(names) + 0.6, 0.34 * len(at) + 1.6), 1, len(names)) as (drawn, axes):
        for column, (name, title) in enumerate(names):
            axis = axes[0, column]
            for k, one in enumerate(found.values()):
                shift = 0.22 * (k - 0.5 * (len(found) - 1))
                style = {"fmt": "os^D"[k % 4], "color": COLORS[k % len(COLORS)], "ms": 4, "capsize": 2}
                axis.errorbar(one.mean[name], at + shift, xerr=one.std[name], **style)
            axis.set_yticks(at, first.joints if column == 0 else [""] * len(at), fontsize="small")
            axis.invert_yaxis()
            axis.set_title(title, fontsize="medium")
            axis.set_xlabel(
                f"mean and standard deviation [{' or '.join(dict.fromkeys(first.units[name]))}]", fontsize="small"
            )
        _legend(drawn, found)


def _legend(drawn: "object", found: Mapping[str, JointStatistics]) -> None:
    from matplotlib.lines import Line2D

    if len(found) > 1:
        keys = [
            Line2D([], [], color=COLORS[k % len(COLORS)], ls=STYLES[k % len(STYLES)], label=label)
            for k, label in enumerate(found)
        ]
        drawn.legend(handles=keys, loc="outside lower center", ncols=2, frameon=False)  # type: ignore[attr-defined]
