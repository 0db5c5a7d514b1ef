"""What joints do on average: mean and standard deviation of angle, velocity and torque, over time and over the gait cycle."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from legged.episodes.panels import joint_unit
from legged.episodes.stored import Episodes
from legged.errors import ConfigError

SETTLE_S = 1.0
"""At the start of an episode, when a robot falls onto its feet: not counted [s]."""
PHASES = 50
"""Points of a gait cycle."""
SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 0.1, 2.0
"""Between touch-downs that are nearer a foot has bounced, between those that are farther apart the robot has stood [s]."""
UNUSUAL = 0.5
"""A cycle whose length differs from the median by more than this share of it is none of the gait: a stop, a stumble."""
MEASURED = (("joint_pos", "angle"), ("joint_vel", "velocity"), ("torque", "torque"))
"""Arrays that are summed up, and what they are called."""


@dataclass(frozen=True)
class JointStatistics:
    """Of D joints, over the steps after `SETTLE_S` of some episodes."""

    joints: list[str]
    units: dict[str, list[str]]
    """Array -> (D,) units."""
    mean: dict[str, np.ndarray]
    """Array -> (D,)"""
    std: dict[str, np.ndarray]
    """Likewise; of the steps themselves, all episodes taken together."""
    episodes: int
    """How many were longer than `SETTLE_S`."""
    steps: int
    lost: int
    """Steps that are left out because their numbers are not finite: physics blew up."""
    foot: str
    """By whose touch-downs cycles are told; empty if the task has no feet."""
    cycles: dict[str, np.ndarray]
    """Array -> (C, PHASES, D) values over the phase of each cycle, from one touch-down on to the next."""
    cycle_s: np.ndarray
    """(C,) length of each cycle [s]."""
    duty: dict[str, float]
    """Foot -> share of the cycles' steps at whose end it feels the ground, like the duty factor of an evaluation:
    `feet_contact` holds each contact a step longer.
    """

    def over_cycle(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation over cycles, (PHASES, D) each."""
        return self.cycles[name].mean(axis=0), self.cycles[name].std(axis=0)


def joint_statistics(episodes: Episodes, where: str = "POLICY") -> JointStatistics:
    """Sum up the joints of some episodes; `where` is the flag that asks for it.

    A cycle begins when the first foot touches down and ends when it does so the next time, if that is neither too soon nor
    too late (`SHORTEST_CYCLE_S`, `LONGEST_CYCLE_S`, `UNUSUAL`); values are interpolated linearly at `PHASES` equal parts.
    Steps whose numbers are not finite are left out, and cycles that have one.

    Raises:
        ConfigError: the task's joints are not known, or no episode is long enough.
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
    """Return the first step of every cycle and that of the next one, of a foot that is in contact (T,) or not."""
    down = np.asarray(contact) > 0.5
    touched = np.flatnonzero(down[1:] & ~down[:-1]) + 1
    pairs = [(int(begin), int(end)) for begin, end in pairwise(touched)]
    return [(b, e) for b, e in pairs if SHORTEST_CYCLE_S <= (e - b) * dt <= LONGEST_CYCLE_S]


def resampled(values: np.ndarray, begin: int, end: int) -> np.ndarray:
    """Return (PHASES, D) values (T, D) from row `begin` on up to, and without, row `end`, interpolated."""
    at = begin + (end - begin) * np.arange(PHASES) / PHASES
    below = np.floor(at).astype(int)
    share = (at - below)[:, None]
    return (1.0 - share) * values[below] + share * values[np.minimum(below + 1, end)]


def check_comparable(one: JointStatistics, other: JointStatistics) -> None:
    """Check that two policies move the same joints.

    Raises:
        ConfigError: they do not.
    """
    if one.joints != other.joints:
        only = [name for name in (*one.joints, *other.joints) if (name in one.joints) != (name in other.joints)]
        differing = ", ".join(only[:4]) or "in another order"
        raise ConfigError(f"POLICY: the two have other joints ({differing}); take policies of one robot")
