"""Where a camera that follows a robot over terrain stands and looks."""

import mujoco
import numpy as np

from legged.rendering.framing import direction
from legged.terrain import HeightMap

SMOOTH = np.array([0.12, 0.12, 0.05])
"""Share of the way to the robot that the camera makes up in a picture, along x, y, z: steps must not shake it."""
CUT = 1.5
"""From farther away than this it does not glide, it cuts: the robot has been put somewhere else [m]."""
FLATTEST, STEEPEST = -22.0, -70.0
"""Elevations between which it looks down [degrees]."""
BEHIND, FRONT = 62.0, 118.0
"""Directions in which it looks, from the x axis [degrees]."""
AHEAD, DROP = 3.0, 0.1
"""A robot walks down where the ground so far ahead is so much lower [m]."""
CLEAR = 0.35
"""Room that its line of sight keeps above the ground, beyond the robot's own surroundings [m]."""


class Follower:
    """Follows one robot after another from the side, `distance` [m] away: from behind those that walk up, from the front
    those that walk down, so that the faces of steps are seen. It looks down as steeply as it needs to see over the rim of
    a pit. Robots are taken to walk along x.
    """

    def __init__(self, ground: HeightMap, distance: float = 3.6) -> None:
        self.ground, self.distance = ground, distance
        self.glide = SMOOTH
        """(3,) share of the way to the robot that is made up in a picture."""
        self.azimuth = BEHIND
        self.lookat: np.ndarray | None = None
        """(3,) point in the middle of the picture, world frame [m]."""
        self.elevation = FLATTEST

    def update(self, target: np.ndarray) -> None:
        """Follow to `target` (3,), world frame [m]; to be called once a picture."""
        if self.lookat is None or np.linalg.norm(target - self.lookat) > CUT:
            self.lookat = np.array(target, dtype=float)
            here, ahead = self.ground.height_at(target[0] + np.array([0.0, AHEAD]), np.full(2, target[1]))
            self.azimuth = FRONT if ahead < here - DROP else BEHIND
            self.elevation = self._free_elevation()
            return
        self.lookat = self.lookat + self.glide * (target - self.lookat)
        self.elevation += 0.05 * (self._free_elevation() - self.elevation)

    def aim(self, view: mujoco.MjvCamera) -> None:
        """Set MuJoCo's camera."""
        assert self.lookat is not None, "update comes first"
        view.lookat[:], view.distance = self.lookat, self.distance
        view.azimuth, view.elevation = self.azimuth, self.elevation

    def _free_elevation(self) -> float:
        """Return the flattest elevation at which no ground is between camera and robot [degrees]."""
        assert self.lookat is not None
        along = np.linspace(0.25, 1.0, 12)[:, None] * self.distance
        for elevation in np.arange(FLATTEST, STEEPEST, -2.0):
            x, y, z = (self.lookat - along * direction(self.azimuth, elevation)).T
            if (z > self.ground.height_at(x, y) + CLEAR).all():
                return float(elevation)
        return STEEPEST
