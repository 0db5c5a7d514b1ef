"""A trained policy that acts: the actor's network alone, without the learner around it."""

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
    """A policy in its task: observations -> actions (N, D), without noise. A recurrent one forgets, robot by robot, the
    episodes that have ended.
    """

    def __init__(self, task: BaseTask, device: torch.device | str) -> None:
        """Build the network that the task's configuration describes, on `device`; its weights come with `load`."""
        self.task = task
        use_matmul(task.cfg)
        self.network = build_actor(task.cfg, task.get_observations(), task.num_actions).to(device).eval()
        """rsl-rl's model; if it is recurrent, it keeps the hidden state of the task's robots from call to call."""

    def __call__(self, observations: TensorDict) -> Tensor:
        """Return the actions; to be called once for every step of the task, if the policy is recurrent."""
        if self.network.is_recurrent:
            self._forget(self.task.reset_buf)
        return self.network(observations)

    def _forget(self, ended: Tensor) -> None:
        """Clear the memory of the robots in `ended` (N,)."""
        hidden = self.network.get_hidden_state()
        if hidden is None:
            return
        # New tensors: the old ones may come from inference mode, and the call from outside of it.
        parts = hidden if isinstance(hidden, tuple) else (hidden,)
        kept = tuple(torch.where(ended.view(1, -1, 1).to(part.device), 0.0, part.detach()) for part in parts)
        self.network.reset(hidden_state=kept if isinstance(hidden, tuple) else kept[0])

    def load(self, checkpoint: Path) -> int:
        """Take the weights of a checkpoint, and the progress of its curricula for the task; return how many iterations it had
        been trained for.

        Raises:
            ConfigError: the file is no checkpoint, or of another network.
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
