"""Size of a robot, and factors that rescale numbers written for another robot.

Bodies of different size move alike if lengths grow by h, times by sqrt(h / g) and masses by m, so that speeds grow by sqrt(g
h), forces by m g and torques by m g h: dynamic similarity (Alexander and Jayes, J. Zool. 201, 1983). Here m is the robot's
mass and h its standing height; gravity is the same for all.
"""

from dataclasses import dataclass
from math import sqrt

from legged.config.units import factor
from legged.robots.robot import load_robot


@dataclass(frozen=True)
class Size:
    """The size of a robot."""

    mass: float
    """Total mass [kg]."""
    height: float
    """Height of the base above the ground with the robot level in its default pose [m]."""


def size_of(name: str, where: str = "robot") -> Size:
    """Return the size of the robot that `load_robot` loads by this name.

    Raises:
        ConfigError: the robot cannot be loaded.
    """
    robot = load_robot(name, where)
    return Size(robot.mass, robot.height)


def growth(reference: Size, robot: Size) -> dict[str, float]:
    """Return the factors of masses ("kg"), lengths ("m") and times ("s") from one robot to another."""
    length = robot.height / reference.height
    return {"kg": robot.mass / reference.mass, "m": length, "s": sqrt(length)}


def grown(unit: str, reference: Size, robot: Size) -> float:
    """Return the factor of a quantity of that unit, as "m/s" or "N^2 m^2", from one robot to another."""
    return factor(unit, growth(reference, robot))
