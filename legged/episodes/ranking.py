"""Key figures of each episode, such as its length and return, and the order of episodes by one of these figures."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from legged.episodes.stored import NO_NUMBERS, TIME_UP, Episodes
from legged.errors import ConfigError, suggest

COLUMNS = {
    "length": ("time [s]", ".2f"),
    "return": ("return", ".2f"),
    "tracking": ("velocity RMSE [m/s]", ".3f"),
    "turning": ("yaw rate RMSE [rad/s]", ".3f"),
    "energy": ("energy [J]", ".0f"),
    "power": ("mean power [W]", ".1f"),
    "torque": ("largest torque [% of limit]", ".0f"),
}
"""Name of a figure by which episodes can be sorted -> title and number format. A task may lack some of the figures."""
LOW_FIRST = ("length", "return")
"""Figures of which the smallest value is the worst."""
FELL = "fell"
"""Name of an order: failed episodes come first, from the shortest to the longest. The others follow, sorted by tracking error
or return, the worst first."""


@dataclass(frozen=True)
class Figures:
    """The figures of E episodes."""

    values: dict[str, np.ndarray]
    """Name in COLUMNS -> (E,) figures, in the order of COLUMNS. Figures that the task lacks are left out."""
    strained: list[str]
    """For each episode, the joint that came closest to its torque limit; empty if no joint has a limit."""
    failed: np.ndarray
    """(E,) True for episodes that ended in a failure."""
    ended: list[list[str]]
    """Names of the terms that ended each episode."""
    ends: list[str]
    """Names of all terms that can end an episode, followed by TIME_UP and NO_NUMBERS."""


def figures_of(episodes: Episodes) -> Figures:
    """Compute the figures of all episodes. Errors are root mean squares over all steps. Energy is |torque * velocity| at the
    ends of control steps, summed over joints and integrated over time. Power is energy divided by the episode's length.
    """
    numbers, strained = range(len(episodes)), []
    ends = [*episodes.about["terminations"], TIME_UP, NO_NUMBERS]

    def each(measure: Callable[[dict[str, np.ndarray]], float]) -> np.ndarray:
        return np.array([measure(episodes.of(i)) for i in numbers])

    def rms(errors: np.ndarray) -> float:  # root mean square of the norms of errors (T, K)
        return float(np.sqrt(np.square(errors, dtype=np.float64).sum(axis=1).mean()))

    seconds = episodes.lengths * episodes.dt
    values = {"length": seconds, "return": each(lambda one: float(one["reward"].sum(dtype=np.float64)))}
    if "command" in episodes:
        values["tracking"] = each(lambda one: rms(one["base_lin_vel"][:, :2] - one["command"][:, :2]))
        values["turning"] = each(lambda one: rms(one["base_ang_vel"][:, 2:] - one["command"][:, 2:]))
    if "torque" in episodes:
        values["energy"] = episodes.dt * each(lambda one: np.abs(one["torque"] * one["joint_vel"]).sum(dtype=np.float64))
        values["power"] = values["energy"] / seconds
        limits = np.array([joint["max_torque"] or np.inf for joint in episodes.about["joints"]], dtype=float)
        shares = np.array([np.abs(episodes.of(i)["torque"]).max(axis=0) / limits for i in numbers])
        if np.isfinite(limits).any():
            values["torque"] = 100.0 * shares.max(axis=1)
            names = [joint["name"] for joint in episodes.about["joints"]]
            strained = [names[worst] for worst in np.nan_to_num(shares, nan=np.inf).argmax(axis=1)]
    return Figures(values, strained, episodes["failed"], [episodes.ended(i) for i in numbers], ends)


def order_of(figures: Figures, by: str, ended_by: str | None = None) -> list[int]:
    """Return the numbers of the episodes, the worst first. With `ended_by`, only episodes that this term ended are listed.

    Raises:
        ConfigError: the episodes have no figure `by`, or no term `ended_by` can end them.
    """
    there = [FELL, *figures.values]
    if by not in there:
        raise ConfigError(f"--sort: {by}: these episodes have no such figure{suggest(by, there)}")
    if ended_by is not None:
        check_ended(ended_by, figures.ends)
    values, failed = figures.values, figures.failed.astype(bool)
    figure = ("tracking" if "tracking" in values else "return") if by == FELL else by
    key = values[figure] if figure in LOW_FIRST else -values[figure]
    key = np.where(np.isfinite(key), key, -np.inf)
    order = np.lexsort((np.where(failed, values["length"], key), ~failed)) if by == FELL else np.argsort(key, kind="stable")
    return [int(i) for i in order if ended_by is None or ended_by in figures.ended[i]]


def check_ended(name: str, ends: Sequence[str]) -> None:
    """Check that a term called `name` can end an episode.

    Raises:
        ConfigError: there is no such term.
    """
    if name not in ends:
        raise ConfigError(f"--ended: {name}: no such term ends episodes{suggest(name, ends)}")


def listing(figures: Figures, numbers: Sequence[int]) -> tuple[list[str], list[list[str]]]:
    """Return the headings of the list of episodes, and the rows of the episodes `numbers`."""
    joint = ["joint"] if figures.strained else []
    rows = []
    for i in numbers:
        ended = ", ".join(figures.ended[i]) + (" (failed)" if figures.failed[i] else "")
        cells = [f"{values[i]:{COLUMNS[name][1]}}" for name, values in figures.values.items()]
        rows.append([str(i), ended, *cells, *(figures.strained[i] for _ in joint)])
    return ["episode", "ended by", *(COLUMNS[name][0] for name in figures.values), *joint], rows


def counts_text(figures: Figures) -> str:
    """Return a text with the number of episodes, of failed ones, and of those that each term ended."""
    counts = Counter(term for terms in figures.ended for term in terms)
    ended = ", ".join(f"{count} by {term}" for term, count in counts.most_common())
    return f"{len(figures.ended)} episodes, {int(figures.failed.sum())} failed; ended: {ended}"
