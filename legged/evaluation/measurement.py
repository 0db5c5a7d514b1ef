"""Parts that all measurements of a policy share: their setting, the head of their result, and contacts that were lost."""

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
    """A policy to measure, with changes to its configuration, and the folder of the result."""

    policy: TrainedPolicy
    device: torch.device
    folder: Path
    overrides: Sequence[tuple[str, Any]] = ()
    """Overrides of the command line."""
    graph: bool = True
    """False: steps are run eagerly instead of as CUDA graphs."""
    where: str = "sim.physics"
    """The argument that names the engine, for errors."""

    @property
    def asked(self) -> list[tuple[str, Any]]:
        """The overrides, with the engine of the device in place of the training's."""
        return [("sim.physics", resolve_physics("auto", self.device)), *self.overrides]

    @cached_property
    def cfg(self) -> Any:
        """The policy's configuration with these overrides."""
        return override(self.policy.cfg, self.asked)

    @property
    def engine(self) -> str:
        """Name of the engine and its solver.

        Raises:
            ConfigError: the device or the machine has no such engine.
        """
        return engine_name(self.cfg.sim, self.device, self.where)

    @property
    def head(self) -> dict[str, Any]:
        """The fields with which every result begins, without the changes."""
        what = {"task": self.policy.cfg.task, "checkpoint": self.policy.checkpoint.name}
        return {**what, "physics": self.engine, "device": device_name(self.device)}

    @property
    def changes(self) -> dict[str, Any]:
        """The field `changes` of a result, with the overrides that change its conditions; empty without such overrides."""
        changes = changes_of(self.overrides)
        return {"changes": changes} if changes else {}


class Overflows:
    """Counter of lost contacts: robots times control steps. The task starts its own count anew with every rollout it logs."""

    NAME = "Metrics/contact_overflows"

    def __init__(self) -> None:
        self._logged: list[Tensor] = []

    def add(self, extras: dict[str, Any]) -> None:
        """Keep what a step returned, if it closed a rollout."""
        if "log" in extras:
            self._logged.append(extras["log"][self.NAME])

    def total(self, task: BaseTask) -> int:
        """Return the count since the task was reset; it can be read once."""
        return int(sum(self._logged, task.metrics.flush()[self.NAME]))


def warn_of_overflows(what: str, lost: int) -> None:
    """Print a warning that results with lost contacts are not to be trusted."""
    if lost:
        said = f"contacts were lost for want of memory, {lost} times (robots x steps); raise sim.nconmax and sim.njmax"
        print(f"warning: {what}: {said}", file=sys.stderr)
