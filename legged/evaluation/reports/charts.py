"""Charts of reports: lines with bands, stacked areas and heat maps as SVG, and several charts in one PNG.

Each SVG can be saved as a file or inserted into a page. Colours are those of M. Okabe and K. Ito (Color Universal Design,
2008), which people with any colour vision can distinguish. Lines also differ in their dashes.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from legged.evaluation.reports import render
from legged.figures import COLORS, STYLES, figure

DASHES = ("", "7 3", "2 2", "9 3 2 3", "5 2", "14 3 2 3 2 3", "12 3", "3 3")
WIDTH, HEIGHT = 480.0, 250.0
"""Size of a drawing without its legend [SVG units, which are pixels on a wide screen]."""
LEFT, RIGHT, TOP, BOTTOM = 58.0, 14.0, 30.0, 42.0
"""Margins around the axes [SVG units]."""
MOST_POINTS = 240
"""Largest number of points of a line. In longer lines neighbours are averaged, because a chart is about 400 pixels wide."""
LETTER = 6.3
"""Mean width of a letter of the legend [SVG units]."""
INK, QUIET, GRID, REST = "#1b1f24", "#57606a", "#e1e5e9", "#9aa4ae"
SHADES = np.array([[244.0, 248, 252], [86.0, 160, 211], [8.0, 48, 107]])
"""Colours (red, green, blue) of a heat map at 0, 0.5 and 1; they differ in lightness."""


@dataclass(frozen=True)
class Line:
    """A curve: x and y (n,); `band` is the lower and the upper edge (n,) of an area around it."""

    name: str
    """Name in the legend. A line without a name is not in the legend. The page's script shows the chart's title for it."""
    x: np.ndarray
    y: np.ndarray
    band: tuple[np.ndarray, np.ndarray] | None = None
    markers: bool = False
    style: int = -1
    """Index into colours and dashes; by default the line's place in the chart."""


@dataclass(frozen=True)
class Chart:
    """Lines over one x axis, and the labels and scales of the axes."""

    title: str
    """Quantity on the y axis, with its unit."""
    x_label: str
    lines: Sequence[Line] = ()
    unit: str = "iteration"
    """Name of the quantity on the x axis. The page's script shows this name next to a value of x."""
    log: bool = False
    percent: bool = False
    """True: y is a share, and its axis ends at 100 %."""
    level: tuple[str, float] | None = None
    """Name and y of a dotted horizontal line."""
    walls: tuple[tuple[str, float], ...] = ()
    """Names and x of dotted vertical lines."""

    def cleaned(self) -> "Chart":
        """Return the chart without values that can't be drawn: those that are not finite or, on a log axis, not positive.
        Each line gets a style, and lines without markers are reduced to MOST_POINTS points.
        """
        lines = []
        for i, line in enumerate(self.lines):
            good = np.isfinite(line.x) & np.isfinite(line.y) & ((line.y > 0.0) | (not self.log))
            parts = [line.x[good], line.y[good], *(part[good] for part in line.band or ())]
            x, y, *band = _thinned(*parts) if not line.markers else parts
            style, markers = i if line.style < 0 else line.style, line.markers or len(x) == 1
            lines.append(Line(line.name, x, y, (band[0], band[1]) if band else None, markers, style % len(COLORS)))
        return replace(self, lines=lines)


# ---- PNG -------------------------------------------------------------------------------------------------------------


def draw_charts(charts: Sequence[Chart], path: Path, title: str = "", iteration_s: float | None = None) -> None:
    """Draw charts as panels of one PNG file, two in a row. With `iteration_s`, the time of an iteration [s], panels have a
    second x axis in seconds.

    Raises:
        RunError: the file can't be written.
    """
    columns = min(2, len(charts))
    rows = -(-len(charts) // columns)
    with figure(path, (5.0 * columns, 3.0 * rows + 0.3), rows, columns) as (drawn, axes):
        for axis in axes.flat[len(charts) :]:
            axis.set_visible(False)
        before: list[str] = []
        for axis, chart in zip(axes.flat, charts, strict=False):
            draw_panel(axis, chart)
            names = axis.get_legend_handles_labels()[1]
            if names and names != before:  # a panel with the same lines as the panel before needs no legend
                axis.legend(fontsize="small", frameon=False)
            before = names
            if iteration_s is not None:
                both = (lambda x: x * iteration_s, lambda x: x / iteration_s)
                axis.secondary_xaxis("top", functions=both).set_xlabel("training loop [s]", fontsize="small")
        if title:
            drawn.suptitle(title)


def draw_panel(axis: Any, chart: Chart) -> None:
    """Draw a chart into the matplotlib axes `axis`."""
    from matplotlib.ticker import PercentFormatter

    chart = chart.cleaned()
    for line in chart.lines:
        look = {"color": COLORS[line.style], "linestyle": STYLES[line.style % len(STYLES)], "linewidth": 1.5}
        look |= {"marker": "o", "markersize": 3} if line.markers else {}
        axis.plot(line.x, line.y, label=line.name or None, **look)
        if line.band is not None and len(line.x) > 1:
            axis.fill_between(line.x, *line.band, color=look["color"], alpha=0.15, linewidth=0)
        elif line.band is not None:  # a single point has no area, so the band is a vertical line
            axis.vlines(line.x, *line.band, color=look["color"], linewidth=1.0)
    dotted: dict[str, Any] = {"color": "0.25", "linestyle": ":", "linewidth": 1.4}
    if chart.level is not None:
        axis.axhline(chart.level[1], label=chart.level[0], **dotted)
    for name, x in chart.walls:
        axis.axvline(x, label=name, **dotted)
    axis.set_title(chart.title, fontsize="medium")
    axis.set_xlabel(chart.x_label)
    axis.set_yscale("log" if chart.log else "linear")
    if chart.percent:
        axis.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    if not chart.log:
        low, high = _y_range(chart)
        axis.set_ylim(low, 1.04 * high if chart.percent else high)  # leave room for markers at 100 %
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


# ---- SVG -------------------------------------------------------------------------------------------------------------


def curves(chart: Chart) -> str:
    """Return the drawing (SVG) of a chart's lines."""
    chart = chart.cleaned()
    xs = np.concatenate([*(line.x for line in chart.lines), [x for _, x in chart.walls]])
    ends = (float(xs.min()), float(xs.max())) if len(xs) else (0.0, 1.0)
    frame = _Frame(chart, ends, _y_range(chart), [line.name for line in chart.lines if line.name])
    for line in chart.lines:
        if len(line.x):
            color, dash = COLORS[line.style], DASHES[line.style]
            if line.band is not None:
                frame.area(line.x, *line.band, color, 0.18)
            frame.line(line, color, dash)
            if line.name:
                frame.key(line.name, color, dash)
    return frame.svg()


def stacked(chart: Chart, x: np.ndarray, parts: dict[str, np.ndarray]) -> str:
    """Return an SVG of `parts` (n,) over x (n,) as areas, with a line for their sum. Negative values stack downwards."""
    x, *values = _thinned(x, *parts.values())
    ups, downs = (np.cumsum([np.zeros(len(x)), *(of(v, 0.0) for v in values)], axis=0) for of in (np.maximum, np.minimum))
    sums = replace(chart, lines=[Line("", x, edge) for edge in (ups[-1], downs[-1])])
    frame = _Frame(chart, (float(x[0]), float(x[-1])), _y_range(sums), [*parts, "sum"])
    for i, (name, value) in enumerate(zip(parts, values, strict=True)):
        color = COLORS[i] if i < len(COLORS) - 1 else REST
        for edges in (ups, downs):
            if np.abs(edges[i + 1] - edges[i]).max() > 0.0:
                frame.area(x, edges[i], edges[i + 1], color, 0.75, edged=True)
        frame.marks.append({"kind": "data", **frame.data(Line(name, x, value), color)})
        frame.key(name, color, area=True)
    frame.line(Line("sum", x, ups[-1] + downs[-1]), INK, "4 2")
    frame.key("sum", INK, "4 2")
    return frame.svg()


def heat_map(title: str, x_label: str, y_label: str, x: Sequence[float], y: Sequence[float], values: np.ndarray) -> str:
    """Return an SVG of values (len(x), len(y)) as cells with numbers, shaded from white (0) to blue (the largest value)."""
    frame = _Frame(Chart(title, x_label), (0.0, float(len(x))), (0.0, float(len(y))), [])
    largest = float(np.nanmax(values)) if np.isfinite(values).any() else 1.0
    width, height = np.diff(frame.px([0.0, 1.0]))[0], -np.diff(frame.py([0.0, 1.0]))[0]
    size = max(7.0, min(12.0, width / 3.2, height * 0.8))
    lefts, tops = frame.px(np.arange(len(x))), frame.py(np.arange(len(y)) + 1.0)
    cells = []
    for (i, j), value in np.ndenumerate(values):
        share = float(value) / largest if np.isfinite(value) and largest else 0.0
        look = {"fill": shade(share), "ink": "#fff" if share > 0.55 else INK, "size": size}
        text = f"{value:.2f}" if np.isfinite(value) else "-"
        cells.append({"x": lefts[i], "y": tops[j], "width": width, "height": height, "text": text, **look})
    names = {"x_ticks": zip(lefts + width / 2, map("{:g}".format, x), strict=True), "y_label": y_label}
    return frame.svg(cells=cells, y_ticks=zip(tops + height / 2, map("{:g}".format, y), strict=True), **names)


def shade(share: float) -> str:
    """Return the colour of a share from 0 (nearly white) to 1 (dark blue)."""
    return "#" + "".join(f"{round(float(np.interp(share, (0.0, 0.5, 1.0), part))):02x}" for part in SHADES.T)


def sheet(drawings: Sequence[str], columns: int = 2) -> str:
    """Return one SVG with all drawings, `columns` of them in a row."""
    sizes = [tuple(map(float, re.findall(r'viewBox="0 0 (\S+) (\S+)"', one)[0])) for one in drawings]
    top, body = 0.0, []
    for start in range(0, len(drawings), columns):
        row = range(start, min(start + columns, len(drawings)))
        for column, i in enumerate(row):
            place = f'<svg x="{column * (WIDTH + 12):g}" y="{top:g}" width="{sizes[i][0]:g}" height="{sizes[i][1]:g}"'
            body.append(drawings[i].replace("<svg", place, 1))
        top += max(sizes[i][1] for i in row) + 12.0
    wide = min(columns, len(drawings)) * (WIDTH + 12.0) - 12.0
    size = f'width="{wide:g}" height="{top:g}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} viewBox="0 0 {wide:g} {top:g}"><rect {size} fill="#fff"/>'
    return f"{head}{''.join(body)}</svg>\n"


class _Frame:
    """A drawing under construction: axes, title, legend and marks."""

    def __init__(self, chart: Chart, x: tuple[float, float], y: tuple[float, float], names: Sequence[str]) -> None:
        self.chart, self.y = chart, y
        self.x = x if x[1] > x[0] else (x[0] - 0.5, x[0] + 0.5)
        self.marks: list[dict[str, Any]] = []
        self._keys: list[dict[str, Any]] = []
        self._places: list[dict[str, float]] = []
        left, row = LEFT, 0
        for name in names:  # start a new row of the legend if the name does not fit into the last row
            width = 28.0 + LETTER * len(name)
            left, row = (LEFT, row + 1) if left + width > WIDTH - 2.0 and left > LEFT else (left, row)
            self._places.append({"x": left, "y": TOP + 6.0 + 16.0 * row})
            left += width + 8.0
        self.top, self.right = TOP + (16.0 * (row + 1) + 6.0 if names else 0.0), WIDTH - RIGHT
        self.height = HEIGHT + self.top - TOP
        self.floor = self.height - BOTTOM
        self.box = f"{LEFT:g} {self.right:g} {self.x[0]:.8g} {self.x[1]:.8g}"

    def px(self, x: ArrayLike) -> np.ndarray:
        """Return the horizontal positions (n,) [SVG units] of values of x (n,)."""
        return LEFT + (np.asarray(x) - self.x[0]) / (self.x[1] - self.x[0]) * (self.right - LEFT)

    def py(self, y: ArrayLike) -> np.ndarray:
        """Return the vertical positions (n,) [SVG units] of values of y (n,)."""
        low, high, values = *self.y, np.asarray(y)
        if self.chart.log:
            low, high, values = math.log10(low), math.log10(high), np.log10(np.maximum(values, 1e-300))
        return self.floor - np.clip((values - low) / (high - low), -0.02, 1.02) * (self.floor - self.top)

    def _points(self, x: np.ndarray, y: np.ndarray) -> str:
        return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(self.px(x), self.py(y), strict=True))

    def area(self, x: np.ndarray, low: np.ndarray, high: np.ndarray, color: str, opacity: float, edged: bool = False) -> None:
        points = f"{self._points(x, low)} {self._points(x[::-1], high[::-1])}"
        self.marks.append({"kind": "area", "points": points, "color": color, "opacity": opacity, "edged": edged})

    def line(self, line: Line, color: str, dash: str) -> None:
        dots = zip(self.px(line.x), self.py(line.y), strict=True) if line.markers else ()
        look = {"points": self._points(line.x, line.y), "dash": dash, "dots": dots}
        self.marks.append({"kind": "line", **look, **self.data(line, color)})

    def data(self, line: Line, color: str) -> dict[str, str]:
        """Return the attributes that the page's script reads from a line: its name, colour and x, and its value at each x."""
        values, unit = (100.0 * line.y, "\u00a0%") if self.chart.percent else (line.y, "")
        x, v = " ".join(f"{value:.6g}" for value in line.x), " ".join(f"{value:.4g}{unit}" for value in values)
        return {"name": line.name or self.chart.title, "color": color, "x": x, "v": v}

    def key(self, name: str, color: str, dash: str = "", area: bool = False) -> None:
        """Add a name to the legend, with a piece of its line, or with a coloured square for an area."""
        self._keys.append({**self._places[len(self._keys)], "name": name, "color": color, "dash": dash, "area": area})

    def svg(self, **parts: Any) -> str:
        """Return the whole drawing. For a heat map, `parts` holds the cells and the labels that replace the ticks."""
        chart = self.chart
        if "cells" not in parts:
            found = _log_ticks(*self.y) if chart.log else ticks(*self.y, 5)
            texts = [f"{100 * value:g} %" if chart.percent else short(value) for value in found]
            parts["y_ticks"] = zip(self.py(found), texts, strict=True)
            across = ticks(*self.x, 6)
            parts["x_ticks"] = zip(self.px(across), map(short, across), strict=True)
        level = None if chart.level is None else self.py(chart.level[1])
        walls = [(name, self.px(x)) for name, x in chart.walls]
        look = {"LEFT": LEFT, "RIGHT": RIGHT, "INK": INK, "QUIET": QUIET, "GRID": GRID}
        return render(
            "chart.svg", frame=self, chart=chart, marks=self.marks, keys=self._keys, level=level, walls=walls, **look, **parts
        )


def _thinned(*columns: np.ndarray) -> list[np.ndarray]:
    """Return the columns (n,) with at most MOST_POINTS values: means of neighbours, and the first and the last value."""
    count = len(columns[0])
    if count <= MOST_POINTS:
        return [np.asarray(column, dtype=float) for column in columns]
    groups = np.array_split(np.arange(1, count - 1), MOST_POINTS - 2)
    return [np.array([column[0], *(column[group].mean() for group in groups), column[-1]]) for column in columns]


def _y_range(chart: Chart) -> tuple[float, float]:
    level = [] if chart.level is None else [[chart.level[1]]]
    values = np.concatenate([*level, [], *(part for line in chart.lines for part in (line.y, *(line.band or ())))])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    if chart.log:
        return (low / 1.2, high * 1.2) if low > 0.0 else (0.1, 1.0)
    low = min(low, 0.0)
    if chart.percent:
        return low, 1.0
    if high <= low:
        return low - 0.5 * (low < 0.0), low + 1.0
    return low - 0.04 * (high - low) * (low < 0.0), high + 0.06 * (high - low)


def ticks(low: float, high: float, count: int) -> list[float]:
    """Return about `count` round numbers from `low` to `high`: multiples of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) + 0.0 for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    """Return the powers of ten from `low` to `high`. If there are few powers, their products with 2 and with 5 are added."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    factors = (1, 2, 5) if high / low < 200.0 else (1,)
    return [factor * 10.0**power for power in powers for factor in factors if low <= factor * 10.0**power <= high]


def short(value: float) -> str:
    """Return a short text for the number of a tick: 1500000 -> 1.5M."""
    for limit, unit, letter in ((1e9, 1e9, "G"), (1e6, 1e6, "M"), (1e4, 1e3, "k")):
        if abs(value) >= limit:
            return f"{value / unit:g}{letter}"
    return f"{value:g}"
