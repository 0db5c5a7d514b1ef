"""Commands and events of the operator: their types, a ramp within the policy's ranges, and scripts."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legged.deploy.contract import Contract
from legged.deploy.states import Event
from legged.errors import ConfigError, suggest

RAMP = np.array([1.0, 1.0, 2.0])
"""Largest change of vx, vy [m/s^2] and yaw rate [rad/s^2]."""


@dataclass(frozen=True)
class Orders:
    """Present command and new events of the operator."""

    velocity: np.ndarray
    """(3,) vx, vy [m/s], yaw rate [rad/s], or shares of the largest values if `shares`."""
    events: tuple[Event, ...] = ()
    """Events since the last poll, oldest first."""
    shares: bool = False
    """`velocity` is a share, -1 to 1, of the policy's command range, like the position of a stick."""
    lost: str | None = None
    """Reason why the operator can no longer be reached; None while it can."""


class Operator(ABC):
    """A source of commands and events."""

    @abstractmethod
    def poll(self, seconds: float) -> Orders:
        """Return the orders `seconds` after the start of the program, without waiting."""

    def close(self) -> None:  # noqa: B027  (most have nothing to release)
        """Release resources, such as a terminal."""


class Ramp:
    """Commands for the policy: zero, or within its ranges and above its dead zone, with a limited rate of change."""

    def __init__(self, contract: Contract) -> None:
        """Start at the command zero."""
        self._low, self._high = contract.command_ranges.T
        self._dead_zone, self._step = contract.dead_zone, RAMP * contract.control_dt
        self.command = np.zeros(3)

    def restart(self) -> None:
        """Return to the command zero at once."""
        self.command = np.zeros(3)

    def advance(self, orders: Orders) -> np.ndarray:
        """Return the command (3,) of this step: vx, vy [m/s], yaw rate [rad/s]."""
        velocity = orders.velocity
        if orders.shares:
            velocity = np.where(velocity > 0.0, velocity * self._high, -velocity * self._low)
        velocity = np.nan_to_num(velocity)
        # Zero stays allowed where the ranges exclude it, because a robot must always be able to stop.
        wanted = np.clip(velocity, self._low, self._high) if velocity.any() else np.zeros(3)
        if np.hypot(*wanted[:2]) < self._dead_zone:
            wanted[:2] = 0.0
        self.command = self.command + np.clip(wanted - self.command, -self._step, self._step)
        return self.command


class Script(Operator):
    """Commands from a file. Each line has a time [s] and either an event or vx, vy [m/s] and yaw rate [rad/s]."""

    def __init__(self, path: Path) -> None:
        """Read the file; empty lines and comments after # are skipped.

        Raises:
            ConfigError: the file cannot be read, or a line is invalid.
        """
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, ValueError) as error:
            raise ConfigError(f"--commands: {path}: cannot be read ({error})") from error
        self._lines: list[tuple[float, Event | np.ndarray]] = []
        for number, line in enumerate(lines, 1):
            words = line.partition("#")[0].split()
            if words:
                self._lines.append(self._parse(words, f"{path}: line {number}"))
        if not self._lines:
            raise ConfigError(f"{path}: has no commands")
        if sorted(self._lines, key=lambda entry: entry[0]) != self._lines:
            raise ConfigError(f"{path}: its times must not decrease")
        self._next, self._velocity = 0, np.zeros(3)

    @staticmethod
    def _parse(words: list[str], where: str) -> tuple[float, Event | np.ndarray]:
        try:
            numbers = [float(word) for word in (words[:1] if len(words) == 2 else words)]
        except ValueError as error:
            raise ConfigError(f"{where}: expected 'time event' or 'time vx vy yaw_rate', got '{' '.join(words)}'") from error
        if len(words) not in (2, 4) or not np.isfinite(numbers).all():
            raise ConfigError(f"{where}: expected 'time event' or 'time vx vy yaw_rate', got '{' '.join(words)}'")
        if len(words) == 4:
            return numbers[0], np.array(numbers[1:])
        events = {event.value: event for event in Event}
        if words[1] not in events:
            raise ConfigError(f"{where}: there is no event '{words[1]}'{suggest(words[1], events)}")
        return numbers[0], events[words[1]]

    def poll(self, seconds: float) -> Orders:
        events = []
        while self._next < len(self._lines) and self._lines[self._next][0] <= seconds:
            wanted = self._lines[self._next][1]
            self._next += 1
            if isinstance(wanted, Event):
                events.append(wanted)
            else:
                self._velocity = wanted
        return Orders(self._velocity, tuple(events))
