"""Size of a robot, and factors that rescale numbers written for another robot.

Robots of different sizes move alike (dynamic similarity; Alexander and Jayes, J. Zool. 201, 1983) if lengths are proportional
to h, times to sqrt(h / g) and masses to m. Then speeds are proportional to sqrt(g h), forces to m g and torques to m g h.
Here m is the robot's mass, h its standing height, and g gravity, which is the same for all robots.
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
    """Return the size of the robot called `name`; for `name` and `where` see `load_robot`.

    Raises:
        ConfigError: the robot cannot be loaded.
    """
    robot = load_robot(name, where)
    return Size(robot.mass, robot.height)


def growth(reference: Size, robot: Size) -> dict[str, float]:
    """Return the ratios of masses ("kg"), lengths ("m") and times ("s") of `robot` to those of `reference`."""
    length = robot.height / reference.height
    return {"kg": robot.mass / reference.mass, "m": length, "s": sqrt(length)}


def grown(unit: str, reference: Size, robot: Size) -> float:
    """Return the factor that converts a number in `unit`, such as "m/s" or "N^2 m^2", from `reference` to `robot`."""
    return factor(unit, growth(reference, robot))
