"""The actor network as policy.weights: plain numbers for `legged.deploy.weights` and a C++ header."""

from typing import Any

import torch
from torch import Tensor, nn

from legged.deploy.weights import ACTIVATION, ACTIVATIONS, GRU, JOIN, KEEP, LINEAR, LSTM, NORMALISE, Layer, pack
from legged.learning.estimator import EstimatingModel


def weights_of(policy: Any, activation: str, num_actions: int) -> bytes:
    """Return the file of `policy`, rsl-rl's actor network on the CPU, whose hidden layers have an activation of rsl-rl's
    name. Only the outputs for the means of actions are kept.
    """
    layers: list[Layer] = []
    if policy.obs_normalization:
        normaliser = policy.obs_normalizer
        mean, divisor = normaliser._mean.flatten(), (normaliser._std + normaliser.eps).flatten()
        layers.append(_layer(NORMALISE, len(mean), len(mean), mean, divisor))
    if policy.is_recurrent:
        layers += _recurrent(policy.rnn.rnn)
    if isinstance(policy, EstimatingModel):
        width = policy.obs_dim
        found = _dense(policy.estimator, activation)
        more = found[-1].outputs
        layers += [Layer(KEEP, 0, width, width, ()), *found, Layer(JOIN, 0, more, width + more, ())]
    return pack([*layers, *_dense(policy.mlp, activation, num_actions)])


def _dense(mlp: nn.Sequential, activation: str, outputs: int | None = None) -> list[Layer]:
    """Return the layers of an MLP; the last one is cut to its first `outputs`, which are the means."""
    layers: list[Layer] = []
    linear = [module for module in mlp if isinstance(module, nn.Linear)]
    for module in linear:
        rows = module.out_features if outputs is None or module is not linear[-1] else outputs
        layers.append(_layer(LINEAR, module.in_features, rows, module.weight[:rows], module.bias[:rows]))
        if module is not linear[-1]:
            layers.append(Layer(ACTIVATION, list(ACTIVATIONS).index(activation), rows, rows, ()))
    return layers


def _recurrent(module: nn.LSTM | nn.GRU) -> list[Layer]:
    """Return the layers of a recurrent module, the first one first."""
    kind, layers = LSTM if isinstance(module, nn.LSTM) else GRU, []
    for i in range(module.num_layers):
        names = (f"weight_ih_l{i}", f"weight_hh_l{i}", f"bias_ih_l{i}", f"bias_hh_l{i}")
        inputs = module.input_size if i == 0 else module.hidden_size
        layers.append(_layer(kind, inputs, module.hidden_size, *(getattr(module, name) for name in names)))
    return layers


@torch.no_grad()
def _layer(kind: int, inputs: int, outputs: int, *arrays: Tensor) -> Layer:
    return Layer(kind, 0, inputs, outputs, tuple(array.detach().float().numpy().copy() for array in arrays))
