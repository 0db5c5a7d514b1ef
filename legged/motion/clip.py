"""A clip: the root pose and the joint angles of a robot in frames at a constant rate."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from legged.errors import ConfigError
from legged.math import quat_conjugate, quat_from_rotation_vector, quat_multiply, rotation_vector
from legged.process.paths import make_folder, replacing
from legged.robots.robot import Robot

FEWEST = 3
"""Smallest number of frames, from which central differences can be taken."""


class Velocities(NamedTuple):
    """Velocities of a clip with T frames and D joints."""

    root_lin: np.ndarray
    """(T, 3) linear velocity of the root, world frame [m/s]."""
    root_ang: np.ndarray
    """(T, 3) angular velocity of the root, world frame [rad/s]."""
    joint: np.ndarray
    """(T, D) joint velocities [rad/s]."""


@dataclass(frozen=True)
class Clip:
    """A motion of a robot with D joints, in T frames."""

    name: str
    fps: float
    """Frames per second."""
    root_pos: np.ndarray
    """(T, 3) position of the base, world frame [m]."""
    root_quat: np.ndarray
    """(T, 4) orientation of the base, w first."""
    joint_pos: np.ndarray
    """(T, D) joint angles in the order of the robot's model [rad]."""

    def __len__(self) -> int:
        return len(self.joint_pos)

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last [s]."""
        return (len(self) - 1) / self.fps

    def resampled(self, fps: float) -> "Clip":
        """Return the clip at another rate. Positions are interpolated linearly, orientations on the shortest arc. The frames
        are at k / `fps`, before the end of the clip.

        Raises:
            ConfigError: too few frames are left.
        """
        if fps == self.fps:
            return self
        count = int(np.ceil(self.seconds * fps - 1e-9))
        if count < FEWEST:
            raise ConfigError(f"{self.name}: has {count} frames at {fps:g} frames per second; it needs at least {FEWEST}")
        places = np.arange(count) * (self.fps / fps)
        first = np.minimum(places.astype(int), len(self) - 2)
        share = (places - first)[:, None]

        def between(values: np.ndarray) -> np.ndarray:
            return (1.0 - share) * values[first] + share * values[first + 1]

        start, end = (torch.from_numpy(self.root_quat[index]) for index in (first, first + 1))
        turn = rotation_vector(quat_multiply(quat_conjugate(start), end))
        quat = quat_multiply(start, quat_from_rotation_vector(torch.from_numpy(share) * turn)).numpy()
        return replace(self, fps=fps, root_pos=between(self.root_pos), root_quat=quat, joint_pos=between(self.joint_pos))

    def velocities(self) -> Velocities:
        """Return the velocities by central differences. At both ends, differences are one-sided, and the angular velocity of
        the root is that of the neighbouring frame.
        """
        root_lin, joint = (np.gradient(values, 1.0 / self.fps, axis=0) for values in (self.root_pos, self.joint_pos))
        quat = torch.from_numpy(self.root_quat)
        turn = rotation_vector(quat_multiply(quat[2:], quat_conjugate(quat[:-2]))) * (0.5 * self.fps)
        return Velocities(root_lin, torch.cat([turn[:1], turn, turn[-1:]]).numpy(), joint)


def make_clip(name: str, fps: float, root_pos: np.ndarray, root_quat: np.ndarray, joint_pos: np.ndarray, where: str) -> Clip:
    """Return a clip of arrays of any number type. Quaternions are normalised. Error messages begin with `where`.

    Raises:
        ConfigError: the clip is too short, its arrays differ in length, its rate is not positive, or a number is not finite.
    """
    pos, quat, joint = (np.array(values, dtype=np.float64) for values in (root_pos, root_quat, joint_pos))
    if not 0.0 < fps < np.inf:
        raise ConfigError(f"{where}: the rate must be positive, got {fps:g} frames per second")
    if len(joint) < FEWEST:
        raise ConfigError(f"{where}: the clip has {len(joint)} frames; it needs at least {FEWEST}")
    if not len(pos) == len(quat) == len(joint):
        raise ConfigError(f"{where}: has {len(pos)} root positions, {len(quat)} orientations and {len(joint)} rows of joints")
    for what, values in (("root position", pos), ("root orientation", quat), ("joint angle", joint)):
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise ConfigError(f"{where}: frame {bad[0]} has a {what} that is NaN or infinite")
    length = np.linalg.norm(quat, axis=1, keepdims=True)
    if (length < 0.5).any():
        raise ConfigError(f"{where}: frame {int(np.argmin(length))} has a root orientation that is no unit quaternion")
    return Clip(name, fps, pos, quat / length, joint)


def write_clip(clip: Clip, robot: Robot, path: Path) -> None:
    """Write a clip as an npz file. `joint_pos` (T, 7 + D) holds root position, root quaternion (w first) and joint angles.

    Raises:
        RunError: the file can't be written.
    """
    make_folder(path.parent)
    rows = np.concatenate([clip.root_pos, clip.root_quat, clip.joint_pos], axis=1).astype(np.float32)
    with replacing(path) as part, part.open("wb") as file:
        np.savez_compressed(file, fps=np.array(clip.fps), joint_names=np.array(robot.joint_names), joint_pos=rows)
