"""Settings of randomised properties and of disturbances."""

from dataclasses import dataclass, field
from typing import Literal

from legged.config.bounds import LARGEST, LONGEST_S, TERMS, between, positive, quantity, rescaled

Range = tuple[float, float]
ITERATIONS = between(0, 10_000_000)
KICK = between(-1000, 1000)


@dataclass(frozen=True)
class DrawConfig:
    """Randomisation of one property. This is the long form of an entry of `domain_rand.ranges`; a range is the short form."""

    range: Range = field(default=(0.0, 0.0), metadata=between(-LARGEST, LARGEST))
    """Lowest and highest value, in the unit of the property."""
    distribution: Literal["uniform", "log_uniform", "gaussian"] = "uniform"
    """Distribution over the range. `log_uniform` is uniform in the logarithm of the value. `gaussian` has its mean in the
    middle of the range and is cut off at the ends."""
    std: float = field(default=0.0, metadata=between(0, LARGEST))
    """Standard deviation of `gaussian` before it is cut off, in the unit of the property. 0 means a quarter of the range's
    width."""
    when: Literal["start", "reset", "interval"] = "start"
    """Time at which a robot's value is sampled: once before training (`start`), at the beginning of each episode (`reset`),
    or every `interval_s` (`interval`), at different times for different robots."""
    interval_s: float = field(default=0.0, metadata=quantity("s", between(0, LONGEST_S)))
    """Time after which a robot's value is sampled anew [s]. Only for `when: interval`."""
    each: bool | None = None
    """True: sample a value for each part that has the property (joint, body, shape). False: sample one value for the whole
    robot. Null: the property's default."""
    grow: Range = field(default=(0.0, 0.0), metadata=ITERATIONS)
    """First and last training iteration in which the range widens. [0, 0] means the full range from the start. The range
    widens from the point of the range that is nearest to the property's neutral value."""


@dataclass(frozen=True)
class KickConfig:
    """Sudden changes of the base's velocity."""

    interval_s: Range = field(default=(5.0, 10.0), metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Range of the time between two kicks of a robot, sampled after each kick [s]."""
    x: Range = field(default=(0.0, 0.0), metadata=rescaled("m/s", KICK))
    """Range of the change of the base's velocity along x, world frame [m/s]."""
    y: Range = field(default=(0.0, 0.0), metadata=rescaled("m/s", KICK))
    """Range of the change of the base's velocity along y, world frame [m/s]."""
    z: Range = field(default=(0.0, 0.0), metadata=rescaled("m/s", KICK))
    """Range of the change of the base's velocity along z, world frame [m/s]."""
    roll: Range = field(default=(0.0, 0.0), metadata=rescaled("rad/s", KICK))
    """Range of the change of the base's angular velocity about the base's x axis, base frame [rad/s]."""
    pitch: Range = field(default=(0.0, 0.0), metadata=rescaled("rad/s", KICK))
    """Range of the change of the base's angular velocity about the base's y axis, base frame [rad/s]."""
    yaw: Range = field(default=(0.0, 0.0), metadata=rescaled("rad/s", KICK))
    """Range of the change of the base's angular velocity about the base's z axis, base frame [rad/s]."""
    grow: Range = field(default=(0.0, 0.0), metadata=ITERATIONS)
    """First and last training iteration in which the ranges widen from zero. [0, 0] means the full ranges from the start."""


@dataclass(frozen=True)
class ForceConfig:
    """Temporary force on a body of the robot, at random intervals."""

    body: str = ""
    """Name of a body in the robot's model; empty for the base. The force acts at the body's centre of mass."""
    joints: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Name patterns of joints, instead of `body`. Each push draws one of these joints. The force acts on the joint's child
    body at the joint's anchor, so it also has a torque about the body's centre of mass (that of the nominal model)."""
    interval_s: Range = field(default=(5.0, 10.0), metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Range of the time from the end of a push to the robot's next push, sampled for each push [s]."""
    duration_s: Range = field(default=(0.1, 0.5), metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Range of a push's duration [s]. A duration is rounded to whole control steps, at least one."""
    x: Range = field(default=(0.0, 0.0), metadata=rescaled("N", between(-LARGEST, LARGEST)))
    """Range of the force along x, world frame [N]."""
    y: Range = field(default=(0.0, 0.0), metadata=rescaled("N", between(-LARGEST, LARGEST)))
    """Range of the force along y, world frame [N]."""
    z: Range = field(default=(0.0, 0.0), metadata=rescaled("N", between(-LARGEST, LARGEST)))
    """Range of the force along z, world frame [N]."""
    size: Range = field(default=(0.0, 0.0), metadata=rescaled("N", between(0, LARGEST)))
    """Range of the size of a force whose direction is uniform on the sphere, instead of `x`, `y` and `z` [N]."""
    grow: Range = field(default=(0.0, 0.0), metadata=ITERATIONS)
    """First and last training iteration in which the ranges widen from zero. [0, 0] means the full ranges from the start."""


@dataclass(frozen=True)
class HeldGoalsConfig:
    """Goals for the joints that `control.held` names. Each robot's goals are a random walk that begins at the default angles
    in each episode. Targets move from one goal to the next in a straight line.
    """

    step: float = field(default=0.0, metadata=quantity("rad", between(0, 10)))
    """Standard deviation of each joint's change from one goal to the next [rad]. Changes are at most four times as large. 0
    holds the joints at their default angles."""
    period_s: float = field(default=0.5, metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Time in which targets move from one goal to the next [s]."""
    limits: dict[str, Range] = field(default_factory=dict, metadata=quantity("rad", between(-100, 100)))
    """Joint-name pattern -> lowest and highest goal [rad]. A joint without an entry has its own range."""
    mirrored: bool = False
    """Let both sides move as mirror images of each other. Then the goals and `limits` are those of the first joint of each
    pair, in the robot's order."""
    grow: Range = field(default=(0.0, 0.0), metadata=ITERATIONS)
    """First and last training iteration in which `step` grows from zero. [0, 0] means the full step from the start."""


def draw_of(entry: Range | DrawConfig) -> DrawConfig:
    """Return an entry of `domain_rand.ranges` in its long form. A range alone is the short form."""
    return entry if isinstance(entry, DrawConfig) else DrawConfig(range=entry)
