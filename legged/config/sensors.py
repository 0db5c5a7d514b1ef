"""How sensors differ from ideal ones: errors of terms beside their noise, and of the map of heights."""

from dataclasses import dataclass, field

from legged.config.bounds import between, rescaled


@dataclass(frozen=True)
class HeightMapConfig:
    """What is wrong with the map from which a robot reads the term `heights`, beside noise, delay and lost packets of the
    term. The groups with `noise: true` see it.
    """

    offset: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Half width of the error of all heights alike, drawn for each episode [m]."""
    shift: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Half width of the map's displacement along each horizontal axis of the world, drawn for each episode [m]."""
    drift: float = field(default=0.0, metadata=rescaled("m/s", between(0, 100)))
    """Half width of the speed at which `offset` grows, drawn for each episode [m/s]."""
    shift_drift: float = field(default=0.0, metadata=rescaled("m/s", between(0, 100)))
    """Half width of the speed at which `shift` grows along each axis, drawn for each episode [m/s]."""
    holes: float = field(default=0.0, metadata=between(0, 1))
    """Share of the points, drawn for each episode, of which the map knows nothing: they read 0, as level ground does
    under a robot that stands `heights_offset` high."""
    lost: float = field(default=0.0, metadata=between(0, 1))
    """Share of the robots, drawn for each episode, whose map knows nothing at all, so that they have to walk as blind ones
    do. Success on terrain is measured with robots that have a map."""


@dataclass(frozen=True)
class HeightLimitsConfig:
    """Limits of the term `heights` for a policy that is trained; 0: as in training. Training does not use them."""

    heights_limit: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """In place of observations.heights_limit [m]."""
    depth_limit: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """In place of observations.depth_limit [m]."""
