"""Rewards, terminations and metrics of a task: evaluation in each step, and sums for the log."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from legged.config.schema import TaskConfig
from legged.envs.concurrent_terms import ConcurrentTerms
from legged.envs.marks import concurrent, is_concurrent
from legged.mdp.metrics import Metrics
from legged.mdp.nan_guard import NanGuard
from legged.mdp.rewards import Rewards
from legged.mdp.terminations import Terminations
from legged.physics import Physics

REWARD_STREAMS = 5
"""Number of streams that concurrent rewards are distributed over. On an H100, the rewards of an ANYmal take 49 us on 5
streams, and 90 us on one stream. `check_termination`, which runs at the same time, takes 34 us."""
SETTLED = ("valid", "terminated_buf", "time_out_buf", "reset_buf", "rew_buf")
"""Tensors that `check_termination` and `compute_reward` write."""


class JudgingTask:
    """Mixin of BaseTask with its rewards, terminations and metrics."""

    cfg: TaskConfig
    num_envs: int
    device: torch.device
    dt: float
    max_episode_length: int
    physics: Physics
    rew_buf: Tensor
    valid: Tensor
    terminated_buf: Tensor
    time_out_buf: Tensor
    reset_buf: Tensor
    episode_length_buf: Tensor
    nan_guard: NanGuard
    check_termination: Callable[[], None]
    active_terminations: Callable[[], tuple[list[str], list[str]]]
    terms: Callable[[str], set[str]]
    _methods: Callable[[str, Any], dict[str, Callable[[], Tensor]]]
    _in_bounds: Tensor
    _clipped_actions: Tensor

    def _collect_judgements(self) -> None:
        """Collect the terminations and rewards that the configuration names, and all metrics."""
        cfg = self.cfg.rewards
        # A hook without the mark `@concurrent` may write tensors that terms read. With such a hook no term runs on a stream.
        hooks = (self.check_termination, self.measure, self.compute_reward)
        streams = (1, REWARD_STREAMS, 1) if all(is_concurrent(hook) for hook in hooks) else (0, 0, 0)
        self._concurrent_terminations, self._concurrent_rewards, self._concurrent_metrics = (
            ConcurrentTerms(self.device, count, self._settled) for count in streams
        )
        failures, time_outs = (
            self._concurrent_terminations.add("_terminate_", self._methods("_terminate_", names))
            for names in self.active_terminations()
        )
        self.terminations = Terminations(failures, time_outs, self.terminated_buf, self.time_out_buf, self.reset_buf)
        scales = {name: scale for name, scale in cfg.scales.items() if scale != 0.0}
        unit = self.dt if cfg.times_dt else 1.0
        rewards = self._concurrent_rewards.add("_reward_", self._methods("_reward_", scales))
        self.rewards = Rewards(rewards, scales, unit, cfg.only_positive_rewards, self.rew_buf, self.physics.kernels)
        self.episode_sums = self.rewards.episode_sums
        names = sorted(self.terms("_metric_"))
        metrics = self._concurrent_metrics.add("_metric_", self._methods("_metric_", names))
        full = self.cfg.env.episode_length_s if cfg.times_dt else self.max_episode_length
        parts = self.rewards.names, self.terminations.names
        self.metrics = Metrics(metrics, *parts, full, self.num_envs, self.device)

    def _settled(self) -> dict[str, Tensor]:
        """Return the tensors, by name, that are written after `_start_terms`. Concurrent terms must not read them."""
        named = {name: getattr(self, name) for name in SETTLED}
        found = zip(self.terminations.names, self.terminations.found, strict=True)
        return named | {f"terminations.found of '{name}'": tensor for name, tensor in found}

    def _start_terms(self) -> None:
        """Start the terms with the mark `@concurrent`. They run at the same time as `check_termination`."""
        self._concurrent_terminations.start()
        self._concurrent_rewards.start()
        self._concurrent_metrics.start()

    @concurrent
    def measure(self) -> None:
        """Hook: add the step to the metrics, at the same time as the rewards are computed."""
        self._concurrent_metrics.join()
        self.metrics.add_step(self.valid, self.physics.overflowed, self.terminations.found)

    @concurrent
    def compute_reward(self) -> None:
        """Hook: compute the reward of the step, before anything is reset."""
        self._concurrent_rewards.join()
        self.rewards.compute(self.valid)

    def _record(self) -> None:
        """Add finished episodes to the metrics. This runs at the same time as `update_curricula`."""
        self.metrics.add_episodes(self.reset_buf, self.terminated_buf, self.episode_length_buf, self.rewards.sums)

    def _look_for_faults(self) -> None:
        """Record non-finite states, actions and rewards. This runs at the same time as the hooks from `update_curricula` to
        `disturb`.
        """
        self.nan_guard.check_state(self._in_bounds, self._clipped_actions)
        self.nan_guard.check_rewards(self.rewards.terms_finite, self.valid)
