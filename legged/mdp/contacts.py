"""Contact and swing times of the feet. They are updated whether or not a reward reads them."""

import torch
from torch import Tensor

from legged.math import masked_set_
from legged.mdp.kernels import Kernels

CONTACT_FORCE = 1.0
"""Vertical force above which a foot counts as in contact, for robots that weigh more than 100 N [N]."""
SHARE_OF_WEIGHT = 0.01
"""Threshold of a contact for robots below 100 N, as a share of their weight. Feet of a 400 g robot hardly ever reach 1 N."""
GRAVITY = 9.81
"""Acceleration of gravity, for weights [m/s^2]."""


def contact_force(mass: float) -> float:
    """Return the vertical force [N] above which a foot counts as in contact, for a robot of that `mass` [kg]."""
    return min(CONTACT_FORCE, SHARE_OF_WEIGHT * GRAVITY * mass)


class FeetContacts:
    """Contacts of F feet of N robots. A foot is in contact if it touches the ground now or did so in the previous step, so
    that a single missed sample does not split a stance.
    """

    STATE = ("_flags", "_times")

    def __init__(
        self,
        num_envs: int,
        num_feet: int,
        dt: float,
        device: torch.device,
        kernels: Kernels | None = None,
        force: float = CONTACT_FORCE,
    ) -> None:
        """Clear all times and contacts. `dt` is the control step [s]; `force` is the threshold of a contact [N]."""
        self.dt, self._kernels, self.force = dt, kernels, force
        # The six masks and times are views of two tensors, so that a reset takes only two kernel launches.
        self._flags = torch.zeros(num_envs, 3, num_feet, dtype=torch.bool, device=device)
        self._times = torch.zeros(num_envs, 3, num_feet, device=device)
        self.in_contact, self.first_contact, self._touching = self._flags.unbind(dim=1)
        """(N, F) masks of the feet that are on the ground, and of those that touched down at this step."""
        self.air_time, self.last_air_time, self.contact_time = self._times.unbind(dim=1)
        """(N, F) duration of the current swing, 0 in contact; of the last finished swing; and of the current stance, 0 in the
        air [s]."""

    def update(self, feet_forces: Tensor) -> None:
        """Advance by one control step. `feet_forces` (N, F, 3) are the contact forces of the feet in the world frame [N]."""
        if self._kernels is not None:
            times = (self.air_time, self.last_air_time, self.contact_time)
            flags = (self.in_contact, self.first_contact, self._touching)
            dim = tuple(self.in_contact.shape)
            self._kernels.launch("advance_feet", dim, feet_forces, self.force, self.dt, *flags, *times)
            return
        touching = feet_forces[:, :, 2] > self.force
        torch.logical_or(touching, self._touching, out=self.in_contact)
        self._touching.copy_(touching)
        torch.logical_and(
            self.air_time, self.in_contact, out=self.first_contact
        )  # an air time above 0 means that the foot was in the air
        self.air_time.add_(self.dt)
        torch.where(self.first_contact, self.air_time, self.last_air_time, out=self.last_air_time)
        self.air_time.masked_fill_(self.in_contact, 0.0)
        self.contact_time.add_(self.dt).mul_(self.in_contact)

    def reset(self, mask: Tensor) -> None:
        """Reset contacts and times of the robots in `mask` (N,)."""
        masked_set_(self._flags, mask, False)
        masked_set_(self._times, mask, 0.0)
