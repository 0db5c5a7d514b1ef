"""Errors of a policy's estimator, which predicts quantities that only the simulator knows."""

import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config.networks import ESTIMATED
from legged.envs import BaseTask
from legged.envs.marks import unit_of
from legged.learning.estimator import EstimatingModel, EstimationErrors


class EstimateMeter:
    """Sums of the squared errors of a policy's estimates; empty for a policy without an estimator."""

    def __init__(self, task: BaseTask, act: Callable[[TensorDict], Tensor]) -> None:
        """Measure the policy `act`, if it is an `Actor` with an estimator."""
        network = getattr(act, "network", None)
        self._network = network if isinstance(network, EstimatingModel) else None
        if self._network is not None:
            self._errors = EstimationErrors(task.observation_groups[ESTIMATED])
            self._squares = torch.zeros(task.num_envs, len(self._errors.names), device=torch.device(task.device))
            self._counted = torch.zeros(task.num_envs, device=self._squares.device)
            self._units = [unit_of(getattr(type(task), f"_obs_{name}")) for name in self._errors.names]

    def add(self, observations: TensorDict, counted: Tensor) -> None:
        """Add the errors of the estimates from `observations` for the robots in `counted` (N,)."""
        if self._network is None:
            return
        squares = self._errors.squares(self._network.estimate(observations), observations[ESTIMATED])
        self._squares += torch.where(counted.unsqueeze(1), squares, 0.0)
        self._counted += counted

    def found(self) -> dict[str, Any]:
        """Return `estimates`: the root mean square error of each term over robots and steps, with its unit; null if no step
        was counted. Return nothing for a policy without an estimator.
        """
        if self._network is None:
            return {}
        count = float(self._counted.double().sum())
        means = (self._squares.double().sum(dim=0) / max(count, 1.0)).tolist()
        each = zip(self._errors.names, means, self._units, strict=True)
        return {"estimates": {name: {"rmse": math.sqrt(mean) if count else None, "unit": unit} for name, mean, unit in each}}
