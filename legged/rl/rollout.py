"""A rollout without a host read: policy, sampling, task and returns, written straight into rsl-rl's storage."""

import torch
from rsl_rl.models import MLPModel
from torch import Tensor

from legged.envs import BaseTask
from legged.rl.ppo import DevicePPO, gaussian_log_prob


class Rollout:
    """The T control steps of an iteration, as rsl-rl's runner and PPO make them, in one function that a graph can hold."""

    def __init__(self, env: BaseTask, alg: DevicePPO) -> None:
        """For a task and a learner on the same device."""
        self.env, self.alg = env, alg
        st = alg.storage
        if st.distribution_params is None:
            st.distribution_params = (torch.zeros_like(st.actions), torch.zeros_like(st.actions))
        self._return = torch.zeros(env.num_envs, device=env.device)
        self._length = torch.zeros(env.num_envs, device=env.device)
        self.ended = torch.zeros(3, device=env.device)
        """(3,) of the episodes that ended in the last rollout: number, sum of returns, sum of lengths [steps]."""

    def forget(self) -> None:
        """All episodes begin anew."""
        self._return.zero_()
        self._length.zero_()

    @torch.no_grad()
    def collect(self) -> None:
        """T steps into the storage, with returns and advantages."""
        st = self.alg.storage
        self.ended.zero_()
        for t in range(st.num_transitions_per_env):
            self._step(t)
        self._returns(self._values())

    def _step(self, t: int) -> None:
        env, alg, st = self.env, self.alg, self.alg.storage
        for name, group in env.observation_groups.items():
            st.observations[name][t].copy_(group.buffer)
        mean, std = alg.actor.mlp(self._input(alg.actor)), alg.action_std()
        actions = torch.addcmul(mean, std, torch.randn_like(mean))
        values = self._values()
        st.actions[t].copy_(actions)
        st.values[t].copy_(values)
        st.actions_log_prob[t].copy_(gaussian_log_prob(actions, mean, std).unsqueeze(1))
        st.distribution_params[0][t].copy_(mean)
        st.distribution_params[1][t].copy_(std.expand_as(mean))

        env.step_in_place(actions.to(env.device))

        # The value of the state that was acted on stands for the one that a time-out cut off, as in rsl-rl.
        cut_off = env.time_out_buf.unsqueeze(1) * values
        st.rewards[t].copy_(env.rew_buf.unsqueeze(1) + alg.gamma * cut_off)
        st.dones[t].copy_(env.reset_buf.unsqueeze(1))
        self._count()

    def _count(self) -> None:
        """Returns and lengths of episodes, for the log."""
        env = self.env
        self._return.add_(env.rew_buf)
        self._length.add_(1.0)
        done = env.reset_buf
        counts = torch.stack([torch.ones_like(self._return), self._return, self._length])
        self.ended.add_(torch.where(done, counts, 0.0).sum(dim=1))
        self._return.masked_fill_(done, 0.0)
        self._length.masked_fill_(done, 0.0)

    def _input(self, model: MLPModel) -> Tensor:
        """What a network is given now: its observation groups side by side, normalised."""
        groups = self.env.observation_groups
        return model.obs_normalizer(torch.cat([groups[name].buffer for name in model.obs_groups], dim=1))

    def _values(self) -> Tensor:
        """(N, 1) value of the state now."""
        return self.alg.critic.mlp(self._input(self.alg.critic))

    def _returns(self, last_values: Tensor) -> None:
        """Generalised advantage estimation (Schulman et al., arXiv 1506.02438), backwards over the storage."""
        alg, st = self.alg, self.alg.storage
        advantage = torch.zeros_like(last_values)
        following = last_values
        for t in reversed(range(st.num_transitions_per_env)):
            alive = 1.0 - st.dones[t].float()
            delta = st.rewards[t] + alive * alg.gamma * following - st.values[t]
            advantage = delta + alive * (alg.gamma * alg.lam) * advantage
            torch.add(advantage, st.values[t], out=st.returns[t])
            following = st.values[t]
        advantages = st.returns - st.values
        if not alg.normalize_advantage_per_mini_batch:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        st.advantages.copy_(advantages)
