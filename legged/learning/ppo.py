"""rsl-rl's PPO, updated without a host read: the same losses and steps, in closed form, on data shuffled once."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.modules.normalization import EmpiricalNormalization
from torch import Tensor

from legged.learning.critic_warmup import CriticWarmup
from legged.learning.distributed import SharedGradients
from legged.learning.estimator import SECTION, EstimatingModel, EstimationErrors
from legged.learning.networks import action_std, layers_of, output_of, update_normalizer

LOWEST_RATE, HIGHEST_RATE, RATE_STEP = 1e-5, 1e-2, 1.5
"""Bounds of the adaptive learning rate and the factor by which it moves, as in rsl-rl."""
FEW = 1e-8
LOSSES = ("value", "surrogate", "entropy", "kl", "symmetry")
"""What is logged of an update, by rsl-rl's names, and `kl`, the divergence of the policy that acted from the one that learns;
the last, how far the policy is from its mirror image, with symmetry.
"""
HALF_LOG_2PI = 0.9189385332046727
"""0.5 * log(2 pi)."""


class DevicePPO(CriticWarmup):
    """PPO (Schulman et al., arXiv 1707.06347) as rsl-rl computes it, for Gaussian MLP policies.

    What differs is where and how often: the learning rate is a tensor on the device; samples are shuffled into contiguous
    memory once an update, not gathered for every mini-batch; log-probability, entropy and divergence of the Gaussian are
    written out; the optimiser is fused; and losses are summed on the device and read once. Where a feature needs rsl-rl's
    own update (`why_stock`), that runs. Where the actor has an estimator, that learns from the same mini-batches.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._rate: Tensor | None = None
        super().__init__(*args, **kwargs)
        self.why_stock = self._why_stock()
        """What keeps the update on rsl-rl's own path; empty if nothing does."""
        if not self.why_stock:
            self._rate = torch.tensor(self._initial_rate, device=self.device)
            parameters = [p for part in self._parts() for p in part]
            capturable = self._rate.is_cuda
            self.optimizer = torch.optim.Adam(self._optimized(), lr=self._rate, fused=True, capturable=capturable)
            # Where this is 1, a fused step changes nothing: neither parameters nor moments nor its count.
            self.optimizer.found_inf = torch.zeros((), device=self.device)  # type: ignore[attr-defined]
            if self.is_multi_gpu:
                self._shared = SharedGradients(parameters, self.gpu_world_size)
        count = len(LOSSES) if self.symmetry else len(LOSSES) - 1
        self._errors: EstimationErrors | None = None
        self._losses = torch.zeros(count + 1, device=self.device)
        """Means over the mini-batches of the last update, by `LOSSES`, of the estimates' square errors, if there are any, by
        term, and the share of mini-batches that were taken."""
        self._one = torch.ones((), device=self.device)
        self._critic_alone = False
        """Whether the update that runs, or is captured, changes the value function alone."""
        self.left_out = 0.0
        """Share of the last update's mini-batches that changed nothing, because a gradient was no number."""

    fits_graph = True
    """Whether an update can be captured; what can't be captured at all has rsl-rl's own loop."""

    def learn_to_estimate(self, errors: EstimationErrors, learning_rate: float) -> None:
        """Say how errors of the actor's estimates are measured, and the step size with which its estimator learns; to be
        called once, before the first update of an actor that has one.
        """
        self._errors = errors
        self._losses = torch.zeros(len(self._losses) + len(errors.names), device=self.device)
        self.optimizer.param_groups[-1]["lr"] = learning_rate

    def _parts(self) -> list[list[torch.nn.Parameter]]:
        """Return the parameters that learn, of the actor, of the critic, and of the actor's estimator if it has one: each of
        them has a norm of gradients of its own.
        """
        of_actor = list(self.actor.parameters())
        parts = [of_actor, list(self.critic.parameters())]
        if isinstance(self.actor, EstimatingModel):
            estimator = list(self.actor.estimator.parameters())
            those = {id(parameter) for parameter in estimator}
            parts = [[parameter for parameter in of_actor if id(parameter) not in those], parts[1], estimator]
        return [[parameter for parameter in part if parameter.requires_grad] for part in parts]

    def _optimized(self) -> list[dict[str, Any]]:
        """Return the optimiser's groups of parameters: actor and critic, whose rate adapts, and the estimator if there is
        one, whose rate is a plain number.
        """
        actor, critic, *estimator = self._parts()
        return [{"params": [*actor, *critic]}, *({"params": part, "lr": 1e-3} for part in estimator)]

    def tensors(self) -> list[Tensor]:
        """Everything that an update changes: parameters, normalisers, moments of the optimiser, learning rate."""
        models = [tensor for model in (self.actor, self.critic) for tensor in model.state_dict(keep_vars=True).values()]
        moments = [tensor for state in self.optimizer.state.values() for tensor in state.values()]
        assert self._rate is not None
        return [*models, *moments, self._rate]

    def _why_stock(self) -> str:
        """Name the first thing that only rsl-rl's own update can do; empty if there is none. Configurations reach all."""
        if self.symmetry and self.symmetry.use_mirror_loss:
            return "a mirror loss"
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
        """The learning rate now; reading it waits for the device."""
        return self._initial_rate if self._rate is None else float(self._rate)

    @learning_rate.setter
    def learning_rate(self, value: float | Tensor) -> None:
        if self._rate is None:
            self._initial_rate = float(value)
        else:
            self._rate.fill_(value)

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """As rsl-rl, of a checkpoint of either class."""
        rates = [group["lr"] for group in self.optimizer.param_groups]
        iteration = super().load(loaded_dict, load_cfg, strict)
        if self._rate is not None:  # loading puts the saved number in place of the tensor
            groups = self.optimizer.param_groups
            self._rate.fill_(groups[0]["lr"])
            for group, rate in zip(groups, (self._rate, *rates[1:]), strict=True):
                group.update(lr=rate, fused=True, capturable=self._rate.is_cuda)
            for state in self.optimizer.state.values():
                state["step"] = state["step"].to(self.device, torch.float32)
        return iteration

    def save(self) -> dict:
        """As rsl-rl, whose optimiser is not fused and has its learning rate and step counts on the host."""
        saved = super().save()
        if self._rate is not None:
            optimizer = saved["optimizer_state_dict"]
            plain = {"fused": None, "capturable": False}
            saved["optimizer_state_dict"] = {
                "state": {key: {**state, "step": state["step"].cpu()} for key, state in optimizer["state"].items()},
                "param_groups": [{**group, "lr": float(group["lr"]), **plain} for group in optimizer["param_groups"]],
            }
        return saved

    def update(self) -> dict[str, float]:
        """All epochs over the stored rollout; returns the mean losses."""
        if self.why_stock:
            return super().update()
        (self.learn_critic if self.warming_up() else self.learn)()
        self.storage.clear()
        return self.losses()

    def learn_critic(self, epochs: int | None = None) -> None:
        """Learn as `learn` does, but change the value function alone: the policy is kept, with its normaliser."""
        self._critic_alone = True
        self.learn(epochs)
        self._critic_alone = False

    def fill_moments(self) -> None:
        """Give every parameter that has no moments yet the ones that the optimiser would begin with, so that a graph knows
        where they are before the first step that uses them.
        """
        for group in self.optimizer.param_groups:
            for parameter in group["params"]:
                if not self.optimizer.state[parameter]:
                    step = torch.zeros((), device=parameter.device)
                    moments = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
                    self.optimizer.state[parameter].update({"step": step, **moments})

    def learn(self, epochs: int | None = None) -> None:
        """All epochs over the stored rollout, or the first `epochs`: no host read, so that one graph can hold it."""
        self._losses.zero_()
        batches = self._mini_batches()
        for _ in range(epochs or self.num_learning_epochs):
            for batch in batches:
                self._losses += self._step(*batch)
        self._losses[:-1] /= self._losses[-1:].clone()
        self._losses[-1:] /= self.num_learning_epochs * self.num_mini_batches
        self._update_normalizers()

    def outcome(self) -> dict[str, Tensor]:
        """What an update leaves on the device to be read: `losses` (K,), of which `losses` makes sense, `std` (D,) of the
        actions, and the learning `rate` ().
        """
        rate = {} if self._rate is None else {"rate": self._rate}
        return {"losses": self._losses, "std": self.action_std(), **rate}

    def losses(self, numbers: Sequence[float] | None = None) -> dict[str, float]:
        """Mean losses of an update from the `numbers` of its outcome, as is `left_out`; read from the device, of the last
        update, where none are given. NaN if no mini-batch had any. Beside them the root mean square errors of the estimates
        by term, `Estimator/<term>_rmse`, each in the term's unit.
        """
        *losses, taken = self._losses.tolist() if numbers is None else numbers
        self.left_out = 1.0 - taken
        terms = self._errors.names if self._errors else ()
        squares = [losses.pop() for _ in terms][::-1]
        errors = {f"{SECTION}{term}_rmse": math.sqrt(square) for term, square in zip(terms, squares, strict=True)}
        return {**dict(zip(LOSSES, losses, strict=False)), **errors}

    @torch.no_grad()
    def _mini_batches(self) -> list[tuple[Tensor, ...]]:
        """Return the rollout, shuffled: for each mini-batch of n samples the networks' inputs, actions (n, D), old
        log-probabilities, advantages, old values, returns (n,) each, and the old Gaussian's mean (n, D) and std (n, D).

        With symmetry, each but the last two also holds the mirror images, after the samples: 2 n. With an estimator, its
        targets (2 n or n, E) come at the end.
        """
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
        return list(zip(*shuffled, strict=True))

    def _order(self, count: int) -> Tensor:
        """Return a random permutation of `count` samples; by sorting, which a graph can hold."""
        return torch.rand(count, device=self.device).argsort()

    def _step(
        self,
        actor_input: Tensor,
        critic_input: Tensor,
        actions: Tensor,
        old_log_prob: Tensor,
        advantages: Tensor,
        old_values: Tensor,
        returns: Tensor,
        old_mean: Tensor,
        old_std: Tensor,
        targets: Tensor | None = None,
    ) -> Tensor:
        """One mini-batch: adapt the learning rate, step down the gradient; returns its losses, as in `LOSSES`, and 1. If a
        gradient is no number, nothing is changed, and all that is returned is 0.
        """
        samples = len(old_mean)
        if self.normalize_advantage_per_mini_batch:
            own = advantages[:samples]
            advantages = (advantages - own.mean()) / (own.std() + FEW)
        mean, estimates = self._act(actor_input)
        values = output_of(self.critic, critic_input, self.use_mixed_precision).squeeze(-1)
        std = self.action_std()
        log_prob = gaussian_log_prob(actions, mean, std)
        entropy = std.log().sum() + actions.shape[1] * (0.5 + HALF_LOG_2PI)
        ratio = torch.exp(log_prob - old_log_prob)
        clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate = torch.max(-advantages * ratio, -advantages * clipped).mean()
        value_loss = (values - returns).square()
        if self.use_clipped_value_loss:
            near = old_values + (values - old_values).clamp(-self.clip_param, self.clip_param)
            value_loss = torch.max(value_loss, (near - returns).square())
        value_loss = value_loss.mean()
        loss = surrogate + self.value_loss_coef * value_loss - self.entropy_coef * entropy
        errors: tuple[Tensor, ...] = ()
        if targets is not None and estimates is not None:
            # Both losses in one backward pass: they meet in no parameter but the hidden layers of an estimator with a latent.
            loss = loss + (estimates - targets).square().mean()
            assert self._errors is not None
            errors = self._errors.squares(estimates[:samples].detach(), targets[:samples]).mean(dim=0).unbind()

        losses = [value_loss, surrogate, entropy]
        if self.symmetry:
            images = self.symmetry.data_augmentation_func(env=self.symmetry.env, obs=None, actions=mean[:samples])[1]
            losses.append((mean[samples:] - images[samples:]).square().mean())

        kl = divergence(old_mean, old_std, mean[:samples].detach(), std.detach())
        losses.insert(LOSSES.index("kl"), kl)  # the tensor, into which several processes put their mean below
        # The clipped value loss passes no gradient on for a value that is NaN, so it is looked at by itself.
        valued = value_loss.detach().clone()
        if self._critic_alone:
            loss = self.value_loss_coef * value_loss
        if self.is_multi_gpu:
            self._shared.zero_()
            loss.backward()
            self._shared.average_(kl, valued)
        else:
            self.optimizer.zero_grad()
            loss.backward()
        if self._critic_alone:
            return self._step_critic([*losses, *errors], valued)
        if self.desired_kl is not None and self.schedule == "adaptive":
            self._adapt_rate(kl)
        fine = (self._clip_gradients() + valued) < torch.inf
        torch.logical_not(fine, out=self.optimizer.found_inf)  # type: ignore[attr-defined]
        self.optimizer.step()
        return torch.where(fine, torch.stack([*losses, *errors, self._one]).detach(), 0.0)

    def _step_critic(self, figures: list[Tensor], valued: Tensor) -> Tensor:
        """End a mini-batch of which the value function alone learns, whose loss was `valued` (); returns what `_step` does,
        of `figures`. The optimiser passes over parameters without a gradient: gradients of 0 would count as steps, and the
        first real ones would be too large.
        """
        of_actor = [(parameter, parameter.grad) for parameter in self.actor.parameters()]
        for parameter, _ in of_actor:
            parameter.grad = None
        fine = (self._clip_gradients() + valued) < torch.inf
        torch.logical_not(fine, out=self.optimizer.found_inf)  # type: ignore[attr-defined]
        self.optimizer.step()
        for parameter, gradient in of_actor:  # of several processes, a part of the buffer that they share
            parameter.grad = gradient
        return torch.where(fine, torch.stack([*figures, self._one]).detach(), 0.0)

    def _clip_gradients(self) -> Tensor:
        """Clip the gradients of actor, critic and estimator, each to the norm `max_grad_norm`, as torch's clip_grad_norm_
        does one after the other; returns the sum () of the norms before.
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
        """Return the mean actions (n, D) for the actor's inputs (n, width), and its estimates (n, E) if it makes any."""
        actor, mixed = self.actor, self.use_mixed_precision
        if not isinstance(actor, EstimatingModel):
            return output_of(actor, inputs, mixed), None
        with torch.autocast(inputs.device.type, torch.bfloat16, mixed, cache_enabled=False):
            x = actor.obs_normalizer(inputs)
            found = layers_of(actor.estimator, x, mixed)
            return layers_of(actor.mlp, actor.joined(x, found), mixed), found[:, : actor.estimates]

    def action_std(self) -> Tensor:
        """Return the standard deviation (D,) of the actions."""
        return action_std(self.actor)

    @torch.no_grad()
    def _adapt_rate(self, kl: Tensor) -> None:
        """Move the learning rate so that the mean divergence `kl` () becomes the wanted one."""
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
    """Mean () of KL(old || new) over Gaussians of means (n, D) and standard deviations (n, D), new ones (D,)."""
    moved = (old_std.square() + (old_mean - mean).square()) / (2.0 * std.square())
    return (torch.log(std / old_std) + moved - 0.5).sum(dim=1).mean()


def gaussian_log_prob(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Log-density (...,) of `x` (..., D) under a Gaussian of mean (..., D) and standard deviation (D,)."""
    return -0.5 * ((x - mean) / std).square().sum(dim=-1) - std.log().sum() - x.shape[-1] * HALF_LOG_2PI
