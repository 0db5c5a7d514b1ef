"""The plots of an episode's page, for legged robots and for others."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from legged.episodes.stored import Episodes
from legged.figures import COLORS

OTHERS = "#BBBBBB"
MOST_PARTS = 7
"""Reward parts with their own colour, the largest ones; the rest is summed."""
MOST_LINES = 8
"""Most lines of a plot."""
SIDES = frozenset(
    (
        *("lf", "rf", "lh", "rh", "fl", "fr", "rl", "rr", "hl", "hr", "bl", "br", "ml", "mr", "l", "r"),
        *("left", "right", "front", "rear", "hind", "back"),
    )
)
"""Words in a joint's name for its leg."""


class Panels:
    """The plots of one episode and their arrays."""

    def __init__(self, episodes: Episodes, number: int) -> None:
        self.episodes, self.one = episodes, episodes.of(number)
        self.arrays: dict[str, np.ndarray] = {}
        """Array -> (T, K) values."""
        self.joints = episodes.about["joints"]

    def sections(self) -> list[dict[str, Any]]:
        """Return the sections of the page in order: title, plots, and whether the section is open at first.

        Reward parts that the task multiplies by its step are drawn per second.
        """
        legged = "command" in self.one
        found = [*(self._of_legs() if legged else [self._of_root()]), self._rewards()]
        if "torque" in self.one and self.joints:
            note = "At the end of each control step. Dotted lines are the limits of the motors."
            found.append(self._by_joint("Torques", "torque", "max_torque", "torque", note))
        if "joint_pos" in self.one and self.joints:
            note = "Dotted lines are the stops, where they are in sight."
            found.append(self._by_joint("Joint positions", "joint_pos", "range", "position", note))
            found.append(self._by_joint("Joint velocities", "joint_vel", "max_velocity", "velocity", "", is_open=False))
        passive = self._passive()
        if passive:
            found.append(passive)
        found.append(self._actions())
        return [section for section in found if section["panels"]]

    # ---- legged robots ---------------------------------------------------------------------------------------------

    def _of_legs(self) -> list[dict[str, Any]]:
        one = self.one
        self.arrays["command"], self.arrays["base_lin_vel"] = one["command"], one["base_lin_vel"]
        self.arrays["base_ang_vel"] = one["base_ang_vel"]
        x, y = one["qpos"][:, 4], one["qpos"][:, 5]
        self.arrays["height"] = one["qpos"][:, 2] - one["ground"]
        # The vertical part of the base's upward axis is 1 - 2 (x^2 + y^2), with x and y of its quaternion.
        self.arrays["tilt"] = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x**2 + y**2), -1.0, 1.0)))
        linear = [
            line
            for axis, name in enumerate(("vx", "vy"))
            for line in (
                _line(f"{name} commanded", "command", axis, COLORS[axis], dashed=True),
                _line(f"{name} actual", "base_lin_vel", axis, COLORS[axis]),
            )
        ]
        turning = [
            _line("commanded", "command", 2, COLORS[2], dashed=True),
            _line("actual", "base_ang_vel", 2, COLORS[2]),
        ]
        base = [
            _panel("height above the ground", "m", [_line("height", "height", 0, COLORS[0])], height=110),
            _panel("tilt", "deg", [_line("tilt", "tilt", 0, COLORS[1])], height=110, include=[0.0]),
        ]
        velocities = [
            _panel("velocity, forward and to the left, base frame", "m/s", linear, include=[0.0]),
            _panel("yaw rate", "rad/s", turning, include=[0.0]),
        ]
        return [
            _section("Commanded and actual velocity", velocities, wide=True),
            self._feet(),
            _section("Base", base),
        ]

    def _feet(self) -> dict[str, Any]:
        feet, contacts = self.episodes.about["feet"], self.episodes.about["contacts"]
        threshold = self.episodes.about["contact_threshold"]
        self.arrays["feet_contact"] = self.one["feet_contact"]
        self.arrays["feet_up_force"] = self.one["feet_force"][:, :, 2]
        rows = [
            {**_line(name, "feet_contact", i, COLORS[i % len(COLORS)]), "above": 0.5}
            for i, name in enumerate(without_common_words(feet))
        ]
        # Other shapes with a contact, at any time.
        force = self.one["contact_force"]
        touched = [i for i, name in enumerate(contacts) if name not in feet and (force[:, i] > threshold).any()]
        self.arrays["other_force"] = force[:, touched] if touched else np.zeros((len(force), 1))
        rows += [{**_line(contacts[i], "other_force", k, "#666666"), "above": threshold} for k, i in enumerate(touched)]
        lines = [_line(foot, "feet_up_force", i, COLORS[i % len(COLORS)]) for i, foot in enumerate(feet)]
        note = "Bars are contacts; grey bars are those of other shapes." if touched else "Bars are contacts."
        panels = [_panel("gait diagram", "", rows, kind="gait"), _panel("vertical force on the feet", "N", lines)]
        return _section("Feet", panels, note, wide=True)

    def _passive(self) -> dict[str, Any] | None:
        """Return the positions of a legged robot's joints without a motor."""
        if "command" not in self.one:
            return None
        names = self.episodes.columns("qpos")
        driven = {joint["qpos"] for joint in self.joints}
        columns = [i for i in range(7, len(names)) if i not in driven]
        if not columns:
            return None
        self.arrays["passive"] = self.one["qpos"][:, columns]
        panels = self._plain("passive", [names[i] for i in columns], "position", "rad, m or 1")
        return _section("Passive joints", panels, "No motor drives them.", is_open=False)

    # ---- all tasks --------------------------------------------------------------------------------------------------

    def _of_root(self) -> dict[str, Any]:
        """Return the coordinates that no motor drives, for a task without a legged robot."""
        panels = []
        for name, key, title, unit in (
            ("qvel", "qvel", "velocities without a motor", "m/s or rad/s"),
            ("qpos", "qpos", "positions without a motor", "m or rad"),
        ):
            names = self.episodes.columns(name)
            driven = {joint[key] for joint in self.joints}
            columns = [i for i in range(len(names)) if i not in driven]
            if columns:
                self.arrays[f"free_{name}"] = self.one[name][:, columns]
                panels += self._plain(f"free_{name}", [names[i] for i in columns], title, unit)
        return _section("Generalised coordinates", panels, wide=True)

    def _rewards(self) -> dict[str, Any]:
        parts, names = self.one["reward_parts"], self.episodes.columns("reward_parts")
        unit = float(self.episodes.about.get("reward_unit", 1.0))
        self.arrays["reward_parts"] = parts / unit
        size = np.abs(np.nan_to_num(parts)).sum(axis=0)
        note = "Rewards lie above zero, penalties below."
        if "termination" in names and size[names.index("termination")] > 0.0:
            once = float(parts[-1, names.index("termination")])
            note += f" The penalty of a failure, {once:.3g} at the end, is left out."
            size[names.index("termination")] = 0.0
        largest = [int(i) for i in np.argsort(-size, kind="stable") if size[i] > 0.0]
        if len(largest) > MOST_PARTS + 1:
            rest = largest[MOST_PARTS:]
            largest = largest[:MOST_PARTS]
            self.arrays["other_parts"] = self.arrays["reward_parts"][:, rest].sum(axis=1)
        else:
            rest = []
        lines = [_line(names[i], "reward_parts", i, COLORS[k % len(COLORS)]) for k, i in enumerate(largest)]
        if rest:
            lines.append(_line(f"{len(rest)} others", "other_parts", 0, OTHERS))
        panels = [_panel("reward parts, stacked", self._reward_unit(), lines, kind="stack", height=230)] if lines else []
        return _section("Reward parts", panels, note, wide=True)

    def _reward_unit(self) -> str:
        return "1/s" if float(self.episodes.about.get("reward_unit", 1.0)) != 1.0 else "1 a step"

    def _by_joint(self, title: str, name: str, limit: str, what: str, note: str, is_open: bool = True) -> dict[str, Any]:
        """Return a plot for each group of joints that differ only in their leg."""
        self.arrays[name] = self.one[name]
        panels = []
        for kind, members in groups_of([joint["name"] for joint in self.joints]):
            units = {joint_unit(name, self.joints[i]["unit"]) for i in members}
            lines = [_line(self.joints[i]["name"], name, i, COLORS[k % len(COLORS)]) for k, i in enumerate(members)]
            limits = sorted({value for i in members for value in _both(self.joints[i][limit])})
            include = limits if name == "torque" else []
            panels.append(_panel(f"{what}, {kind}", " or ".join(sorted(units)), lines, limits=limits, include=include))
        return _section(title, panels, note if any(panel["limits"] for panel in panels) else "", is_open=is_open)

    def _actions(self) -> dict[str, Any]:
        self.arrays["action"], names = self.one["action"], self.episodes.columns("action")
        panels = []
        for kind, members in groups_of(names):
            lines = [_line(names[i], "action", i, COLORS[k % len(COLORS)]) for k, i in enumerate(members)]
            panels.append(_panel(f"action, {kind}", "1", lines))
        return _section("Actions", panels, is_open=False)

    def _plain(self, name: str, labels: Sequence[str], title: str, unit: str) -> list[dict[str, Any]]:
        """Return plots of the columns of an array, at most `MOST_LINES` in each."""
        lines = [_line(label, name, i, COLORS[i % MOST_LINES]) for i, label in enumerate(labels)]
        return [_panel(title, unit, lines[i : i + MOST_LINES]) for i in range(0, len(lines), MOST_LINES)]


def joint_unit(array: str, of_position: str) -> str:
    """Return the unit of an array of joints, for a joint whose position is in radians or metres."""
    turning = of_position == "rad"
    return {"joint_pos": of_position, "joint_vel": f"{of_position}/s", "torque": "N m" if turning else "N"}[array]


def groups_of(names: Sequence[str]) -> list[tuple[str, list[int]]]:
    """Return the groups of joints whose names differ only in the words for a leg (`SIDES`), in order: their common name, and
    their numbers. A joint without such partners is a group of its own. Joints of a group with more than `MOST_LINES` form
    separate groups.
    """
    found: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        words = [word for word in re.split(r"[\W_]+", name) if word and word.lower() not in SIDES]
        found.setdefault(" ".join(words) or name, []).append(i)
    groups: list[tuple[str, list[int]]] = []
    for kind, members in found.items():
        alike = 1 < len(members) <= MOST_LINES
        groups += [(kind, members)] if alike else [(names[i], [i]) for i in members]
    return groups


def _both(limit: Any) -> list[float]:
    """Return both limits: those of a range, or a value and its negative; no limits for None."""
    return [] if limit is None else list(limit) if isinstance(limit, list) else [-limit, limit]


def without_common_words(names: Sequence[str]) -> list[str]:
    """Return names without the words that all have in common: LF_FOOT and RF_FOOT become LF and RF. A name without other
    words stays whole.
    """
    words = [[word for word in re.split(r"[\W_]+", name) if word] for name in names]
    common = set.intersection(*map(set, words)) if words else set()
    return [" ".join(w for w in own if w not in common) or name for own, name in zip(words, names, strict=True)]


def _line(label: str, series: str, column: int, color: str, dashed: bool = False) -> dict[str, Any]:
    return {"label": label, "series": series, "column": column, "color": color, "dashed": dashed}


def _panel(
    title: str,
    unit: str,
    lines: list[dict[str, Any]],
    kind: str = "lines",
    height: int = 150,
    limits: Sequence[float] = (),
    include: Sequence[float] = (),
) -> dict[str, Any]:
    return {
        "title": title,
        "unit": unit,
        "lines": lines,
        "kind": kind,
        "height": height,
        "limits": list(limits),
        "include": list(include),
    }


def _section(
    title: str, panels: list[dict[str, Any]], note: str = "", wide: bool = False, is_open: bool = True
) -> dict[str, Any]:
    return {"title": title, "panels": panels, "note": note, "wide": wide, "open": is_open}
