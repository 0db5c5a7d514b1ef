"""Means for the log of a rollout, accumulated on the device without synchronisation."""

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from legged.graph.step_graph import calling

SQUARED = "_rmse"
"""Ending of the names of metrics that return squared errors. The root of their mean is logged."""


class Metrics:
    """Sums over robots and steps, and over finished episodes, since the last `flush`."""

    def __init__(
        self,
        functions: Mapping[str, Callable[[], Tensor]],
        reward_names: Sequence[str],
        termination_names: Sequence[str],
        reward_unit: float,
        num_envs: int,
        device: torch.device,
    ) -> None:
        """Set all sums to zero. `functions` are the metrics, each returning (N,). Reward sums of episodes are divided by
        `reward_unit` before they are averaged, because legged_gym logs them per second of a full episode.
        """
        self._functions = dict(functions)
        self.reward_names, self.termination_names = tuple(reward_names), tuple(termination_names)
        self.reward_unit, self.num_envs = reward_unit, num_envs
        # A step adds to a separate sum for each robot, which costs two kernel launches per table. A sum over robots in every
        # step would cost a third launch, so `flush` computes it.
        self._metrics = torch.zeros(len(self._functions), num_envs, device=device)
        # The rows are: steps, steps of valid robots, steps with lost contacts, episodes ended by each termination.
        self._counts = torch.zeros(3 + len(self.termination_names), num_envs, device=device)
        self._ended = torch.zeros(2, num_envs, device=device)  # rows: episodes, falls
        self._lengths = torch.zeros(num_envs, device=device)
        self._rewards = torch.zeros(len(self.reward_names), num_envs, device=device)
        self._always = torch.ones(num_envs, dtype=torch.bool, device=device)
        self._zero = torch.zeros((), device=device)

    def add_step(self, valid: Tensor, overflowed: Tensor, ended_by: Sequence[Tensor]) -> None:
        """Add a step. Metrics count for the robots of `valid` (N,). `overflowed` (N,) marks robots that lost contacts, and
        `ended_by` has for each termination a mask (N,) of the robots whose episodes it has ended.

        Raises:
            TermError: a metric fails, or does not return (N,).
        """
        values = []
        for name, function in self._functions.items():
            with calling(f"_metric_{name}"):
                value = function()
                if value.shape != (self.num_envs,):
                    raise ValueError(f"must return a tensor ({self.num_envs},), got {tuple(value.shape)}")
            values.append(value)
        if values:
            self._metrics.add_(torch.where(valid, torch.stack(values), self._zero))
        self._counts.add_(torch.stack([self._always, valid, overflowed, *ended_by]))

    def add_episodes(self, ended: Tensor, failed: Tensor, length: Tensor, reward_sums: Tensor) -> None:
        """Add the episodes that end at this step: masks `ended` and `failed` (N,), `length` (N,) in steps, `reward_sums`
        (terms, N).
        """
        self._ended.add_(torch.stack([ended, failed]))
        self._lengths.addcmul_(ended, length)
        self._rewards.add_(torch.where(ended, reward_sums, self._zero))

    def flush(self) -> dict[str, Tensor]:
        """Return means since the last flush, by name in TensorBoard, as new 0-dimensional tensors. Then clear all sums."""
        all_steps, steps, overflows, *ended = self._counts.sum(dim=1).unbind()
        episodes, falls = self._ended.sum(dim=1).unbind()
        metrics, rewards = self._metrics.sum(dim=1).unbind(), (self._rewards.sum(dim=1) / self.reward_unit).unbind()
        length = self._lengths.sum()
        for sums in (self._counts, self._ended, self._metrics, self._rewards, self._lengths):
            sums.zero_()
        # Without a finished episode the mean is 0 / 0 = NaN, which means "no value". A 0 would look like a bad result.
        log = {f"rew_{name}": value / episodes for name, value in zip(self.reward_names, rewards, strict=True)}
        for name, value in zip(self._functions, metrics, strict=True):
            mean = value / steps
            log[f"Metrics/{name}"] = mean.sqrt() if name.endswith(SQUARED) else mean
        log["Metrics/falls"] = falls / episodes
        log["Metrics/episode_length"] = length / episodes
        log["Metrics/non_finite_worlds"] = all_steps - steps
        log["Metrics/contact_overflows"] = overflows
        by_term = zip(self.termination_names, ended, strict=True)
        return {**log, **{f"Terminations/{name}": count / episodes for name, count in by_term}}
