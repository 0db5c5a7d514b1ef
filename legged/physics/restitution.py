"""Contact damping that gives a wanted restitution. MuJoCo's contact model has no parameter for restitution."""

import math

import torch
from torch import Tensor

POINTS = 1024


def kept_speed(ratio: float) -> float:
    """Return the restitution of a body on a spring and damper with damping ratio `ratio` (0 to 1): the share of its speed
    that it keeps after an impact. The contact ends when the contact force would begin to pull.

    Source: Schwager and Poeschel, Coefficient of restitution and linear-dashpot model revisited (Granular Matter 9, 2007),
    equation 21: exp(-r / w * angle) with w = sqrt(1 - r^2) and angle = atan2(2 r w, 2 r^2 - 1); exp(-2) at r = 1.
    """
    if ratio >= 1.0:
        return math.exp(-2.0)
    swing = math.sqrt(1.0 - ratio * ratio)
    return math.exp(-ratio / swing * math.atan2(2.0 * ratio * swing, 2.0 * ratio * ratio - 1.0))


def _ratios() -> list[float]:
    """Return the damping ratios for restitutions 0, 1 / POINTS, 2 / POINTS, ..., 1."""
    found = []
    for k in range(POINTS + 1):
        low, high = 0.0, 1.0
        for _ in range(50):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if kept_speed(middle) > k / POINTS else (low, middle)
        found.append(high)
    return found


LEAST_RATIO = 0.01
"""Smallest damping ratio of contacts: without damping, a standing robot never comes to rest."""


class DampingOfBounces:
    """Table that maps restitution to the damping ratio of contacts, so that no equation is solved within a step."""

    def __init__(self, device: torch.device, dtype: torch.dtype) -> None:
        self.table = torch.tensor(_ratios(), dtype=dtype, device=device).clamp_(min=LEAST_RATIO)
        """(POINTS + 1,) damping ratios."""

    def ratio(self, restitution: Tensor) -> Tensor:
        """Return the damping ratio for each number in `restitution`, in the same shape. Restitutions below exp(-2) = 0.135
        get the largest damping ratio, 1.
        """
        place = restitution.clamp(0.0, 1.0) * POINTS
        index = place.long().clamp(max=POINTS - 1)
        low, high = self.table[index], self.table[index + 1]
        return low + (place - index) * (high - low)
