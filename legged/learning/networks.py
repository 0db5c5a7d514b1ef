"""Actor and critic: rsl-rl's settings for them, and their forward passes during an update."""

import math
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.modules.normalization import EmpiricalNormalization
from rsl_rl.utils import resolve_class
from tensordict import TensorDict
from torch import Tensor

from legged.config import TaskConfig
from legged.config.learning import PolicyConfig
from legged.config.networks import ESTIMATED, NETWORKS, groups_of
from legged.learning.distributed import sum_over_ranks_
from legged.learning.estimator import TARGETS

UNBOUNDED = (1e-6, 1e6)
"""Default bounds of rsl-rl for the standard deviation."""


def network_settings(cfg: TaskConfig) -> dict[str, dict[str, Any]]:
    """Return rsl-rl's dictionaries `actor`, `critic` and `obs_groups`."""
    policy = cfg.train.policy
    groups = {network: list(groups_of(cfg, network)) for network in NETWORKS}
    if policy.estimator.targets:
        groups[TARGETS] = [ESTIMATED]
    return {
        "obs_groups": groups,
        "actor": {**actor_settings(policy), **_estimating(policy)},
        "critic": {**_shared(policy), "hidden_dims": list(policy.critic_hidden_dims)},
    }


def _estimating(policy: PolicyConfig) -> dict[str, Any]:
    """Return the settings that an estimator adds to the actor's; empty without an estimator."""
    estimator = policy.estimator
    if not estimator.targets:
        return {}
    return {
        "class_name": "legged.learning.estimator:EstimatingModel",
        "estimator_hidden_dims": list(estimator.hidden_dims),
        "latent": estimator.latent,
        "policy_gradient": estimator.policy_gradient,
    }


def _shared(policy: PolicyConfig) -> dict[str, Any]:
    """Return the settings that actor and critic share."""
    shared: dict[str, Any] = {
        "class_name": "MLPModel",
        "activation": policy.activation,
        "obs_normalization": policy.obs_normalization,
    }
    if policy.rnn_type != "none":
        shared["class_name"] = "RNNModel"
        shared |= {name: getattr(policy, name) for name in ("rnn_type", "rnn_hidden_dim", "rnn_num_layers")}
    return shared


def actor_settings(policy: PolicyConfig) -> dict[str, Any]:
    """Return rsl-rl's dictionary of a network that acts: an actor, a student or a teacher."""
    distribution = {
        "class_name": "HeteroscedasticGaussianDistribution" if policy.state_dependent_std else "GaussianDistribution",
        "init_std": policy.init_noise_std,
        "std_type": policy.noise_std_type,
        "std_range": (policy.min_noise_std, policy.max_noise_std),
    }
    return {**_shared(policy), "hidden_dims": list(policy.actor_hidden_dims), "distribution_cfg": distribution}


def build_actor(cfg: TaskConfig, observations: TensorDict, num_actions: int) -> MLPModel:
    """Build the policy's network alone, on the CPU. Only the shapes of `observations` matter. The CPU's random generator
    keeps its state.
    """
    settings = network_settings(cfg)
    kind, rest = resolve_class(settings["actor"])
    with torch.random.fork_rng(devices=[]):
        return kind(observations, settings["obs_groups"], "actor", num_actions, **rest)


def action_std(actor: MLPModel) -> Tensor:
    """Return the standard deviations (D,) of a policy's actions, within their bounds and with a gradient. They must not
    depend on the state.
    """
    distribution = actor.distribution
    if distribution.std_type == "scalar":
        return distribution.std_param.clamp(*distribution.std_range)
    return distribution.log_std_param.clamp(*distribution.log_std_range).exp()


@torch.no_grad()
def reset_std(actor: MLPModel, cfg: TaskConfig) -> None:
    """Set the standard deviation of a policy's actions to the initial one, if it does not depend on the state."""
    distribution, std = actor.distribution, cfg.train.policy.init_noise_std
    if type(distribution) is GaussianDistribution:
        if distribution.std_type == "scalar":
            distribution.std_param.fill_(std)
        else:
            distribution.log_std_param.fill_(math.log(std))


def keep_std_in_bounds(actor: MLPModel, optimizer: torch.optim.Optimizer) -> None:
    """Clamp a learned standard deviation to its bounds after each step of the optimiser.

    rsl-rl clamps the value at each use. A parameter outside the bounds then has no gradient, so it would stay outside.
    """
    distribution = actor.distribution
    if type(distribution) is not GaussianDistribution or tuple(distribution.std_range) == UNBOUNDED:
        return
    if distribution.std_type == "scalar":
        parameter, bounds = distribution.std_param, distribution.std_range
    else:
        parameter, bounds = distribution.log_std_param, distribution.log_std_range

    @torch.no_grad()
    def clamp(*_: Any) -> None:
        parameter.clamp_(*bounds)

    optimizer.register_step_post_hook(clamp)


def use_matmul(cfg: TaskConfig) -> None:
    """Set the precision of matrix products on a GPU, and their library on a CPU, for this process.

    On AVX-512 processors that are not from Intel, torch's default library MKL takes 2.5 times as long as oneDNN. torch uses
    oneDNN if its settings allow bfloat16. On processors without bfloat16 units (AMX) this function allows bfloat16, but
    oneDNN still computes in float32. On processors with these units the function forbids bfloat16, so torch uses MKL.
    """
    rounded = cfg.train.runner.matmul == "tf32"
    torch.backends.cuda.matmul.allow_tf32 = rounded
    onednn = getattr(torch.backends.mkldnn, "matmul", None)
    if onednn is not None and hasattr(onednn, "fp32_precision"):
        exact_anyway = torch.backends.cpu.get_cpu_capability() == "AVX512" and not torch.cpu._is_amx_tile_supported()
        onednn.fp32_precision = "bf16" if rounded and exact_anyway else "ieee"


def output_of(model: MLPModel, inputs: Tensor, mixed_precision: bool) -> Tensor:
    """Return a network's outputs (n, outputs), float32, for its inputs (n, width). With mixed precision its layers compute in
    bfloat16.
    """
    # A graph must cast the weights at every replay, so autocast must not cache the cast weights.
    with torch.autocast(inputs.device.type, torch.bfloat16, mixed_precision, cache_enabled=False):
        return model.mlp(model.obs_normalizer(inputs)).float()


def normalization(model: MLPModel) -> tuple[Tensor | float, Tensor | float]:
    """Return what a network subtracts from its inputs, and the factor by which it multiplies the rest, each (1, width) or a
    number.
    """
    normalizer = model.obs_normalizer
    if not isinstance(normalizer, EmpiricalNormalization):
        return 0.0, 1.0
    return normalizer._mean, 1.0 / (normalizer._std + normalizer.eps)


@torch.no_grad()
def update_normalizer(normalizer: EmpiricalNormalization, x: Tensor) -> None:
    """Update the running mean and variance with the samples of all processes, as rsl-rl does. `x` (n, width) holds those
    of this process. The tensors are updated in place, because a graph needs fixed addresses.
    """
    mean, variance = x.mean(dim=0, keepdim=True), x.var(dim=0, unbiased=False, keepdim=True)
    count = len(x)
    if torch.distributed.is_initialized():
        count *= torch.distributed.get_world_size()
        own_mean = mean
        mean = sum_over_ranks_(own_mean * len(x)) / count
        variance = sum_over_ranks_((variance + (own_mean - mean).square()) * len(x)) / count
    normalizer.count += count
    rate = count / normalizer.count
    moved = mean - normalizer._mean
    normalizer._mean += rate * moved
    normalizer._var += rate * (variance - normalizer._var + moved * (mean - normalizer._mean))
    torch.sqrt(normalizer._var, out=normalizer._std)
