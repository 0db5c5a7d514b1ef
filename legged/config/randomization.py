"""How a property that differs from robot to robot is drawn, and how robots are disturbed."""

from dataclasses import dataclass, field
from typing import Literal

from legged.config.bounds import LARGEST, LONGEST_S, between, positive, quantity, rescaled

Range = tuple[float, float]
ITERATIONS = between(0, 10_000_000)
KICK = between(-1000, 1000)


@dataclass(frozen=True)
class DrawConfig:
    """How one property is drawn: what an entry of `domain_rand.ranges` may say beside its range."""

    range: Range = field(default=(0.0, 0.0), metadata=between(-LARGEST, LARGEST))
    """Lowest and highest value, in the unit of the property."""
    distribution: Literal["uniform", "log_uniform", "gaussian"] = "uniform"
    """Evenly; evenly in the logarithm; or normally around the middle of the range, cut off at its ends."""
    std: float = field(default=0.0, metadata=between(0, LARGEST))
    """Standard deviation of gaussian before it is cut off, in the unit of the property; 0 is a quarter of the range's
    width."""
    when: Literal["start", "reset", "interval"] = "start"
    """Once before training; whenever an episode begins; or every `interval_s`, each robot at its own moment."""
    interval_s: float = field(default=0.0, metadata=quantity("s", between(0, LONGEST_S)))
    """Time between two draws of a robot [s]; of `interval` only."""
    each: bool | None = None
    """One number for each part that has the property (joint, body, shape), or one for all of a robot; null as the property
    says."""
    grow: Range = field(default=(0.0, 0.0), metadata=ITERATIONS)
    """Iterations between which the range grows to its full width, from the property's neutral value or, where it leaves that
    out, from the end that is nearest; [0, 0] has it full at once."""


@dataclass(frozen=True)
class KickConfig:
    """Sudden changes of the base's velocity."""

    interval_s: Range = field(default=(5.0, 10.0), metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Range of the time between two kicks of a robot, drawn anew after each [s]."""
    x: Range = field(default=(0.0, 0.0), metadata=rescaled("m/s", KICK))
    """What is added to the base's velocity along x, world frame [m/s]."""
    y: Range = field(default=(0.0, 0.0), metadata=rescaled("m/s", KICK))
    """Along y, world frame [m/s]."""
    z: Range = field(default=(0.0, 0.0), metadata=rescaled("m/s", KICK))
    """Along z, world frame [m/s]."""
    roll: Range = field(default=(0.0, 0.0), metadata=rescaled("rad/s", KICK))
    """What is added to the base's angular velocity about its x axis, base frame [rad/s]."""
    pitch: Range = field(default=(0.0, 0.0), metadata=rescaled("rad/s", KICK))
    """About its y axis, base frame [rad/s]."""
    yaw: Range = field(default=(0.0, 0.0), metadata=rescaled("rad/s", KICK))
    """About its z axis, base frame [rad/s]."""
    grow: Range = field(default=(0.0, 0.0), metadata=ITERATIONS)
    """Iterations between which kicks grow from nothing to their full ranges; [0, 0] has them full at once."""


@dataclass(frozen=True)
class ForceConfig:
    """A force that acts on a body for a time, now and then."""

    body: str = ""
    """Body of the robot's model; empty is the base."""
    interval_s: Range = field(default=(5.0, 10.0), metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Range of the time from the end of one push of a robot to the next, drawn anew after each [s]."""
    duration_s: Range = field(default=(0.1, 0.5), metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Range of the time that it lasts, in whole control steps and at least one [s]."""
    x: Range = field(default=(0.0, 0.0), metadata=rescaled("N", between(-LARGEST, LARGEST)))
    """Force along x at the body's centre of mass, world frame [N]."""
    y: Range = field(default=(0.0, 0.0), metadata=rescaled("N", between(-LARGEST, LARGEST)))
    """Along y, world frame [N]."""
    z: Range = field(default=(0.0, 0.0), metadata=rescaled("N", between(-LARGEST, LARGEST)))
    """Along z, world frame [N]."""
    grow: Range = field(default=(0.0, 0.0), metadata=ITERATIONS)
    """Iterations between which forces grow from nothing to their full ranges; [0, 0] has them full at once."""


def draw_of(entry: Range | DrawConfig) -> DrawConfig:
    """Return what an entry of `domain_rand.ranges` says, of which a range alone is the short form."""
    return entry if isinstance(entry, DrawConfig) else DrawConfig(range=entry)
