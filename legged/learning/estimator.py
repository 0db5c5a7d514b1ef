"""Policy with an estimator, a network that estimates quantities that only the simulator knows, such as the base velocity.

Ji et al., arXiv 2202.05481, train policy and estimator in the same iterations on the same samples. PPO trains the policy, and
the error of the estimates trains the estimator.
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
"""Key in rsl-rl's `obs_groups` for the observation groups that hold the estimator's targets."""
SECTION = "Estimator/"
"""Prefix of the estimates' errors in TensorBoard."""


class EstimatingModel(MLPModel):
    """MLP policy with an estimator, which is a second MLP. Both read the normalised observations (width I). The policy also
    reads the estimator's outputs: E estimates and L values without a target (`latent`).
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
        """Build both networks. The arguments are rsl-rl's, except for the last three, which are fields of
        `EstimatorConfig`.
        """
        self.target_groups = list(obs_groups[TARGETS])
        """Observation groups of the targets."""
        self.estimates = sum(obs[name].shape[-1] for name in self.target_groups)
        """Number of estimated values E."""
        self._latent, self._policy_gradient = latent, policy_gradient
        super().__init__(
            obs, obs_groups, obs_set, output_dim, list(hidden_dims), activation, obs_normalization, distribution_cfg
        )
        self.estimator = MLP(self.obs_dim, self.estimates + latent, list(estimator_hidden_dims), activation)
        """Network (n, I) -> (n, E + L) with the estimates first."""

    def _get_latent_dim(self) -> int:
        return self.obs_dim + self.estimates + self._latent

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Any = None) -> Tensor:
        """Return the input of the policy's layers, (..., I + E + L), for observations by group."""
        x = super().get_latent(obs, masks, hidden_state)
        return self.joined(x, self.estimator(x))

    def joined(self, x: Tensor, found: Tensor) -> Tensor:
        """Return the input of the policy's layers: normalised observations `x` (..., I), followed by the estimator's output
        `found` (..., E + L). With `policy_gradient`, the policy's loss also trains the estimates. Else they are detached.
        """
        if self._policy_gradient:
            return torch.cat([x, found], dim=-1)
        if not self._latent:
            return torch.cat([x, found.detach()], dim=-1)
        return torch.cat([x, found[..., : self.estimates].detach(), found[..., self.estimates :]], dim=-1)

    def estimate(self, obs: TensorDict) -> Tensor:
        """Return the estimates (N, E) for observations by group. They have the scales of the observation terms that they
        estimate.
        """
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
    """Copy of the layers of an EstimatingModel, for export. The normaliser is not included."""

    def __init__(self, model: EstimatingModel) -> None:
        """Copy the layers of `model`."""
        super().__init__()
        self.estimator, self.policy = copy.deepcopy(model.estimator), copy.deepcopy(model.mlp)

    def forward(self, x: Tensor) -> Tensor:
        """Return the policy's output for normalised observations (n, I)."""
        return self.policy(torch.cat([x, self.estimator(x)], dim=-1))


class EstimationErrors:
    """Errors of the estimates for each term, in the term's own unit."""

    def __init__(self, group: ObservationGroup) -> None:
        """Take the observation group of the targets."""
        self.names: tuple[str, ...] = tuple(term.name for term in group.terms)
        """Names of the estimated terms."""
        scale = torch.cat([term.scale for term in group.terms])
        # A target with the scale 0 is always 0, so its error can't be given in a unit, and counts as 0.
        self._factors = torch.where(scale == 0.0, torch.zeros_like(scale), scale.reciprocal()).square()
        self._shares = torch.zeros(len(scale), len(self.names), device=scale.device)
        for i, term in enumerate(group.terms):
            self._shares[term.columns, i] = 1.0 / (term.columns.stop - term.columns.start)

    def squares(self, estimates: Tensor, targets: Tensor) -> Tensor:
        """Return the mean square error (n, terms) of each sample and term. `estimates` and `targets` (n, E) both have the
        terms' scales.
        """
        return ((estimates - targets).square() * self._factors) @ self._shares
