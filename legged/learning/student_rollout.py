"""The rollout of a student: it acts, and its teacher says what it would have done, on the student's states."""

import torch
from torch import Tensor

from legged.envs import BaseTask
from legged.learning.distillation import DeviceDistillation
from legged.learning.recurrent import Memory
from legged.learning.rollout import Steps


class StudentRollout(Steps):
    """The steps from which a student learns."""

    def __init__(self, env: BaseTask, alg: DeviceDistillation) -> None:
        """Roll out a task for a learner on the same device."""
        super().__init__(env, alg.storage)
        self.alg = alg
        self.student, self.teacher = alg.memory, Memory(alg.teacher, env.num_envs)

    def forget(self) -> None:
        """Begin all episodes anew."""
        super().forget()
        for memory in (self.student, self.teacher):
            for part in memory.parts:
                part.zero_()

    @torch.no_grad()
    def collect(self, steps: int | None = None) -> None:
        """Make T steps into the storage, with what the teacher would have done; `steps`, to rehearse, are fewer of them."""
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
        """Return the mean actions (N, D) of a network for the observations now, and let it remember them in place."""
        now = memory.copy(memory.parts)
        actions = now.act(torch.cat([self._observations[name] for name in memory.network.obs_groups], dim=-1))
        memory.take(now.parts)
        return actions

    def _step(self, t: int) -> None:
        super()._step(t)
        for memory in (self.student, self.teacher):
            for part in memory.parts:
                part.masked_fill_(self.env.reset_buf.unsqueeze(1), 0.0)

    def _judge(self) -> None:
        """Let a teacher that has no memory say for all steps at once what it would have done."""
        if not self.teacher.parts:
            self.storage.privileged_actions.copy_(self.alg.teacher(self.storage.observations))
