"""rsl-rl's distillation with an update in which the host reads no values from the device. The student acts, and learns the
actions that the teacher would have taken.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from rsl_rl.algorithms import Distillation
from rsl_rl.models import MLPModel
from rsl_rl.utils import resolve_optimizer
from torch import Tensor, nn

from legged.learning.distributed import SharedGradients
from legged.learning.networks import action_std, output_of, update_normalizer
from legged.learning.recurrent import Memory
from legged.learning.row_threads import RowThreads


class DeviceDistillation(Distillation):
    """DAgger (Ross et al., arXiv 1011.0686) as rsl-rl computes it, for students with and without recurrent layers.

    The differences from rsl-rl are these. Losses are summed on the device and read once per iteration. Without recurrent
    layers, the `gradient_length` steps of one gradient form one batch. The optimiser is fused. A recurrent teacher keeps its
    hidden state from one iteration to the next, while rsl-rl resets it. With `stock`, rsl-rl's own update and loop run.
    """

    def __init__(self, student: MLPModel, teacher: MLPModel, *args: Any, stock: bool = False, **kwargs: Any) -> None:
        for parameter in student.distribution.parameters():  # no loss depends on the noise of the student's actions
            parameter.requires_grad_(False)
        with warnings.catch_warnings():  # rsl-rl warns of gradient_length, which the configuration has checked
            warnings.simplefilter("ignore")
            super().__init__(student, teacher, *args, **kwargs)
        name = kwargs.get("optimizer", "adam")
        self._learned = parameters = [parameter for parameter in self.student.parameters() if parameter.requires_grad]
        self.why_stock = "train.runner.loop is stock" if stock else "" if name == "adam" else f"the optimiser is {name}"
        """Reason why rsl-rl's own update is used; empty if it is not."""
        if self.why_stock:
            self.optimizer = resolve_optimizer(name)(parameters, lr=self.learning_rate)  # type: ignore[operator]
        else:
            on_gpu = parameters[0].is_cuda
            self.optimizer = torch.optim.Adam(parameters, lr=self.learning_rate, fused=True, capturable=on_gpu)
            # While found_inf is 1, a fused step leaves the parameters, the moments and the step count unchanged.
            self.optimizer.found_inf = torch.zeros((), device=self.device)  # type: ignore[attr-defined]
            if self.is_multi_gpu:
                self._shared = SharedGradients(parameters, self.gpu_world_size)
        self.memory = Memory(self.student, self.storage.num_envs)
        """Hidden state of the student for each robot, during the rollout."""
        self.memory_before = [part.clone() for part in self.memory.parts]
        """Hidden state before the first step of the stored rollout."""
        self._losses = torch.zeros(2, device=self.device)
        """Mean loss of the last update, and the share of its gradients that were finite and used."""
        self.threads = RowThreads()
        self.left_out = 0.0
        """Share of the last update's gradients that were NaN or infinite and therefore not used."""

    @property
    def actor(self) -> MLPModel:
        """Policy that acts: the student."""
        return self._raw_student

    @property
    def fits_graph(self) -> bool:
        """True if a CUDA graph can capture the update. This is not possible with recurrent layers, because NVIDIA's library
        for these layers decides itself which kernels to launch.
        """
        return not self.student.is_recurrent

    def tensors(self) -> list[Tensor]:
        """Return everything that an update changes: parameters, normaliser, moments of the optimiser."""
        moments = [tensor for state in self.optimizer.state.values() for tensor in state.values()]
        return [*self.student.state_dict(keep_vars=True).values(), *moments]

    def action_std(self) -> Tensor:
        """Return the standard deviation (D,) of the student's actions."""
        return action_std(self.student)

    def update(self) -> dict[str, float]:
        """Learn for all epochs from the stored rollout and return the mean loss."""
        if self.why_stock:
            return super().update()
        self.learn()
        self.storage.clear()
        return self.losses()

    def learn(self, epochs: int | None = None) -> None:
        """Learn from the stored rollout for `epochs` epochs, by default all configured ones. The host reads nothing."""
        self._losses.zero_()
        epochs = epochs or self.num_learning_epochs
        observations = self.storage.observations
        inputs = torch.cat([observations[name] for name in self.student.obs_groups], dim=-1)
        for _ in range(epochs):
            (self._epoch_with_memory if self.student.is_recurrent else self._epoch)(inputs)
        self._losses[:1] /= self._losses[1:].clone()
        self._losses[1:] /= epochs * len(inputs) // self.gradient_length
        if self.student.obs_normalization:
            update_normalizer(self.student.obs_normalizer, inputs.flatten(0, 1))

    def outcome(self) -> dict[str, Tensor]:
        """Return the results of an update, on the device: `losses` (2,) and the standard deviation `std` (D,) of the actions.
        The method `losses` takes the tensor `losses` after its transfer to the host.
        """
        return {"losses": self._losses, "std": self.action_std()}

    def losses(self, numbers: Sequence[float] | None = None) -> dict[str, float]:
        """Return the mean loss of a step, and set `left_out`. `numbers` are the `losses` of `outcome`, after their
        transfer to the host. By default they are read from the device now. The loss is NaN if no gradient was used.
        """
        loss, taken = self._losses.tolist() if numbers is None else numbers
        self.left_out = 1.0 - taken
        return {"behavior": loss}

    def _epoch(self, inputs: Tensor) -> None:
        """Learn once from all steps of `inputs` (T, N, W). The steps of one gradient form one batch."""
        labels = self.storage.privileged_actions
        for x, wanted in zip(inputs.split(self.gradient_length), labels.split(self.gradient_length), strict=True):
            self._forget_gradients()
            chunks = self.threads.chunks((x.flatten(0, 1), wanted.flatten(0, 1)))
            self._step(self.threads.backward(self._gradients, chunks, self._learned))

    def _gradients(self, inputs: Tensor, wanted: Tensor) -> tuple[Sequence[Tensor], Tensor]:
        """Return the gradients for inputs (n, width) and wanted actions (n, D) of a gradient's steps, and the mean loss (1,).

        rsl-rl adds up the mean losses of single steps. That sum is the mean over all steps times their number.
        """
        mean = self.loss_fn(output_of(self.student, inputs, self.use_mixed_precision), wanted)
        return torch.autograd.grad(self.gradient_length * mean, self._learned), mean.detach().unsqueeze(0)

    def _epoch_with_memory(self, inputs: Tensor) -> None:
        """Learn once from all steps of `inputs` (T, N, W), in order, starting from the hidden state before the first step."""
        memory = self.memory.copy(self.memory_before)
        loss = torch.zeros((), device=self.device)
        for t, x in enumerate(inputs):
            with torch.autocast(x.device.type, torch.bfloat16, self.use_mixed_precision):
                actions = memory.act(x)
            loss = loss + self.loss_fn(actions.float(), self.storage.privileged_actions[t])
            if (t + 1) % self.gradient_length == 0:
                self._descend(loss)
                memory.detach()
                loss = torch.zeros((), device=self.device)
            memory.forget(self.storage.dones[t].bool())
        self.memory.take(memory.parts)

    def _descend(self, loss: Tensor) -> None:
        """Take a gradient step. `loss` () is a sum over `gradient_length` steps."""
        self._forget_gradients()
        loss.backward()
        self._step(loss.detach().unsqueeze(0) / self.gradient_length)

    def _forget_gradients(self) -> None:
        if self.is_multi_gpu:
            self._shared.zero_()
        else:
            self.optimizer.zero_grad()

    def _step(self, mean: Tensor) -> None:
        """Take a gradient step, unless the `mean` loss (1,) or a gradient is NaN or infinite."""
        if self.is_multi_gpu:
            self._shared.average_(mean[0])
        norm = nn.utils.clip_grad_norm_(self.student.parameters(), self.max_grad_norm or torch.inf)
        fine = (norm + mean[0]) < torch.inf
        torch.logical_not(fine, out=self.optimizer.found_inf)  # type: ignore[attr-defined]
        self.optimizer.step()
        self._losses += torch.where(fine, torch.cat([mean, torch.ones_like(mean)]), 0.0)

    def save(self) -> dict:
        """Return the parts of a checkpoint: the student as `actor`, the teacher, and the optimiser. The optimiser has
        rsl-rl's form: it is not fused, and its step counts are on the host.
        """
        saved = self.optimizer.state_dict()
        state = {
            key: {name: tensor.cpu() if name == "step" else tensor for name, tensor in tensors.items()}
            for key, tensors in saved["state"].items()
        }
        groups = saved["param_groups"]
        if not self.why_stock:
            groups = [{**group, "fused": None, "capturable": False} for group in groups]
        return {
            "actor_state_dict": self._raw_student.state_dict(),
            "teacher_state_dict": self._raw_teacher.state_dict(),
            "optimizer_state_dict": {"state": state, "param_groups": groups},
        }

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load student, teacher and optimiser from a checkpoint. The learning rate stays that of the configuration."""
        parts = load_cfg or {"optimizer": True, "iteration": True}
        self._raw_student.load_state_dict(loaded_dict["actor_state_dict"], strict=strict)
        self._raw_teacher.load_state_dict(loaded_dict["teacher_state_dict"], strict=strict)
        self.teacher_loaded = True
        if parts.get("optimizer"):
            rates = [group["lr"] for group in self.optimizer.param_groups]
            self.optimizer.load_state_dict(loaded_dict["optimizer_state_dict"])
            for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
                group["lr"] = rate
        return parts.get("iteration", False)
