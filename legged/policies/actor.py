"""A trained policy: the actor network without the learner."""

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.envs import BaseTask
from legged.errors import ConfigError
from legged.learning.checkpoint import describe_mismatch, read_checkpoint
from legged.learning.networks import build_actor, use_matmul
from legged.process.paths import relative


class Actor:
    """A policy in its task: observations -> actions (N, D), without noise. The hidden state of a recurrent policy is cleared
    for robots whose episode has ended.
    """

    def __init__(self, task: BaseTask, device: torch.device | str) -> None:
        """Build the network of the task's configuration on `device`; `load` sets its weights."""
        self.task = task
        use_matmul(task.cfg)
        self.network = build_actor(task.cfg, task.get_observations(), task.num_actions).to(device).eval()
        """Model of rsl-rl; a recurrent one keeps the hidden state of the task's robots between calls."""

    def __call__(self, observations: TensorDict) -> Tensor:
        """Return the actions; a recurrent policy must be called once per step of the task."""
        if self.network.is_recurrent:
            self._forget(self.task.reset_buf)
        return self.network(observations)

    def _forget(self, ended: Tensor) -> None:
        """Clear the hidden state of the robots in the mask `ended` (N,)."""
        hidden = self.network.get_hidden_state()
        if hidden is None:
            return
        # The old tensors may come from inference mode, so they are not changed in place.
        parts = hidden if isinstance(hidden, tuple) else (hidden,)
        kept = tuple(torch.where(ended.view(1, -1, 1).to(part.device), 0.0, part.detach()) for part in parts)
        self.network.reset(hidden_state=kept if isinstance(hidden, tuple) else kept[0])

    def load(self, checkpoint: Path) -> int:
        """Load the weights of a checkpoint, and continue its curricula in the task; return the number of training iterations
        of the checkpoint.

        Raises:
            ConfigError: the file is no checkpoint, or its network has other sizes.
        """
        saved = read_checkpoint(checkpoint)
        try:
            self.network.load_state_dict(saved["actor_state_dict"])
        except RuntimeError as error:
            wanted = self.network.state_dict()
            raise ConfigError(describe_mismatch(checkpoint, saved, wanted, self.task.cfg.task)) from error
        self.network.reset()
        try:
            if "task_state" in saved["infos"]:
                self.task.load_progress(saved["infos"]["task_state"])
        except (RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
            where = relative(checkpoint)
            raise ConfigError(f"{where}: the progress of its curricula is damaged ({error})") from error
        return saved["iter"] + 1
