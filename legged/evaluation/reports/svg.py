"""Drawings as SVG text: curves with bands, stacked parts, heat maps. Each stands alone, and is part of a page as it is.

Colours are those of M. Okabe and K. Ito (Color Universal Design, 2008), which people with any kind of colour vision tell
apart; lines differ by their dashes too, and names stand beside them.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from legged.figures import COLORS

DASHES = ("", "7 3", "2 2", "9 3 2 3", "5 2", "14 3 2 3 2 3", "12 3", "3 3")
WIDTH, HEIGHT = 480.0, 250.0
"""Of a drawing without its legend [SVG units, which are pixels on a wide screen]."""
LEFT, RIGHT, TOP, BOTTOM = 58.0, 14.0, 30.0, 42.0
"""Margins around the axes [SVG units]."""
FONT = 'font-family="system-ui, Segoe UI, Roboto, Arial, sans-serif"'
MOST_POINTS = 240
"""Points of a line; of a longer one, neighbours are averaged. There are hardly more pixels."""
LETTER = 6.3
"""Mean width of a letter of the legend [SVG units]."""
INK, QUIET = "#1b1f24", "#57606a"


@dataclass(frozen=True)
class Line:
    """A curve: x and y (n,); `band` is below and above it (n,) each. One without a name is called by the title."""

    name: str
    x: np.ndarray
    y: np.ndarray
    band: tuple[np.ndarray, np.ndarray] | None = None
    markers: bool = False
    style: int | None = None
    """Which of the colours and dashes it has; that of its place among the lines if None."""


@dataclass(frozen=True)
class Axes:
    """What a drawing of lines says of its axes."""

    title: str
    """What is drawn, with its unit."""
    x_label: str
    unit: str = "iteration"
    """What a value of x is called."""
    low: float | None = 0.0
    """y shows at least this; None shows what there is."""
    high: float | None = None
    """y ends here; None lets it end where the lines do."""
    log: bool = False
    percent: bool = False
    level: tuple[str, float] | None = None
    """A dotted line at one y, and its name."""
    walls: tuple[tuple[str, float], ...] = ()
    """Dotted lines at some x, and their names."""


def curves(axes: Axes, lines: Sequence[Line]) -> str:
    """Draw lines; values that are no numbers, or not above 0 on a logarithmic axis, are left out."""
    lines = [_cleaned(line, axes.log) for line in lines]
    drawn = [line for line in lines if len(line.x)]
    xs = np.concatenate([line.x for line in drawn]) if drawn else np.array([0.0, 1.0])
    ys = [part for line in drawn for part in (line.y, *(line.band or ()))]
    if axes.level is not None:
        ys.append(np.array([axes.level[1]]))
    xs = np.append(xs, [x for _, x in axes.walls])
    y_range = _y_range(np.concatenate(ys) if ys else np.array([0.0, 1.0]), axes)
    frame = _Frame(axes, _wide(float(xs.min()), float(xs.max())), y_range, [line.name for line in lines if line.name])
    for i, line in enumerate(drawn):
        style = i if line.style is None else line.style
        color, dash = COLORS[style % len(COLORS)], DASHES[style % len(DASHES)]
        x = frame.px(line.x)
        if line.band is not None:
            frame.area(x, frame.py(line.band[0]), frame.py(line.band[1]), color, 0.18)
        shown = [_number(100.0 * v) + " %" if axes.percent else _number(v) for v in line.y]
        data = _data(line.name or axes.title, color, line.x, shown)
        frame.line(x, frame.py(line.y), color, dash, data)
        if line.markers or len(x) == 1:
            frame.body += [
                f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{color}"/>' for a, b in zip(x, frame.py(line.y), strict=True)
            ]
        if line.name:
            frame.key(line.name, color, dash, style_only=False)
    return frame.svg()


def stacked(axes: Axes, x: np.ndarray, parts: dict[str, np.ndarray]) -> str:
    """Draw parts (n,) on top of each other, those below 0 downwards from it, and their sum as a line."""
    x, *values = _thinned(x, *parts.values())
    up, down = np.zeros(len(x)), np.zeros(len(x))
    layers = []
    for name, value in zip(parts, values, strict=True):
        above, below = np.maximum(value, 0.0), np.minimum(value, 0.0)
        layers.append((name, value, up, up + above, down, down + below))
        up, down = up + above, down + below
    frame = _Frame(axes, _wide(float(x[0]), float(x[-1])), _y_range(np.concatenate([up, down]), axes), [*parts, "sum"])
    px = frame.px(x)
    for i, (name, value, up_from, up_to, down_from, down_to) in enumerate(layers):
        color = COLORS[i] if i < len(COLORS) - 1 else "#9aa4ae"
        for low, high in ((up_from, up_to), (down_from, down_to)):
            if np.abs(high - low).max() > 0.0:
                frame.area(px, frame.py(low), frame.py(high), color, 0.75, stroke=True)
        data = _data(name, color, x, [_number(v) for v in value])
        frame.body.append(f"<g{data}></g>")
        frame.key(name, color, "", style_only=True)
    total = up + down
    frame.line(px, frame.py(total), INK, "4 2", _data("sum", INK, x, [_number(v) for v in total]))
    frame.key("sum", INK, "4 2", style_only=False)
    return frame.svg()


def heat_map(title: str, x_label: str, y_label: str, x: Sequence[float], y: Sequence[float], values: np.ndarray) -> str:
    """Draw values (len(x), len(y)) as shades from white (0) to blue (the largest), with their numbers in them."""
    axes = Axes(title, x_label)
    frame = _Frame(axes, (0.0, float(len(x))), (0.0, float(len(y))), [], y_label=y_label)
    largest = float(np.nanmax(values)) if np.isfinite(values).any() else 1.0
    x0, x1 = frame.px(np.array([0.0, 1.0]))
    y1, y0 = frame.py(np.array([0.0, 1.0]))
    width, height = x1 - x0, y1 - y0
    size = max(7.0, min(12.0, width / 3.2, height * 0.8))
    for (i, j), value in np.ndenumerate(values):
        left, top = float(frame.px(np.array([float(i)]))[0]), float(frame.py(np.array([j + 1.0]))[0])
        share = float(value) / largest if np.isfinite(value) and largest else 0.0
        text = f"{value:.2f}" if np.isfinite(value) else "-"
        frame.body.append(
            f'<rect x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" height="{height:.1f}" fill="{shade(share)}"/>'
            f'<text x="{left + width / 2:.1f}" y="{top + height / 2 + size * 0.35:.1f}" font-size="{size:.1f}"'
            f' text-anchor="middle" fill="{"#fff" if share > 0.55 else INK}">{text}</text>'
        )
    frame.names(x, y)
    return frame.svg(grid=False)


def shade(share: float) -> str:
    """Return the colour of a share from 0 (nearly white) to 1 (dark blue); lightness alone tells them apart."""
    low, middle, high = np.array([244.0, 248, 252]), np.array([86.0, 160, 211]), np.array([8.0, 48, 107])
    share = min(max(share, 0.0), 1.0)
    mixed = low + (middle - low) * 2 * share if share < 0.5 else middle + (high - middle) * (2 * share - 1)
    return "#" + "".join(f"{round(float(value)):02x}" for value in mixed)


def sheet(drawings: Sequence[str], columns: int = 2) -> str:
    """Return drawings as one, side by side."""
    sizes = [tuple(map(float, re.search(r'viewBox="0 0 (\S+) (\S+)"', one).groups())) for one in drawings]  # type: ignore[union-attr]
    top, body, wide = 0.0, [], 0.0
    for start in range(0, len(drawings), columns):
        left = 0.0
        row = list(zip(drawings, sizes, strict=True))[start : start + columns]
        for drawing, (width, height) in row:
            place = f'<svg x="{left:g}" y="{top:g}" width="{width:g}" height="{height:g}"'
            body.append(drawing.replace("<svg", place, 1))
            left += width + 12.0
        wide, top = max(wide, left - 12.0), top + max(height for _, (_, height) in row) + 12.0
    background = f'<rect width="{wide:g}" height="{top:g}" fill="#fff"/>'
    size = f'width="{wide:g}" height="{top:g}" viewBox="0 0 {wide:g} {top:g}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{background}{"".join(body)}</svg>\n'


class _Frame:
    """Axes, grid, title and legend of a drawing that is being made."""

    def __init__(
        self, axes: Axes, x: tuple[float, float], y: tuple[float, float], names: Sequence[str], y_label: str = ""
    ) -> None:
        self.axes, self.x, self.y, self.y_label = axes, x, y, y_label
        self.body: list[str] = []
        self._keys: list[str] = []
        self._key_x, self._rows = LEFT, 1 if names else 0
        for name in names:
            self._place(name)
        self.top = TOP + (16.0 * self._rows + 6.0 if self._rows else 0.0)
        self._key_x, self._rows = LEFT, 1 if names else 0
        self.height = HEIGHT + self.top - TOP
        self.floor = self.height - BOTTOM
        self._named: tuple[Sequence[float], Sequence[float]] | None = None

    def px(self, x: np.ndarray) -> np.ndarray:
        """Return where values of x (n,) are from left to right."""
        low, high = self.x
        return LEFT + (np.asarray(x) - low) / (high - low) * (WIDTH - LEFT - RIGHT)

    def py(self, y: np.ndarray) -> np.ndarray:
        """Return where values of y (n,) are from top to bottom."""
        low, high = self.y
        if self.axes.log:
            low, high, y = math.log10(low), math.log10(high), np.log10(np.maximum(y, 1e-300))
        return self.floor - np.clip((np.asarray(y) - low) / (high - low), -0.02, 1.02) * (self.floor - self.top)

    def line(self, x: np.ndarray, y: np.ndarray, color: str, dash: str, data: str) -> None:
        """Draw a line through points."""
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
        dashes = f' stroke-dasharray="{dash}"' if dash else ""
        self.body.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="1.8"{dashes}{data}/>')

    def area(
        self, x: np.ndarray, low: np.ndarray, high: np.ndarray, color: str, opacity: float, stroke: bool = False
    ) -> None:
        """Fill what lies between two lines."""
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in [*zip(x, low, strict=True), *zip(x[::-1], high[::-1], strict=True)])
        edge = ' stroke="#fff" stroke-width="0.8"' if stroke else ""
        self.body.append(f'<polygon points="{points}" fill="{color}" fill-opacity="{opacity:g}"{edge}/>')

    def names(self, x: Sequence[float], y: Sequence[float]) -> None:
        """Name the cells of a heat map, instead of ticks."""
        self._named = (x, y)

    def _place(self, name: str) -> float:
        """Return where the next entry of the legend begins, in a new row where the last has no room for it."""
        width = 28.0 + LETTER * len(name)
        if self._key_x + width > WIDTH - 2.0 and self._key_x > LEFT:
            self._key_x, self._rows = LEFT, self._rows + 1
        at = self._key_x
        self._key_x += width + 8.0
        return at

    def key(self, name: str, color: str, dash: str, style_only: bool) -> None:
        """Put a name into the legend, with its line, or with a square of its colour."""
        x, y = self._place(name), TOP - 2.0 + 16.0 * (self._rows - 1) + 8.0
        dashes = f' stroke-dasharray="{dash}"' if dash else ""
        mark = f'<line x1="{x:g}" x2="{x + 22:g}" y1="{y:g}" y2="{y:g}" stroke="{color}" stroke-width="2.2"{dashes}/>'
        if style_only:
            mark = f'<rect x="{x + 6:g}" y="{y - 5:g}" width="11" height="10" fill="{color}" fill-opacity="0.75"/>'
        self._keys.append(f'{mark}<text x="{x + 26:g}" y="{y + 4:g}" font-size="11.5">{escape(name)}</text>')

    def svg(self, grid: bool = True) -> str:
        """Return the whole drawing."""
        axes = self.axes
        parts = [f'<text x="{LEFT - 44:g}" y="18" font-size="13.5" font-weight="600">{escape(axes.title)}</text>']
        parts += self._ticks() if grid else self._cell_names()
        parts += self.body
        if axes.level is not None:
            parts.append(self._dotted(axes.level[0], None, axes.level[1]))
        parts += [self._dotted(name, x, None, row) for row, (name, x) in enumerate(axes.walls)]
        middle = (LEFT + WIDTH - RIGHT) / 2
        parts.append(
            f'<text x="{middle:g}" y="{self.height - 8:g}" font-size="12" text-anchor="middle" fill="{QUIET}">'
            f"{escape(axes.x_label)}</text>"
        )
        if self.y_label:
            at = f"{14:g} {(self.top + self.floor) / 2:g}"
            place = f'transform="rotate(-90 {at})" x="{at.split()[0]}" y="{at.split()[1]}"'
            parts.append(f'<text {place} font-size="12" text-anchor="middle" fill="{QUIET}">{escape(self.y_label)}</text>')
        cursor = f'<line class="cursor" y1="{self.top:g}" y2="{self.floor:g}" stroke="{QUIET}" visibility="hidden"/>'
        box = f"{LEFT:g} {WIDTH - RIGHT:g} {self.x[0]:.8g} {self.x[1]:.8g}"
        data = f' data-box="{box}" data-unit="{escape(axes.unit)}"' if grid else ""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH:g} {self.height:g}" {FONT} fill="{INK}" role="img"'
            f' aria-label="{escape(axes.title)}"{data}>{"".join([*parts, *self._keys, cursor])}</svg>'
        )

    def _ticks(self) -> list[str]:
        """Return grid, ticks and their numbers."""
        found = []
        logs = _log_ticks(*self.y) if self.axes.log else ticks(*self.y, 5)
        for value in logs:
            y = float(self.py(np.array([value]))[0])
            text = f"{100 * value:g} %" if self.axes.percent else short(value)
            found.append(f'<line x1="{LEFT:g}" x2="{WIDTH - RIGHT:g}" y1="{y:.1f}" y2="{y:.1f}" stroke="#e1e5e9"/>')
            found.append(f'<text x="{LEFT - 6:g}" y="{y + 4:.1f}" font-size="11.5" text-anchor="end">{text}</text>')
        for value in ticks(*self.x, 6):
            x = float(self.px(np.array([value]))[0])
            found.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{self.floor:g}" y2="{self.floor + 4:g}" stroke="{QUIET}"/>')
            at = f'x="{x:.1f}" y="{self.floor + 17:g}"'
            found.append(f'<text {at} font-size="11.5" text-anchor="middle">{short(value)}</text>')
        line = f'x1="{LEFT:g}" x2="{WIDTH - RIGHT:g}" y1="{self.floor:g}" y2="{self.floor:g}"'
        return [*found, f'<line {line} stroke="{QUIET}"/>']

    def _cell_names(self) -> list[str]:
        """Return the values of x and y beside the cells of a heat map."""
        assert self._named is not None, "a heat map names its cells"
        found = []
        for i, value in enumerate(self._named[0]):
            x = float(self.px(np.array([i + 0.5]))[0])
            at = f'x="{x:.1f}" y="{self.floor + 16:g}"'
            found.append(f'<text {at} font-size="11.5" text-anchor="middle">{value:g}</text>')
        for j, value in enumerate(self._named[1]):
            y = float(self.py(np.array([j + 0.5]))[0])
            found.append(f'<text x="{LEFT - 6:g}" y="{y + 4:.1f}" font-size="11.5" text-anchor="end">{value:g}</text>')
        return found

    def _dotted(self, name: str, x: float | None, y: float | None, row: int = 0) -> str:
        """Return a dotted line across the axes, and its name; that of a line at one x in a row of its own, from below."""
        line = f'stroke="{QUIET}" stroke-width="1.3" stroke-dasharray="2 3"'
        if y is not None:
            at = float(self.py(np.array([y]))[0])
            ends = f'x1="{LEFT:g}" x2="{WIDTH - RIGHT:g}" y1="{at:.1f}" y2="{at:.1f}"'
            where = f'x="{WIDTH - RIGHT - 3:g}" y="{at - 4:.1f}"'
        else:
            at = float(self.px(np.array([x]))[0])
            ends = f'x1="{at:.1f}" x2="{at:.1f}" y1="{self.top:g}" y2="{self.floor:g}"'
            where = f'x="{at - 4:.1f}" y="{self.floor - 6 - 13 * row:g}"'
        return f'<line {ends} {line}/><text {where} font-size="11" text-anchor="end" fill="{QUIET}">{escape(name)}</text>'


def _data(name: str, color: str, x: np.ndarray, shown: Sequence[str]) -> str:
    """Return what the page's script reads of a line: its name, and its values at each x."""
    at = " ".join(f"{value:.6g}" for value in x)
    values = " ".join(text.replace(" ", "\u00a0") for text in shown)
    return f' data-name="{escape(name)}" data-color="{color}" data-x="{at}" data-v="{values}"'


def _cleaned(line: Line, log: bool) -> Line:
    """Return a line without what can't be drawn, and with as many points as can be seen."""
    good = np.isfinite(line.x) & np.isfinite(line.y) & ((line.y > 0.0) | (not log))
    band = line.band
    parts = [line.x[good], line.y[good], *(part[good] for part in band or ())]
    x, y, *rest = _thinned(*parts) if not line.markers else parts
    return Line(line.name, x, y, (rest[0], rest[1]) if rest else None, line.markers, line.style)


def _thinned(*columns: np.ndarray) -> list[np.ndarray]:
    """Return columns (n,) of at most MOST_POINTS values: means of neighbours, but the first and the last as they are."""
    count = len(columns[0])
    if count <= MOST_POINTS:
        return [np.asarray(column, dtype=float) for column in columns]
    inner = [np.asarray(column, dtype=float)[1:-1] for column in columns]
    groups = np.array_split(np.arange(count - 2), MOST_POINTS - 2)
    means = [[float(values[group].mean()) for group in groups] for values in inner]
    return [np.array([column[0], *mean, column[-1]]) for column, mean in zip(columns, means, strict=True)]


def _wide(low: float, high: float) -> tuple[float, float]:
    """Return a range that has an extent: one value is in its middle."""
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _y_range(values: np.ndarray, axes: Axes) -> tuple[float, float]:
    """Return the range of y that shows `values` (n,)."""
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    if axes.log:
        return (low / 1.2, high * 1.2) if low > 0.0 else (0.1, 1.0)
    low = low if axes.low is None else min(low, axes.low)
    if axes.high is not None:
        return low, axes.high
    if high <= low:
        return low - 0.5 * (low < 0.0), low + 1.0
    return low - (0.04 * (high - low) if low < 0.0 or axes.low is None else 0.0), high + 0.06 * (high - low)


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
    for limit, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= limit:
            return f"{value / (1e3 if letter == 'k' else limit):g}{letter}"
    return f"{value:g}"


def _number(value: float) -> str:
    """Return a value with four digits."""
    return f"{value:.4g}"
