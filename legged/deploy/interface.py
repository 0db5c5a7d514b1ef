"""The interface between the program and a robot."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class RobotFacts:
    """Properties of a robot with D joints. Readings and commands have the joints in the same order as `joint_names`."""

    name: str
    joint_names: tuple[str, ...]
    position_limits: np.ndarray
    """(D, 2) [rad]; infinite for a joint without a limit."""
    velocity_limits: np.ndarray
    """(D,) [rad/s]."""
    torque_limits: np.ndarray
    """(D,) [N m]."""
    imu_body: str
    """Body in whose frame `Reading.quaternion` and `Reading.gyro` are given."""
    offers: frozenset[str] = frozenset()
    """Additional sources: observation terms from an estimator, a map or a simulator."""


@dataclass(frozen=True)
class Reading:
    """Measurements of a robot at one moment."""

    time: float
    """Time of the robot's clock [s]."""
    received: float
    """Time of arrival on this machine, on the clock of `time.perf_counter` [s]."""
    quaternion: np.ndarray
    """(4,) w, x, y, z; rotation from the frame of `RobotFacts.imu_body` to the world frame, whose z axis points up."""
    gyro: np.ndarray
    """(3,) angular velocity in the frame of `RobotFacts.imu_body` [rad/s]."""
    positions: np.ndarray
    """(D,) joint angles [rad]."""
    velocities: np.ndarray
    """(D,) joint velocities [rad/s]."""
    torques: np.ndarray | None = None
    """(D,) joint torques, measured or estimated [N m]; None if unknown."""
    temperatures: np.ndarray | None = None
    """(D,) temperatures of the motors [degrees Celsius]; None if unknown."""
    sources: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Source -> newest value. `base_lin_vel` (3,) is in the frame of the IMU's body [m/s]. `heights` (P,) are ground heights
    at the requested points, relative to the base [m]. Any other source has the unscaled values of the term with its name."""
    stop: bool = False
    """True if the operator requests a stop with the robot's remote control."""


class Interface(ABC):
    """A real or a simulated robot."""

    facts: RobotFacts

    @abstractmethod
    def ask(self, sources: Mapping[str, np.ndarray | None]) -> None:
        """Request these sources for all later readings. The value of `heights` is its points (P, 2), x forward and y left of
        the base [m]. The value of any other source is None.
        """

    @abstractmethod
    def read(self) -> list[Reading]:
        """Return the readings since the last call, oldest first, without waiting; the list may be empty."""

    @abstractmethod
    def write(self, positions: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        """Command the torques stiffness * (positions - q) - damping * dq until the next call. The arguments have the shape
        (D,) and the units [rad], [N m/rad] and [N m s/rad].
        """

    @abstractmethod
    def close(self) -> None:
        """Release the robot."""
