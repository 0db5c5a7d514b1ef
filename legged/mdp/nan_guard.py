"""Handling of numbers that are NaN, infinite or too large for any robot.

One such number in a sample would spread to every weight of the networks. Therefore a reward or observation that is such a
number counts as 0, and the robot's episode ends at the next step. For each term, the log shows how many robots had such a
number. None of this waits for the host.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from legged.mdp.observations import ObservationTerms

LARGEST = 1e10
"""Bound on rewards and observations. Larger values are treated as infinite, because squares of sums must fit a float32."""
LARGEST_STATE = 1e4
"""Bound on positions [m], velocities [m/s], angles [rad] and rates [rad/s]. Beyond it the physics has diverged."""


class NanGuard:
    """Record of non-finite numbers since the last `flush`: for each term, which of N robots had one. Numbers beyond LARGEST
    or LARGEST_STATE count as non-finite.
    """

    STATE = ("sound",)

    def __init__(self, rewards: Sequence[str], observations: ObservationTerms, num_envs: int, device: torch.device) -> None:
        """Watch the reward terms named `rewards` and the terms of `observations`. `check_rewards` takes a row for
        each reward term, in the order of `rewards`.
        """
        self.outputs_finite = torch.ones(num_envs, dtype=torch.bool, device=device)
        """(N,) True for robots whose rewards and observations of the last step were finite. The episodes of all other robots
        end at the next step."""
        self.sound = self.outputs_finite
        """The tensor `outputs_finite`, under its name in saved states."""
        self._terms = observations
        self._names = ("physics", "action", *(f"reward_{n}" for n in rewards), *(f"obs_{n}" for n in observations.columns))
        self._now = torch.zeros(2, num_envs, dtype=torch.bool, device=device)  # rows: physics, action
        self._seen = torch.zeros_like(self._now)
        self._rewards_finite = torch.ones(len(rewards), num_envs, dtype=torch.bool, device=device)
        # Largest absolute value (N, width) of each observation since the last `flush`. A step updates it by two launches.
        self._largest = torch.zeros_like(observations.values)

    def check_state(self, in_bounds: Tensor, clipped_actions: Tensor) -> None:
        """Record faults of physics and actions. `in_bounds` (N,) is True for robots whose state and actions are finite;
        `clipped_actions` (N, D) are finite or NaN.
        """
        physics, action = self._now
        torch.any(clipped_actions != clipped_actions, dim=1, out=action)
        torch.eq(in_bounds, action, out=physics)  # True if out of bounds although actions are finite
        self._seen.logical_or_(self._now)

    def check_rewards(self, rewards_finite: Tensor, valid: Tensor) -> None:
        """Record faults of rewards. `rewards_finite` (terms, N) is True for finite rewards. Robots outside `valid` (N,) are
        left out: their episodes end in this step anyway.
        """
        finite = rewards_finite >= valid  # finite, or not valid
        torch.all(finite, dim=0, out=self.outputs_finite)
        self._rewards_finite.logical_and_(finite)

    def check_observations(self, begun: Tensor) -> None:
        """Record faults of observation terms, before they are scaled and clipped. Call it after `check_rewards`. Robots of
        `begun` (N,) have new episodes; faulty rewards of their old episodes do not end the new ones.
        """
        size = self._terms.raw.abs()
        self.outputs_finite.logical_or_(begun)
        self.outputs_finite.logical_and_(size.amax(dim=1) < LARGEST)  # a NaN becomes the maximum, and NaN < LARGEST is False
        torch.maximum(self._largest, size, out=self._largest)

    def flush(self) -> dict[str, Tensor]:
        """Return the number of robots with each fault, by name in TensorBoard, as new 0-dimensional tensors. Then clear the
        record. The number is NaN for a fault that no robot had.
        """
        broken = [~(self._largest[:, columns].amax(dim=1) < LARGEST) for columns in self._terms.columns.values()]
        counts = torch.cat([self._seen, ~self._rewards_finite, torch.stack(broken)]).sum(dim=1).float()
        self._seen.zero_()
        self._rewards_finite.fill_(True)
        self._largest.zero_()
        counts = torch.where(counts > 0.0, counts, torch.nan)  # NaN means "no value" and is not logged
        return {f"Faults/{name}": count for name, count in zip(self._names, counts.unbind(), strict=True)}
