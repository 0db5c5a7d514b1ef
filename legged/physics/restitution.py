"""From how much of its speed a body keeps when it bounces to the damping of its contacts: MuJoCo has no restitution."""

import math

import torch
from torch import Tensor

POINTS = 1024


def kept_speed(ratio: float) -> float:
    """Return the share of its speed that a body keeps which bounces off a spring with a damper of damping ratio `ratio`, from
    0 to 1, where the contact ends as soon as it no longer pushes.

    Source: Schwager and Poeschel, Coefficient of restitution and linear-dashpot model revisited (Granular Matter 9, 2007),
    equation 21: exp(-r / w * angle) with w = sqrt(1 - r^2) and angle = atan2(2 r w, 2 r^2 - 1); exp(-2) at r = 1.
    """
    if ratio >= 1.0:
        return math.exp(-2.0)
    swing = math.sqrt(1.0 - ratio * ratio)
    return math.exp(-ratio / swing * math.atan2(2.0 * ratio * swing, 2.0 * ratio * ratio - 1.0))


def _ratios() -> list[float]:
    """Return the damping ratios at which 0, 1 / POINTS, ... and all of the speed is kept."""
    found = []
    for k in range(POINTS + 1):
        low, high = 0.0, 1.0
        for _ in range(50):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if kept_speed(middle) > k / POINTS else (low, middle)
        found.append(high)
    return found


LEAST_RATIO = 0.01
"""Contacts are damped at least so much: without any, a robot that stands never comes to rest."""


class DampingOfBounces:
    """Restitution -> damping ratio of contacts, by a table: nothing is solved for within a step."""

    def __init__(self, device: torch.device, dtype: torch.dtype) -> None:
        self.table = torch.tensor(_ratios(), dtype=dtype, device=device).clamp_(min=LEAST_RATIO)
        """(POINTS + 1,) ratios."""

    def ratio(self, restitution: Tensor) -> Tensor:
        """Return damping ratios for shares of the speed that bounces keep, of any shape. Less than exp(-2) = 0.135 is not to
        be had with a ratio of at most 1, at which it stays.
        """
        place = restitution.clamp(0.0, 1.0) * POINTS
        index = place.long().clamp(max=POINTS - 1)
        low, high = self.table[index], self.table[index + 1]
        return low + (place - index) * (high - low)
