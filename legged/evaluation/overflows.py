"""Contacts that an engine lost for want of memory while something was measured."""

import sys
from typing import Any

from torch import Tensor

from legged.envs import BaseTask


class Overflows:
    """Counts lost contacts: robots times control steps. The task's own count begins anew with every rollout that it logs."""

    NAME = "Metrics/contact_overflows"

    def __init__(self) -> None:
        self._logged: list[Tensor] = []

    def add(self, extras: dict[str, Any]) -> None:
        """Keep what a step returned, if it closed a rollout."""
        if "log" in extras:
            self._logged.append(extras["log"][self.NAME])

    def total(self, task: BaseTask) -> int:
        """Return all since the task was reset; to be asked once."""
        return int(sum(self._logged, task.metrics.flush()[self.NAME]))


def warn_of_overflows(what: str, lost: int) -> None:
    """Say that results with lost contacts are not to be trusted."""
    if lost:
        print(
            f"warning: {what}: contacts were lost for want of memory, {lost} times (robots x steps); raise sim.nconmax and"
            " sim.njmax",
            file=sys.stderr,
        )
