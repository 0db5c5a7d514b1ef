"""Settings of the height map: its errors, and limits of the observed heights."""

from dataclasses import dataclass, field

from legged.config.bounds import between, rescaled


@dataclass(frozen=True)
class HeightMapConfig:
    """Errors of the height map from which a robot reads the observation term `heights`. The term's bias, noise, delay and
    lost packets come in addition. The errors of the map appear only in groups with `noise: true`. Each half width is that
    of a uniform distribution around 0.
    """

    offset: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Half width of the map's vertical offset [m]. The offset is sampled for each episode."""
    shift: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Half width of the map's shift along each horizontal world axis [m]. The shift is sampled for each episode."""
    drift: float = field(default=0.0, metadata=rescaled("m/s", between(0, 100)))
    """Half width of the speed at which the vertical offset drifts [m/s]. The speed is sampled for each episode."""
    shift_drift: float = field(default=0.0, metadata=rescaled("m/s", between(0, 100)))
    """Half width of the speed at which the shift drifts along each axis [m/s]. The speed is sampled for each episode."""
    holes: float = field(default=0.0, metadata=between(0, 1))
    """Share of the map's points that are missing. Different points are missing in each episode. The observation of a missing
    point is 0, as on level ground with the base at the height `observations.heights_offset`."""
    lost: float = field(default=0.0, metadata=between(0, 1))
    """Probability that a robot has no map during an episode and must walk blindly. When success on terrain is measured, all
    robots have a map."""


@dataclass(frozen=True)
class HeightLimitsConfig:
    """Limits of the term `heights` in play, evaluation and export. A limit of 0 keeps the limit of the training."""

    heights_limit: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Limit that replaces observations.heights_limit [m]."""
    depth_limit: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Limit that replaces observations.depth_limit [m]."""
