"""What is done about numbers that are none: NaN, infinite, or beyond anything a robot's could be.

One such number in a sample would reach every weight of the networks. So a reward or an observation counts as 0 there, the
robot's episode ends at the next step, and robots are counted by the term at fault; nothing of this waits for the host.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from legged.observations import ObservationTerms

LARGEST = 1e10
"""Rewards and observations beyond this count as infinite: the squares of sums of them must fit a float32."""
LARGEST_STATE = 1e4
"""Positions [m], velocities [m/s], angles [rad] and rates [rad/s] beyond this are no robot's: its physics has diverged."""


class Faults:
    """Which of N robots had a number that is none since the last `flush`, and what it was a number of."""

    STATE = ("sound",)

    def __init__(self, rewards: Sequence[str], observations: ObservationTerms, num_envs: int, device: torch.device) -> None:
        """`rewards` are the names of the reward terms, in the order of their rows."""
        self.sound = torch.ones(num_envs, dtype=torch.bool, device=device)
        """(N,) robots whose rewards and observations of the last step were numbers; the others end at the next one."""
        self._names = ("physics", "action", *(f"reward_{n}" for n in rewards), *(f"obs_{n}" for n in observations.columns))
        self._seen = torch.zeros(len(self._names), num_envs, dtype=torch.bool, device=device)
        self._physics, self._action = self._seen[:2]
        self._rewards, self._observations = self._seen[2:].split([len(rewards), len(observations.columns)])
        self._column_of_term = torch.zeros(len(observations.columns), observations.values.shape[1], device=device)
        for i, columns in enumerate(observations.columns.values()):
            self._column_of_term[i, columns] = 1.0

    def check_state(self, in_bounds: Tensor, clipped_actions: Tensor) -> None:
        """Take in which robots' states and actions are numbers, (N,), and the actions (N, D), which are finite or NaN."""
        broken = (clipped_actions != clipped_actions).any(dim=1)
        self._action.logical_or_(broken)
        self._physics.logical_or_(~(in_bounds | broken))

    def check_rewards(self, fine: Tensor, valid: Tensor) -> None:
        """Take in which rewards are numbers, (terms, N), of the robots that were sound before, (N,); the others end now."""
        broken = valid & ~fine
        torch.logical_not(broken.any(dim=0), out=self.sound)
        self._rewards.logical_or_(broken)

    def check_observations(self, raw: Tensor) -> None:
        """Take in the terms' values (N, width), before they are scaled and clipped; after `check_rewards`."""
        broken = ~(raw.abs() < LARGEST)
        self.sound.logical_and_(~broken.any(dim=1))
        self._observations.logical_or_(self._column_of_term @ broken.t().float() > 0.0)

    def flush(self) -> dict[str, Tensor]:
        """Return the number of robots by fault, as fresh 0-dimensional tensors by their name in TensorBoard, NaN where there
        were none; then start anew.
        """
        counts = self._seen.sum(dim=1).float()
        self._seen.zero_()
        counts = torch.where(counts > 0.0, counts, torch.nan)  # NaN says "no value", and is not logged
        return {f"Faults/{name}": count for name, count in zip(self._names, counts.unbind(), strict=True)}
