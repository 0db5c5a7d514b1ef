"""How large a robot is, and what that makes of numbers that were written for another one.

Bodies of different size move alike where lengths grow by h, times by sqrt(h / g), masses by m, and so speeds by sqrt(g h),
forces by m g and torques by m g h: dynamic similarity (Alexander and Jayes, J. Zool. 201, 1983). Here m is the robot's mass
and h its standing height; gravity is the same for all.
"""

from dataclasses import dataclass
from math import sqrt

from legged.config.units import factor
from legged.robots.robot import load_robot


@dataclass(frozen=True)
class Size:
    """What the size of a robot is."""

    mass: float
    """Total mass [kg]."""
    height: float
    """Base above the ground when the robot stands level in its default pose [m]."""


def size_of(name: str, where: str = "robot") -> Size:
    """Return the size of the robot that `load_robot` knows by this name.

    Raises:
        ConfigError: it cannot be loaded.
    """
    robot = load_robot(name, where)
    return Size(robot.mass, robot.height)


def growth(reference: Size, robot: Size) -> dict[str, float]:
    """Return by what masses ("kg"), lengths ("m") and times ("s") grow from one robot to another."""
    length = robot.height / reference.height
    return {"kg": robot.mass / reference.mass, "m": length, "s": sqrt(length)}


def grown(unit: str, reference: Size, robot: Size) -> float:
    """Return by what a quantity of that unit, as "m/s" or "N^2 m^2", grows from one robot to another."""
    return factor(unit, growth(reference, robot))
