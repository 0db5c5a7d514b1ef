"""A parametric drive fitted to a log: P and D gains, delay, torque-speed line of the motor and friction of the joint.

The formulas are those of legged/mdp/actuators/. For each delay the Levenberg-Marquardt method minimises the squared error of
the torque; the delay with the smallest error is chosen.
"""

from dataclasses import dataclass, replace

import numpy as np
from mujoco.minimize import least_squares

from legged.fitting.log import ActuatorLog

SEEN = 0.002
"""The motor's torque-speed line is identified only if it limits at least this share of the samples."""
PEAK, LIMITS = ("breakaway", "stribeck_velocity"), ("stall_torque", "no_load_speed")
"""Parameters that a fit may leave out: those of a friction peak, and those of the motor's torque-speed line."""
MOST_SAMPLES = 40_000
"""Approximate largest number of samples in a search. The samples are spread evenly over the log."""
ROUGHLY = 4_000
"""Approximate largest number of samples in each of the first searches, which try all delays."""
SMOOTHING = 0.1
"""Speed below which Coulomb friction fades [rad/s]."""
WORTH = 0.005
"""A friction peak at low speed is identified only if it reduces the squared error by at least this share."""
NARROWEST, WIDEST = 0.5 * SMOOTHING, 0.1
"""Range of identifiable Stribeck velocities. It begins at NARROWEST [rad/s], because friction fades below that speed. It ends
at WIDEST times the largest speed, because a wider "peak" would fit other effects of speed."""


@dataclass(frozen=True)
class Drive:
    """Parameters of a drive, shared by all joints of a fit."""

    stiffness: float
    """[N m/rad]"""
    damping: float
    """[N m s/rad]"""
    coulomb: float
    """[N m]"""
    breakaway: float
    """[N m]"""
    stribeck_velocity: float
    """[rad/s]"""
    viscous: float
    """[N m s/rad]"""
    stall_torque: float = np.inf
    """[N m]; infinite where the log shows no limit."""
    no_load_speed: float = np.inf
    """[rad/s]"""
    effort: float = np.inf
    """[N m]"""
    delay: float = 0.0
    """[s]"""

    def torques(self, error: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the torques [N m] for position errors (delayed target - position) [rad] and velocities [rad/s]."""
        asked = self.stiffness * error - self.damping * velocity
        low: float | np.ndarray = -self.effort
        high: float | np.ndarray = self.effort
        if np.isfinite(self.stall_torque):
            fastest = self.no_load_speed * (1.0 + min(self.effort / self.stall_torque, 1e6))
            share = np.clip(velocity, -fastest, fastest) / self.no_load_speed
            low = np.maximum(self.stall_torque * (-1.0 - share), low)
            high = np.minimum(self.stall_torque * (1.0 - share), high)
        return np.clip(asked, low, high) - self.friction(velocity)

    def friction(self, velocity: np.ndarray) -> np.ndarray:
        """Return the friction torques [N m] at velocities [rad/s]."""
        slow = np.exp(-((velocity / self.stribeck_velocity) ** 2))
        dry = self.coulomb + (self.breakaway - self.coulomb) * slow
        return dry * np.tanh(velocity / SMOOTHING) + self.viscous * velocity

    def predict(self, log: ActuatorLog) -> np.ndarray:
        """Return the drive's torques (T, D) [N m] for the targets, positions and velocities of a log."""
        return self.torques(delayed(log, self.delay / log.dt) - log.position, log.velocity)


def delayed(log: ActuatorLog, samples: float) -> np.ndarray:
    """Return the targets (T, D) of a log [rad], delayed by a number of samples and interpolated linearly. A run's first
    target also holds before the delay has passed.
    """
    first = np.maximum.accumulate(np.where(np.r_[True, np.diff(log.run) != 0], np.arange(len(log.run)), 0))
    whole = int(np.floor(samples))
    share = samples - whole
    rows = np.arange(len(log.run))
    near, far = (log.target[np.maximum(rows - shift, first)] for shift in (whole, whole + 1))
    return near if share == 0.0 else (1.0 - share) * near + share * far


def fit_drive(log: ActuatorLog, longest_delay: float = 0.05) -> Drive:
    """Fit a drive to the torques of a log, without the held-out samples; delays are at most `longest_delay` [s]. If the log
    holds both gains, they are kept. Otherwise the damping includes the viscous friction, which cannot be identified
    separately. Breakaway friction equals Coulomb friction unless the log shows a friction peak at low speed.
    """
    every = np.flatnonzero(~log.held_out)
    effort = np.inf if log.torque_limit is None else float(log.torque_limit.max())
    gains = ("viscous",) if log.has_gains else ("stiffness", "damping")

    def search(
        samples: float, start: Drive, limited: bool, most: int = MOST_SAMPLES, peaked: bool = True
    ) -> tuple[float, Drive]:
        rows = every[:: max(1, round(len(every) * len(log.joint_names) / most))]
        position, velocity, torque = (getattr(log, name)[rows].ravel() for name in ("position", "velocity", "torque"))
        error = delayed(log, samples)[rows].ravel() - position
        free = (*gains, "coulomb", *(PEAK if peaked else ()), *(LIMITS if limited else ()))
        return _search(replace(start, delay=samples * log.dt), error, velocity, torque, free)

    # The first searches try every delay in whole samples, with and without the motor's torque-speed line.
    start = _start(log, effort)
    torques, speeds = np.abs(log.torque[every]), np.abs(log.velocity[every])
    limits = replace(start, stall_torque=1.2 * torques.max(), no_load_speed=1.5 * max(speeds.max(), 1.0))
    delays = np.arange(0, int(longest_delay / log.dt + 1e-6) + 1)
    tried = [search(float(k), of, of is limits, ROUGHLY) for k in delays for of in (start, limits)]
    best = min(tried, key=lambda one: one[0])[1]
    free = replace(best, stall_torque=np.inf, no_load_speed=np.inf)
    reduced = np.abs(best.predict(log)[every] - free.predict(log)[every]) > 1e-6  # the torque-speed line limits these samples
    limited = bool(np.isfinite(best.stall_torque)) and float(np.mean(reduced)) >= SEEN
    best = best if limited else free
    found = search(best.delay / log.dt, best, limited)
    for step in (1.0, 0.5, 0.25, 0.1):
        near = found[1].delay / log.dt + step * np.array([-1.0, 1.0])
        found = min([found, *(search(float(k), found[1], limited) for k in near if k >= 0.0)], key=lambda one: one[0])
    at_low_speed = float(found[1].friction(np.array(5.0 * SMOOTHING)))
    dry = max(found[1].coulomb, min(found[1].breakaway, at_low_speed), 1e-6)
    flat = replace(found[1], coulomb=dry, breakaway=dry, stribeck_velocity=2.0 * SMOOTHING)  # dry friction without a peak
    even = search(found[1].delay / log.dt, flat, limited, peaked=False)
    told = NARROWEST <= found[1].stribeck_velocity <= WIDEST * speeds.max() and found[0] <= (1.0 - WORTH) * even[0]
    return (found if told else even)[1]


def _start(log: ActuatorLog, effort: float) -> Drive:
    """Return the first drive of the search: with the log's gains or those of a linear regression, and little friction."""
    if log.stiffness is not None and log.damping is not None:
        stiffness, damping = float(log.stiffness.mean()), float(log.damping.mean())
    else:
        columns = np.stack([(log.target - log.position).ravel(), -log.velocity.ravel()], axis=1)
        stiffness, damping = np.maximum(np.linalg.lstsq(columns, log.torque.ravel(), rcond=None)[0], 1e-3)
    dry = 0.02 * float(np.abs(log.torque).max()) + 1e-6
    return Drive(float(stiffness), float(damping), dry, dry, 2.0 * SMOOTHING, 0.05 * damping + 1e-6, effort=effort)


def _search(
    start: Drive, error: np.ndarray, velocity: np.ndarray, torque: np.ndarray, free: tuple[str, ...]
) -> tuple[float, Drive]:
    """Search from `start` for a local minimum of the mean squared torque error; return that error and the drive. The search
    changes the logarithms of the `free` parameters.
    """
    start = start if "viscous" in free else replace(start, viscous=0.0)

    def drive(x: np.ndarray) -> Drive:
        values = dict(zip(free, np.exp(x).tolist(), strict=True))
        values.setdefault("breakaway", values["coulomb"])
        return replace(start, **values)

    def residual(points: np.ndarray) -> np.ndarray:
        return np.stack([drive(x).torques(error, velocity) - torque for x in points.T], axis=1) / len(torque) ** 0.5

    x, bounds = np.log([getattr(start, name) for name in free]), np.full((2, len(free)), [[-18.0], [18.0]])
    found, _ = least_squares(x, residual, list(bounds), eps=1e-4, x_scale="jac", verbose=0)
    return float(np.sum(residual(found[:, None]) ** 2)), drive(found)
