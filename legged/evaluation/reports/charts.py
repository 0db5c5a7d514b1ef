"""Charts of reports: lines with bands, stacked areas and heat maps as SVG, and several charts in one PNG.

Each SVG can be a file of its own, or part of a page without a change. Colours are those of M. Okabe and K. Ito (Color
Universal Design, 2008), which people with any colour vision can distinguish. Lines also differ in their dashes.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from legged.figures import COLORS, STYLES, figure

DASHES = ("", "7 3", "2 2", "9 3 2 3", "5 2", "14 3 2 3 2 3", "12 3", "3 3")
WIDTH, HEIGHT = 480.0, 250.0
"""Size of a drawing without its legend [SVG units, which are pixels on a wide screen]."""
LEFT, RIGHT, TOP, BOTTOM = 58.0, 14.0, 30.0, 42.0
"""Margins around the axes [SVG units]."""
FONT = 'font-family="system-ui, Segoe UI, Roboto, Arial, sans-serif"'
MOST_POINTS = 240
"""Largest number of points of a line; a longer line is averaged to as many. A drawing has hardly more pixels."""
LETTER = 6.3
"""Mean width of a letter of the legend [SVG units]."""
INK, QUIET, GRID, REST = "#1b1f24", "#57606a", "#e1e5e9", "#9aa4ae"
SHADES = np.array([[244.0, 248, 252], [86.0, 160, 211], [8.0, 48, 107]])
"""Colours (red, green, blue) of a heat map at 0, 0.5 and 1; they differ in lightness."""


@dataclass(frozen=True)
class Line:
    """A curve: x and y (n,); `band` is the lower and the upper edge (n,) of an area around it."""

    name: str
    """Name in the legend; a line without a name gets the chart's title."""
    x: np.ndarray
    y: np.ndarray
    band: tuple[np.ndarray, np.ndarray] | None = None
    markers: bool = False
    style: int | None = None
    """Index into colours and dashes; by default the line's place in the chart."""


@dataclass(frozen=True)
class Chart:
    """Lines over one x axis, and how their axes are labelled."""

    title: str
    """Quantity on the y axis, with its unit."""
    x_label: str
    lines: Sequence[Line] = ()
    unit: str = "iteration"
    """Name of a value of x."""
    low: float | None = 0.0
    """The y axis shows at least this value; None fits it to the lines."""
    high: float | None = None
    """Upper end of the y axis; None fits it to the lines."""
    log: bool = False
    percent: bool = False
    level: tuple[str, float] | None = None
    """Name and y of a dotted horizontal line."""
    walls: tuple[tuple[str, float], ...] = ()
    """Names and x of dotted vertical lines."""

    def cleaned(self) -> "Chart":
        """Return the chart without values that can't be drawn: those that are not finite, or not positive on a log axis."""
        return replace(self, lines=[_cleaned(line, self.log) for line in self.lines])


# ---- PNG -------------------------------------------------------------------------------------------------------------


def draw_charts(charts: Sequence[Chart], path: Path, title: str = "", iteration_s: float | None = None) -> None:
    """Draw charts as panels of one PNG file, two in a row. With `iteration_s`, the length of an iteration [s], panels have a
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
            draw_panel(axis, chart.cleaned())
            names = axis.get_legend_handles_labels()[1]
            if names and names != before:  # one legend for panels with the same lines
                axis.legend(fontsize="small", frameon=False)
            before = names
            if iteration_s is not None:
                both = (lambda x: x * iteration_s, lambda x: x / iteration_s)
                axis.secondary_xaxis("top", functions=both).set_xlabel("training loop [s]", fontsize="small")
        if title:
            drawn.suptitle(title)


def draw_panel(axis: Any, chart: Chart) -> None:
    """Draw a chart into axes of matplotlib."""
    from matplotlib.ticker import PercentFormatter

    for i, line in enumerate(chart.lines):
        style = i if line.style is None else line.style
        look = {"color": COLORS[style % len(COLORS)], "linestyle": STYLES[style % len(STYLES)], "linewidth": 1.5}
        if line.markers or len(line.x) == 1:
            look |= {"marker": "o", "markersize": 3}
        axis.plot(line.x, line.y, label=line.name or None, **look)
        if line.band is not None and len(line.x) > 1:
            axis.fill_between(line.x, *line.band, color=look["color"], alpha=0.15, linewidth=0)
        elif line.band is not None:  # the area of a single point has no width
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
        axis.set_ylim(low, 1.04 * high if chart.percent else high)  # markers at 100 % are not cut off
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


# ---- SVG -------------------------------------------------------------------------------------------------------------


def curves(chart: Chart) -> str:
    """Draw the lines of a chart."""
    chart = chart.cleaned()
    xs = np.concatenate([*(line.x for line in chart.lines), [x for _, x in chart.walls]])
    ends = (float(xs.min()), float(xs.max())) if len(xs) else (0.0, 1.0)
    frame = _Frame(chart, ends, _y_range(chart), [line.name for line in chart.lines if line.name])
    for i, line in enumerate(chart.lines):
        if not len(line.x):
            continue
        style = i if line.style is None else line.style
        color, dash = COLORS[style % len(COLORS)], DASHES[style % len(DASHES)]
        x, y = frame.px(line.x), frame.py(line.y)
        if line.band is not None:
            frame.area(x, frame.py(line.band[0]), frame.py(line.band[1]), color, "0.18")
        values = 100.0 * line.y if chart.percent else line.y
        frame.line(x, y, color, dash, _data(line.name or chart.title, color, line.x, values, " %" if chart.percent else ""))
        if line.markers or len(x) == 1:
            frame.body += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{color}"/>' for a, b in zip(x, y, strict=True)]
        if line.name:
            frame.key(line.name, color, dash)
    return frame.svg()


def stacked(chart: Chart, x: np.ndarray, parts: dict[str, np.ndarray]) -> str:
    """Draw stacked areas (n,) over x (n,), positive parts above 0 and negative parts below 0, and their sum as a line."""
    x, *values = _thinned(x, *parts.values())
    ups, downs = (np.cumsum([np.zeros(len(x)), *(of(v, 0.0) for v in values)], axis=0) for of in (np.maximum, np.minimum))
    sums = replace(chart, lines=[Line("", x, edge) for edge in (ups[-1], downs[-1])])
    frame = _Frame(chart, (float(x[0]), float(x[-1])), _y_range(sums), [*parts, "sum"])
    px = frame.px(x)
    for i, (name, value) in enumerate(zip(parts, values, strict=True)):
        color = COLORS[i] if i < len(COLORS) - 1 else REST
        for edges in (ups, downs):
            if np.abs(edges[i + 1] - edges[i]).max() > 0.0:
                frame.area(px, frame.py(edges[i]), frame.py(edges[i + 1]), color, "0.75", ' stroke="#fff" stroke-width="0.8"')
        frame.body.append(f"<g{_data(name, color, x, value)}></g>")
        frame.key(name, color, area=True)
    total = ups[-1] + downs[-1]
    frame.line(px, frame.py(total), INK, "4 2", _data("sum", INK, x, total))
    frame.key("sum", INK, "4 2")
    return frame.svg()


def heat_map(title: str, x_label: str, y_label: str, x: Sequence[float], y: Sequence[float], values: np.ndarray) -> str:
    """Draw values (len(x), len(y)) as shades from white (0) to blue (the largest), with their numbers in them."""
    frame = _Frame(Chart(title, x_label), (0.0, float(len(x))), (0.0, float(len(y))), [])
    largest = float(np.nanmax(values)) if np.isfinite(values).any() else 1.0
    width, height = np.diff(frame.px(np.array([0.0, 1.0])))[0], -np.diff(frame.py(np.array([0.0, 1.0])))[0]
    size = max(7.0, min(12.0, width / 3.2, height * 0.8))
    lefts, tops = frame.px(np.arange(len(x))), frame.py(np.arange(len(y)) + 1.0)
    for (i, j), value in np.ndenumerate(values):
        share = float(value) / largest if np.isfinite(value) and largest else 0.0
        box = f'x="{lefts[i]:.1f}" y="{tops[j]:.1f}" width="{width:.1f}" height="{height:.1f}"'
        frame.body.append(f'<rect {box} fill="{shade(share)}"/>')
        text, middle = f"{value:.2f}" if np.isfinite(value) else "-", tops[j] + height / 2 + size * 0.35
        frame.body.append(_text(lefts[i] + width / 2, middle, text, size, "middle", "#fff" if share > 0.55 else INK))
    names = [_text(lefts[i] + width / 2, frame.floor + 16, f"{value:g}") for i, value in enumerate(x)]
    names += [_text(LEFT - 6, tops[j] + height / 2 + 4, f"{value:g}", anchor="end") for j, value in enumerate(y)]
    turned = f'<g transform="rotate(-90 14 {(frame.top + frame.floor) / 2:g})">'
    names.append(f"{turned}{_text(14, (frame.top + frame.floor) / 2, y_label, 12, fill=QUIET)}</g>")
    return frame.svg(names)


def shade(share: float) -> str:
    """Return the colour of a share from 0 (nearly white) to 1 (dark blue)."""
    return "#" + "".join(f"{round(float(np.interp(share, (0.0, 0.5, 1.0), part))):02x}" for part in SHADES.T)


def sheet(drawings: Sequence[str], columns: int = 2) -> str:
    """Return drawings as one, side by side."""
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
    """Axes, grid, title and legend of a drawing that is being made."""

    def __init__(self, chart: Chart, x: tuple[float, float], y: tuple[float, float], names: Sequence[str]) -> None:
        self.chart, self.y = chart, y
        self.x = x if x[1] > x[0] else (x[0] - 0.5, x[0] + 0.5)
        self.body: list[str] = []
        self._keys: list[str] = []
        self._places: list[tuple[float, int]] = []
        left, row = LEFT, 0
        for name in names:  # a new row of the legend if the last row has no room
            width = 28.0 + LETTER * len(name)
            left, row = (LEFT, row + 1) if left + width > WIDTH - 2.0 and left > LEFT else (left, row)
            self._places.append((left, row))
            left += width + 8.0
        self.top = TOP + (16.0 * (row + 1) + 6.0 if names else 0.0)
        self.height = HEIGHT + self.top - TOP
        self.floor = self.height - BOTTOM

    def px(self, x: np.ndarray) -> np.ndarray:
        """Return the horizontal places of values of x (n,)."""
        return LEFT + (np.asarray(x) - self.x[0]) / (self.x[1] - self.x[0]) * (WIDTH - LEFT - RIGHT)

    def py(self, y: np.ndarray) -> np.ndarray:
        """Return the vertical places of values of y (n,)."""
        low, high, values = *self.y, np.asarray(y)
        if self.chart.log:
            low, high, values = math.log10(low), math.log10(high), np.log10(np.maximum(values, 1e-300))
        return self.floor - np.clip((values - low) / (high - low), -0.02, 1.02) * (self.floor - self.top)

    def line(self, x: np.ndarray, y: np.ndarray, color: str, dash: str, data: str) -> None:
        """Draw a line through points."""
        dashes = f' stroke-dasharray="{dash}"' if dash else ""
        look = f'fill="none" stroke="{color}" stroke-width="1.8"{dashes}{data}'
        self.body.append(f'<polyline points="{_points(x, y)}" {look}/>')

    def area(self, x: np.ndarray, low: np.ndarray, high: np.ndarray, color: str, opacity: str, edge: str = "") -> None:
        """Fill the area between two lines."""
        points = f"{_points(x, low)} {_points(x[::-1], high[::-1])}"
        self.body.append(f'<polygon points="{points}" fill="{color}" fill-opacity="{opacity}"{edge}/>')

    def key(self, name: str, color: str, dash: str = "", area: bool = False) -> None:
        """Put a name into the legend, with its line or with a square of its colour."""
        x, row = self._places[len(self._keys)]
        y = TOP + 6.0 + 16.0 * row
        dashes = f' stroke-dasharray="{dash}"' if dash else ""
        mark = f'<line x1="{x:g}" x2="{x + 22:g}" y1="{y:g}" y2="{y:g}" stroke="{color}" stroke-width="2.2"{dashes}/>'
        if area:
            mark = f'<rect x="{x + 6:g}" y="{y - 5:g}" width="11" height="10" fill="{color}" fill-opacity="0.75"/>'
        self._keys.append(mark + _text(x + 26, y + 4, name, anchor="start"))

    def svg(self, names: Sequence[str] | None = None) -> str:
        """Return the whole drawing; `names` of cells take the place of ticks."""
        chart = self.chart
        title = f'<text x="{LEFT - 44:g}" y="18" font-size="13.5" font-weight="600">{escape(chart.title)}</text>'
        parts = [title, *(self._ticks() if names is None else names), *self.body]
        if chart.level is not None:
            y = float(self.py(np.array(chart.level[1])))
            place = (LEFT, WIDTH - RIGHT, y, y)
            parts += [_rule(*place, dotted=True), _text(WIDTH - RIGHT - 3, y - 4, chart.level[0], 11, "end", QUIET)]
        for row, (name, at) in enumerate(chart.walls):  # each name in its own row
            x = float(self.px(np.array(at)))
            parts += [_rule(x, x, self.top, self.floor, dotted=True)]
            parts += [_text(x - 4, self.floor - 6 - 13 * row, name, 11, "end", QUIET)]
        parts.append(_text((LEFT + WIDTH - RIGHT) / 2, self.height - 8, chart.x_label, 12, fill=QUIET))
        cursor = f'<line class="cursor" y1="{self.top:g}" y2="{self.floor:g}" stroke="{QUIET}" visibility="hidden"/>'
        box = f"{LEFT:g} {WIDTH - RIGHT:g} {self.x[0]:.8g} {self.x[1]:.8g}"
        data = f' data-box="{box}" data-unit="{escape(chart.unit)}"' if names is None else ""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH:g} {self.height:g}" {FONT} fill="{INK}" role="img"'
            f' aria-label="{escape(chart.title)}"{data}>{"".join([*parts, *self._keys, cursor])}</svg>'
        )

    def _ticks(self) -> list[str]:
        """Return the grid, the ticks and their numbers."""
        found = []
        for value in _log_ticks(*self.y) if self.chart.log else ticks(*self.y, 5):
            y = float(self.py(np.array(value)))
            text = f"{100 * value:g} %" if self.chart.percent else short(value)
            found += [_rule(LEFT, WIDTH - RIGHT, y, y, GRID), _text(LEFT - 6, y + 4, text, anchor="end")]
        for value in ticks(*self.x, 6):
            x = float(self.px(np.array(value)))
            found += [_rule(x, x, self.floor, self.floor + 4), _text(x, self.floor + 17, short(value))]
        return [*found, _rule(LEFT, WIDTH - RIGHT, self.floor, self.floor)]


def _text(x: float, y: float, text: str, size: float = 11.5, anchor: str = "middle", fill: str = "") -> str:
    color = f' fill="{fill}"' if fill else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:.4g}" text-anchor="{anchor}"{color}>{escape(text)}</text>'


def _rule(x1: float, x2: float, y1: float, y2: float, color: str = QUIET, dotted: bool = False) -> str:
    """Return a straight line."""
    look = ' stroke-width="1.3" stroke-dasharray="2 3"' if dotted else ""
    return f'<line x1="{x1:.1f}" x2="{x2:.1f}" y1="{y1:.1f}" y2="{y2:.1f}" stroke="{color}"{look}/>'


def _points(x: np.ndarray, y: np.ndarray) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


def _data(name: str, color: str, x: np.ndarray, values: np.ndarray, unit: str = "") -> str:
    """Return the attributes of a line that the page's script reads: its name, and its values at each x."""
    at = " ".join(f"{value:.6g}" for value in x)
    shown = " ".join(f"{value:.4g}{unit}".replace(" ", "\u00a0") for value in values)
    return f' data-name="{escape(name)}" data-color="{color}" data-x="{at}" data-v="{shown}"'


def _cleaned(line: Line, log: bool) -> Line:
    """Return a line without values that can't be drawn, and with as many points as can be seen."""
    good = np.isfinite(line.x) & np.isfinite(line.y) & ((line.y > 0.0) | (not log))
    parts = [line.x[good], line.y[good], *(part[good] for part in line.band or ())]
    x, y, *band = _thinned(*parts) if not line.markers else parts
    return replace(line, x=x, y=y, band=(band[0], band[1]) if band else None)


def _thinned(*columns: np.ndarray) -> list[np.ndarray]:
    """Return columns (n,) of at most MOST_POINTS values: means of neighbours; the first and the last value are kept."""
    count = len(columns[0])
    if count <= MOST_POINTS:
        return [np.asarray(column, dtype=float) for column in columns]
    groups = np.array_split(np.arange(1, count - 1), MOST_POINTS - 2)
    return [np.array([column[0], *(column[group].mean() for group in groups), column[-1]]) for column in columns]


def _y_range(chart: Chart) -> tuple[float, float]:
    """Return the range of the y axis of a chart."""
    level = [] if chart.level is None else [[chart.level[1]]]
    values = np.concatenate([*level, [], *(part for line in chart.lines for part in (line.y, *(line.band or ())))])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    if chart.log:
        return (low / 1.2, high * 1.2) if low > 0.0 else (0.1, 1.0)
    low = low if chart.low is None else min(low, chart.low)
    if chart.high is not None:
        return low, chart.high
    if high <= low:
        return low - 0.5 * (low < 0.0), low + 1.0
    return low - (0.04 * (high - low) if low < 0.0 or chart.low is None else 0.0), high + 0.06 * (high - low)


def ticks(low: float, high: float, count: int) -> list[float]:
    """Return about `count` round numbers from `low` to `high`: multiples of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) + 0.0 for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    """Return powers of ten from `low` to `high`, with 2 and 5 times them where there are few."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    factors = (1, 2, 5) if high / low < 200.0 else (1,)
    return [factor * 10.0**power for power in powers for factor in factors if low <= factor * 10.0**power <= high]


def short(value: float) -> str:
    """Return the number of a tick in few letters: 1500000 -> 1.5M."""
    for limit, unit, letter in ((1e9, 1e9, "G"), (1e6, 1e6, "M"), (1e4, 1e3, "k")):
        if abs(value) >= limit:
            return f"{value / unit:g}{letter}"
    return f"{value:g}"
