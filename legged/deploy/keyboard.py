"""Commands by the keyboard of a terminal."""

import os
import re
import select
import sys
from contextlib import suppress

import numpy as np

from legged.deploy.commands import Operator, Orders
from legged.deploy.states import Event
from legged.errors import ConfigError

EVENTS = {
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
"""Key -> axis of the command and sign."""
SEQUENCE = re.compile("\x1b[\\[O][0-?]*[ -/]*[@-~]")
"""Sequences of arrow and function keys (ECMA-48, 5.4), which begin with the escape character and are ignored."""
SILENCE_S = 10.0
"""Time after the last key at which a command ends, because the operator may have left [s]."""
STEP = 0.1
"""Change of a command by one key, as a share of the largest command."""
HELP = (
    "0 idle, 1 damping, 2 stand up, 3 walk, space stop, x quit;"
    f" w s forward and back, a d left and right, q e turn, r no command; a command ends {SILENCE_S:g} s after the last key"
)


class Keyboard(Operator):
    """The terminal of the program, read key by key until `close`."""

    def __init__(self, descriptor: int | None = None) -> None:
        """Open the terminal, by default standard input.

        Raises:
            ConfigError: there is no terminal.
        """
        self._descriptor = sys.stdin.fileno() if descriptor is None else descriptor
        if not os.isatty(self._descriptor):
            raise ConfigError("--input: the keyboard needs a terminal; name a gamepad (gamepad) or a file (--commands)")
        import termios
        import tty

        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        self._velocity = np.zeros(3)
        self._typed = 0.0
        self._lost: str | None = None

    def poll(self, seconds: float) -> Orders:
        events = []
        keys = self._keys()
        if keys:
            self._typed = seconds
        elif seconds - self._typed > SILENCE_S:
            self._velocity = np.zeros(3)
        for key in SEQUENCE.sub("", keys):
            if key in EVENTS:
                events.append(EVENTS[key])
            if key == "r" or EVENTS.get(key) in (Event.STOP, Event.STAND, Event.WALK):
                self._velocity = np.zeros(3)
            elif key in STEPS:
                axis, sense = STEPS[key]
                self._velocity[axis] = np.clip(self._velocity[axis] + sense * STEP, -1.0, 1.0)
        return Orders(self._velocity.copy(), tuple(events), shares=True, lost=self._lost)

    def _keys(self) -> str:
        """Return the characters typed since the last call."""
        found = b""
        while self._lost is None and select.select([self._descriptor], [], [], 0.0)[0]:
            try:
                more = os.read(self._descriptor, 64)
            except OSError:
                more = b""
            if not more:
                self._lost = "the terminal is closed"
            found += more
        return found.decode("utf-8", "ignore")

    def close(self) -> None:
        import termios

        with suppress(termios.error):  # the terminal may be closed; TCSANOW, because a held terminal never drains
            termios.tcsetattr(self._descriptor, termios.TCSANOW, self._before)
