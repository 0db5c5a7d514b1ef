"""Detector of trainings whose numbers become NaN or infinite. It warns once of each fault, and gives a reason to end a
training that does not recover.
"""

import sys
from collections.abc import Mapping
from math import isnan

from legged.errors import RunError

PATIENCE = 10
"""Number of consecutive bad iterations after which training ends."""
SHARE_OF_ROBOTS, SHARE_OF_BATCHES = 0.2, 0.5
"""Thresholds of a bad iteration: the share of robot steps that ended in a reset for NaN, and the share of skipped
mini-batches."""
FAULT = "Faults/"
MINI_BATCHES = "Faults/mini_batches"
"""Name in the log for the share of skipped mini-batches; logged if it is above 0."""


class Diverged(RunError):
    """Error raised when training has diverged; the text gives the cause."""


class DivergenceDetector:
    """Detector that reads the log of each iteration. It warns once of each fault, and sets `why_stop` if the training does
    not recover.
    """

    def __init__(self, steps_per_iteration: int) -> None:
        """Take the number of control steps that all robots of this process make in an iteration."""
        self._steps = steps_per_iteration
        self._said: set[str] = set()
        self._in_a_row = 0
        self.why_stop = ""
        """Reason why training can't go on; empty if it can."""

    def update(self, values: Mapping[str, float], left_out: float) -> None:
        """Process the log `values` of an iteration, by name, and the share `left_out` of skipped mini-batches."""
        found = {name.removeprefix(FAULT): count for name, count in values.items() if name.startswith(FAULT)}
        for name, count in found.items():
            if name not in self._said and not isnan(count):
                self._said.add(name)
                robots = f"{count:.0f} robot{'' if count == 1.0 else 's'}"
                say(f"{term(name)} of {robots} {MEANING.get(name, 'was NaN or infinite')}; logged as {FAULT}{name}")
        if left_out > 0.0 and MINI_BATCHES not in self._said:
            self._said.add(MINI_BATCHES)
            say(f"{100 * left_out:.0f} % of the mini-batches were left out, because a gradient was NaN or infinite")
        reset = values.get("Metrics/non_finite_worlds", 0.0) / self._steps
        wrong = reset >= SHARE_OF_ROBOTS or left_out >= SHARE_OF_BATCHES
        self._in_a_row = self._in_a_row + 1 if wrong else 0
        if self._in_a_row >= PATIENCE:
            what = [f"robots were reset in {100 * reset:.0f} % of their steps"] if reset >= SHARE_OF_ROBOTS else []
            what += [f"{100 * left_out:.0f} % of the mini-batches were left out"] if left_out >= SHARE_OF_BATCHES else []
            terms = ", ".join(term(name) for name in found)
            culprits = f" ({terms})" if terms else ""
            self.why_stop = f"numbers were NaN or infinite for {PATIENCE} iterations in a row{culprits}: {' and '.join(what)}"


MEANING = {"physics": "went out of bounds, so they were reset", "action": "was NaN, so they were reset"}
"""Fault -> description. A fault without an entry here is a term that was NaN or infinite."""


def term(name: str) -> str:
    """Return a fault as text: 'physics' -> 'the physics', and for terms 'reward_torques' -> '_reward_torques'."""
    return f"the {name}" if name in MEANING else f"_{name}"


def say(text: str) -> None:
    """Print a warning."""
    print(f"warning: {text}", file=sys.stderr, flush=True)
