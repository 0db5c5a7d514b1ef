"""Statistics of joints: mean and standard deviation of angle, velocity and torque, over time and over the gait cycle."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from legged.episodes.panels import joint_unit
from legged.episodes.stored import Episodes
from legged.errors import ConfigError

SETTLE_S = 1.0
"""Time at the start of an episode that is not counted, while a robot drops onto its feet [s]."""
PHASES = 50
"""Points of a gait cycle."""
SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 0.1, 2.0
"""Limits of a gait cycle: touch-downs closer together are bounces, those further apart have a stop between them [s]."""
UNUSUAL = 0.5
"""Cycles whose length differs from the median by more than this share are left out: stops and stumbles."""
MEASURED = (("joint_pos", "angle"), ("joint_vel", "velocity"), ("torque", "torque"))
"""Arrays with statistics, and their titles."""


@dataclass(frozen=True)
class JointStatistics:
    """Statistics of D joints, over the steps after `SETTLE_S` of some episodes."""

    joints: list[str]
    units: dict[str, list[str]]
    """Array -> (D,) units."""
    mean: dict[str, np.ndarray]
    """Array -> (D,)"""
    std: dict[str, np.ndarray]
    """Array -> (D,) standard deviation over the steps of all episodes."""
    episodes: int
    """Number of episodes longer than `SETTLE_S`."""
    steps: int
    lost: int
    """Number of steps left out because their numbers are not finite."""
    foot: str
    """Foot whose touch-downs delimit cycles; empty if the task has no feet."""
    cycles: dict[str, np.ndarray]
    """Array -> (C, PHASES, D) values over the phase of each cycle, from one touch-down on to the next."""
    cycle_s: np.ndarray
    """(C,) length of each cycle [s]."""
    duty: dict[str, float]
    """Foot -> share of the cycles' steps at whose end it has contact, like the duty factor of an evaluation; `feet_contact`
    holds each contact a step longer.
    """

    def over_cycle(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation over cycles, (PHASES, D) each."""
        return self.cycles[name].mean(axis=0), self.cycles[name].std(axis=0)


def joint_statistics(episodes: Episodes, where: str = "POLICY") -> JointStatistics:
    """Compute the statistics of some episodes; `where` is the argument for errors.

    A cycle lasts from a touch-down of the first foot to its next one, within the limits `SHORTEST_CYCLE_S`, `LONGEST_CYCLE_S`
    and `UNUSUAL`. Its values are interpolated linearly at `PHASES` points. Steps with numbers that are not finite are left
    out, and so are their cycles.

    Raises:
        ConfigError: the task has no joints with motors, or no episode is long enough.
    """
    if not episodes.about["joints"]:
        raise ConfigError(f"{where}: '{episodes.about['task']}' has no joints with a motor each")
    names = [name for name, _ in MEASURED if name in episodes]
    settled = round(SETTLE_S / episodes.dt)
    chosen = [i for i in range(len(episodes)) if episodes.lengths[i] > settled]
    if not chosen:
        raise ConfigError(f"{where}: no episode of '{episodes.about['task']}' is longer than {SETTLE_S:g} s")
    feet = list(episodes.about.get("feet", []))
    pooled: dict[str, list[np.ndarray]] = {name: [] for name in names}
    lost = 0
    spans: list[tuple[int, int, dict[str, np.ndarray]]] = []
    for i in chosen:
        one = {name: array[settled:] for name, array in episodes.of(i).items()}
        known = np.all([np.isfinite(one[name]).all(axis=1) for name in names], axis=0)
        lost += int((~known).sum())
        for name in names:
            pooled[name].append(one[name][known])
        if feet:
            whole = (span for span in cycles_of(one["feet_contact"][:, 0], episodes.dt) if known[span[0] : span[1] + 1].all())
            spans += [(*span, one) for span in whole]
    if not any(len(part) for part in pooled[names[0]]):
        raise ConfigError(f"{where}: physics blew up: no step of '{episodes.about['task']}' after {SETTLE_S:g} s has numbers")
    usual = float(np.median([end - begin for begin, end, _ in spans])) if spans else 0.0
    spans = [(begin, end, one) for begin, end, one in spans if abs(end - begin - usual) <= UNUSUAL * usual]
    lengths = [(end - begin) * episodes.dt for begin, end, _ in spans]
    contacts = [one["feet_force"][begin:end, :, 2] > episodes.about["contact_threshold"] for begin, end, one in spans]
    cycles = {name: [resampled(one[name], begin, end) for begin, end, one in spans] for name in names}
    values = {name: np.concatenate(parts).astype(np.float64) for name, parts in pooled.items()}
    joints = episodes.about["joints"]
    duty = np.concatenate(contacts).mean(axis=0) if contacts else np.zeros(len(feet))
    return JointStatistics(
        joints=[joint["name"] for joint in joints],
        units={name: [joint_unit(name, joint["unit"]) for joint in joints] for name in names},
        mean={name: value.mean(axis=0) for name, value in values.items()},
        std={name: value.std(axis=0) for name, value in values.items()},
        episodes=len(chosen),
        steps=len(values[names[0]]),
        lost=lost,
        foot=feet[0] if feet else "",
        cycles={name: np.array(parts) for name, parts in cycles.items()} if lengths else {},
        cycle_s=np.array(lengths),
        duty=dict(zip(feet, duty.tolist(), strict=True)) if lengths else {},
    )


def cycles_of(contact: np.ndarray, dt: float) -> list[tuple[int, int]]:
    """Return the first step of every cycle and that of the next, from the contacts (T,) of a foot."""
    down = np.asarray(contact) > 0.5
    touched = np.flatnonzero(down[1:] & ~down[:-1]) + 1
    pairs = [(int(begin), int(end)) for begin, end in pairwise(touched)]
    return [(b, e) for b, e in pairs if SHORTEST_CYCLE_S <= (e - b) * dt <= LONGEST_CYCLE_S]


def resampled(values: np.ndarray, begin: int, end: int) -> np.ndarray:
    """Return (PHASES, D) values, interpolated from the rows `begin` to `end` (exclusive) of values (T, D)."""
    at = begin + (end - begin) * np.arange(PHASES) / PHASES
    below = np.floor(at).astype(int)
    share = (at - below)[:, None]
    return (1.0 - share) * values[below] + share * values[np.minimum(below + 1, end)]


def check_comparable(one: JointStatistics, other: JointStatistics) -> None:
    """Check that two policies have the same joints.

    Raises:
        ConfigError: their joints differ.
    """
    if one.joints != other.joints:
        only = [name for name in (*one.joints, *other.joints) if (name in one.joints) != (name in other.joints)]
        differing = ", ".join(only[:4]) or "in another order"
        raise ConfigError(f"POLICY: the two have other joints ({differing}); name policies of the same robot")
