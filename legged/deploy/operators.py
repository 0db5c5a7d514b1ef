"""States and events of the program, and the operators that command a robot: a keyboard, a gamepad or a file.

An event of Linux's joystick device is 8 bytes: time [ms] uint32, value int16, type uint8 (1 button, 2 axis, plus 0x80 for
events that report the initial state), number uint8 (Linux, Documentation/input/joydev/joystick-api.rst).
"""

import os
import re
import select
import struct
import sys
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from legged.deploy.contract import Contract
from legged.deploy.errors import ConfigError, suggest


class State(Enum):
    """State of the program."""

    IDLE = "idle"
    """No torque."""
    DAMPING = "damping"
    """Joints are braked, so the robot sinks to the ground."""
    STAND = "stand"
    """Joints move to the default pose, and hold it."""
    WALK = "walk"
    """The policy acts."""
    STOP = "stop"
    """Joints are braked after a fault or a stop by the operator. Only the operator can end this state."""


class Event(Enum):
    """Request of the operator."""

    IDLE = "idle"
    DAMPING = "damping"
    STAND = "stand"
    WALK = "walk"
    STOP = "stop"
    QUIT = "quit"


TRANSITIONS = {
    State.IDLE: (Event.DAMPING, Event.STOP),
    State.DAMPING: (Event.IDLE, Event.STAND, Event.STOP),
    State.STAND: (Event.DAMPING, Event.WALK, Event.STOP),
    State.WALK: (Event.STAND, Event.DAMPING, Event.STOP),
    State.STOP: (Event.DAMPING, Event.STOP),
}
"""State -> its allowed events. Each event leads to the state with the same name. `Event.QUIT` is allowed in all states."""
MOVING = (State.STAND, State.WALK)
"""States in which the safety checks can stop the robot."""
RAMP, BASE_RAMP = np.array([1.0, 1.0, 2.0]), np.array([0.2, 0.5])
"""Largest rates of change: of the commanded vx, vy [m/s^2] and yaw rate [rad/s^2], and of height [m/s] and pitch [rad/s]."""
KEYS = {
    "0": Event.IDLE,
    "1": Event.DAMPING,
    "2": Event.STAND,
    "3": Event.WALK,
    " ": Event.STOP,
    "\x1b": Event.STOP,
    "x": Event.QUIT,
    "\x03": Event.QUIT,
}
STEPS = {"w": (0, 1.0), "s": (0, -1.0), "a": (1, 1.0), "d": (1, -1.0), "q": (2, 1.0), "e": (2, -1.0)}
"""Key -> (index in the command vx, vy, yaw rate; sign of the change)."""
SEQUENCE = re.compile("\x1b[\\[O][0-?]*[ -/]*[@-~]")
"""Escape sequences of arrow and function keys (ECMA-48, 5.4). They are ignored, although the escape key alone is a stop."""
SILENCE_S = 10.0
"""Time without a key press after which the command becomes zero, because the operator may have left [s]."""
STEP = 0.1
"""Change of a command per key press, as a share of the largest command."""
JOYSTICK = struct.Struct("<IhBB")
BUTTON, AXIS, AT_START = 1, 2, 0x80
LARGEST = 32767.0
"""Largest value that the joystick device reports for an axis."""
STILL = 0.1
"""Dead zone of a stick as a share of its range."""
DEVICE = Path("/dev/input/js0")
AXES = {1: (0, -1.0), 0: (1, -1.0), 3: (2, -1.0)}
"""Axis of the gamepad -> (index in the command vx, vy, yaw rate; sign). A stick moved up or left gives positive commands."""
BUTTONS = {0: Event.WALK, 1: Event.STOP, 2: Event.DAMPING, 3: Event.STAND, 6: Event.QUIT, 7: Event.IDLE}
"""Number of a button -> event. On an Xbox gamepad these buttons are A, B, X, Y, back and start."""
HELP = {
    "keyboard": "0 idle, 1 damping, 2 stand up, 3 walk, space stop, x quit; w s forward and back, a d left and right, q e"
    f" turn, r zero command; the command becomes zero {SILENCE_S:g} s after the last key press",
    "gamepad": "Y stand up, A walk, B stop, X damping, start idle, back quit; left stick walks, right stick turns",
}


@dataclass(frozen=True)
class Orders:
    """Present command and new events of the operator."""

    velocity: np.ndarray
    """(3,) commanded vx, vy [m/s] and yaw rate [rad/s], or their shares if `shares` is true."""
    events: tuple[Event, ...] = ()
    """Events since the last poll, oldest first."""
    shares: bool = False
    """True if `velocity` holds shares of the policy's command ranges: -1 is the lowest command, and 1 the highest."""
    lost: str | None = None
    """Reason why the operator can no longer be reached; None while the operator is connected."""
    base: np.ndarray | None = None
    """(2,) commanded height [m] and pitch [rad] of the base; None for the usual ones."""


class Operator(ABC):
    """A source of commands and events."""

    @abstractmethod
    def poll(self, seconds: float) -> Orders:
        """Return the orders at the time `seconds` [s] after the start of the program. The call does not wait."""

    def close(self) -> None:  # noqa: B027  (most operators have nothing to release)
        """Release resources, such as a terminal."""


class Ramp:
    """Limiter of commands: clips them to the policy's ranges, zeroes speeds in the dead zone, and limits accelerations."""

    def __init__(self, contract: Contract) -> None:
        self._low, self._high = contract.command_ranges.T
        self._dead_zone, self._step = contract.dead_zone, RAMP * contract.control_dt
        self._base, self._base_step = contract.base_commands.T, BASE_RAMP * contract.control_dt
        self.restart()

    def restart(self) -> None:
        """Set the command to zero at once, and height and pitch of the base to the usual ones."""
        self.command, self.base = np.zeros(3), self._base[1]

    def advance(self, orders: Orders) -> np.ndarray:
        """Return the command (3,) of this step: vx, vy [m/s], yaw rate [rad/s]. `base` (2,) is the height [m] and the pitch
        [rad] of this step.
        """
        velocity = orders.velocity
        if orders.shares:
            velocity = np.where(velocity > 0.0, velocity * self._high, -velocity * self._low)
        velocity = np.nan_to_num(velocity)
        # The command zero is always allowed, even outside the ranges, because a robot must always be able to stop.
        wanted = np.clip(velocity, self._low, self._high) if velocity.any() else np.zeros(3)
        if np.hypot(*wanted[:2]) < self._dead_zone:
            wanted[:2] = 0.0
        self.command = self.command + np.clip(wanted - self.command, -self._step, self._step)
        low, usual, high = self._base
        asked = usual if orders.base is None else np.clip(orders.base, low, high)
        self.base = self.base + np.clip(asked - self.base, -self._base_step, self._base_step)
        return self.command


class Script(Operator):
    """Commands from a file. Each line has a time [s], and either an event or vx, vy [m/s] and yaw rate [rad/s], after which
    height [m] and pitch [rad] of the base may follow.
    """

    def __init__(self, path: Path) -> None:
        """Read the file; empty lines and comments after # are skipped.

        Raises:
            ConfigError: the file cannot be read, or a line is invalid.
        """
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, ValueError) as error:
            raise ConfigError(f"--commands: {path}: cannot be read ({error})") from error
        words = {number: line.partition("#")[0].split() for number, line in enumerate(lines, 1)}
        self._lines = [self._parse(found, f"{path}: line {number}") for number, found in words.items() if found]
        if not self._lines:
            raise ConfigError(f"{path}: has no commands")
        if sorted(self._lines, key=lambda entry: entry[0]) != self._lines:
            raise ConfigError(f"{path}: its times must not decrease")
        self._command = np.zeros(3)

    @staticmethod
    def _parse(words: list[str], where: str) -> tuple[float, Event | np.ndarray]:
        try:
            numbers = [float(word) for word in (words[:1] if len(words) == 2 else words)]
        except ValueError:
            numbers = [np.nan]
        if len(words) not in (2, 4, 6) or not np.isfinite(numbers).all():
            forms = "'time event', 'time vx vy yaw_rate' or 'time vx vy yaw_rate height pitch'"
            raise ConfigError(f"{where}: expected {forms}, got '{' '.join(words)}'")
        if len(words) > 2:
            return numbers[0], np.array(numbers[1:])
        events = {event.value: event for event in Event}
        if words[1] not in events:
            raise ConfigError(f"{where}: there is no event '{words[1]}'{suggest(words[1], events)}")
        return numbers[0], events[words[1]]

    def poll(self, seconds: float) -> Orders:
        events = []
        while self._lines and self._lines[0][0] <= seconds:
            wanted = self._lines.pop(0)[1]
            if isinstance(wanted, Event):
                events.append(wanted)
            else:
                self._command = wanted
        velocity, base = self._command[:3], self._command[3:]
        return Orders(velocity, tuple(events), base=base if len(base) else None)


class _Device(Operator):
    """Operator with an open device. Commands are shares of the largest command. An operator whose device closes is lost."""

    def __init__(self, descriptor: int, name: str) -> None:
        self._descriptor, self._name = descriptor, name
        self._velocity = np.zeros(3)
        self._lost: str | None = None

    def _read(self) -> bytes:
        """Return the bytes received since the last call."""
        found = b""
        while self._lost is None and select.select([self._descriptor], [], [], 0.0)[0]:
            try:
                more = os.read(self._descriptor, 512)
            except OSError:
                more = b""
            if not more:
                self._lost = f"{self._name} is closed"
            found += more
        return found

    def _orders(self, events: list[Event]) -> Orders:
        return Orders(self._velocity.copy(), tuple(events), shares=True, lost=self._lost)


class Keyboard(_Device):
    """Keyboard of the program's terminal. Each key counts at once, without Enter. `close` restores the terminal's mode."""

    def __init__(self, descriptor: int | None = None) -> None:
        """Read keys from the terminal `descriptor`, by default standard input.

        Raises:
            ConfigError: there is no terminal.
        """
        super().__init__(sys.stdin.fileno() if descriptor is None else descriptor, "the terminal")
        if not os.isatty(self._descriptor):
            raise ConfigError("--input: the keyboard needs a terminal; use --input gamepad or --commands FILE")
        import termios
        import tty

        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        self._typed = 0.0

    def poll(self, seconds: float) -> Orders:
        events = []
        keys = self._read().decode("utf-8", "ignore")
        if keys:
            self._typed = seconds
        elif seconds - self._typed > SILENCE_S:
            self._velocity = np.zeros(3)
        for key in SEQUENCE.sub("", keys):
            if key in KEYS:
                events.append(KEYS[key])
            if key == "r" or KEYS.get(key) in (Event.STOP, Event.STAND, Event.WALK):
                self._velocity = np.zeros(3)
            elif key in STEPS:
                axis, sense = STEPS[key]
                self._velocity[axis] = np.clip(self._velocity[axis] + sense * STEP, -1.0, 1.0)
        return self._orders(events)

    def close(self) -> None:
        import termios

        # A closed terminal raises an error. TCSANOW does not wait for output that Ctrl-S holds back.
        with suppress(termios.error):
            termios.tcsetattr(self._descriptor, termios.TCSANOW, self._before)


class Gamepad(_Device):
    """A gamepad, read from Linux's joystick device."""

    def __init__(self, device: Path = DEVICE) -> None:
        """Open the device.

        Raises:
            ConfigError: the device does not exist, or this user may not read it.
        """
        try:
            super().__init__(os.open(device, os.O_RDONLY | os.O_NONBLOCK), str(device))
        except OSError as error:
            raise ConfigError(f"--input: there is no gamepad at {device} ({error.strerror})") from error
        self._rest = b""

    def poll(self, seconds: float) -> Orders:
        events = []
        self._rest += self._read()
        whole = len(self._rest) - len(self._rest) % JOYSTICK.size
        for _, value, kind, number in JOYSTICK.iter_unpack(self._rest[:whole]):
            if kind & ~AT_START == AXIS and number in AXES:
                axis, sense = AXES[number]
                share = float(np.clip(value / LARGEST, -1.0, 1.0))
                self._velocity[axis] = sense * share if abs(share) > STILL else 0.0
            elif kind == BUTTON and value and number in BUTTONS:
                events.append(BUTTONS[number])
        self._rest = self._rest[whole:]
        return self._orders(events)

    def close(self) -> None:
        os.close(self._descriptor)
