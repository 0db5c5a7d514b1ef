"""From where a camera sees what it is to see."""

from collections.abc import Sequence

import numpy as np


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """Return the unit vector (3,), world frame, along which a MuJoCo camera of these angles [degrees] looks."""
    a, e = np.radians([azimuth, elevation])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def frame(
    points: np.ndarray, reach: Sequence[float], azimuth: float, elevation: float
) -> tuple[np.ndarray, float, np.ndarray]:
    """Find the nearest place of a camera from which all `points` (N, 3), world frame [m], are seen. Return where it looks at
    (3,), its distance from there [m], and (2,) how far the points reach across and up in that picture.

    `reach` are the tangents of the angles from the middle of the picture to its right and to its upper edge, as far as they
    are to be filled; what comes back of the points is measured alike, from the first of them to the last.
    """
    forward = direction(azimuth, elevation)
    right = np.array([np.sin(np.radians(azimuth)), -np.cos(np.radians(azimuth)), 0.0])
    axes = np.stack([right, np.cross(right, forward)])
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    depth, aside = (points - middle) @ forward, (points - middle) @ axes.T
    # A point at `aside` is on the picture if |aside - shift| <= reach * (distance + depth), on either side of either axis.
    high, low = ((sign * aside / reach - depth[:, None]).max(axis=0) for sign in (1.0, -1.0))
    distance = float(0.5 * (high + low).max())
    shift = 0.5 * np.asarray(reach) * (high - low)
    seen = (aside - shift) / (distance + depth)[:, None]
    return middle + shift @ axes, distance, np.ptp(seen, axis=0)
