"""Statistics of joints over time and over the gait cycle, for one policy or two: tables, a page and a figure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from legged.episodes.stored import Episodes, joint_unit
from legged.errors import ConfigError
from legged.evaluation.reports.document import Cell, Heading, Number, Paragraph, Part, Picture, Table, write_pages
from legged.figures import COLORS, STYLES, figure
from legged.process.paths import relative

NAME = "joint_statistics"
"""Name of the written files without their endings."""
PANEL_INCHES = 3.6, 1.45
"""Width and height of a panel of the figure [inches]."""
SETTLE_S = 1.0
"""Duration left out at the start of every episode, while the robot drops onto its feet [s]."""
PHASES = 50
"""Number of evenly spaced points in a gait cycle."""
SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 0.1, 2.0
"""Limits of a gait cycle's length [s]. A shorter cycle is a bounce of the foot, and a longer cycle contains a stop."""
UNUSUAL = 0.5
"""Largest relative deviation of a cycle's length from the median. Cycles that deviate more, as in stumbles, are left out."""
MEASURED = (("joint_pos", "angle"), ("joint_vel", "velocity"), ("torque", "torque"))
"""Names and titles of the recorded arrays whose statistics are computed."""


@dataclass(frozen=True)
class JointStatistics:
    """Statistics of D joints over some episodes, without the first `SETTLE_S` of each episode."""

    joints: list[str]
    units: dict[str, list[str]]
    mean: dict[str, np.ndarray]
    std: dict[str, np.ndarray]
    """`units`, `mean` and `std` map names of recorded arrays to (D,) values. Every step has the same weight."""
    episodes: int
    """Number of episodes longer than `SETTLE_S`."""
    steps: int
    lost: int
    """Number of steps that are left out because they hold numbers that are not finite."""
    cycles: dict[str, np.ndarray]
    """Name of a recorded array -> (C, PHASES, D) values at `PHASES` points of each of C gait cycles."""
    cycle_s: np.ndarray
    """(C,) length of each cycle [s]."""
    duty: dict[str, float]
    """Foot -> duty factor: share of the cycles' steps that end with the foot in contact. Contact is judged by the force at
    the end of the step, as in `legged evaluate`. (In the array `feet_contact`, each contact lasts a step longer.)
    """

    def over_cycle(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and the standard deviation of the array `name` over the cycles, (PHASES, D) each."""
        return self.cycles[name].mean(axis=0), self.cycles[name].std(axis=0)


def joint_statistics(episodes: Episodes) -> JointStatistics:
    """Compute the statistics of some episodes.

    A cycle lasts from one touch-down of the first foot to the next. Its length is limited by `SHORTEST_CYCLE_S`,
    `LONGEST_CYCLE_S` and `UNUSUAL`, and its values are interpolated linearly at `PHASES` points. Steps with numbers that are
    not finite are left out, and so are the cycles with these steps.

    Raises:
        ConfigError: the task has no joints with motors, or no episode is long enough.
    """
    joints, feet, task = episodes.about["joints"], list(episodes.about.get("feet", [])), episodes.about["task"]
    if not joints:
        raise ConfigError(f"POLICY: '{task}' has no motors that drive one joint each")
    names = [name for name, _ in MEASURED if name in episodes]
    settled = round(SETTLE_S / episodes.dt)
    chosen = np.flatnonzero(episodes.lengths > settled).tolist()
    if not chosen:
        raise ConfigError(f"POLICY: no episode of '{task}' is longer than {SETTLE_S:g} s")
    parts: list[dict[str, np.ndarray]] = []
    spans: list[tuple[int, int, dict[str, np.ndarray]]] = []
    for i in chosen:
        one = {name: array[settled:] for name, array in episodes.of(i).items()}
        known = np.all([np.isfinite(one[name]).all(axis=1) for name in names], axis=0)
        parts.append({name: one[name][known] for name in names})
        if feet:
            found = cycles_of(one["feet_contact"][:, 0], episodes.dt)
            spans += [(begin, end, one) for begin, end in found if known[begin : end + 1].all()]
    values = {name: np.concatenate([part[name] for part in parts]).astype(np.float64) for name in names}
    steps = len(values[names[0]])
    if not steps:
        raise ConfigError(f"POLICY: physics blew up: no step of '{task}' after {SETTLE_S:g} s has finite numbers")
    usual = float(np.median([end - begin for begin, end, _ in spans])) if spans else 0.0
    spans = [(begin, end, one) for begin, end, one in spans if abs(end - begin - usual) <= UNUSUAL * usual]
    contacts = [one["feet_force"][begin:end, :, 2] > episodes.about["contact_threshold"] for begin, end, one in spans]
    return JointStatistics(
        joints=[joint["name"] for joint in joints],
        units={name: [joint_unit(name, joint["unit"]) for joint in joints] for name in names},
        mean={name: value.mean(axis=0) for name, value in values.items()},
        std={name: value.std(axis=0) for name, value in values.items()},
        episodes=len(chosen),
        steps=steps,
        lost=int((episodes.lengths[chosen] - settled).sum()) - steps,
        cycles={name: np.array([resampled(one[name], b, e) for b, e, one in spans]) for name in names} if spans else {},
        cycle_s=np.array([(end - begin) * episodes.dt for begin, end, _ in spans]),
        duty=dict(zip(feet, np.concatenate(contacts).mean(axis=0).tolist(), strict=True)) if spans else {},
    )


def cycles_of(contact: np.ndarray, dt: float) -> list[tuple[int, int]]:
    """Return (first step, first step of the next cycle) for every gait cycle in the contacts (T,) of a foot."""
    down = contact > 0.5
    touched = np.flatnonzero(down[1:] & ~down[:-1]) + 1
    pairs = [(int(begin), int(end)) for begin, end in pairwise(touched)]
    return [(b, e) for b, e in pairs if SHORTEST_CYCLE_S <= (e - b) * dt <= LONGEST_CYCLE_S]


def resampled(values: np.ndarray, begin: int, end: int) -> np.ndarray:
    """Return the rows `begin` to `end` (exclusive) of values (T, D), interpolated linearly to (PHASES, D)."""
    at = begin + (end - begin) * np.arange(PHASES) / PHASES
    below = np.floor(at).astype(int)
    share = (at - below)[:, None]
    return (1.0 - share) * values[below] + share * values[np.minimum(below + 1, end)]


# ---- report ------------------------------------------------------------------------------------------------------------


def write_statistics(folder: Path, found: Mapping[str, JointStatistics]) -> None:
    """Write statistics into `folder` as Markdown, HTML and PNG. `found` maps labels of policies to their statistics.

    Raises:
        RunError: a file can't be written.
    """
    picture = folder / f"{NAME}.png"
    draw_statistics(found, picture)
    parts: list[Part] = [Paragraph(notes_of(found))]
    for heading, table in tables_of(found).items():
        parts += [Heading(heading), table]
    title = "Joint statistics" if len(found) == 1 else "Joint statistics of two policies"
    write_pages(folder / NAME, title, [*parts, Heading("Figure"), Picture(picture, "joint statistics")])
    for ending in (".md", ".html", ".png"):
        print(f"written: {relative(folder / f'{NAME}{ending}')}")


def tables_of(found: Mapping[str, JointStatistics]) -> dict[str, Table]:
    """Return title -> table. Each quantity has a table with a row for each joint. The columns are the mean and the standard
    deviation of each policy and, for two policies, the difference of the means. The last table describes gait cycles, if any.

    Raises:
        ConfigError: the joints of two policies differ.
    """
    several, tables = list(found.values()), {}
    one, other = several[0].joints, several[-1].joints
    if one != other:
        differing = ", ".join([name for name in (*one, *other) if (name in one) != (name in other)][:4]) or "in another order"
        raise ConfigError(f"POLICY: the joints of the two policies differ ({differing}); name policies of the same robot")
    names = [f", {label}" if len(found) > 1 else "" for label in found]
    for name, title in _measured(found):
        heads = ["joint", *(f"{what}{of}" for of in names for what in ("mean", "standard deviation"))]
        columns = [values for one in several for values in (one.mean[name], one.std[name])]
        cells: list[Sequence[Cell]] = [one, *([_number(value) for value in column] for column in columns)]
        if len(several) == 2:
            heads.append("difference of the means")
            cells.append([_number(value, "+.3f") for value in several[1].mean[name] - several[0].mean[name]])
        rows = list(zip(*cells, strict=True))
        tables[f"{title} [{_unit(found, name)}]"] = Table(heads, rows)
    if any(len(one.cycle_s) for one in several):
        lines = {"cycles": [_number(len(one.cycle_s), ".0f") for one in several]}
        for label, of in (("mean", np.mean), ("standard deviation", np.std)):
            lines[f"length, {label} [s]"] = [_number(of(one.cycle_s) if len(one.cycle_s) else None) for one in several]
        for foot in dict.fromkeys(foot for one in several for foot in one.duty):
            shares = [100.0 * one.duty[foot] if foot in one.duty else None for one in several]
            lines[f"{foot} in contact [%]"] = [_number(share, ".0f") for share in shares]
        tables["gait cycle"] = Table(["measure", *found], [[label, *cells] for label, cells in lines.items()])
    return tables


def _measured(found: Mapping[str, JointStatistics]) -> list[tuple[str, str]]:
    return [(name, title) for name, title in MEASURED if all(name in one.mean for one in found.values())]


def _unit(found: Mapping[str, JointStatistics], name: str) -> str:
    return " or ".join(dict.fromkeys(next(iter(found.values())).units[name]))


def _number(value: Any, form: str = ".3f") -> Number:
    return Number("none", None) if value is None else Number(f"{value:{form}}", float(value))


def notes_of(found: Mapping[str, JointStatistics]) -> str:
    """Return sentences that say from which episodes and steps the statistics are computed."""
    parts = []
    for label, one in found.items():
        lost = f"; {one.lost} more are left out because physics blew up in them" if one.lost else ""
        parts.append(f"{label}: {one.episodes} episodes, {one.steps} control steps{lost}.")
    parts.append(f"The first {SETTLE_S:g} s of an episode are left out. Standard deviations are those of single steps.")
    feet = {next(iter(one.duty)) for one in found.values() if one.duty}
    if feet:
        parts.append(f"A gait cycle goes from one touch-down of {' or '.join(sorted(feet))} to its next.")
    return " ".join(parts)


def draw_statistics(found: Mapping[str, JointStatistics], path: Path) -> None:
    """Draw the mean of every joint over the gait cycle, with a band of one standard deviation. If a policy has no
    cycles, draw the means and standard deviations of all joints side by side. Each policy has its own colour and line style.
    """
    cyclic = all(len(one.cycle_s) for one in found.values())
    names, first = _measured(found), next(iter(found.values()))
    joints, (width, height) = first.joints, PANEL_INCHES
    rows, tall = (len(joints), height * len(joints) + 0.9) if cyclic else (1, 0.34 * len(joints) + 1.6)
    at, phase = np.arange(len(joints)), 100.0 * np.arange(PHASES) / PHASES
    with figure(path, (width * len(names) + 0.6, tall), rows, len(names)) as (drawn, axes):
        for column, (name, title) in enumerate(names):
            panels = axes[:, column]
            panels[0].set_title(title, fontsize="medium")
            for k, (label, one) in enumerate(found.items()):
                if not cyclic:
                    place, look = at + 0.22 * (k - 0.5 * (len(found) - 1)), {"fmt": "os"[k], "ms": 4, "capsize": 2}
                    panels[0].errorbar(one.mean[name], place, xerr=one.std[name], label=label, color=COLORS[k], **look)
                    continue
                for axis, mean, std in zip(panels, *(part.T for part in one.over_cycle(name)), strict=True):
                    axis.plot(phase, mean, STYLES[k], color=COLORS[k], lw=1.4, label=label)
                    axis.fill_between(phase, mean - std, mean + std, color=COLORS[k], alpha=0.2, lw=0)
            if not cyclic:
                panels[0].set_yticks(at, [""] * len(at) if column else joints, fontsize="small")
                panels[0].invert_yaxis()
                panels[0].set_xlabel(f"mean and standard deviation [{_unit(found, name)}]", fontsize="small")
                continue
            for axis, joint, unit in zip(panels, joints, first.units[name], strict=True):
                axis.set_xlim(0, 100)
                axis.tick_params(labelsize="small", labelbottom=axis is panels[-1])
                axis.set_ylabel(f"[{unit}]" if column else f"{joint}\n[{unit}]", fontsize="small")
            panels[-1].set_xlabel("gait cycle [%]", fontsize="small")
        if len(found) > 1:
            handles, _ = axes[0, 0].get_legend_handles_labels()
            drawn.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
