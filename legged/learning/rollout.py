"""Rollout in which the host reads no values from the device. All results go straight into rsl-rl's storage."""

from abc import ABC, abstractmethod

import torch
from rsl_rl.storage import RolloutStorage
from torch import Tensor

from legged.envs import BaseTask
from legged.learning.ppo import DevicePPO, gaussian_log_prob


class Steps(ABC):
    """Rollout of T control steps as in rsl-rl's training loop, but as one function that a CUDA graph can hold. A subclass
    computes the actions (`_act`), and the quantities that need all steps (`_finish`).
    """

    def __init__(self, env: BaseTask, storage: RolloutStorage) -> None:
        """Take a task and a storage on the same device."""
        self.env, self.storage = env, storage
        st = storage
        self._observations = {name: group.buffer for name, group in env.observation_groups.items()}
        self._cut_off = torch.zeros_like(st.rewards)
        """Tensor (T, N, 1) with 1 where an episode ended by a time-out in this step, else 0."""
        self._so_far = torch.zeros(2, env.num_envs, device=env.device)
        self._return, self._length = self._so_far.unbind()
        # `_ended` holds sums of each robot. Adding up the robots only at the end of the rollout saves kernel launches.
        self._ended = torch.zeros(3, env.num_envs, device=env.device)
        self._zero = torch.zeros((), device=env.device)
        self._return_at = torch.zeros_like(st.rewards).squeeze(-1)  # (T, N) return of the episode so far, after each step
        self.ended = torch.zeros(4, device=env.device)
        """Statistics (4,) of the episodes that ended in the last rollout: their number, the sum of returns, the sum of
        lengths [steps], and the sum of squared differences of the returns from their mean."""

    @property
    def episodes(self) -> dict[str, Tensor]:
        """Sum of rewards (`return`) and `length` [steps] of each robot's episode so far, (N,) each."""
        return {"return": self._return, "length": self._length}

    def forget(self) -> None:
        """Reset the returns and lengths of all episodes."""
        self._so_far.zero_()

    @torch.no_grad()
    def collect(self, steps: int | None = None) -> None:
        """Make `steps` steps, by default T, and compute the quantities that need all steps."""
        self._ended.zero_()
        for t in range(steps or self.storage.num_transitions_per_env):
            self._step(t)
        torch.sum(self._ended, dim=1, out=self.ended[:3])
        self._sum_squared_differences()
        self._finish()

    @abstractmethod
    def _act(self, t: int) -> Tensor:
        """Return the actions (N, D) of step `t`."""

    @abstractmethod
    def _finish(self) -> None:
        """Compute, for all steps at once, the quantities that are not needed to act."""

    def _step(self, t: int) -> None:
        env, st = self.env, self.storage
        for name, now in self._observations.items():
            st.observations[name][t].copy_(now)
        actions = self._act(t)
        st.actions[t].copy_(actions)

        env.step_in_place(actions.to(env.device))

        st.rewards[t].copy_(env.rew_buf.unsqueeze(1))
        st.dones[t].copy_(env.reset_buf.unsqueeze(1))
        self._cut_off[t].copy_(env.time_out_buf.unsqueeze(1))
        self._count(t)

    def _count(self, t: int) -> None:
        """Record returns and lengths of episodes after step `t`, for the log."""
        env = self.env
        self._return.add_(env.rew_buf)
        self._return_at[t].copy_(self._return)
        self._length.add_(1.0)
        self._ended[0].add_(env.reset_buf)
        self._ended[1:].add_(torch.where(env.reset_buf, self._so_far, self._zero))
        self._so_far.masked_fill_(env.reset_buf, 0.0)

    def _sum_squared_differences(self) -> None:
        """Sum the squared differences between the returns of ended episodes and their mean. This takes a second pass, because
        in float32 a sum of squares would be too inaccurate where the mean is large.
        """
        moved = self._return_at - self.ended[1] / self.ended[0]
        self.ended[3].copy_(torch.where(self.storage.dones.squeeze(-1).bool(), moved.square(), self._zero).sum())


class Rollout(Steps):
    """Rollout for PPO."""

    def __init__(self, env: BaseTask, alg: DevicePPO) -> None:
        """Take a task and a learner on the same device."""
        super().__init__(env, alg.storage)
        self.alg = alg
        st = alg.storage
        if st.distribution_params is None:
            st.distribution_params = (torch.zeros_like(st.actions), torch.zeros_like(st.actions))

    def _act(self, t: int) -> Tensor:
        """Return the policy's actions (N, D) with its noise."""
        alg = self.alg
        mean = alg.actor.mlp(alg.actor.get_latent(self._observations))
        actions = torch.addcmul(mean, alg.action_std(), torch.randn_like(mean))
        alg.storage.distribution_params[0][t].copy_(mean)
        return actions

    def _finish(self) -> None:
        """Compute log-probabilities, values, returns and advantages. Add the discounted value to rewards at time-outs."""
        alg, st = self.alg, self.alg.storage
        std = alg.action_std()
        st.distribution_params[1].copy_(std.expand_as(st.actions))
        st.actions_log_prob.copy_(gaussian_log_prob(st.actions, st.distribution_params[0], std).unsqueeze(-1))
        st.values.copy_(alg.critic.mlp(alg.critic.get_latent(st.observations)))
        if alg.reward_scale != 1.0:
            st.rewards.mul_(alg.reward_scale)
        # At a time-out the next state is in a new episode, so the value of the last state is used, as in rsl-rl.
        st.rewards.add_(alg.gamma * self._cut_off * st.values)
        self._returns()

    def _returns(self) -> None:
        """Compute returns and advantages by generalised advantage estimation (Schulman et al., arXiv 1506.02438)."""
        alg, st = self.alg, self.alg.storage
        last = alg.critic.mlp(alg.critic.get_latent(self._observations))
        following = torch.cat([st.values[1:], last.unsqueeze(0)])
        alive = 1.0 - st.dones.float()
        sums = st.rewards + alive * alg.gamma * following - st.values  # temporal differences
        decay = alive * (alg.gamma * alg.lam)
        for t in reversed(range(len(sums) - 1)):
            sums[t].add_(decay[t] * sums[t + 1])
        torch.add(sums, st.values, out=st.returns)
        advantages = st.returns - st.values
        if not alg.normalize_advantage_per_mini_batch:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        st.advantages.copy_(advantages)
