"""A policy whose first part estimates what only the simulator knows, such as the velocity of the base.

Ji et al., arXiv 2202.05481, train policy and estimator in the same iterations on the same samples: PPO the one, the error of
its estimates the other.
"""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP
from tensordict import TensorDict
from torch import Tensor, nn

from legged.mdp.observations import ObservationGroup

TARGETS = "estimator"
"""Observation set, in rsl-rl's terms, of what is estimated."""
SECTION = "Estimator/"
"""How the names of the estimates' errors begin in TensorBoard."""


class EstimatingModel(MLPModel):
    """An MLP policy that is given, after its normalised observations (width I), E estimates and L free outputs that another
    MLP makes of the same observations.
    """

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: Sequence[int],
        activation: str,
        obs_normalization: bool,
        distribution_cfg: dict[str, Any],
        estimator_hidden_dims: Sequence[int],
        latent: int,
        policy_gradient: bool,
    ) -> None:
        """Build both networks; arguments are rsl-rl's, and for the last three `EstimatorConfig` says what they mean."""
        self.target_groups = list(obs_groups[TARGETS])
        """Observation groups of the targets."""
        self.estimates = sum(obs[name].shape[-1] for name in self.target_groups)
        """E, numbers that are estimated."""
        self._latent, self._policy_gradient = latent, policy_gradient
        super().__init__(
            obs, obs_groups, obs_set, output_dim, list(hidden_dims), activation, obs_normalization, distribution_cfg
        )
        self.estimator = MLP(self.obs_dim, self.estimates + latent, list(estimator_hidden_dims), activation)
        """(n, I) -> (n, E + L), the estimates first."""

    def _get_latent_dim(self) -> int:
        return self.obs_dim + self.estimates + self._latent

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Any = None) -> Tensor:
        """Return what the policy's layers are given for observations by group: (..., I + E + L)."""
        x = super().get_latent(obs, masks, hidden_state)
        return self.joined(x, self.estimator(x))

    def joined(self, x: Tensor, found: Tensor) -> Tensor:
        """Return what the policy's layers are given: normalised observations `x` (..., I), and what the estimator has
        `found` in them (..., E + L). Through the estimates no gradient is passed on, unless that is wanted.
        """
        if self._policy_gradient:
            return torch.cat([x, found], dim=-1)
        if not self._latent:
            return torch.cat([x, found.detach()], dim=-1)
        return torch.cat([x, found[..., : self.estimates].detach(), found[..., self.estimates :]], dim=-1)

    def estimate(self, obs: TensorDict) -> Tensor:
        """Return the estimates (N, E) for observations by group, scaled like the terms that they are of."""
        return self.estimator(super().get_latent(obs))[..., : self.estimates]

    def as_jit(self) -> nn.Module:
        """Return rsl-rl's module for TorchScript, with the estimator among its layers."""
        module = super().as_jit()
        module.mlp = EstimatingLayers(self)
        return module

    def as_onnx(self, verbose: bool) -> nn.Module:
        """Return rsl-rl's module for ONNX, with the estimator among its layers."""
        module = super().as_onnx(verbose)
        module.mlp = EstimatingLayers(self)
        return module


class EstimatingLayers(nn.Module):
    """The layers of an EstimatingModel without gradients, from normalised observations on."""

    def __init__(self, model: EstimatingModel) -> None:
        """Copy the layers of `model`."""
        super().__init__()
        self.estimator, self.policy = copy.deepcopy(model.estimator), copy.deepcopy(model.mlp)

    def forward(self, x: Tensor) -> Tensor:
        """Return the policy's output for normalised observations (n, I)."""
        return self.policy(torch.cat([x, self.estimator(x)], dim=-1))


class EstimationErrors:
    """How far estimates are from their targets, term by term, each in the term's own unit."""

    def __init__(self, group: ObservationGroup) -> None:
        """Take the observation group of the targets."""
        self.names: tuple[str, ...] = tuple(term.name for term in group.terms)
        """The terms that are estimated."""
        scale = torch.cat([term.scale for term in group.terms])
        # A target that is scaled by 0 is known exactly, and has no unit to be measured in.
        self._factors = torch.where(scale == 0.0, torch.zeros_like(scale), scale.reciprocal()).square()
        self._shares = torch.zeros(len(scale), len(self.names), device=scale.device)
        for i, term in enumerate(group.terms):
            self._shares[term.columns, i] = 1.0 / (term.columns.stop - term.columns.start)

    def squares(self, estimates: Tensor, targets: Tensor) -> Tensor:
        """Return for each sample and term (n, terms) the mean square error of its numbers, of estimates and targets (n, E),
        scaled both.
        """
        return ((estimates - targets).square() * self._factors) @ self._shares
