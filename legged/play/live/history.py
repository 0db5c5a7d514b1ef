"""The last seconds of one robot: commands, velocities, foot contacts and reward terms."""

from dataclasses import dataclass

import numpy as np

from legged.envs import BaseTask, LeggedRobot
from legged.policies.episodes import unit_of

KEPT_S = 10.0
"""Length of the history [s]."""
SMOOTHED_S = 0.2
"""Window over which rewards are averaged, because some terms occur in single steps, such as touch-downs [s]."""
AXES, UNITS = ("vx", "vy", "yaw rate"), ("m/s", "m/s", "rad/s")
"""Names and units of the components of a command."""


@dataclass(frozen=True)
class Sample:
    """A robot at the end of a control step."""

    time: float
    """Simulated time since the start of the session [s]."""
    actual: np.ndarray
    """(3,) vx, vy [m/s] and yaw rate [rad/s], base frame; in tasks without commands only vx, world frame, the rest NaN."""
    commanded: np.ndarray
    """(3,) commanded vx, vy [m/s] and yaw rate [rad/s]; NaN in tasks without commands."""
    contacts: np.ndarray
    """(F,) 1 for feet on the ground, 0 for others."""
    rewards: np.ndarray
    """(terms,) each scaled reward term, in the task's own unit."""


class History:
    """Samples of one robot, one for each control step, oldest first."""

    def __init__(self, task: BaseTask) -> None:
        """Keep KEPT_S of a task's robot."""
        self.terms = task.rewards.names
        self.feet = task.robot.feet_names if isinstance(task, LeggedRobot) else ()
        self.per_second = task.cfg.rewards.times_dt
        """Rewards are counted per second, not per step."""
        self.dt = task.dt
        self.length = max(2, round(KEPT_S / task.dt))
        self._samples: list[Sample] = []

    def __len__(self) -> int:
        return len(self._samples)

    def clear(self) -> None:
        """Remove all samples."""
        self._samples.clear()

    def add(self, task: BaseTask, robot: int, time: float) -> None:
        """Add the last control step of a task's robot; a step that ended an episode is NaN."""
        if bool(task.reset_buf[robot]):
            nothing = np.full(3, np.nan)
            feet, terms = np.full(len(self.feet), np.nan), np.full(len(self.terms), np.nan)
            sample = Sample(time, nothing, nothing, feet, terms)
        else:
            sample = sample_of(task, robot, time, len(self.feet))
        self._samples.append(sample)
        del self._samples[: -self.length]

    def times(self) -> np.ndarray:
        """Return the times (K,) of the samples relative to the newest one [s]."""
        times = np.array([sample.time for sample in self._samples])
        return times - times[-1] if len(times) else times

    def commanded(self) -> np.ndarray:
        """Return `Sample.commanded` as (3, K)."""
        return np.array([sample.commanded for sample in self._samples]).reshape(-1, 3).T

    def actual(self) -> np.ndarray:
        """Return `Sample.actual` as (3, K)."""
        return np.array([sample.actual for sample in self._samples]).reshape(-1, 3).T

    def contacts(self) -> np.ndarray:
        """Return `Sample.contacts` as (F, K)."""
        return np.array([sample.contacts for sample in self._samples]).reshape(-1, len(self.feet)).T

    def rewards(self) -> np.ndarray:
        """Return the rewards as (terms, K), averaged over the SMOOTHED_S before each sample."""
        values = np.array([sample.rewards for sample in self._samples]).reshape(-1, len(self.terms)).T
        width = max(1, round(SMOOTHED_S / self.dt))
        counted = np.cumsum(np.isfinite(values), axis=1, dtype=float)
        summed = np.cumsum(np.nan_to_num(values), axis=1)
        for sums in (counted, summed):
            sums[:, width:] -= sums[:, :-width].copy()
        means = np.divide(summed, counted, out=np.full(values.shape, np.nan), where=counted > 0)
        return np.where(np.isfinite(values), means, np.nan)


def sample_of(task: BaseTask, robot: int, time: float, feet: int) -> Sample:
    """Return a sample of a robot's present state."""
    rewards = (task.rewards.last[:, robot] / unit_of(task)).cpu().numpy().astype(float)
    unknown = np.full(3, np.nan)
    if not isinstance(task, LeggedRobot):
        speed = float(task.physics.qvel[robot, 0])
        return Sample(time, np.array([speed, np.nan, np.nan]), unknown, np.zeros(feet), rewards)
    lin, ang = task.base_lin_vel[robot].tolist(), task.base_ang_vel[robot].tolist()
    commanded = np.array(task.commands[robot, :3].tolist())
    contacts = task.contacts.in_contact[robot].cpu().numpy().astype(float)
    return Sample(time, np.array([lin[0], lin[1], ang[2]]), commanded, contacts, rewards)
