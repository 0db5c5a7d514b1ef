"""rsl-rl's PPO with an update in which the host reads no values from the device. Losses and gradient steps are those of
rsl-rl, but losses are computed in closed form, and data is shuffled once per update.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.modules.normalization import EmpiricalNormalization
from torch import Tensor

from legged.learning import closed_form
from legged.learning.closed_form import HALF_LOG_2PI
from legged.learning.critic_warmup import CriticWarmup
from legged.learning.distributed import SharedGradients, copy_from_first_
from legged.learning.estimator import SECTION, EstimatingModel, EstimationErrors
from legged.learning.fused_update import why_not
from legged.learning.networks import action_std, output_of, update_normalizer
from legged.learning.row_threads import Chunks, RowThreads

if TYPE_CHECKING:
    from legged.learning.fused_update.update import FusedUpdate

LOWEST_RATE, HIGHEST_RATE, RATE_STEP = 1e-5, 1e-2, 1.5
"""Bounds of the adaptive learning rate, and the factor by which one adaptation raises or lowers it, as in rsl-rl."""
FEW = 1e-8
LOSSES = ("value", "surrogate", "entropy", "kl", "symmetry")
"""Logged losses of an update, by rsl-rl's names. `kl` is the divergence from the policy that acted to the policy that learns.
`symmetry` is the mean square difference between the policy and its mirror image, logged only if symmetry is on."""


class MiniBatch(NamedTuple):
    """Tensors of n samples. With symmetry, most have 2 n rows, because the mirror images follow the samples."""

    actor_input: Tensor
    """(n or 2 n, width) inputs of the actor."""
    critic_input: Tensor
    """(n or 2 n, width) inputs of the critic."""
    actions: Tensor
    """(n or 2 n, D) actions."""
    old_log_prob: Tensor
    """(n or 2 n,) log-probabilities of the samples under the policy that acted."""
    advantages: Tensor
    """(n or 2 n,) advantages."""
    old_values: Tensor
    """(n or 2 n,) values before the update."""
    returns: Tensor
    """(n or 2 n,) returns."""
    old_mean: Tensor
    """(n, D) mean of the Gaussian that acted."""
    old_std: Tensor
    """(n, D) standard deviation of the Gaussian that acted."""
    targets: Tensor | None = None
    """(n or 2 n, E) targets of the actor's estimator, if it has one."""


class DevicePPO(CriticWarmup):
    """PPO (Schulman et al., arXiv 1707.06347) as rsl-rl computes it, for Gaussian MLP policies.

    The differences from rsl-rl are these. The learning rate is a tensor on the device. Samples are shuffled into contiguous
    memory once per update, instead of being gathered for every mini-batch. The Gaussian's log-probability, entropy and
    divergence have closed forms. The optimiser is fused. Losses are summed on the device and read once per update. An actor's
    estimator learns from the same mini-batches. On a GPU, `FusedUpdate` takes the same steps by Triton kernels, unless
    `why_not` names a reason against it. If a feature needs rsl-rl's own update, `why_stock` names the feature and that update
    runs.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._rate: Tensor | None = None
        self._fused: FusedUpdate | None = None
        super().__init__(*args, **kwargs)
        self.why_stock = self._why_stock()
        """Reason why rsl-rl's own update is used; empty if it is not."""
        if not self.why_stock:
            self._rate = torch.tensor(self._initial_rate, device=self.device)
            self._learned = [parameter for part in self._parts() for parameter in part]
            capturable = self._rate.is_cuda
            self.optimizer = torch.optim.Adam(self._optimized(), lr=self._rate, fused=True, capturable=capturable)
            # While found_inf is 1, a fused step leaves the parameters, the moments and the step count unchanged.
            self.optimizer.found_inf = torch.zeros((), device=self.device)  # type: ignore[attr-defined]
            reason = why_not(self) or self.use_kernels()
            if reason and self._rate.is_cuda:
                print(f"the update runs without fused kernels: {reason}", flush=True)
            if self.is_multi_gpu and self._fused is None:
                self._shared = SharedGradients(self._learned, self.gpu_world_size)
        count = len(LOSSES) if self.symmetry else len(LOSSES) - 1
        self._errors: EstimationErrors | None = None
        self._losses = torch.zeros(count + 1, device=self.device)
        """Means over the mini-batches of the last update: the losses in the order of `LOSSES`, the square estimation error of
        each term if there is an estimator, and the share of mini-batches that were used."""
        self._one = torch.ones(1, device=self.device)
        self.threads = RowThreads()
        """Threads that compute gradients on a CPU. By default mini-batches are not split."""
        plain = not self.why_stock and type(self.actor) is MLPModel and not self.use_mixed_precision
        self._in_closed_form = (
            plain
            and torch.device(self.device).type == "cpu"
            and all(closed_form.fits(model.mlp) for model in (self.actor, self.critic))
        )
        self._critic_alone = False
        """True while an update of the value function alone runs or is captured."""
        self.left_out = 0.0
        """Share of the last update's mini-batches that were skipped, because a gradient was NaN or infinite."""

    fits_graph = True
    """True if a CUDA graph can capture an update. Features that can't be captured use rsl-rl's own loop."""

    def use_kernels(self, kind: torch.dtype = torch.float16) -> str:
        """Compute updates by Triton kernels, whose products have operands of type `kind`. If Triton fails on this machine,
        return a text that says why; else an empty text.
        """
        from legged.learning.fused_update.update import FAILURES, FusedUpdate  # these import Triton

        assert self._rate is not None
        try:
            self._fused = FusedUpdate(self, self._rate, (LOWEST_RATE, HIGHEST_RATE, RATE_STEP), kind)
        except FAILURES as error:
            return f"Triton fails here: {' '.join(str(error).split())[:200]}"
        return ""

    def broadcast_parameters(self) -> None:
        """Give all processes the networks of the first. The kernels pad their weights, so these are not contiguous."""
        networks = [self.actor, self.critic, *([self.rnd.predictor, self.rnd.target] if self.rnd else [])]
        for network in networks:
            copy_from_first_(network.state_dict().values())

    def learn_to_estimate(self, errors: EstimationErrors, learning_rate: float) -> None:
        """Set the object that measures estimation errors, and the learning rate of the actor's estimator. Call this once,
        before the first update.
        """
        self._errors = errors
        self._losses = torch.zeros(len(self._losses) + len(errors.names), device=self.device)
        self.optimizer.param_groups[-1]["lr"] = learning_rate

    def _parts(self) -> list[list[torch.nn.Parameter]]:
        """Return the parameters of the actor, of the critic, and of the actor's estimator if it has one. Gradients are
        clipped for each of these lists separately.
        """
        of_actor = list(self.actor.parameters())
        parts = [of_actor, list(self.critic.parameters())]
        if isinstance(self.actor, EstimatingModel):
            estimator = list(self.actor.estimator.parameters())
            those = {id(parameter) for parameter in estimator}
            parts = [[parameter for parameter in of_actor if id(parameter) not in those], parts[1], estimator]
        return [[parameter for parameter in part if parameter.requires_grad] for part in parts]

    def _optimized(self) -> list[dict[str, Any]]:
        """Return the optimiser's parameter groups: actor and critic with the adaptive learning rate, and the estimator, if
        there is one, with a constant rate.
        """
        actor, critic, *estimator = self._parts()
        return [{"params": [*actor, *critic]}, *({"params": part, "lr": 1e-3} for part in estimator)]

    def tensors(self) -> list[Tensor]:
        """Return everything that an update changes: parameters, normalisers, moments of the optimiser, learning rate."""
        models = [tensor for model in (self.actor, self.critic) for tensor in model.state_dict(keep_vars=True).values()]
        moments = [tensor for state in self.optimizer.state.values() for tensor in state.values()]
        assert self._rate is not None
        return [*models, *moments, self._rate]

    def _why_stock(self) -> str:
        """Return the first configured feature that only rsl-rl's own update supports, or an empty text."""
        if self.symmetry and self.symmetry.use_mirror_loss:
            return "mirror_loss_coeff is above 0"
        for name, model in (("actor", self.actor), ("critic", self.critic)):
            if type(model) not in (MLPModel, EstimatingModel):
                return f"the {name} is a {type(model).__name__}"
        if type(self.actor.distribution) is not GaussianDistribution:
            return f"actions are {type(self.actor.distribution).__name__}"
        if type(self.optimizer) is not torch.optim.Adam:
            return f"the optimiser is {type(self.optimizer).__name__}"
        return ""

    @property
    def learning_rate(self) -> float:  # type: ignore[override]
        """Current learning rate. Reading it waits for the device."""
        return self._initial_rate if self._rate is None else float(self._rate)

    @learning_rate.setter
    def learning_rate(self, value: float | Tensor) -> None:
        if self._rate is None:
            self._initial_rate = float(value)
        else:
            self._rate.fill_(value)

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load a checkpoint of this class or of rsl-rl's PPO."""
        rates = [group["lr"] for group in self.optimizer.param_groups]
        iteration = super().load(loaded_dict, load_cfg, strict)
        if self._rate is not None:  # loading has replaced the tensor by the saved number
            groups = self.optimizer.param_groups
            self._rate.fill_(groups[0]["lr"])
            for group, rate in zip(groups, (self._rate, *rates[1:]), strict=True):
                group.update(lr=rate, fused=True, capturable=self._rate.is_cuda)
            for state in self.optimizer.state.values():
                state["step"] = state["step"].to(self.device, torch.float32)
            if self._fused is not None:
                self._fused.take_state()
        return iteration

    def save(self) -> dict:
        """Return the parts of a checkpoint in rsl-rl's form: the optimiser is not fused, and its learning rate and step
        counts are on the host.
        """
        saved = super().save()
        if self._rate is not None:
            optimizer = saved["optimizer_state_dict"]
            moments = {key: alone(state) for key, state in optimizer["state"].items()}
            plain = {"fused": None, "capturable": False}
            saved["optimizer_state_dict"] = {
                "state": {key: {**state, "step": state["step"].cpu()} for key, state in moments.items()},
                "param_groups": [{**group, "lr": float(group["lr"]), **plain} for group in optimizer["param_groups"]],
            }
            saved |= {name: alone(saved[name]) for name in ("actor_state_dict", "critic_state_dict")}
        return saved

    def update(self) -> dict[str, float]:
        """Learn for all epochs from the stored rollout and return the mean losses."""
        if self.why_stock:
            return super().update()
        (self.learn_critic if self.warming_up() else self.learn)()
        self.storage.clear()
        return self.losses()

    def learn_critic(self, epochs: int | None = None) -> None:
        """Learn as `learn` does, but change the value function alone. The policy and its normaliser stay as they are."""
        self._critic_alone = True
        self.learn(epochs)
        self._critic_alone = False

    def fill_moments(self) -> None:
        """Create the optimiser's initial moments for every parameter that has none, so that a graph knows their addresses
        before the first step that uses them.
        """
        for group in self.optimizer.param_groups:
            for parameter in group["params"]:
                if not self.optimizer.state[parameter]:
                    step = torch.zeros((), device=parameter.device)
                    moments = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
                    self.optimizer.state[parameter].update({"step": step, **moments})

    def learn(self, epochs: int | None = None) -> None:
        """Learn from the stored rollout for `epochs` epochs, by default all configured ones. Nothing is read on the host, so
        one graph can hold the update.
        """
        self._losses.zero_()
        epochs = epochs or self.num_learning_epochs
        if self._fused is not None:
            self._fused.learn(
                self._order(self._fused.samples * self.num_mini_batches), epochs, self._critic_alone, self._losses
            )
        else:
            batches = self._mini_batches()
            for _ in range(epochs):
                for batch in batches:
                    self._losses += self._step(batch)
        self._losses[:-1] /= self._losses[-1:].clone()
        self._losses[-1:] /= self.num_learning_epochs * self.num_mini_batches
        self._update_normalizers()

    def outcome(self) -> dict[str, Tensor]:
        """Return the results of an update, on the device: `losses` (K,), the standard deviation `std` (D,) of the actions,
        and the learning `rate` (). The method `losses` takes the tensor `losses` after its transfer to the host.
        """
        rate = {} if self._rate is None else {"rate": self._rate}
        return {"losses": self._losses, "std": self.action_std(), **rate}

    def losses(self, numbers: Sequence[float] | None = None) -> dict[str, float]:
        """Return the mean losses of an update, and set `left_out`. `numbers` are the `losses` of `outcome`, after their
        transfer to the host. By default they are read from the device now.

        Losses are NaN if all mini-batches were skipped. With an estimator, its root mean square errors are added as
        `Estimator/<term>_rmse`, each in the term's unit.
        """
        *losses, taken = self._losses.tolist() if numbers is None else numbers
        self.left_out = 1.0 - taken
        terms = self._errors.names if self._errors else ()
        squares = [losses.pop() for _ in terms][::-1]
        errors = {f"{SECTION}{term}_rmse": math.sqrt(square) for term, square in zip(terms, squares, strict=True)}
        return {**dict(zip(LOSSES, losses, strict=False)), **errors}

    @torch.no_grad()
    def _mini_batches(self) -> list[Chunks]:
        """Return the shuffled rollout as mini-batches (see `MiniBatch`), each in chunks."""
        st = self.storage
        observations, actions = st.observations.flatten(0, 1), st.actions.flatten(0, 1)
        samples = len(actions)
        if self.symmetry:
            observations, actions = self.symmetry.data_augmentation_func(
                env=self.symmetry.env, obs=observations, actions=actions
            )
        images = len(actions) // samples
        count = samples // self.num_mini_batches
        order = self._order(count * self.num_mini_batches).view(self.num_mini_batches, count)
        imaged = torch.cat([order + i * samples for i in range(images)], dim=1)
        repeated = order.repeat(1, images)
        inputs = [torch.cat([observations[name] for name in m.obs_groups], dim=-1) for m in (self.actor, self.critic)]
        single = (st.actions_log_prob, st.advantages, st.values, st.returns)
        assert st.distribution_params is not None
        columns = [
            *((column, imaged) for column in (*inputs, actions)),
            *((column.flatten(), repeated) for column in single),
            *((column.flatten(0, 1), order) for column in st.distribution_params),
        ]
        if isinstance(self.actor, EstimatingModel):
            columns.append((torch.cat([observations[name] for name in self.actor.target_groups], dim=-1), imaged))
        shuffled = [column.index_select(0, index.flatten()).split(index.shape[1]) for column, index in columns]
        batches = [MiniBatch(*tensors) for tensors in zip(*shuffled, strict=True)]
        if self.normalize_advantage_per_mini_batch:
            own = [batch.advantages[:count] for batch in batches]
            batches = [
                batch._replace(advantages=(batch.advantages - samples.mean()) / (samples.std() + FEW))
                for batch, samples in zip(batches, own, strict=True)
            ]
        return [self.threads.chunks([tensor for tensor in batch if tensor is not None]) for batch in batches]

    def _order(self, count: int) -> Tensor:
        """Return a random permutation of `count` samples, found by sorting random numbers. A CUDA graph can hold a sort."""
        return torch.rand(count, device=self.device).argsort()

    def _step(self, batch: Chunks) -> Tensor:
        """Adapt the learning rate and take a gradient step on a mini-batch. Return its figures (`_loss`) and a count of 1; or
        return zeros without a step, if a gradient or the value loss is NaN or infinite.
        """
        if self.is_multi_gpu:
            self._shared.zero_()
        else:
            self.optimizer.zero_grad()
        figures = self.threads.backward(self._gradients, batch, self._learned)
        # If the critic returns NaN, the gradient of the clipped value loss may be finite, so the loss is checked as well.
        kl, valued = figures[LOSSES.index("kl")], figures[LOSSES.index("value")].clone()
        if self.is_multi_gpu:
            self._shared.average_(kl, valued)  # this writes the means over all processes into both
        if self._critic_alone:
            return self._step_critic(figures, valued)
        if self.desired_kl is not None and self.schedule == "adaptive":
            self._adapt_rate(kl)
        fine = (self._clip_gradients() + valued) < torch.inf
        torch.logical_not(fine, out=self.optimizer.found_inf)  # type: ignore[attr-defined]
        self.optimizer.step()
        return torch.where(fine, torch.cat([figures, self._one]), 0.0)

    def _gradients(self, *tensors: Tensor) -> tuple[Sequence[Tensor | None], Tensor]:
        """Return the gradient of a mini-batch's loss by each learned parameter, and the figures (K,) of `_loss`. `tensors`
        are the fields of a `MiniBatch`.
        """
        batch = MiniBatch(*tensors)
        if self._in_closed_form:
            return self._gradients_in_closed_form(batch)
        loss, figures = self._loss(batch)
        return torch.autograd.grad(loss, self._learned, allow_unused=True), figures

    @torch.no_grad()
    def _gradients_in_closed_form(self, batch: MiniBatch) -> tuple[Sequence[Tensor | None], Tensor]:
        """Return the same as `_gradients` without autograd."""
        actor, critic = self.actor, self.critic
        with torch.enable_grad():
            bounded = self.action_std()
        std = bounded.detach()
        acted = closed_form.forward(actor.mlp, actor.obs_normalizer(batch.actor_input))
        valued = closed_form.forward(critic.mlp, critic.obs_normalizer(batch.critic_input))
        mean, rows = acted[0][-1], len(batch.actions)
        surrogate, by_mean, by_std = closed_form.surrogate_loss(
            mean, std, batch.actions, batch.old_log_prob, batch.advantages, self.clip_param
        )
        errors, by_value = closed_form.value_loss(
            valued[0][-1].squeeze(-1),
            batch.returns,
            batch.old_values,
            self.clip_param if self.use_clipped_value_loss else None,
        )
        figures = self._figures(batch, mean, std, errors.mean(), surrogate.mean())
        of_critic = closed_form.backward(critic.mlp, *valued, (self.value_loss_coef / rows * by_value).unsqueeze(-1))
        found = dict(zip(critic.mlp.parameters(), of_critic, strict=True))
        if not self._critic_alone:
            found |= zip(actor.mlp.parameters(), closed_form.backward(actor.mlp, *acted, by_mean / rows), strict=True)
            (learned_std,) = actor.distribution.parameters()
            with torch.enable_grad():
                weighted = (bounded * (by_std / rows - self.entropy_coef / std)).sum()
            (found[learned_std],) = torch.autograd.grad(weighted, learned_std)
        return [found.get(parameter) for parameter in self._learned], figures

    def _loss(self, batch: MiniBatch) -> tuple[Tensor, Tensor]:
        """Return the loss () of a mini-batch, and its figures (K,): the losses in the order of `LOSSES`, and the estimation
        errors.
        """
        samples = len(batch.old_mean)
        mean, estimates = self._act(batch.actor_input)
        values = output_of(self.critic, batch.critic_input, self.use_mixed_precision).squeeze(-1)
        std = self.action_std()
        log_prob = gaussian_log_prob(batch.actions, mean, std)
        ratio = torch.exp(log_prob - batch.old_log_prob)
        clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate = torch.max(-batch.advantages * ratio, -batch.advantages * clipped).mean()
        value_loss = (values - batch.returns).square()
        if self.use_clipped_value_loss:
            near = batch.old_values + (values - batch.old_values).clamp(-self.clip_param, self.clip_param)
            value_loss = torch.max(value_loss, (near - batch.returns).square())
        value_loss = value_loss.mean()
        loss = self.value_loss_coef * value_loss
        if not self._critic_alone:
            loss = loss + surrogate - self.entropy_coef * entropy(std)
        figures = self._figures(batch, mean, std, value_loss, surrogate)
        if batch.targets is not None and estimates is not None:
            # One backward pass serves PPO's loss and the estimator's. PPO's loss also trains the estimator's hidden layers if
            # there are `latent` outputs, and the whole estimator if `policy_gradient` is set.
            if not self._critic_alone:
                loss = loss + (estimates - batch.targets).square().mean()
            assert self._errors is not None
            errors = self._errors.squares(estimates[:samples].detach(), batch.targets[:samples]).mean(dim=0)
            figures = torch.cat([figures, errors])
        return loss, figures

    @torch.no_grad()
    def _figures(self, batch: MiniBatch, mean: Tensor, std: Tensor, value_loss: Tensor, surrogate: Tensor) -> Tensor:
        """Return the losses (K,) in the order of `LOSSES`. `mean` and `std` are those of the policy that learns."""
        samples = len(batch.old_mean)
        kl = divergence(batch.old_mean, batch.old_std, mean[:samples], std)
        losses = [value_loss, surrogate, entropy(std), kl]
        if self.symmetry:
            images = self.symmetry.data_augmentation_func(env=self.symmetry.env, obs=None, actions=mean[:samples])[1]
            losses.append((mean[samples:] - images[samples:]).square().mean())
        return torch.stack(losses)

    def _step_critic(self, figures: Tensor, valued: Tensor) -> Tensor:
        """Take a gradient step of the value function alone. Return `figures`, followed by a count of 1; or return zeros if
        the value loss `valued` () or a gradient is NaN or infinite.

        The actor's gradients are set to None, because the optimiser skips parameters without a gradient. With zero gradients
        Adam would count a step, and the first real steps of the actor would then be too large.
        """
        of_actor = [(parameter, parameter.grad) for parameter in self.actor.parameters()]
        for parameter, _ in of_actor:
            parameter.grad = None
        fine = (self._clip_gradients() + valued) < torch.inf
        torch.logical_not(fine, out=self.optimizer.found_inf)  # type: ignore[attr-defined]
        self.optimizer.step()
        for parameter, gradient in of_actor:  # restored: with several processes, gradients are views of a shared buffer
            parameter.grad = gradient
        return torch.where(fine, torch.cat([figures, self._one]), 0.0)

    def _clip_gradients(self) -> Tensor:
        """Clip the gradients of actor, critic and estimator, each to the norm `max_grad_norm`, as torch's clip_grad_norm_
        does. Return the sum () of the norms before clipping.
        """
        gradients = [[parameter.grad for parameter in part if parameter.grad is not None] for part in self._parts()]
        of_each = torch.stack(torch._foreach_norm([gradient for some in gradients for gradient in some]))
        norms = torch.stack([torch.linalg.vector_norm(n) for n in of_each.split([len(some) for some in gradients])])
        factors = (self.max_grad_norm / (norms + 1e-6)).clamp(max=1.0)
        for some, factor in zip(gradients, factors.unbind(), strict=True):
            if some:
                torch._foreach_mul_(some, factor)
        return norms.sum()

    def _act(self, inputs: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the mean actions (n, D) for the actor's inputs (n, width). Also return the estimates (n, E), or None
        without an estimator.
        """
        actor, mixed = self.actor, self.use_mixed_precision
        if not isinstance(actor, EstimatingModel):
            return output_of(actor, inputs, mixed), None
        with torch.autocast(inputs.device.type, torch.bfloat16, mixed, cache_enabled=False):
            x = actor.obs_normalizer(inputs)
            found = actor.estimator(x).float()
            return actor.mlp(actor.joined(x, found)).float(), found[:, : actor.estimates]

    def action_std(self) -> Tensor:
        """Return the standard deviation (D,) of the actions."""
        return action_std(self.actor)

    @torch.no_grad()
    def _adapt_rate(self, kl: Tensor) -> None:
        """Move the learning rate so that the mean divergence `kl` () approaches `desired_kl`."""
        assert self._rate is not None
        slower = (self._rate / RATE_STEP).clamp(min=LOWEST_RATE)
        faster = (self._rate * RATE_STEP).clamp(max=HIGHEST_RATE)
        rate = torch.where((kl < 0.5 * self.desired_kl) & (kl > 0.0), faster, self._rate)
        self._rate.copy_(torch.where(kl > 2.0 * self.desired_kl, slower, rate))

    def _update_normalizers(self) -> None:
        for model in (self.critic,) if self._critic_alone else (self.actor, self.critic):
            if isinstance(model.obs_normalizer, EmpiricalNormalization):
                inputs = torch.cat([self.storage.observations[name] for name in model.obs_groups], dim=-1)
                update_normalizer(model.obs_normalizer, inputs.flatten(0, 1))


@torch.no_grad()
def divergence(old_mean: Tensor, old_std: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Return the mean KL(old || new) () between Gaussians with means (n, D). The old standard deviations are (n, D), the new
    ones (D,).
    """
    moved = (old_std.square() + (old_mean - mean).square()) / (2.0 * std.square())
    return (torch.log(std / old_std) + moved - 0.5).sum(dim=1).mean()


def alone(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return copies of tensors. A file with views of one vector, as the kernels have them, would hold the whole vector."""
    return {name: tensor.clone(memory_format=torch.contiguous_format) for name, tensor in tensors.items()}


def entropy(std: Tensor) -> Tensor:
    """Return the entropy () of a Gaussian of standard deviation (D,)."""
    return std.log().sum() + len(std) * (0.5 + HALF_LOG_2PI)


def gaussian_log_prob(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Return the log-density (...,) of `x` (..., D) under a Gaussian of mean (..., D) and standard deviation (D,)."""
    return -0.5 * ((x - mean) / std).square().sum(dim=-1) - std.log().sum() - x.shape[-1] * HALF_LOG_2PI
