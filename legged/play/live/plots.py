"""The live plots as SVG: velocities asked and reached, feet on the ground, parts of the reward. Text takes the colour of the
page; curves have the colours of all figures, and dashes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from legged.figures import COLORS
from legged.play.live.history import AXES, KEPT_S, UNITS, History

OTHERS = "#7F7F7F"
"""Colour of what is added up."""
DASHES = ("", "5 2", "2 2")
"""The second and third dozen of curves are dashed."""
COMMANDED, ACTUAL = COLORS[1], COLORS[0]
WIDTH, LEFT, RIGHT, TOP = 320.0, 40.0, 6.0, 16.0
"""Of a figure, and what it leaves for numbers on the left, on the right, and for its name [pixels]."""
BELOW = 32.0
"""Room for the time axis [pixels]."""
MOST_POINTS = 160
"""Points of a curve: more than are seen only cost."""
PARTS = 6
"""Reward terms that are told apart: the largest. The others are added up."""


@dataclass(frozen=True)
class Curve:
    """A line in a figure."""

    name: str
    values: np.ndarray
    """(K,); NaN where the line is broken."""
    color: str
    dash: str = ""


def velocity_figures(history: History, has_commands: bool) -> str:
    """Return figures of vx, vy [m/s] and yaw rate [rad/s], asked and reached; without commands, of vx alone."""
    times, actual, commanded = history.times(), history.actual(), history.commanded()
    if not has_commands:
        return figure("forward velocity [m/s]", times, [Curve("actual", actual[0], ACTUAL)], 90.0)
    found = []
    for axis, (name, unit) in enumerate(zip(AXES, UNITS, strict=True)):
        curves = [Curve("commanded", commanded[axis], COMMANDED, DASHES[1]), Curve("actual", actual[axis], ACTUAL)]
        found.append(figure(f"{name} [{unit}]", times, curves, 60.0, time_axis=axis == 2, legend=axis == 0, least=0.5))
    return "".join(found)


def reward_figure(history: History) -> str:
    """Return a figure of the largest parts of the reward, and the sum of the others."""
    values = history.rewards()
    if values.shape[1] == 0:
        return figure(_reward_unit(history), history.times(), [], 120.0)
    known = np.isfinite(values)
    size = np.where(known, np.abs(np.nan_to_num(values)), 0.0).sum(axis=1)
    largest = sorted(np.argsort(-size)[:PARTS].tolist())
    curves = [Curve(history.terms[i], values[i], COLORS[k % len(COLORS)]) for k, i in enumerate(largest)]
    others = [i for i in range(len(history.terms)) if i not in largest]
    if others:
        name = history.terms[others[0]] if len(others) == 1 else f"{len(others)} others"
        curves.append(Curve(name, values[others].sum(axis=0), OTHERS, DASHES[1]))
    return figure(_reward_unit(history), history.times(), curves, 130.0)


def _reward_unit(history: History) -> str:
    return f"reward parts [1/{'s' if history.per_second else 'step'}]"


def gait_figure(history: History) -> str:
    """Return the gait diagram: for each foot, bars where it is on the ground."""
    times, contacts = history.times(), history.contacts()
    row = 14.0
    height = row * len(history.feet)
    canvas = [_text(LEFT, 11.0, "feet on the ground", weight="600")]
    for i, name in enumerate(history.feet):
        y = TOP + i * row
        canvas.append(_text(LEFT - 4.0, y + 10.5, short(name, history.feet), anchor="end"))
        canvas.append(f'<rect x="{LEFT}" y="{y + 1:.1f}" width="{_plot_width():.1f}" height="{row - 2:.1f}" {FRAME}/>')
        for start, end in _stretches(times, contacts[i] > 0.5, history.dt) if len(times) else ():
            x, wide = _across(start), _across(end) - _across(start)
            canvas.append(
                f'<rect x="{x:.1f}" y="{y + 2:.1f}" width="{max(wide, 0.5):.1f}" height="{row - 4:.1f}" fill="{ACTUAL}"/>'
            )
    return _svg([*canvas, *_time_axis(TOP + height)], TOP + height + BELOW)


FRAME = 'fill="none" stroke="currentColor" stroke-opacity="0.25"'


def short(name: str, names: Sequence[str]) -> str:
    """Return a name without the words that all `names` begin or end with: 'LF_FOOT' among feet becomes 'LF'."""
    split = [other.split("_") for other in names]
    before = after = 0
    if len(names) > 1:
        least = min(map(len, split)) - 1
        while before < least and len({words[before] for words in split}) == 1:
            before += 1
        while after < least - before and len({words[-1 - after] for words in split}) == 1:
            after += 1
    words = name.split("_")
    return "_".join(words[before : len(words) - after])[:7]


def _stretches(times: np.ndarray, on: np.ndarray, dt: float) -> list[tuple[float, float]]:
    """Return the beginnings and ends [s] of stretches in which `on` (K,) holds, each a step of `dt` before one of `times`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
    return [(float(times[a] - dt), float(times[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def figure(
    name: str,
    times: np.ndarray,
    curves: Sequence[Curve],
    height: float,
    time_axis: bool = True,
    legend: bool = True,
    least: float = 0.0,
) -> str:
    """Return a figure of curves over `times` (K,) [s], 0 now, as an SVG element: `height` is that of the plot [pixels], and
    its vertical axis spans at least `least`, 0 included.
    """
    canvas = [_text(LEFT, 11.0, name, weight="600")]
    rows = _legend(curves) if legend else []
    top = TOP + (13.0 * len(rows) if rows else 0.0)
    for k, entries in enumerate(rows):
        canvas += [_entry(x, TOP + 13.0 * k, curve) for x, curve in entries]
    values = np.concatenate([curve.values[np.isfinite(curve.values)] for curve in curves]) if curves else np.zeros(0)
    low, high = (min(0.0, float(values.min())), max(0.0, float(values.max()))) if len(values) else (0.0, 1.0)
    if high - low < max(least, 1e-6):
        middle = 0.5 * (low + high)
        low, high = min(0.0, middle - 0.5 * max(least, 1e-6)), max(0.0, middle + 0.5 * max(least, 1e-6))
    step = tick_step(high - low, 3 if height < 80.0 else 5)
    low, high = step * np.floor(low / step + 1e-9), step * np.ceil(high / step - 1e-9)

    def up(value: np.ndarray | float) -> np.ndarray:
        return np.asarray(top + height * (high - value) / (high - low))

    for tick in np.arange(round((high - low) / step) + 1) * step + low:
        y = float(up(tick))
        strong = "0.55" if abs(tick) < 1e-9 * step else "0.18"
        line = f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"'
        canvas.append(f'{line} stroke="currentColor" stroke-opacity="{strong}"/>')
        canvas.append(_text(LEFT - 4.0, y + 3.5, f"{tick:.4g}" if abs(tick) > 1e-9 * step else "0", anchor="end"))
    shown = slice(None, None, max(1, -(-len(times) // MOST_POINTS)))
    for curve in curves:
        for at, unbroken in _lines(times[shown], curve.values[shown]):
            points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(_across(at), up(unbroken), strict=True))
            dash = f' stroke-dasharray="{curve.dash}"' if curve.dash else ""
            canvas.append(f'<polyline points="{points}" fill="none" stroke="{curve.color}" stroke-width="1.6"{dash}/>')
    if time_axis:
        canvas += _time_axis(top + height)
    return _svg(canvas, top + height + (BELOW if time_axis else 6.0))


def tick_step(span: float, most: int) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten of which at most `most` go into a span."""
    power = 10.0 ** np.floor(np.log10(span / most))
    return float(next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if span / (factor * power) <= most + 1e-9))


def _lines(times: np.ndarray, values: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the unbroken parts of a curve of at least two points."""
    known = np.isfinite(values)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    return [(times[a:b], values[a:b]) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1]


def _legend(curves: Sequence[Curve]) -> list[list[tuple[float, Curve]]]:
    """Return the curves in rows, each with where its entry begins [pixels]."""
    rows: list[list[tuple[float, Curve]]] = []
    x = WIDTH
    for curve in curves if len(curves) > 1 else ():
        wide = 26.0 + 6.6 * len(curve.name)
        if x + wide > WIDTH - RIGHT:
            rows.append([])
            x = LEFT
        rows[-1].append((x, curve))
        x += wide
    return rows


def _entry(x: float, y: float, curve: Curve) -> str:
    dash = f' stroke-dasharray="{curve.dash}"' if curve.dash else ""
    line = f'<line x1="{x}" x2="{x + 14.0}" y1="{y + 6.0}" y2="{y + 6.0}" stroke="{curve.color}" stroke-width="2.5"{dash}/>'
    return line + _text(x + 17.0, y + 9.5, curve.name)


def _time_axis(y: float) -> list[str]:
    ticks = [_text(float(_across(t)), y + 12.0, f"{t:g}", anchor="middle") for t in (-10.0, -8.0, -6.0, -4.0, -2.0, 0.0)]
    return [*ticks, _text(float(_across(-0.5 * KEPT_S)), y + 24.0, "time [s]", anchor="middle")]


def _plot_width() -> float:
    return WIDTH - LEFT - RIGHT


def _across(time: np.ndarray | float) -> np.ndarray:
    """Return where times [s], 0 now, are on the horizontal axis [pixels]."""
    return np.asarray(LEFT + _plot_width() * (1.0 + np.maximum(time, -KEPT_S) / KEPT_S))


def _text(x: float, y: float, text: str, anchor: str = "start", weight: str = "400") -> str:
    style = f'text-anchor="{anchor}" font-weight="{weight}" font-size="10" fill="currentColor"'
    return f'<text x="{x:.1f}" y="{y:.1f}" {style}>{escape(text)}</text>'


def _svg(parts: Sequence[str], height: float) -> str:
    return (
        f'<svg viewBox="0 0 {WIDTH:g} {height:g}" width="100%" xmlns="http://www.w3.org/2000/svg"'
        f' font-family="system-ui, sans-serif" style="display:block">{"".join(parts)}</svg>'
    )
