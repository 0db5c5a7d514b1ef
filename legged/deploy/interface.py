"""What stands between the program and a robot: few numbers in, few numbers out."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class RobotFacts:
    """What an interface knows of its robot. D joints, in the order in which it gives and takes numbers."""

    name: str
    joint_names: tuple[str, ...]
    position_limits: np.ndarray
    """(D, 2) [rad]; infinite where there are none."""
    velocity_limits: np.ndarray
    """(D,) [rad/s]."""
    torque_limits: np.ndarray
    """(D,) [N m]."""
    imu_body: str
    """Body in whose frame `Reading.quaternion` and `Reading.gyro` are given."""
    offers: frozenset[str] = frozenset()
    """Sources beside the sensors of `Reading`: observation terms that an estimator, a map or a simulator gives."""


@dataclass(frozen=True)
class Reading:
    """What a robot measured at one moment."""

    time: float
    """By the robot's clock [s]."""
    received: float
    """When this machine got it, by `time.perf_counter` [s]."""
    quaternion: np.ndarray
    """(4,) w, x, y, z; it turns the frame of `RobotFacts.imu_body` into the world's, whose z points up."""
    gyro: np.ndarray
    """(3,) angular velocity in the frame of `RobotFacts.imu_body` [rad/s]."""
    positions: np.ndarray
    """(D,) joint angles [rad]."""
    velocities: np.ndarray
    """(D,) joint velocities [rad/s]."""
    torques: np.ndarray | None = None
    """(D,) joint torques, measured or estimated [N m]; None if the robot gives none."""
    temperatures: np.ndarray | None = None
    """(D,) temperatures of the motors [degrees Celsius]; None if the robot gives none."""
    sources: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Source -> its newest value: `base_lin_vel` (3,) in the frame of the IMU's body [m/s]; `heights` (P,) of the ground at
    each of the points that were asked for, less that of the base [m]; others as their observation terms have them."""
    stop: bool = False
    """Whether the operator asks for a stop by the robot's own remote control."""


class Interface(ABC):
    """A robot, or what stands in for one."""

    facts: RobotFacts

    @abstractmethod
    def ask(self, sources: Mapping[str, np.ndarray | None]) -> None:
        """Say which sources are wanted from now on; for `heights`, at which points (P, 2), x forward and y left of the base,
        seen from above [m].
        """

    @abstractmethod
    def read(self) -> list[Reading]:
        """Return what has come since the last call, the oldest first, without waiting; maybe nothing."""

    @abstractmethod
    def write(self, positions: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        """Ask for the torques stiffness * (positions - q) - damping * dq, (D,) each [rad], [N m/rad], [N m s/rad], until the
        next call.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of the robot."""
