"""Live plots of the followed robot: velocities and reward terms as viser's uPlot charts, and a gait diagram."""

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from legged.figures import COLORS
from legged.play.live.history import AXES, KEPT_S, UNITS, History

OTHERS = "#7F7F7F"
"""Colour of the sum of the smaller reward terms."""
COMMANDED, ACTUAL = COLORS[1], COLORS[0]
DASH = (5, 2)
"""Dash and gap of commanded velocities and of the summed reward terms [pixels]."""
MOST_POINTS = 160
"""Points per curve; more cannot be told apart at the width of the panel."""
LARGEST = 6
"""Reward terms that have a curve of their own."""
LEFT, RIGHT, X_AXIS, FRAME = 44, 12, 30, 10
"""Width of the vertical axis, margin on the right, height of the time axis, and viser's own margin of a chart [pixels]."""
SMALLEST_RANGE = 0.25
"""Velocity axes reach at least this far up and down [m/s, rad/s]."""


class LivePlots:
    """Charts in the container of viser's GUI that is open while the object is created."""

    def __init__(self, server: Any, history: History, has_commands: bool) -> None:
        """Create the charts; without commands only the forward velocity has one."""
        self._server = server
        actual, commanded = _line("actual", ACTUAL), _line("commanded", COMMANDED, DASH)
        if has_commands:
            self._velocities = [
                self._chart(f"{name} [{unit}]", (commanded, actual), 56, legend=axis == 0, time_axis=axis == 2)
                for axis, (name, unit) in enumerate(zip(AXES, UNITS, strict=True))
            ]
        else:
            self._velocities = [self._chart("forward velocity [m/s]", (actual,), 90)]
        self._gait = server.gui.add_html("") if history.feet else None
        self._names, _ = reward_curves(history)
        unit = "s" if history.per_second else "step"
        self._rewards = self._chart(f"reward terms [1/{unit}]", _reward_lines(self._names), 110, least=0.0)

    def _chart(
        self,
        title: str,
        lines: tuple[dict[str, Any], ...],
        height: int,
        legend: bool = True,
        time_axis: bool = True,
        least: float = SMALLEST_RANGE,
    ) -> Any:
        """Return a chart without data whose plot area is `height` pixels high and whose vertical axis includes 0."""
        # Mode 1 lets an axis end at the soft limit unless the data exceed it.
        low, high = ({"soft": limit, "mode": 1, "pad": 0.1} for limit in (-least, least))
        return self._server.gui.add_uplot(
            (np.zeros(0),) * (1 + len(lines)),
            ({"label": "time [s]"}, *lines),
            title=title,
            scales={"x": {"time": False, "range": (-KEPT_S, 0.0)}, "y": {"range": {"min": low, "max": high}}},
            axes=({"show": time_axis, "size": X_AXIS}, {"size": LEFT, "space": 18}),
            legend={"show": legend},
            height=height + (X_AXIS if time_axis else 0),
            padding=(8, RIGHT, 0 if time_axis else 8, 0),
        )

    def update(self, history: History) -> None:
        """Show the samples of a history."""
        shown = slice(None, None, max(1, -(-len(history) // MOST_POINTS)))
        times, actual, commanded = history.times(), history.actual(), history.commanded()
        names, rewards = reward_curves(history)
        with self._server.atomic():
            for axis, chart in enumerate(self._velocities):
                curves = (commanded[axis], actual[axis]) if len(chart.series) > 2 else (actual[axis],)
                chart.data = (times[shown], *(curve[shown] for curve in curves))
            if self._gait is not None:
                self._gait.content = gait_diagram(history)
            if names != self._names:  # new series make the browser build the chart anew
                self._names = names
                self._rewards.series = ({"label": "time [s]"}, *_reward_lines(names))
            self._rewards.data = (times[shown], *(curve[shown] for curve in rewards))


def _line(name: str, color: str, dash: tuple[int, int] | None = None) -> dict[str, Any]:
    """Return uPlot's options for a curve."""
    return {"label": name, "stroke": color, "width": 1.6, **({"dash": dash} if dash else {})}


def _reward_lines(names: Sequence[str]) -> tuple[dict[str, Any], ...]:
    """Return uPlot's options for reward curves; a curve after the LARGEST is the sum of the other terms."""
    return tuple(_line(name, COLORS[k]) if k < LARGEST else _line(name, OTHERS, DASH) for k, name in enumerate(names))


def reward_curves(history: History) -> tuple[list[str], list[np.ndarray]]:
    """Return the names and values (K,) of the LARGEST reward terms in a history, then those of the sum of the others."""
    values = history.rewards()
    sizes = np.abs(np.nan_to_num(values)).sum(axis=1)
    largest = sorted(np.argsort(-sizes, kind="stable")[:LARGEST].tolist())
    others = [i for i in range(len(history.terms)) if i not in largest]
    names, curves = [history.terms[i] for i in largest], [values[i] for i in largest]
    if others:
        names.append(history.terms[others[0]] if len(others) == 1 else f"{len(others)} others")
        curves.append(values[others].sum(axis=0))
    return names, curves


def gait_diagram(history: History) -> str:
    """Return HTML with one row per foot, whose bars are the times at which the foot is on the ground."""
    rows = []
    for name, contacts in zip(short_names(history.feet), history.contacts(), strict=True):
        bars = "".join(
            f'<rect x="{start:.3f}" width="{end - start:.3f}" height="1" fill="{ACTUAL}"/>'
            for start, end in _stretches(history.times(), contacts > 0.5, history.dt)
        )
        # One unit of the drawing's width is a second, so the bars line up with the time axes of the charts.
        rows.append(
            f'<div style="display:flex"><span style="width:{LEFT}px;margin:0 6px 0 4px;text-align:right">{escape(name)}'
            f'</span><svg viewBox="{-KEPT_S:g} 0 {KEPT_S:g} 1" preserveAspectRatio="none" style="flex:1;'
            f'height:11px;margin:3px {RIGHT + FRAME}px 2px 0;outline:1px solid #8884">{bars}</svg></div>'
        )
    return f'<div style="font-size:11px"><b style="margin-left:{LEFT + FRAME}px">feet on the ground</b>{"".join(rows)}</div>'


def _stretches(times: np.ndarray, on: np.ndarray, dt: float) -> list[tuple[float, float]]:
    """Return the starts and ends [s] of the stretches in which `on` (K,) holds; a sample covers the `dt` before its time."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
    return [(float(times[a] - dt), float(times[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def short_names(names: Sequence[str]) -> list[str]:
    """Return names without the words that all of them share: LF and RF for LF_FOOT and RF_FOOT."""
    shared = set.intersection(*(set(name.split("_")) for name in names))
    return [("_".join(word for word in name.split("_") if word not in shared) or name)[:7] for name in names]
