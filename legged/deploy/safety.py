"""Safety: limits of targets, and reasons to stop the robot."""

from dataclasses import dataclass

import numpy as np

from legged.deploy.contract import Contract
from legged.deploy.interface import Reading
from legged.deploy.policy import gravity_in

SLOWEST_FALL = 0.5
"""Joint speed at which braking needs the joint's largest torque, as a share of the joint's largest speed."""
AT_ONCE = 2.0
"""The robot is stopped at once if a joint is faster than this multiple of its allowed speed."""
MOST_DAMPING = 4.0
"""Largest D gain for braking, as a multiple of the policy's D gain. With a much larger gain, motors may be unstable."""


@dataclass(frozen=True)
class Limits:
    """Limits beyond which the robot is stopped."""

    max_tilt: float = 1.0
    """Largest angle between the base's up axis and the vertical [rad]."""
    max_age_s: float = 0.05
    """Largest age of the newest reading [s]."""
    speed_share: float = 1.2
    """Allowed joint speed, as a multiple of the contract's velocity limit."""
    fast_s: float = 0.04
    """Time for which a joint may exceed the allowed speed, for example when a foot hits an edge [s]."""
    beyond: float = 0.2
    """Largest distance of a joint beyond its position limits [rad]."""
    max_missed: int = 5
    """Number of missed deadlines in a row at which the robot is stopped."""
    max_temperature: float = 90.0
    """Largest temperature of a motor [degrees Celsius]."""


class Watch:
    """Check of readings and deadlines for reasons to stop the robot."""

    def __init__(self, contract: Contract, limits: Limits) -> None:
        self._contract, self.limits = contract, limits
        self._fastest = limits.speed_share * contract.velocity_limits
        self._fast_s = np.zeros(len(self._fastest))
        """(D,) time for which each joint was too fast [s]. At allowed speeds it falls by a quarter of the elapsed time."""
        self._seen: float | None = None

    def see(self, reading: Reading) -> None:
        """Update the times for which joints were too fast. The program calls this method for every reading."""
        passed = 0.0 if self._seen is None else np.clip(reading.received - self._seen, 0.0, self.limits.max_age_s)
        self._seen = reading.received
        fast = np.abs(reading.velocities) > self._fastest
        self._fast_s = np.maximum(0.0, self._fast_s + np.where(fast, passed, -0.25 * passed))

    def reason(self, reading: Reading | None, now: float, missed: int) -> str | None:
        """Return the reason to stop the robot, as one line of text; None if the robot may go on.

        `reading` is the newest reading, `now` is the time by `time.perf_counter` [s], and `missed` is the number of deadlines
        missed in a row.
        """
        limits = self.limits
        if reading is None:
            return "no data: no reading has arrived yet"
        if reading.stop:
            return "remote control: the operator asks for a stop"
        age = now - reading.received
        if age > limits.max_age_s:
            return f"stale data: the newest reading is {1e3 * age:.0f} ms old (allowed: {1e3 * limits.max_age_s:.0f} ms)"
        for name, values in (
            ("quaternion", reading.quaternion),
            ("gyro", reading.gyro),
            ("joint positions", reading.positions),
            ("joint velocities", reading.velocities),
            *((f"source {name}", values) for name, values in reading.sources.items()),
        ):
            if not np.isfinite(values).all():
                return f"non-finite data: {name}"
        norm = float(np.linalg.norm(reading.quaternion))
        if not 0.9 < norm < 1.1:
            return f"quaternion: its norm is {norm:.3g}, not 1"
        tilt = float(np.arccos(np.clip(-gravity_in(reading.quaternion)[2], -1.0, 1.0)))
        if tilt > limits.max_tilt:
            return f"tilt: {tilt:.2f} rad (allowed: {limits.max_tilt:g})"
        joints = self._contract.joint_names
        at_once = np.abs(reading.velocities) > AT_ONCE * self._fastest
        too_fast = at_once if at_once.any() else self._fast_s >= limits.fast_s
        if too_fast.any():
            i = int(too_fast.argmax())
            how = f"turns at {reading.velocities[i]:.1f} rad/s" if at_once.any() else "has been faster for too long"
            return f"joint speed: {joints[i]} {how} (allowed: {self._fastest[i]:.1f} rad/s for {1e3 * limits.fast_s:.0f} ms)"
        low, high = self._contract.position_limits.T
        beyond = np.maximum(low - reading.positions, reading.positions - high)
        i = int(beyond.argmax())
        if beyond[i] > limits.beyond:
            found = f"{joints[i]} is at {reading.positions[i]:.2f} rad"
            return f"joint position: {found} (its limits: {low[i]:.2f} to {high[i]:.2f})"
        if reading.temperatures is not None and reading.temperatures.max() > limits.max_temperature:
            i = int(reading.temperatures.argmax())
            return f"temperature: {joints[i]} has {reading.temperatures[i]:.0f} degrees (allowed: {limits.max_temperature:g})"
        if missed >= limits.max_missed:
            return f"missed deadlines: {missed} in a row (allowed: {limits.max_missed - 1})"
        for name, term in self._contract.sources.items():
            if name not in reading.sources:
                return f"missing data: source {name}"
            if reading.sources[name].shape != (term.size,):
                return f"missing data: source {name} has {reading.sources[name].size} numbers, not {term.size}"
        return None


def clamp_targets(targets: np.ndarray, positions: np.ndarray, velocities: np.ndarray, contract: Contract) -> np.ndarray:
    """Return the targets (D,) [rad], clipped first to the position limits and then to the range in which the torque
    kp (target - q) - kd dq is within the torque limits. If the two ranges do not overlap, the torque limits take precedence.
    """
    kp, kd, most = contract.stiffness, contract.damping, contract.torque_limits
    inside = np.clip(targets, *contract.position_limits.T)
    stiff = np.where(kp > 0.0, kp, 1.0)
    low, high = positions + (kd * velocities - most) / stiff, positions + (kd * velocities + most) / stiff
    return np.where(kp > 0.0, np.clip(inside, low, high), inside)


def braking(contract: Contract) -> np.ndarray:
    """Return the D gains (D,) for braking [N m s/rad]. A joint at half of its largest speed is braked with its
    largest torque, or with less torque if the gain reaches its limit, four times the policy's D gain.
    """
    return np.minimum(contract.torque_limits / (SLOWEST_FALL * contract.velocity_limits), MOST_DAMPING * contract.damping)
