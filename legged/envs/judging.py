"""How a task judges a step: its rewards, its metrics, and the record of both."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from legged.config.schema import TaskConfig
from legged.envs.ahead import Ahead, is_ours
from legged.mdp.faults import Faults
from legged.mdp.metrics import Metrics
from legged.mdp.rewards import Rewards
from legged.mdp.terminations import Terminations
from legged.physics import Physics

REWARD_LINES = 5
"""Lines of work among which rewards are shared out: with so many, those of an ANYmal take an H100 49 us instead of 90, and
`check_termination` beside them 34."""
LATE = frozenset({"termination"})
"""Rewards of ours that ask which episodes end."""


class JudgingTask:
    """The part of a task that says what a step was worth."""

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
    faults: Faults
    check_termination: Callable[[], None]
    active_terminations: Callable[[], tuple[list[str], list[str]]]
    terms: Callable[[str], set[str]]
    _methods: Callable[[str, Any], dict[str, Callable[[], Tensor]]]
    _in_bounds: Tensor
    _clipped_actions: Tensor

    def _collect_judgements(self) -> None:
        """Find the terminations, rewards and metrics that the configuration names."""
        cfg = self.cfg.rewards
        # Who overrides one of these may write there what our terms read.
        plain = all(is_ours(hook) for hook in (self.check_termination, self.measure, self.compute_reward))
        lines = (1, REWARD_LINES, 1) if plain else (0, 0, 0)
        self._endings_ahead, self._rewards_ahead, self._metrics_ahead = (Ahead(self.device, count) for count in lines)
        failures, time_outs = (
            self._endings_ahead.take("_terminate_", self._methods("_terminate_", names))
            for names in self.active_terminations()
        )
        self.terminations = Terminations(failures, time_outs, self.terminated_buf, self.time_out_buf, self.reset_buf)
        scales = {name: scale for name, scale in cfg.scales.items() if scale != 0.0}
        unit = self.dt if cfg.times_dt else 1.0
        rewards = self._rewards_ahead.take("_reward_", self._methods("_reward_", scales), LATE)
        self.rewards = Rewards(rewards, scales, unit, cfg.only_positive_rewards, self.rew_buf, self.physics.kernels)
        self.episode_sums = self.rewards.episode_sums
        metrics = self._metrics_ahead.take("_metric_", self._methods("_metric_", sorted(self.terms("_metric_"))))
        full = self.cfg.env.episode_length_s if cfg.times_dt else self.max_episode_length
        names = self.rewards.names, self.terminations.names
        self.metrics = Metrics(metrics, *names, full, self.num_envs, self.device)

    def _look_ahead(self) -> None:
        """Evaluate what can be while it is judged which episodes end. Runs beside `check_termination`."""
        self._endings_ahead.find()
        self._rewards_ahead.find()
        self._metrics_ahead.find()

    def measure(self) -> None:
        """Take in metrics of the step. Runs beside the rewards."""
        self._metrics_ahead.join()
        self.metrics.add_step(self.valid, self.physics.overflowed, self.terminations.found)

    def compute_reward(self) -> None:
        """Judge the step, before anything is reset."""
        self._rewards_ahead.join()
        self.rewards.compute(self.valid)

    def _record(self) -> None:
        """Take in the episodes that end. Runs beside the curricula."""
        self.metrics.add_episodes(self.reset_buf, self.terminated_buf, self.episode_length_buf, self.rewards.sums)

    def _look_for_faults(self) -> None:
        """Find out which states, actions and rewards are no numbers. Runs beside all that comes before `observe`."""
        self.faults.check_state(self._in_bounds, self._clipped_actions)
        self.faults.check_rewards(self.rewards.fine, self.valid)
