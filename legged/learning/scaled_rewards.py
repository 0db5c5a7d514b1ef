"""rsl-rl's PPO with scaled rewards. A value function learns slowly if returns are in the thousands."""

from typing import Any

from rsl_rl.algorithms import PPO
from tensordict import TensorDict
from torch import Tensor


class ScaledRewards(PPO):
    """PPO that learns from `reward_scale` times the task's rewards. Logs and evaluations are not scaled."""

    reward_scale = 1.0
    """Factor on the rewards."""

    def process_env_step(self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Any]) -> None:
        """Record one step of the task."""
        scaled = rewards if self.reward_scale == 1.0 else rewards * self.reward_scale
        super().process_env_step(obs, scaled, dones, extras)
