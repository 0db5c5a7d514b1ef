"""Figures of each episode, and an order by one of them."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from legged.episodes.stored import NO_NUMBERS, TIME_UP, Episodes
from legged.errors import ConfigError, suggest


@dataclass(frozen=True)
class Column:
    """A figure of every episode."""

    name: str
    """Name for --sort."""
    title: str
    form: str
    low_first: bool = False
    """True if the smallest value is the worst."""


COLUMNS = (
    Column("length", "time [s]", ".2f", low_first=True),
    Column("return", "return", ".2f", low_first=True),
    Column("tracking", "velocity RMSE [m/s]", ".3f"),
    Column("turning", "yaw rate RMSE [rad/s]", ".3f"),
    Column("energy", "energy [J]", ".0f"),
    Column("power", "mean power [W]", ".1f"),
    Column("torque", "largest torque [% of limit]", ".0f"),
)
"""Figures by which episodes can be sorted, as far as a task has them."""
FELL = "fell"
"""Order with failed episodes first, the shortest of them at the top, then the others by tracking error or return, the worst
first."""


@dataclass(frozen=True)
class Figures:
    """The figures of E episodes."""

    values: dict[str, np.ndarray]
    """Name of a column -> (E,); only those that the task has."""
    strained: list[str]
    """The joint with the largest share of its torque limit, in each episode; empty if none has a limit."""
    failed: np.ndarray
    """(E,)"""
    ended: list[list[str]]
    """Terms that ended each episode."""
    ends: list[str]
    """Names of everything that can end an episode."""

    @property
    def columns(self) -> list[Column]:
        """The columns there are."""
        return [column for column in COLUMNS if column.name in self.values]


def figures_of(episodes: Episodes) -> Figures:
    """Compute the figures of all episodes. Errors are root mean squares over all steps; energy is the sum of |torque *
    velocity| at the ends of control steps, over joints and time; power is energy over the length of the episode.
    """
    count, strained = len(episodes), []
    ends = [*episodes.about["terminations"], TIME_UP, NO_NUMBERS]
    numbers = range(count)

    def each(measure: Callable[[dict[str, np.ndarray]], float]) -> np.ndarray:
        return np.array([measure(episodes.of(i)) for i in numbers])

    seconds = episodes.lengths * episodes.dt
    values = {"length": seconds, "return": each(lambda one: float(one["reward"].sum(dtype=np.float64)))}
    if "command" in episodes:
        values["tracking"] = each(lambda one: _rms(one["base_lin_vel"][:, :2] - one["command"][:, :2]))
        values["turning"] = each(lambda one: _rms((one["base_ang_vel"][:, 2] - one["command"][:, 2])[:, None]))
    if "torque" in episodes:
        values["energy"] = episodes.dt * each(_work_rate)
        values["power"] = values["energy"] / seconds
        limits = np.array([joint["max_torque"] or np.inf for joint in episodes.about["joints"]], dtype=float)
        shares = np.array([np.abs(episodes.of(i)["torque"]).max(axis=0) / limits for i in numbers])
        if np.isfinite(limits).any():
            values["torque"] = 100.0 * shares.max(axis=1)
            names = [joint["name"] for joint in episodes.about["joints"]]
            strained = [names[worst] for worst in np.nan_to_num(shares, nan=np.inf).argmax(axis=1)]
    return Figures(values, strained, episodes["failed"], [episodes.ended(i) for i in numbers], ends)


def _work_rate(one: dict[str, np.ndarray]) -> float:
    """Return the sum over joints and steps of |torque * velocity| [W]."""
    return float(np.abs(one["torque"] * one["joint_vel"]).sum(dtype=np.float64))


def _rms(errors: np.ndarray) -> float:
    """Return the root of the mean over rows of the squared length of errors (T, K)."""
    return float(np.sqrt(np.square(errors, dtype=np.float64).sum(axis=1).mean()))


def order_of(figures: Figures, by: str, ended_by: str | None = None, flag: str = "--sort") -> list[int]:
    """Return the numbers of the episodes, the worst first; with `ended_by`, only of those that this term ended.

    Raises:
        ConfigError: the task lacks that figure or that term.
    """
    there = [FELL, *figures.values]
    if by not in there:
        raise ConfigError(f"{flag}: {by}: these episodes have no such figure{suggest(by, there)}")
    numbers = list(range(len(figures.ended)))
    if ended_by is not None:
        check_ended(ended_by, figures.ends)
        numbers = [i for i in numbers if ended_by in figures.ended[i]]
    if by == FELL:
        rest = figures.values.get("tracking", -figures.values["return"])
        # Failed episodes come first, sorted by length, then the others by tracking error or return.
        length = figures.values["length"]
        return sorted(numbers, key=lambda i: (0, length[i]) if figures.failed[i] else (1, -_or_worst(rest[i])))
    column = next(column for column in COLUMNS if column.name == by)
    sign = 1.0 if column.low_first else -1.0
    return sorted(numbers, key=lambda i: sign * _or_worst(figures.values[by][i], -sign))


def check_ended(name: str, ends: Sequence[str]) -> None:
    """Check that a term of that name can end an episode.

    Raises:
        ConfigError: there is no such term.
    """
    if name not in ends:
        raise ConfigError(f"--ended: {name}: no episode ends by it{suggest(name, ends)}")


def _or_worst(value: Any, sign: float = 1.0) -> float:
    """Return a number; infinity, the worst value, if it is not finite."""
    return float(value) if np.isfinite(value) else sign * np.inf


def heads_of(figures: Figures) -> list[str]:
    """Return the heads of the list's columns."""
    return ["episode", "ended by", *(column.title for column in figures.columns), *(["joint"] if figures.strained else [])]


def row_of(figures: Figures, number: int) -> list[str]:
    """Return the row of an episode."""
    ended = ", ".join(figures.ended[number]) + (" (failed)" if figures.failed[number] else "")
    cells = [f"{figures.values[column.name][number]:{column.form}}" for column in figures.columns]
    return [str(number), ended, *cells, *([figures.strained[number]] if figures.strained else [])]


def counts_text(figures: Figures) -> str:
    """Return the numbers of episodes and failures, and the terms that ended episodes, as text."""
    counts = Counter(term for terms in figures.ended for term in terms)
    ended = ", ".join(f"{count} by {term}" for term, count in counts.most_common())
    return f"{len(figures.ended)} episodes, {int(figures.failed.sum())} failed; ended: {ended}"
