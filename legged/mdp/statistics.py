"""What is logged about a rollout, accumulated on the device without synchronisation."""

from collections.abc import Sequence

import torch
from torch import Tensor

STEP_COUNTERS = ("steps", "lin_vel_error", "ang_vel_error", "non_finite", "overflows")
EPISODE_COUNTERS = ("episodes", "falls", "episode_steps")


class Statistics:
    """Sums over robots and steps since the last `flush`."""

    def __init__(self, reward_names: Sequence[str], episode_length_s: float, device: torch.device) -> None:
        """Reward sums of episodes are logged per second of a full episode, as legged_gym does."""
        self.reward_names, self.episode_length_s = tuple(reward_names), episode_length_s
        self._steps = torch.zeros(len(STEP_COUNTERS), device=device)
        self._episodes = torch.zeros(len(EPISODE_COUNTERS) + len(self.reward_names), device=device)

    def add_step(self, lin_error: Tensor, ang_error: Tensor, valid: Tensor, overflowed: Tensor) -> None:
        """Squared velocity errors (N,) [m^2/s^2], [rad^2/s^2] of the valid robots, and lost contacts (N,)."""
        ok = valid.float()
        errors = torch.where(valid, torch.stack([lin_error, ang_error]), 0.0)
        counts = torch.stack([ok, *errors.unbind(), 1.0 - ok, overflowed.float()])
        self._steps.add_(counts.sum(dim=1))

    def add_episodes(self, ended: Tensor, fell: Tensor, length: Tensor, reward_sums: Tensor) -> None:
        """Episodes that end at this step: masks (N,), lengths in steps (N,), reward sums (terms, N)."""
        counts = torch.stack([torch.ones_like(fell, dtype=torch.float32), fell.float(), length.float()])
        values = torch.cat([counts, reward_sums / self.episode_length_s])
        self._episodes.add_(torch.where(ended, values, 0.0).sum(dim=1))

    def flush(self) -> dict[str, Tensor]:
        """Means since the last flush as fresh 0-dimensional tensors, by their name in TensorBoard; then start anew."""
        steps_sums, episode_sums = self._steps.clone(), self._episodes.clone()
        self._steps.zero_()
        self._episodes.zero_()
        n = len(EPISODE_COUNTERS)
        steps, lin, ang, non_finite, overflows = steps_sums.unbind()
        episodes, falls, length = episode_sums[:n].unbind()
        # No finished episode in the window: 0 / 0, NaN, says "no value" where 0 would look like a bad one.
        log = {f"rew_{name}": value / episodes for name, value in zip(self.reward_names, episode_sums[n:], strict=True)}
        log["Metrics/lin_vel_rmse"] = (lin / steps).sqrt()
        log["Metrics/ang_vel_rmse"] = (ang / steps).sqrt()
        log["Metrics/falls"] = falls / episodes
        log["Metrics/episode_length"] = length / episodes
        log["Metrics/non_finite_worlds"] = non_finite
        log["Metrics/contact_overflows"] = overflows
        return log
