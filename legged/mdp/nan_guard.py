"""What is done about numbers that are none: NaN, infinite, or beyond anything a robot's could be.

One such number in a sample would reach every weight of the networks. So a reward or an observation counts as 0 there, the
robot's episode ends at the next step, and robots are counted by the term at fault; nothing of this waits for the host.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from legged.mdp.observations import ObservationTerms

LARGEST = 1e10
"""Rewards and observations beyond this count as infinite: the squares of sums of them must fit a float32."""
LARGEST_STATE = 1e4
"""Positions [m], velocities [m/s], angles [rad] and rates [rad/s] beyond this are no robot's: its physics has diverged."""


class NanGuard:
    """Which of N robots had a number that is none since the last `flush`, and what it was a number of."""

    STATE = ("sound",)

    def __init__(self, rewards: Sequence[str], observations: ObservationTerms, num_envs: int, device: torch.device) -> None:
        """Watch `rewards`, the names of the reward terms, in the order of their rows."""
        self.sound = torch.ones(num_envs, dtype=torch.bool, device=device)
        """(N,) robots whose rewards and observations of the last step were numbers; the others end at the next one."""
        self._terms = observations
        self._names = ("physics", "action", *(f"reward_{n}" for n in rewards), *(f"obs_{n}" for n in observations.columns))
        self._now = torch.zeros(2, num_envs, dtype=torch.bool, device=device)  # physics, action
        self._seen = torch.zeros_like(self._now)
        self._rewards_whole = torch.ones(len(rewards), num_envs, dtype=torch.bool, device=device)
        # Of observations the largest number is kept, by column, which costs two launches a step; robots are counted later.
        self._largest = torch.zeros_like(observations.values)

    def check_state(self, in_bounds: Tensor, clipped_actions: Tensor) -> None:
        """Take in which robots' states and actions are numbers, (N,), and the actions (N, D), which are finite or NaN."""
        physics, action = self._now
        torch.any(clipped_actions != clipped_actions, dim=1, out=action)
        torch.eq(in_bounds, action, out=physics)  # neither: who has an action that is none is not in bounds
        self._seen.logical_or_(self._now)

    def check_rewards(self, fine: Tensor, valid: Tensor) -> None:
        """Take in which rewards are numbers, (terms, N), of the robots that were sound before, (N,); the others end now."""
        whole = fine >= valid  # fine, or not valid
        torch.all(whole, dim=0, out=self.sound)
        self._rewards_whole.logical_and_(whole)

    def check_observations(self, begun: Tensor) -> None:
        """Look at the terms' values, before they are scaled and clipped; after `check_rewards`. Robots of `begun` (N,) have
        new episodes, which are not to blame for the rewards of those that ended.
        """
        size = self._terms.raw.abs()
        self.sound.logical_or_(begun)
        self.sound.logical_and_(size.amax(dim=1) < LARGEST)  # NaN is the largest of all, and not below
        torch.maximum(self._largest, size, out=self._largest)

    def flush(self) -> dict[str, Tensor]:
        """Return the number of robots by fault, as fresh 0-dimensional tensors by their name in TensorBoard, NaN where there
        were none; then start anew.
        """
        broken = [~(self._largest[:, columns].amax(dim=1) < LARGEST) for columns in self._terms.columns.values()]
        counts = torch.cat([self._seen, ~self._rewards_whole, torch.stack(broken)]).sum(dim=1).float()
        self._seen.zero_()
        self._rewards_whole.fill_(True)
        self._largest.zero_()
        counts = torch.where(counts > 0.0, counts, torch.nan)  # NaN says "no value", and is not logged
        return {f"Faults/{name}": count for name, count in zip(self._names, counts.unbind(), strict=True)}
