"""Sections of every task's Markov decision process: control, observations, rewards, terminations, randomisation."""

from dataclasses import dataclass, field, replace
from typing import Self

from legged.config.actuator import LONGEST_DELAY, Steps
from legged.config.bounds import LARGEST, NAMES, TERMS, UNIT, between, positive, rescaled_by_entry
from legged.config.randomization import DrawConfig, Range
from legged.config.section import Section


@dataclass(frozen=True)
class ControlConfig(Section):
    """Conversion of actions to controls of the robot."""

    decimation: int = field(default=4, metadata=between(1, 1000))
    """Number of physics steps per control step. The control law is computed in every physics step."""
    clip_actions: float = field(default=100.0, metadata=positive(LARGEST))
    """Absolute value at which actions are clipped."""


@dataclass(frozen=True)
class TerminationsConfig(Section):
    """Terms `_terminate_<name>` that end an episode. NaN, infinite numbers and the time limit also end it."""

    failures: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Terms that end an episode as a failure. The learner assumes that no reward follows a failure."""
    time_outs: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Terms that end an episode as a time-out. The learner bootstraps the value of the last state."""


@dataclass(frozen=True)
class DomainRandConfig(Section):
    """Domain randomisation of the robots."""

    ranges: dict[str, Range | DrawConfig] = field(
        default_factory=dict, metadata=rescaled_by_entry("domain_rand.ranges.", between(-LARGEST, LARGEST))
    )
    """Property -> range of a uniform distribution, from which each robot's value is sampled once before training. For another
    distribution or time, the entry is a mapping with `range`, `distribution`, `when` and more (DrawConfig). The properties
    are listed in legged/physics/fields.py."""
    observed_ranges: dict[str, Range | DrawConfig] = field(
        default_factory=dict, metadata=rescaled_by_entry("domain_rand.ranges.", between(-LARGEST, LARGEST))
    )
    """Property -> range that the observation `_obs_rand_<property>` scales to [-1, 1]. By default, this is the
    property's range in `ranges`. Play and evaluation copy the ranges of the training to this setting."""

    def nominal(self) -> Self:
        """Return a copy without randomisation, for play and evaluation. The ranges move to `observed_ranges`."""
        return replace(self, ranges={}, observed_ranges={**self.observed_ranges, **self.ranges})


@dataclass(frozen=True)
class RewardsConfig(Section):
    """Scales of the `_reward_<name>` terms."""

    scales: dict[str, float] = field(
        default_factory=dict, metadata=rescaled_by_entry("_reward_", between(-LARGEST, LARGEST), -1)
    )
    """Term -> scale. A scale of 0 switches the term off."""
    times_dt: bool = True
    """Multiply scales by the control step, so that sums of rewards over time do not depend on the control step."""
    only_positive_rewards: bool = False
    """Clip the sum of rewards (except `termination`) at zero, so that a robot can't avoid negative rewards by falling."""


@dataclass(frozen=True)
class ObservationGroupConfig:
    """Observation group, which one or several networks read."""

    terms: tuple[str, ...] = field(default=(), metadata=NAMES)
    """Names of `_obs_<name>` terms, concatenated in this order."""
    history: int = field(default=1, metadata=between(1, 1000))
    """Number of concatenated control steps, oldest first. The first step of an episode fills the whole history."""
    noise: bool = False
    """Add uniform noise to the terms."""


@dataclass(frozen=True)
class ObservationsConfig(Section):
    """Observation groups, and scales and errors of their terms."""

    groups: dict[str, ObservationGroupConfig] = field(default_factory=dict)
    """Name of a group -> its terms, history and noise. `train.policy` sets the groups that each network reads. By default the
    policy reads the group `actor`."""
    scales: dict[str, float] = field(default_factory=dict, metadata=between(-LARGEST, LARGEST))
    """Term -> factor on its values. A term without an entry has the factor 1."""
    add_noise: bool = True
    """Add noise to the groups with `noise: true`."""
    noise_level: float = field(default=1.0, metadata=between(0, 1000))
    """Factor on the noise of all terms."""
    noise: dict[str, float] = field(default_factory=dict, metadata=between(0, LARGEST))
    """Term -> half width of its uniform noise, in the term's unit before scaling."""
    bias: dict[str, float] = field(default_factory=dict, metadata=rescaled_by_entry("_obs_", between(0, LARGEST)))
    """Term -> half width of its uniform bias, in the term's unit before scaling. Each number of the term has its own bias,
    which is sampled for each episode. Bias, delay and lost packets affect only groups with `noise: true`, and only if
    `add_noise` is true."""
    delay: dict[str, Steps] = field(default_factory=dict, metadata=between(0, LONGEST_DELAY))
    """Term -> range of its delay, in control steps. Each robot's delay is sampled for each episode."""
    dropped: dict[str, float] = field(default_factory=dict, metadata=UNIT)
    """Term -> share of the control steps in which its packet is lost. The values of the previous step are then kept."""
    clip: float = field(default=100.0, metadata=positive(LARGEST))
    """Absolute value at which scaled observations are clipped."""

    def trained(self) -> Self:
        """Return the settings of the observations for play, evaluation and export of a trained policy."""
        return self
