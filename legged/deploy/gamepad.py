"""Commands by a gamepad, read from Linux's joystick device.

An event of the device is 8 bytes: time [ms] uint32, value int16, type uint8 (1 button, 2 axis, plus 0x80 for events that
report the initial state), number uint8 (Linux, Documentation/input/joydev/joystick-api.rst).
"""

import os
import struct
from pathlib import Path

import numpy as np

from legged.deploy.commands import Operator, Orders
from legged.deploy.states import Event
from legged.errors import ConfigError

EVENT = struct.Struct("<IhBB")
BUTTON, AXIS, AT_START = 1, 2, 0x80
LARGEST = 32767.0
"""Largest value of an axis."""
STILL = 0.1
"""Dead zone of a stick as a share of its range."""
DEVICE = Path("/dev/input/js0")
AXES = {1: (0, -1.0), 0: (1, -1.0), 3: (2, -1.0)}
"""Number of an axis -> axis of the command and sign: left stick up, left stick left and right stick left are positive."""
BUTTONS = {0: Event.WALK, 1: Event.STOP, 2: Event.DAMPING, 3: Event.STAND, 6: Event.QUIT, 7: Event.IDLE}
"""Number of a button -> event; on an Xbox gamepad A, B, X, Y, back and start."""
HELP = "Y stand up, A walk, B stop, X damping, start idle, back quit; left stick walks, right stick turns"


class Gamepad(Operator):
    """A gamepad; when it is unplugged the operator counts as lost."""

    def __init__(self, device: Path = DEVICE) -> None:
        """Open the device.

        Raises:
            ConfigError: the device does not exist, or this user may not read it.
        """
        try:
            self._descriptor = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise ConfigError(f"--input: there is no gamepad at {device} ({error.strerror})") from error
        self._device = device
        self._sticks = np.zeros(3)
        self._lost: str | None = None
        self._rest = b""

    def poll(self, seconds: float) -> Orders:
        events = []
        self._rest += self._bytes()
        whole = len(self._rest) - len(self._rest) % EVENT.size
        for _, value, kind, number in EVENT.iter_unpack(self._rest[:whole]):
            if kind & ~AT_START == AXIS and number in AXES:
                axis, sense = AXES[number]
                share = float(np.clip(value / LARGEST, -1.0, 1.0))
                self._sticks[axis] = sense * share if abs(share) > STILL else 0.0
            elif kind == BUTTON and value and number in BUTTONS:
                events.append(BUTTONS[number])
        self._rest = self._rest[whole:]
        return Orders(self._sticks.copy(), tuple(events), shares=True, lost=self._lost)

    def _bytes(self) -> bytes:
        """Return the bytes received since the last call."""
        found = b""
        while self._lost is None:
            try:
                more = os.read(self._descriptor, 64 * EVENT.size)
            except BlockingIOError:
                break
            except OSError as error:
                self._lost = f"{self._device} ({error.strerror})"
                break
            if not more:
                self._lost = f"{self._device} is closed"
            found += more
        return found

    def close(self) -> None:
        os.close(self._descriptor)
