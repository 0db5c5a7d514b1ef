"""Hidden states of recurrent policies."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor


def hidden_states(networks: Mapping[str, Any], num_envs: int) -> dict[str, Tensor]:
    """Return the hidden states (layers, N, width) of all recurrent `networks` of rsl-rl, by `<network>_<number>`. A missing
    state is created as zeros.
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
    """Make a recurrent policy of rsl-rl return the log-probabilities of T steps of one robot as (T,).

    If a mini-batch has a single robot, rsl-rl squeezes the old log-probabilities to (T,), but the new ones are (T, 1). Their
    ratio would be broadcast to (T, T), which mixes different steps. Log-probabilities of several robots, (T, n), and of
    one step, (N,), stay unchanged.
    """
    ask = policy.get_output_log_prob

    def shaped(outputs: Tensor) -> Tensor:
        found: Tensor = ask(outputs)
        return found.squeeze(1) if found.ndim == 2 else found

    policy.get_output_log_prob = shaped


def parts_of(layers: torch.nn.Module) -> int:
    """Return the number of tensors in the hidden state of recurrent layers."""
    return 2 if isinstance(layers, torch.nn.LSTM) else 1


class Memory:
    """Hidden state of one of rsl-rl's networks for N robots; empty for a network without recurrent layers.

    `take` keeps the addresses of the tensors, so that a CUDA graph can use them. `act`, `forget` and `detach` make new
    tensors, because autograd needs the old ones.
    """

    def __init__(self, network: Any, num_envs: int, parts: list[Tensor] | None = None) -> None:
        """Use the tensors `parts` (layers, N, width), or by default the hidden state of the network itself."""
        self.network = network
        self.parts = [*hidden_states({"": network}, num_envs).values()] if parts is None else parts

    def copy(self, parts: list[Tensor]) -> "Memory":
        """Return a Memory that holds `parts`, for the same network."""
        return Memory(self.network, 0, [*parts])

    def act(self, inputs: Tensor) -> Tensor:
        """Return the mean actions (N, D) for `inputs` (N, W), and advance the hidden state."""
        x = self.network.obs_normalizer(inputs)
        if self.parts:
            x, after = self.network.rnn.rnn(x.unsqueeze(0), tuple(self.parts) if len(self.parts) > 1 else self.parts[0])
            self.parts = [*after] if isinstance(after, tuple) else [after]
            x = x.squeeze(0)
        return self.network.distribution.deterministic_output(self.network.mlp(x))

    def forget(self, ended: Tensor) -> None:
        """Reset the hidden state of the robots for which the mask `ended` (N, 1) is True."""
        self.parts = [part.masked_fill(ended, 0.0) for part in self.parts]

    def detach(self) -> None:
        """Detach the hidden state, so that no gradient reaches earlier steps."""
        self.parts = [part.detach() for part in self.parts]

    @torch.no_grad()
    def take(self, parts: list[Tensor]) -> None:
        """Copy the tensors `parts` of another Memory into the tensors of this one."""
        for part, value in zip(self.parts, parts, strict=True):
            part.copy_(value)
