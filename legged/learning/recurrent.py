"""Recurrent policies: their memory while they act, and the kind of one that a checkpoint holds."""

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.envs import BaseTask

GATES = {4: "lstm", 3: "gru"}
"""Rows of a recurrent layer's weights, over its width -> its kind."""


class Remembering:
    """A recurrent policy that forgets, robot by robot, the episodes that have ended."""

    def __init__(self, policy: Any, task: BaseTask) -> None:
        """`policy` is rsl-rl's model, which keeps the hidden state of the task's robots from call to call."""
        self._policy, self._task = policy, task

    def __call__(self, observations: TensorDict) -> Tensor:
        """Actions (N, D), once for every step of the task."""
        begun = self._task.reset_buf.view(1, -1, 1)
        hidden = self._policy.get_hidden_state()
        if hidden is not None:
            # A new tensor: the old one may come from inference mode, and the call from outside of it.
            pair = hidden if isinstance(hidden, tuple) else (hidden,)
            kept = tuple(torch.where(begun.to(state.device), 0.0, state.detach()) for state in pair)
            self._policy.reset(hidden_state=kept if isinstance(hidden, tuple) else kept[0])
        return self._policy(observations)


def rnn_of(state: dict[str, Tensor]) -> tuple[str, int, int]:
    """Kind, width and number of the recurrent layers in a model's state; ("none", 0, 0) without any."""
    layers = [name for name in state if "weight_hh_l" in name]
    if not layers:
        return "none", 0, 0
    rows, width = (*state[layers[0]].shape, 0, 0)[:2]
    return GATES.get(rows // max(width, 1), "of no known kind"), width, len(layers)
