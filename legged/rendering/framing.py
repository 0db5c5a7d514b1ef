"""Viewpoints: sizes of robots, cameras that fit points into a picture, and a camera that follows a robot over terrain."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged.robots.importing.convert import robot_spec_of
from legged.robots.robot import Robot
from legged.terrain import HeightMap

SMOOTH = np.array([0.12, 0.12, 0.05])
"""Share of the distance to the robot that the camera covers per picture, along x, y, z: steps then shake it less."""
CUT = 1.5
"""Distance above which the camera jumps to the robot at once, because the robot was put somewhere else [m]."""
FLATTEST, STEEPEST = -22.0, -70.0
"""Limits of the camera's elevation [degrees]."""
BEHIND, FRONT = 62.0, 118.0
"""Viewing directions, from the x axis [degrees]."""
AHEAD, DROP = 3.0, 0.1
"""A robot walks down if the ground at the distance AHEAD is lower by DROP [m]."""
CLEAR = 0.35
"""Clearance of the line of sight above the ground, beyond the robot's surroundings [m]."""


@dataclass(frozen=True)
class RobotSize:
    """The upright box around a robot in its default pose: ANYmal C's is 1.04 m long and 0.77 m high."""

    longest: float
    """Its longest side [m]."""
    height: float
    """[m]."""
    sides: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Along x, y and z [m]."""


def size_of(robot: Robot) -> RobotSize:
    """Return the size of a robot, with its visual and collision shapes."""
    return size_of_model(robot_spec_of(robot.model_path, drawn=True).compile(), robot.default_qpos)


def size_of_model(model: mujoco.MjModel, qpos: np.ndarray) -> RobotSize:
    """Return the size of all bodies of a model except the world, at the positions `qpos` (nq,)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    own = [i for i in range(model.ngeom) if model.geom_bodyid[i] > 0 and model.geom_type[i] != mujoco.mjtGeom.mjGEOM_PLANE]
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    points = [
        data.geom_xpos[i] + (model.geom_aabb[i, :3] + corners * model.geom_aabb[i, 3:]) @ data.geom_xmat[i].reshape(3, 3).T
        for i in own
    ]
    sides = np.ptp(np.concatenate(points), axis=0)
    return RobotSize(float(sides.max()), float(sides[2]), tuple(sides.tolist()))


def side_by_side(count: int, columns: int) -> np.ndarray:
    """Return points (count, 3) of a horizontal grid of spacing 1 around the origin, row after row along -x."""
    at = np.arange(count)
    grid = np.stack([-(at // columns), at % columns, 0 * at], axis=1).astype(float)
    return grid - grid.mean(axis=0)


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """Return the viewing direction (3,), a unit vector in the world frame, of a MuJoCo camera with these angles [degrees]."""
    a, e = np.radians([azimuth, elevation])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def frame(
    points: np.ndarray, reach: Sequence[float], azimuth: float, elevation: float
) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the nearest viewpoint from which all `points` (N, 3), world frame [m], are seen: the point (3,) in the middle of
    the picture, the camera's distance from it [m], and the extent (2,) of the points across and up in the picture.

    `reach` are the tangents of the angles from the middle of the picture to the right and to the upper end of the area to
    fill; the returned extent has the same unit.
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


class Follower:
    """A camera at the side of a robot, `distance` [m] away: behind robots that walk up and in front of robots that walk down,
    so that the faces of steps are visible. It looks down steeply enough to see over the rim of a pit. Robots are assumed to
    walk along x.
    """

    def __init__(self, ground: HeightMap, distance: float = 3.6) -> None:
        self.ground, self.distance = ground, distance
        self.glide = SMOOTH
        """(3,) share of the distance to the robot that is covered per picture."""
        self.azimuth = BEHIND
        self.lookat: np.ndarray | None = None
        """(3,) point in the middle of the picture, world frame [m]."""
        self.elevation = FLATTEST

    def update(self, target: np.ndarray) -> None:
        """Move towards `target` (3,), world frame [m]; called once per picture."""
        if self.lookat is None or np.linalg.norm(target - self.lookat) > CUT:
            self.lookat = np.array(target, dtype=float)
            here, ahead = self.ground.height_at(target[0] + np.array([0.0, AHEAD]), np.full(2, target[1]))
            self.azimuth = FRONT if ahead < here - DROP else BEHIND
            self.elevation = self._free_elevation()
            return
        self.lookat = self.lookat + self.glide * (target - self.lookat)
        self.elevation += 0.05 * (self._free_elevation() - self.elevation)

    def aim(self, view: mujoco.MjvCamera) -> None:
        """Set MuJoCo's camera; requires an `update`."""
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
