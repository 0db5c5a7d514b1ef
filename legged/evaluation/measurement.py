"""Common parts of all measurements of a policy: the setting, the first fields of a result, and the count of lost contacts."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from legged.config import override
from legged.envs import BaseTask
from legged.evaluation.result_file import changes_of, device_name
from legged.physics import engine_name, resolve_physics
from legged.policies.restore import TrainedPolicy


@dataclass(frozen=True)
class Setting:
    """A policy to measure, the changes to its configuration, the device, and the folder of the result."""

    policy: TrainedPolicy
    device: torch.device
    folder: Path
    overrides: Sequence[tuple[str, Any]] = ()
    """Overrides that the user gave on the command line."""
    graph: bool = True
    """True: on a GPU, steps run as CUDA graphs. False: steps run eagerly."""
    where: str = "sim.physics"
    """Name of the argument that chooses the engine, for error messages."""

    @property
    def asked(self) -> list[tuple[str, Any]]:
        """An override that selects the device's default engine, not that of the training, followed by the `overrides`."""
        return [("sim.physics", resolve_physics("auto", self.device)), *self.overrides]

    @cached_property
    def cfg(self) -> Any:
        """The policy's configuration with the overrides in `asked`."""
        return override(self.policy.cfg, self.asked)

    @property
    def engine(self) -> str:
        """Name of the engine and its solver.

        Raises:
            ConfigError: the engine does not run on the device, or is not installed.
        """
        return engine_name(self.cfg.sim, self.device, self.where)

    @property
    def head(self) -> dict[str, Any]:
        """The fields with which every result begins: task, checkpoint, engine and device."""
        what = {"task": self.policy.cfg.task, "checkpoint": self.policy.checkpoint.name}
        return {**what, "physics": self.engine, "device": device_name(self.device)}

    @property
    def changes(self) -> dict[str, Any]:
        """{"changes": {field: value, ...}} for overrides that change the conditions of the measurement. Without them: {}."""
        changes = changes_of(self.overrides)
        return {"changes": changes} if changes else {}


class Overflows:
    """Number of control steps in which contacts were lost, summed over robots. A task resets its own count at each logging.
    Therefore this class adds up the logged counts.
    """

    NAME = "Metrics/contact_overflows"

    def __init__(self) -> None:
        self._logged: list[Tensor] = []

    def add(self, extras: dict[str, Any]) -> None:
        """Add the count in the `extras` of a control step, if the task logged in this step."""
        if "log" in extras:
            self._logged.append(extras["log"][self.NAME])

    def total(self, task: BaseTask) -> int:
        """Return the count since the first step. Call this only once, because it resets the task's count."""
        return int(sum(self._logged, task.metrics.flush()[self.NAME]))


def warn_of_overflows(what: str, lost: int) -> None:
    """Print a warning if contacts were lost in the measurement `what`. `lost` is the number of losses (robots x steps)."""
    if lost:
        said = f"contacts were lost {lost} times (robots x steps), because memory was full; raise sim.nconmax and sim.njmax"
        print(f"warning: {what}: {said}", file=sys.stderr)
