"""PPO's update as a sequence of kernels."""

import math
from collections.abc import Sequence
from subprocess import CalledProcessError

import torch
from torch import Tensor, nn
from triton.errors import TritonError

from legged.graph.step_graph import Branch
from legged.learning.critic_warmup import CriticWarmup
from legged.learning.fused_update import kernels
from legged.learning.fused_update.layout import BLOCK, Layout, padded
from legged.learning.fused_update.network import ROWS, Network, linear_layers

FAILURES = (RuntimeError, CalledProcessError, TritonError)
"""Errors of Triton if it finds no C compiler, or if a kernel does not fit the GPU."""


class FusedUpdate:
    """PPO's update of an actor and a critic as kernels.

    All parameters move into one vector, and Adam's moments into two others. The networks' parameters and the optimiser's
    state are views of these vectors.
    """

    def __init__(
        self, alg: CriticWarmup, rate: Tensor, rates: tuple[float, float, float], kind: torch.dtype = torch.float16
    ) -> None:
        """Take the learner; its learning `rate` () on the device; the lowest and highest rate, and the factor of an
        adaptation; and the type of the operands of products. All kernels are launched once, on zeros.

        Raises:
            One of FAILURES: Triton can't compile or launch a kernel. The learner is unchanged then.
        """
        self.alg, self.rate, self._rates = alg, rate, rates
        device, storage = rate.device, alg.storage
        self.models = (alg.actor, alg.critic)
        linears = [linear_layers(model) for model in self.models]
        self.actions = storage.actions.shape[-1]
        self.layout = layout = Layout(linears, self.actions)

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        self.vector, self.first, self.second = zeros(layout.size), zeros(layout.size), zeros(layout.size)
        self.shadow = zeros(layout.size, dtype=kind)
        self.steps = zeros(2)
        """Numbers of Adam's steps of actor and critic."""
        self.images = 2 if alg.symmetry else 1
        self.samples = storage.actions[..., 0].numel() // alg.num_mini_batches
        self.rows_used = self.samples * self.images
        """Rows of a mini-batch without padding."""
        self.rows = ROWS * -(-self.rows_used // ROWS)
        self.networks = [Network(layers, self.rows, alg.num_mini_batches, kind, device) for layers in layout.networks]
        self.columns = padded(self.actions)
        totals = 4 + self.columns
        self.gradient = zeros(layout.size + totals)
        """Gradient by the vector, followed by the sums of losses and of the gradient by the standard deviation."""
        self.totals = self.gradient[layout.size :]
        self.sums = zeros(self.rows // ROWS, totals)
        self.largest, self.no_factor = zeros(2, 4), torch.full((1,), 16.0, device=device)
        """Column 0 has the largest |gradient| by the outputs of actor and critic; `no_factor` is one whose factor is 1."""
        self.scalars = zeros(2, 4)
        """Numbers that `settle` leaves to `adam`."""
        self.squares = zeros(sum(len(network.parts) for network in self.networks))
        self._branch = Branch(device)

        self._mirror_actions = self._mirror_table([])
        self._mirror_inputs = [self._mirror_table(model.obs_groups) for model in self.models]
        self._launch_all()
        self._adopt(linears)

    def _launch_all(self) -> None:
        """Take a step with parameters that are 0, so that all kernels are compiled. Undo it afterwards."""
        before = self.rate.clone()
        losses = torch.zeros(6, device=self.rate.device)
        order = torch.rand(self.samples * self.alg.num_mini_batches, device=self.rate.device).argsort()
        self.learn(order, 0, False, losses)
        self._step(0, torch.zeros(self.samples, dtype=torch.int64, device=self.rate.device), False, losses)
        self.rate.copy_(before)
        for tensor in (self.vector, self.first, self.second, self.steps):
            tensor.zero_()

    def _adopt(self, linears: list[list[nn.Linear]]) -> None:
        """Turn parameters and moments into views of the vectors, with their values."""
        std = self.alg.actor.distribution.std_param
        views = [self.layout.views(vector, linears, std) for vector in (self.vector, self.first, self.second)]
        of_actor = {id(parameter) for parameter in self.alg.actor.parameters()}
        for parameter, view in views[0].items():
            view.copy_(parameter.data)
            parameter.data = view
            step = self.steps[0 if id(parameter) in of_actor else 1]
            moments = {"exp_avg": views[1][parameter], "exp_avg_sq": views[2][parameter]}
            self.alg.optimizer.state[parameter] = {"step": step, **moments}
        self._state = {parameter: dict(self.alg.optimizer.state[parameter]) for parameter in views[0]}

    def take_state(self) -> None:
        """Copy a state that the optimiser has loaded into the vectors."""
        for parameter, own in self._state.items():
            loaded = self.alg.optimizer.state[parameter]
            for name, tensor in own.items():
                tensor.copy_(loaded[name])
            self.alg.optimizer.state[parameter] = dict(own)

    def _mirror_table(self, groups: Sequence[str]) -> tuple[Tensor, Tensor]:
        """Return columns and signs (images, padded width) that make samples and mirror images: of inputs that consist of the
        observation `groups`, or of actions if there are no groups.

        The columns and signs are found by mirroring a row in which each number is its column, counted from 1.
        """
        widths = [self.alg.storage.observations[name].shape[-1] for name in groups] or [self.actions]
        numbers = torch.arange(1.0, sum(widths) + 1.0, device=self.rate.device).unsqueeze(0)
        rows, symmetry = numbers, self.alg.symmetry
        if symmetry and groups:
            observations = self.alg.storage.observations[0, :1].clone()
            observations.update(dict(zip(groups, numbers.split(widths, dim=-1), strict=True)))
            seen, _ = symmetry.data_augmentation_func(env=symmetry.env, obs=observations, actions=None)
            rows = torch.cat([seen[name] for name in groups], dim=-1)
        elif symmetry:
            _, rows = symmetry.data_augmentation_func(env=symmetry.env, obs=None, actions=numbers)
        rows = nn.functional.pad(rows, (0, padded(rows.shape[1]) - rows.shape[1]))
        return (rows.abs() - 1.0).clamp(min=0.0).int(), rows.sign()

    @torch.no_grad()
    def learn(self, order: Tensor, epochs: int, critic_alone: bool, losses: Tensor) -> None:
        """Learn from the stored rollout for a number of epochs, and add the losses of the mini-batches to `losses` (K,).
        Mini-batches take the samples in the `order` (S,), a permutation.
        """
        st = self.alg.storage
        batches = self.alg.num_mini_batches
        self._bound_std()
        self.shadow.copy_(self.vector)
        self.largest.zero_()
        for model, network, mirror in zip(self.models, self.networks, self._mirror_inputs, strict=True):
            groups = [st.observations[name].flatten(0, 1) for name in model.obs_groups]
            x = groups[0] if len(groups) == 1 else torch.cat(groups, dim=-1)
            network.pack(model, x, order, mirror, self.samples)
        for _ in range(epochs):
            for batch in range(batches):
                self._step(batch, order[batch * self.samples :], critic_alone, losses)

    def _step(self, batch: int, order: Tensor, critic_alone: bool, losses: Tensor) -> None:
        """Take a gradient step on a mini-batch, whose samples begin `order`."""
        actor, critic = self.networks
        with self._branch.fork():
            critic.forward(batch, self.shadow, self.vector)
            self._critic_loss(critic, order)
            critic.backward(batch, self.shadow, self.largest[1])
            critic.reduce(self.gradient, self.squares[len(actor.parts) :], self.largest[1], self.rows_used)
        actor.forward(batch, self.shadow, self.vector)
        self._actor_loss(actor, order)
        actor.backward(batch, self.shadow, self.largest[0])
        actor.reduce(self.gradient, self.squares, self.largest[0], self.rows_used)
        self._branch.join()
        torch.sum(self.sums, dim=0, out=self.totals)
        if self.alg.is_multi_gpu:
            self._average()
        self._settle(critic_alone, losses)
        self._adam()
        self._bound_std()

    def _actor_loss(self, network: "Network", order: Tensor) -> None:
        st, columns = self.alg.storage, self.columns
        # The storage has no parameters of a policy before the first rollout.
        old_mean, old_std = st.distribution_params or (st.actions, st.actions)
        kernels.actor_loss[(self.rows // ROWS,)](
            network.outputs[-1], order, st.actions, *self._mirror_actions, st.actions_log_prob, st.advantages,
            old_mean, old_std, self.vector[self.layout.std :], network.by_outputs, self.largest, self.sums, self.samples,
            self.alg.clip_param, self.images, self.actions, columns, ROWS,
        )  # fmt: skip

    def _critic_loss(self, network: "Network", order: Tensor) -> None:
        st, alg = self.alg.storage, self.alg
        kernels.critic_loss[(self.rows // ROWS,)](
            network.outputs[-1], order, st.values, st.returns, network.by_outputs, self.largest[1], self.sums,
            self.samples, alg.clip_param, alg.value_loss_coef, alg.use_clipped_value_loss, self.images,
            network.layers[-1].outputs, self.sums.shape[1], ROWS,
        )  # fmt: skip

    def _average(self) -> None:
        """Average the gradient and the sums of losses over all processes, and sum up the squares anew."""
        torch.distributed.all_reduce(self.gradient)
        self.gradient /= self.alg.gpu_world_size
        start = 0
        for network in self.networks:
            own, programs = self.gradient[network.start :], len(network.parts)
            kernels.reduce[(programs,)](own, network.one_part, own, self.squares[start:], self.no_factor, 1.0, 0, BLOCK)
            start += programs

    def _settle(self, critic_alone: bool, losses: Tensor) -> None:
        alg, layout = self.alg, self.layout
        adaptive = alg.desired_kl is not None and alg.schedule == "adaptive"
        decays = alg.optimizer.param_groups[0]["betas"]
        kernels.settle[(1,)](
            self.totals, self.squares, self.largest, self.vector[layout.std :], self.gradient[layout.std :], self.rate,
            self.steps, self.scalars, losses, self.rows_used, self.samples, alg.entropy_coef, alg.desired_kl or 0.0,
            *self._rates, alg.max_grad_norm, *(math.log(decay) for decay in decays), len(self.networks[0].parts),
            len(self.squares), adaptive, critic_alone, self.images, self.actions, self.columns,
            1 << (len(self.squares) - 1).bit_length(),
        )  # fmt: skip

    def _adam(self) -> None:
        layout, group = self.layout, self.alg.optimizer.param_groups[0]
        kernels.adam[(layout.size // BLOCK,)](
            self.vector, self.first, self.second, self.shadow, self.gradient, self.rate, self.scalars, layout.actor_end,
            *group["betas"], group["eps"], BLOCK,
        )  # fmt: skip

    def _bound_std(self) -> None:
        """Clamp the standard deviation to its bounds, as `keep_std_in_bounds` does after a step of the optimiser."""
        self.vector[self.layout.std : self.layout.std + self.actions].clamp_(*self.alg.actor.distribution.std_range)
