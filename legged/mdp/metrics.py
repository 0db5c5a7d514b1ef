"""What is logged about a rollout: means by name, accumulated on the device without synchronisation."""

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from legged.graph.step_graph import calling

SQUARED = "_rmse"
"""How the name of a metric ends whose term gives squared errors, and of whose mean the root is logged."""
EPISODES = ("episodes", "falls", "steps")


class Metrics:
    """Sums over robots and steps, and over episodes that ended, since the last `flush`."""

    def __init__(
        self,
        functions: Mapping[str, Callable[[], Tensor]],
        reward_names: Sequence[str],
        termination_names: Sequence[str],
        reward_unit: float,
        num_envs: int,
        device: torch.device,
    ) -> None:
        """Take functions by metric, each giving (N,). Reward sums of episodes are divided by `reward_unit` before they are
        averaged: legged_gym logs them per second of a full episode.
        """
        self._functions = dict(functions)
        self.reward_names, self.termination_names = tuple(reward_names), tuple(termination_names)
        self.reward_unit, self.num_envs = reward_unit, num_envs
        # Valid robots, their metrics, robots that are none, lost contacts, what each termination has ended.
        self._steps = torch.zeros(1 + len(self._functions) + 2 + len(self.termination_names), device=device)
        self._episodes = torch.zeros(len(EPISODES) + len(self.reward_names), device=device)

    def add_step(self, valid: Tensor, overflowed: Tensor, ended_by: Sequence[Tensor]) -> None:
        """Take the metrics of the robots of `valid` (N,), count those of `overflowed` (N,), which lost contacts, and those
        that each termination has ended, (N,) bool.
        """
        ok = valid.float()
        values = []
        for name, function in self._functions.items():
            with calling(f"_metric_{name}"):
                value = function()
                if value.shape != (self.num_envs,):
                    raise ValueError(f"must return a tensor ({self.num_envs},), got {tuple(value.shape)}")
            values.append(value)
        taken = torch.where(valid, torch.stack(values), 0.0).unbind() if values else ()
        # Stacked, so that summing costs one launch and not one a metric.
        counted = [ended.float() for ended in (overflowed, *ended_by)]
        self._steps.add_(torch.stack([ok, *taken, 1.0 - ok, *counted]).sum(dim=1))

    def add_episodes(self, ended: Tensor, failed: Tensor, length: Tensor, reward_sums: Tensor) -> None:
        """Take in episodes that end at this step: masks (N,), lengths in steps (N,), reward sums (terms, N)."""
        counts = torch.stack([torch.ones_like(failed, dtype=torch.float32), failed.float(), length.float()])
        values = torch.cat([counts, reward_sums / self.reward_unit])
        self._episodes.add_(torch.where(ended, values, 0.0).sum(dim=1))

    def flush(self) -> dict[str, Tensor]:
        """Return means since the last flush as fresh 0-dimensional tensors, by their name in TensorBoard; then start anew."""
        steps_sums, episode_sums = self._steps.clone(), self._episodes.clone()
        for sums in (self._steps, self._episodes):
            sums.zero_()
        count = 3 + len(self._functions)
        steps, *metrics, non_finite, overflows = steps_sums[:count].unbind()
        episodes, falls, length, *rewards = episode_sums.unbind()
        # No finished episode in the window: 0 / 0, NaN, says "no value" where 0 would look like a bad one.
        log = {f"rew_{name}": value / episodes for name, value in zip(self.reward_names, rewards, strict=True)}
        for name, value in zip(self._functions, metrics, strict=True):
            mean = value / steps
            log[f"Metrics/{name}"] = mean.sqrt() if name.endswith(SQUARED) else mean
        log["Metrics/falls"] = falls / episodes
        log["Metrics/episode_length"] = length / episodes
        log["Metrics/non_finite_worlds"] = non_finite
        log["Metrics/contact_overflows"] = overflows
        ended = zip(self.termination_names, steps_sums[count:].unbind(), strict=True)
        return {**log, **{f"Terminations/{name}": count / episodes for name, count in ended}}
