"""Rollout of a student, with the actions that its teacher would have taken in the same states."""

import torch
from torch import Tensor

from legged.envs import BaseTask
from legged.learning.distillation import DeviceDistillation
from legged.learning.recurrent import Memory
from legged.learning.rollout import Steps


class StudentRollout(Steps):
    """Rollout for distillation."""

    def __init__(self, env: BaseTask, alg: DeviceDistillation) -> None:
        """Take a task and a learner on the same device."""
        super().__init__(env, alg.storage)
        self.alg = alg
        self.student, self.teacher = alg.memory, Memory(alg.teacher, env.num_envs)

    def forget(self) -> None:
        """Reset all returns and lengths of episodes, and all hidden states."""
        super().forget()
        for memory in (self.student, self.teacher):
            for part in memory.parts:
                part.zero_()

    @torch.no_grad()
    def collect(self, steps: int | None = None) -> None:
        """Make `steps` control steps, or a whole rollout if `steps` is None, and record the teacher's actions."""
        for before, now in zip(self.alg.memory_before, self.student.parts, strict=True):
            before.copy_(now)
        super().collect(steps)

    def _act(self, t: int) -> Tensor:
        """Return the student's actions (N, D) with its noise."""
        mean = self._advance(self.student)
        if self.teacher.parts:
            self.storage.privileged_actions[t].copy_(self._advance(self.teacher))
        return torch.addcmul(mean, self.alg.action_std(), torch.randn_like(mean))

    def _advance(self, memory: Memory) -> Tensor:
        """Return the mean actions (N, D) of a network for the current observations, and advance its hidden state in place."""
        now = memory.copy(memory.parts)
        actions = now.act(torch.cat([self._observations[name] for name in memory.network.obs_groups], dim=-1))
        memory.take(now.parts)
        return actions

    def _step(self, t: int) -> None:
        super()._step(t)
        for memory in (self.student, self.teacher):
            for part in memory.parts:
                part.masked_fill_(self.env.reset_buf.unsqueeze(1), 0.0)

    def _finish(self) -> None:
        """Compute the teacher's actions for all steps at once, unless the teacher has recurrent layers."""
        if not self.teacher.parts:
            self.storage.privileged_actions.copy_(self.alg.teacher(self.storage.observations))
