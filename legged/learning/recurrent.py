"""Recurrent policies: their memory, and the kind of one that a checkpoint holds."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

GATES = {4: "lstm", 3: "gru"}
"""Rows of a recurrent layer's weights, over its width -> its kind."""


def hidden_states(networks: Mapping[str, Any], num_envs: int) -> dict[str, Tensor]:
    """Return the hidden states (layers, N, width) of those of rsl-rl's networks that have any, by name and number; zeros
    take the place of one that is not there yet.
    """
    found: dict[str, Tensor] = {}
    for name, network in networks.items():
        if not network.is_recurrent:
            continue
        if network.get_hidden_state() is None:
            layers = network.rnn.rnn
            like = next(layers.parameters())
            states = [like.new_zeros(layers.num_layers, num_envs, layers.hidden_size) for _ in range(parts_of(layers))]
            network.reset(hidden_state=tuple(states) if len(states) > 1 else states[0])
        hidden = network.get_hidden_state()
        found |= {f"{name}_{i}": state for i, state in enumerate(hidden if isinstance(hidden, tuple) else (hidden,))}
    return found


def parts_of(layers: torch.nn.Module) -> int:
    """Return how many tensors the hidden state of recurrent layers is made of."""
    return 2 if isinstance(layers, torch.nn.LSTM) else 1


def rnn_of(state: dict[str, Tensor]) -> tuple[str, int, int]:
    """Return kind, width and number of the recurrent layers in a model's state; ("none", 0, 0) without any."""
    layers = [name for name in state if "weight_hh_l" in name]
    if not layers:
        return "none", 0, 0
    rows, width = (*state[layers[0]].shape, 0, 0)[:2]
    return GATES.get(rows // max(width, 1), "of no known kind"), width, len(layers)
