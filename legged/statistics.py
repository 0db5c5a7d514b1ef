"""What is logged about a rollout, accumulated on the device without synchronisation."""

from collections.abc import Sequence

import torch
from torch import Tensor

COUNTERS = (
    "episodes",
    "falls",
    "episode_steps",
    "steps",
    "lin_vel_error",
    "ang_vel_error",
    "non_finite",
    "overflows",
)


class Statistics:
    """Sums over robots and steps since the last `flush`."""

    def __init__(self, reward_names: Sequence[str], episode_length_s: float, device: torch.device) -> None:
        """Reward sums of episodes are logged per second of a full episode, as legged_gym does."""
        self.reward_names, self.episode_length_s = tuple(reward_names), episode_length_s
        self._sums = torch.zeros(len(COUNTERS), device=device)
        self._rewards = torch.zeros(len(self.reward_names), device=device)

    def add_step(self, lin_error: Tensor, ang_error: Tensor, valid: Tensor, overflowed: Tensor) -> None:
        """Squared velocity errors (N,) [m^2/s^2], [rad^2/s^2] of the valid robots, and lost contacts (N,)."""
        self._add(
            steps=valid.sum(),
            lin_vel_error=torch.where(valid, lin_error, 0.0).sum(),
            ang_vel_error=torch.where(valid, ang_error, 0.0).sum(),
            non_finite=(~valid).sum(),
            overflows=overflowed.sum(),
        )

    def add_episodes(self, ended: Tensor, fell: Tensor, length: Tensor, reward_sums: Tensor) -> None:
        """Episodes that end at this step: masks (N,), lengths in steps (N,), reward sums (terms, N)."""
        self._add(episodes=ended.sum(), falls=fell.sum(), episode_steps=torch.where(ended, length, 0).sum())
        self._rewards.add_(torch.where(ended, reward_sums, 0.0).sum(dim=1) / self.episode_length_s)

    def _add(self, **values: Tensor) -> None:
        zero = torch.zeros((), device=self._sums.device)
        self._sums.add_(torch.stack([values.get(name, zero).to(torch.float32) for name in COUNTERS]))

    def flush(self) -> dict[str, Tensor]:
        """Means since the last flush as fresh 0-dimensional tensors, by their name in TensorBoard; then start anew."""
        total = dict(zip(COUNTERS, self._sums.clone().unbind(), strict=True))
        episodes, steps = total["episodes"].clamp(min=1.0), total["steps"].clamp(min=1.0)
        # No finished episode in the window: NaN says "no value" where 0 would look like a bad one.
        none = torch.where(total["episodes"] > 0, 0.0, float("nan"))
        log = {f"rew_{name}": value / episodes + none for name, value in zip(self.reward_names, self._rewards.clone())}
        log["Metrics/lin_vel_rmse"] = (total["lin_vel_error"] / steps).sqrt()
        log["Metrics/ang_vel_rmse"] = (total["ang_vel_error"] / steps).sqrt()
        log["Metrics/falls"] = total["falls"] / episodes + none
        log["Metrics/episode_length"] = total["episode_steps"] / episodes + none
        log["Metrics/non_finite_worlds"] = total["non_finite"]
        log["Metrics/contact_overflows"] = total["overflows"]
        self._sums.zero_()
        self._rewards.zero_()
        return log
