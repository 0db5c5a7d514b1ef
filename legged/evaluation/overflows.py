"""Contacts that an engine lost during a measurement because its memory was full."""

import sys
from typing import Any

from torch import Tensor

from legged.envs import BaseTask


class Overflows:
    """Counter of lost contacts: robots times control steps. The task's own count restarts with every rollout that it logs."""

    NAME = "Metrics/contact_overflows"

    def __init__(self) -> None:
        self._logged: list[Tensor] = []

    def add(self, extras: dict[str, Any]) -> None:
        """Add the count that a step returned, if the step ended a rollout."""
        if "log" in extras:
            self._logged.append(extras["log"][self.NAME])

    def total(self, task: BaseTask) -> int:
        """Return the count since the task was reset; it can be read once."""
        return int(sum(self._logged, task.metrics.flush()[self.NAME]))


def warn_of_overflows(what: str, lost: int) -> None:
    """Print a warning that results with lost contacts are not to be trusted."""
    if lost:
        print(
            f"warning: {what}: contacts were lost for want of memory, {lost} times (robots x steps); raise sim.nconmax and"
            " sim.njmax",
            file=sys.stderr,
        )
