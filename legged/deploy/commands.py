"""What the operator asks for: commands within what the policy knows, ramped, and a script of them for tests."""

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
    """What the operator wants now."""

    velocity: np.ndarray
    """(3,) vx, vy [m/s], yaw rate [rad/s], or shares of the largest ones where `shares` says so."""
    events: tuple[Event, ...] = ()
    """Asked for since the last look, the oldest first."""
    shares: bool = False
    """Whether `velocity` is -1 to 1 of what the policy can be asked for, as a stick's position is."""
    lost: str | None = None
    """Why nobody is there to ask any more; None while somebody is."""


class Operator(ABC):
    """Somebody who asks for something."""

    @abstractmethod
    def poll(self, seconds: float) -> Orders:
        """Return what is wanted `seconds` after the start of the program, without waiting."""

    def close(self) -> None:  # noqa: B027  (most have taken nothing)
        """Give back what was taken, a terminal for instance."""


class Ramp:
    """Commands as the policy gets them: none, or within its ranges and not too slow, changed bit by bit."""

    def __init__(self, contract: Contract) -> None:
        """Begin at no command."""
        self._low, self._high = contract.command_ranges.T
        self._dead_zone, self._step = contract.dead_zone, RAMP * contract.control_dt
        self.command = np.zeros(3)

    def restart(self) -> None:
        """Begin at no command again."""
        self.command = np.zeros(3)

    def advance(self, orders: Orders) -> np.ndarray:
        """Return the command (3,) of this step: vx, vy [m/s], yaw rate [rad/s]."""
        velocity = orders.velocity
        if orders.shares:
            velocity = np.where(velocity > 0.0, velocity * self._high, -velocity * self._low)
        velocity = np.nan_to_num(velocity)
        # No command is 0 also where the ranges leave 0 out: a robot must always be able to halt.
        wanted = np.clip(velocity, self._low, self._high) if velocity.any() else np.zeros(3)
        if np.hypot(*wanted[:2]) < self._dead_zone:
            wanted[:2] = 0.0
        self.command = self.command + np.clip(wanted - self.command, -self._step, self._step)
        return self.command


class Script(Operator):
    """A file of commands. Each line has a time [s] and either an event or vx, vy [m/s] and yaw rate [rad/s]."""

    def __init__(self, path: Path) -> None:
        """Read the file; empty lines and what follows a # are left out.

        Raises:
            ConfigError: it cannot be read, or has a line that is none.
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
