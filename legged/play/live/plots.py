"""Live plots of the followed robot: velocities and reward terms as viser's uPlot charts, and a gait diagram."""

from collections import deque
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from legged.envs import BaseTask, is_robot_task, is_velocity_task
from legged.figures import COLORS, without_common_words
from legged.policies.episodes import unit_of

KEPT_S = 10.0
"""Length of the history [s]."""
SMOOTHED_S = 0.2
"""Window over which rewards are averaged, because some terms, such as those of touch-downs, occur in single steps [s]."""
AXES, UNITS = ("vx", "vy", "yaw rate"), ("m/s", "m/s", "rad/s")
"""Names and units of the components of a command."""
OTHERS = "#7F7F7F"
"""Colour of the sum of the smaller reward terms."""
COMMANDED, ACTUAL = COLORS[1], COLORS[0]
DASH = (5, 2)
"""Lengths of dash and gap in the curves of commanded velocities and of summed reward terms [pixels]."""
MOST_POINTS = 160
"""Largest number of points of a curve; more could not be told apart in the panel."""
LARGEST = 6
"""Number of reward terms that have their own curves. These are the largest terms."""
LEFT, RIGHT, X_AXIS, FRAME = 44, 12, 30, 10
"""Width of the vertical axis, right margin, height of the time axis, and viser's margin around a chart [pixels]."""
SMALLEST_RANGE = 0.25
"""Velocity axes reach at least this far up and down from 0 [m/s, rad/s]."""
Lines = tuple[dict[str, Any], ...]
"""Options of several curves for uPlot."""


class History:
    """The last K control steps (KEPT_S) of a robot with F feet, oldest first. Values of steps that end episodes are NaN."""

    def __init__(self, task: BaseTask) -> None:
        self.terms = task.rewards.names
        self.feet = task.robot.feet_names if is_robot_task(task) else ()
        self.per_second = task.cfg.rewards.times_dt
        """True: rewards are per second. False: rewards are per step."""
        self.dt = task.dt
        self.rows: deque[np.ndarray] = deque(maxlen=max(2, round(KEPT_S / task.dt)))
        """Rows: time, actual and commanded velocity (3 each), contacts (F), and rewards in the task's unit (terms)."""

    def add(self, task: BaseTask, robot: int, time: float) -> None:
        """Add the last control step of the robot with the index `robot`. `time` is the simulated time [s]."""
        row = np.full(7 + len(self.feet) + len(self.terms), np.nan)
        row[0] = time
        if not bool(task.reset_buf[robot]):
            if is_robot_task(task):
                row[1:3] = task.base_lin_vel[robot, :2].tolist()
                row[3] = float(task.base_ang_vel[robot, 2])
                row[7 : 7 + len(self.feet)] = task.contacts.in_contact[robot].tolist()
            else:
                row[1] = float(task.physics.qvel[robot, 0])
            if is_velocity_task(task):
                row[4:7] = task.commands[robot, :3].tolist()
            row[7 + len(self.feet) :] = (task.rewards.last[:, robot] / unit_of(task)).tolist()
        self.rows.append(row)

    def curves(self) -> dict[str, np.ndarray]:
        """Return arrays by name. `times` (K,) are relative to the newest step, so at most 0 [s]. `actual` and `commanded`
        (3, K) are vx, vy [m/s] and yaw rate [rad/s], base frame. `contacts` (F, K) are 1 for feet on the ground. `rewards`
        (terms, K) are averaged over the SMOOTHED_S before each step. In tasks without commands only the actual vx is known,
        in the world frame. All other velocities are then NaN.
        """
        feet = len(self.feet)
        table = np.array(self.rows).reshape(-1, 7 + feet + len(self.terms)).T
        (times,), actual, commanded, contacts, values = np.split(table, [1, 4, 7, 7 + feet])
        width = max(1, round(SMOOTHED_S / self.dt))
        counted = np.cumsum(np.isfinite(values), axis=1, dtype=float)
        summed = np.cumsum(np.nan_to_num(values), axis=1)
        for sums in (counted, summed):
            sums[:, width:] -= sums[:, :-width].copy()
        means = np.divide(summed, counted, out=np.full(values.shape, np.nan), where=np.isfinite(values))
        found = {"times": times - times[-1:], "actual": actual, "commanded": commanded, "contacts": contacts}
        return found | {"rewards": means}


class LivePlots:
    """Charts in viser's GUI, in the container that is open while this object is created."""

    def __init__(self, server: Any, history: History, has_commands: bool) -> None:
        """Create the charts. For tasks without commands the only velocity chart is that of the forward velocity."""
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
        self._names, _ = reward_curves(history.terms, history.curves()["rewards"])
        unit = "s" if history.per_second else "step"
        self._rewards = self._chart(f"reward terms [1/{unit}]", _reward_lines(self._names), 110, least=0.0)

    def _chart(
        self,
        title: str,
        lines: Lines,
        height: int,
        legend: bool = True,
        time_axis: bool = True,
        least: float = SMALLEST_RANGE,
    ) -> Any:
        """Return a chart without data. Its plot area is `height` pixels high, and its vertical axis includes 0."""
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
        """Show the values of a history."""
        shown = slice(None, None, max(1, -(-len(history.rows) // MOST_POINTS)))
        found = history.curves()
        times, actual, commanded = found["times"], found["actual"], found["commanded"]
        names, rewards = reward_curves(history.terms, found["rewards"])
        with self._server.atomic():
            for axis, chart in enumerate(self._velocities):
                curves = (commanded[axis], actual[axis]) if len(chart.series) > 2 else (actual[axis],)
                chart.data = (times[shown], *(curve[shown] for curve in curves))
            if self._gait is not None:
                self._gait.content = gait_diagram(history.feet, times, found["contacts"], history.dt)
            if names != self._names:  # the browser builds the chart anew at each change of its curves
                self._names = names
                self._rewards.series = ({"label": "time [s]"}, *_reward_lines(names))
            self._rewards.data = (times[shown], *(curve[shown] for curve in rewards))


def _line(name: str, color: str, dash: tuple[int, int] | None = None) -> dict[str, Any]:
    return {"label": name, "stroke": color, "width": 1.6, **({"dash": dash} if dash else {})}


def _reward_lines(names: Sequence[str]) -> Lines:
    """Return uPlot's options for reward curves. A curve after the first LARGEST ones is the sum of the smaller terms."""
    return tuple(_line(name, COLORS[k]) if k < LARGEST else _line(name, OTHERS, DASH) for k, name in enumerate(names))


def reward_curves(terms: Sequence[str], values: np.ndarray) -> tuple[list[str], list[np.ndarray]]:
    """Return names and curves (K,). The first LARGEST curves are the largest reward terms. A last curve is the sum of all
    other terms. `values` (terms, K) has one row for each of `terms`.
    """
    sizes = np.abs(np.nan_to_num(values)).sum(axis=1)
    largest = sorted(np.argsort(-sizes, kind="stable")[:LARGEST].tolist())
    others = [i for i in range(len(terms)) if i not in largest]
    names, curves = [terms[i] for i in largest], [values[i] for i in largest]
    if others:
        names.append(terms[others[0]] if len(others) == 1 else f"{len(others)} others")
        curves.append(values[others].sum(axis=0))
    return names, curves


def gait_diagram(feet: Sequence[str], times: np.ndarray, contacts: np.ndarray, dt: float) -> str:
    """Return HTML with a row for each foot. Bars show the `times` (K,) [s] at which the foot's `contacts` (F, K) are 1."""
    rows = []
    for name, own in zip(without_common_words(feet), contacts, strict=True):
        # `a` is the first step of a contact, `b` the first step after it. The step at time t lasts from t - dt to t.
        edges = np.flatnonzero(np.diff(np.concatenate([[False], own > 0.5, [False]]).astype(int)))
        bars = "".join(
            f'<rect x="{times[a] - dt:.3f}" width="{times[b - 1] - times[a] + dt:.3f}" height="1" fill="{ACTUAL}"/>'
            for a, b in edges.reshape(-1, 2)
        )
        # One unit of the drawing's width is a second, so the bars line up with the time axes of the charts.
        rows.append(
            f'<div style="display:flex"><span style="width:{LEFT}px;margin:0 6px 0 4px;text-align:right">{escape(name[:7])}'
            f'</span><svg viewBox="{-KEPT_S:g} 0 {KEPT_S:g} 1" preserveAspectRatio="none" style="flex:1;'
            f'height:11px;margin:3px {RIGHT + FRAME}px 2px 0;outline:1px solid #8884">{bars}</svg></div>'
        )
    return f'<div style="font-size:11px"><b style="margin-left:{LEFT + FRAME}px">feet on the ground</b>{"".join(rows)}</div>'
