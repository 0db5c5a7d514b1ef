"""Contact and swing times of the feet, kept whether or not a reward asks for them."""

import torch
from torch import Tensor

from legged.math import masked_set_

CONTACT_FORCE = 1.0
"""Vertical force above which a foot counts as in contact [N]."""


class FeetContacts:
    """Contacts of F feet of N robots. A foot is in contact if it feels the ground now or felt it a step before, so that
    a single missed sample does not split a stance.
    """

    def __init__(self, num_envs: int, num_feet: int, dt: float, device: torch.device) -> None:
        """All feet start on the ground, at rest; `dt` is the control step [s]."""
        shape = (num_envs, num_feet)
        self.dt = dt
        self.in_contact = torch.zeros(shape, dtype=torch.bool, device=device)
        self.first_contact = torch.zeros(shape, dtype=torch.bool, device=device)
        """(N, F) the foot touched down at this step."""
        self.air_time = torch.zeros(shape, device=device)
        """(N, F) length of the swing that is going on, 0 in contact [s]."""
        self.last_air_time = torch.zeros(shape, device=device)
        """(N, F) length of the last finished swing, known from its touch-down on [s]."""
        self._touching = torch.zeros(shape, dtype=torch.bool, device=device)

    def update(self, feet_forces: Tensor) -> None:
        """Advance by one control step; `feet_forces` (N, F, 3) in the world frame [N]."""
        touching = feet_forces[:, :, 2] > CONTACT_FORCE
        torch.logical_or(touching, self._touching, out=self.in_contact)
        self._touching.copy_(touching)
        self.first_contact.copy_((self.air_time > 0.0) & self.in_contact)
        self.air_time.add_(self.dt)
        self.last_air_time.copy_(torch.where(self.first_contact, self.air_time, self.last_air_time))
        self.air_time.masked_fill_(self.in_contact, 0.0)

    def reset(self, mask: Tensor) -> None:
        """Forget the past of the robots in `mask`."""
        for tensor in (self.in_contact, self.first_contact, self._touching):
            masked_set_(tensor, mask, False)
        for tensor in (self.air_time, self.last_air_time):
            masked_set_(tensor, mask, 0.0)
