"""Common parts of all measurements of a policy: its setting, the first fields of a result, and the count of lost contacts."""

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
    """Overrides of the command line."""
    graph: bool = True
    """True: on a GPU, steps run as CUDA graphs. False: steps run eagerly."""
    where: str = "sim.physics"
    """Name of the argument that chooses the engine, for error messages."""

    @property
    def asked(self) -> list[tuple[str, Any]]:
        """The `overrides`, after an override that selects the device's default engine instead of the training's engine."""
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
        """{"changes": mapping from field to value} of the overrides that change the conditions; empty if none does."""
        changes = changes_of(self.overrides)
        return {"changes": changes} if changes else {}


class Overflows:
    """Counts in how many control steps contacts were lost, summed over robots. It adds up the task's own counts, which the
    task resets whenever it logs them.
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
    """Print a warning if contacts were lost `lost` times in the measurement `what`."""
    if lost:
        said = f"contacts were lost {lost} times (robots x steps), because memory was full; raise sim.nconmax and sim.njmax"
        print(f"warning: {what}: {said}", file=sys.stderr)
