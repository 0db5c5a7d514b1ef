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


def keep_shape_of_one_robot(policy: Any) -> None:
    """Let a recurrent policy of rsl-rl give the log-probabilities of T steps of a single robot as (T,). Its update has those
    that were stored in this shape where a mini-batch is a single robot; of (T, 1) and (T,) it would make the ratio of every
    step to every other one, (T, T). Those of more robots, (T, n), and of one step, (N,), are left as they are.
    """
    ask = policy.get_output_log_prob

    def shaped(outputs: Tensor) -> Tensor:
        found: Tensor = ask(outputs)
        return found.squeeze(1) if found.ndim == 2 else found

    policy.get_output_log_prob = shaped


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


class Memory:
    """What one of rsl-rl's networks remembers of N robots; nothing of a network without recurrent layers, which acts too. The
    tensors keep their addresses in `take` and `forget_`, for a graph; the others are for who differentiates.
    """

    def __init__(self, network: Any, num_envs: int, parts: list[Tensor] | None = None) -> None:
        """Be what the network itself remembers, or other `parts`, (layers, N, width) each."""
        self.network = network
        self.parts = [*hidden_states({"": network}, num_envs).values()] if parts is None else parts

    def copy(self, parts: list[Tensor]) -> "Memory":
        """Return a memory of the same network that holds `parts`."""
        return Memory(self.network, 0, [*parts])

    def act(self, inputs: Tensor) -> Tensor:
        """Return the mean actions (N, D) for `inputs` (N, W), and remember them."""
        x = self.network.obs_normalizer(inputs)
        if self.parts:
            x, after = self.network.rnn.rnn(x.unsqueeze(0), tuple(self.parts) if len(self.parts) > 1 else self.parts[0])
            self.parts = [*after] if isinstance(after, tuple) else [after]
            x = x.squeeze(0)
        return self.network.distribution.deterministic_output(self.network.mlp(x))

    def forget(self, ended: Tensor) -> None:
        """Remember nothing of the robots in `ended` (N, 1)."""
        self.parts = [part.masked_fill(ended, 0.0) for part in self.parts]

    def detach(self) -> None:
        """Pass no gradient on to what was before."""
        self.parts = [part.detach() for part in self.parts]

    @torch.no_grad()
    def take(self, parts: list[Tensor]) -> None:
        """Remember what another memory holds, in place."""
        for part, value in zip(self.parts, parts, strict=True):
            part.copy_(value)
