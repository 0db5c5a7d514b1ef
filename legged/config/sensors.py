"""Settings of the height map: its errors, and limits of the observed heights."""

from dataclasses import dataclass, field

from legged.config.bounds import between, rescaled


@dataclass(frozen=True)
class HeightMapConfig:
    """Errors of the map from which a robot reads the term `heights`, in addition to the term's noise, delay and lost packets.
    They appear only in groups with `noise: true`. Half widths are those of uniform distributions around 0.
    """

    offset: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Half width of a common error of all heights, sampled for each episode [m]."""
    shift: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Half width of the map's displacement along each horizontal world axis, sampled for each episode [m]."""
    drift: float = field(default=0.0, metadata=rescaled("m/s", between(0, 100)))
    """Half width of the speed at which the heights' common error drifts, sampled for each episode [m/s]."""
    shift_drift: float = field(default=0.0, metadata=rescaled("m/s", between(0, 100)))
    """Half width of the speed at which the map's displacement drifts along each axis, sampled for each episode [m/s]."""
    holes: float = field(default=0.0, metadata=between(0, 1))
    """Share of the points that the map lacks. Different points are missing in each episode. A missing point reads 0, like
    level ground under a robot whose base is `heights_offset` high."""
    lost: float = field(default=0.0, metadata=between(0, 1))
    """Probability that a robot has no map in an episode and must walk blindly. Success on terrain is measured with robots
    that have a map."""


@dataclass(frozen=True)
class HeightLimitsConfig:
    """Limits of the term `heights` in play, evaluation and export. A limit of 0 keeps the limit of the training."""

    heights_limit: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Limit that replaces observations.heights_limit [m]."""
    depth_limit: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Limit that replaces observations.depth_limit [m]."""
