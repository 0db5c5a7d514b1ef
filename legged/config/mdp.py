"""Sections of every task's Markov decision process: control, observations, rewards, terminations, randomisation."""

from dataclasses import dataclass, field, replace
from typing import Self

from legged.config.actuator import LONGEST_DELAY, Steps
from legged.config.bounds import LARGEST, NAMES, TERMS, UNIT, between, positive, rescaled_by_entry, rescaled_by_term
from legged.config.randomization import DrawConfig, Range


@dataclass(frozen=True)
class ControlConfig:
    """Conversion of actions to controls of the robot."""

    decimation: int = field(default=4, metadata=between(1, 1000))
    """Physics steps per control step. The control law is computed in each of them."""
    clip_actions: float = field(default=100.0, metadata=positive(LARGEST))
    """Absolute value at which actions are clipped."""


@dataclass(frozen=True)
class TerminationsConfig:
    """Terms `_terminate_<name>` that end an episode. NaN, infinite numbers and the time limit also end it."""

    failures: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Terms that end an episode as a failure. The learner expects no reward after it."""
    time_outs: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Terms that end an episode as a time-out. The learner bootstraps the value of the last state."""


@dataclass(frozen=True)
class DomainRandConfig:
    """Domain randomisation of the robots."""

    ranges: dict[str, Range | DrawConfig] = field(
        default_factory=dict, metadata=rescaled_by_entry("domain_rand.ranges", between(-LARGEST, LARGEST))
    )
    """Property -> range of a uniform distribution, from which each robot's value is sampled at the start; or a mapping with
    `range`, `distribution`, `when` and more (DrawConfig). Properties: legged/physics/fields.py."""
    observed_ranges: dict[str, Range | DrawConfig] = field(
        default_factory=dict, metadata=rescaled_by_entry("domain_rand.ranges", between(-LARGEST, LARGEST))
    )
    """Property -> range that scales the observation `_obs_rand_<property>`; by default that in `ranges`. Play and evaluation
    put the ranges of the training here."""

    def nominal(self) -> Self:
        """Return a copy without randomisation, for play and evaluation. Observations keep their scales."""
        return replace(self, ranges={}, observed_ranges={**self.observed_ranges, **self.ranges})


@dataclass(frozen=True)
class RewardsConfig:
    """Scales of the `_reward_<name>` terms."""

    scales: dict[str, float] = field(default_factory=dict, metadata=between(-LARGEST, LARGEST))
    """Term -> scale. A scale of 0 switches the term off."""
    times_dt: bool = True
    """Multiply scales by the control step, so that sums over time do not depend on it."""
    only_positive_rewards: bool = False
    """Clip the sum of rewards (except `termination`) at zero, so that the policy does not learn early to fall."""


@dataclass(frozen=True)
class ObservationGroupConfig:
    """Observation group, which one or several networks read."""

    terms: tuple[str, ...] = field(default=(), metadata=NAMES)
    """Names of `_obs_<name>` terms, concatenated in this order."""
    history: int = field(default=1, metadata=between(1, 1000))
    """Number of steps that are concatenated, oldest first. A new episode repeats its first step."""
    noise: bool = False
    """Add uniform noise to the terms."""


@dataclass(frozen=True)
class ObservationsConfig:
    """Observation groups, and scales and errors of their terms."""

    groups: dict[str, ObservationGroupConfig] = field(default_factory=dict)
    """Group -> terms, history and noise of the group. `train.policy` sets the groups that each network reads; by default the
    policy reads the group `actor`."""
    scales: dict[str, float] = field(default_factory=dict, metadata=between(-LARGEST, LARGEST))
    """Term -> factor; 1 for other terms."""
    add_noise: bool = True
    """Add noise to the groups with `noise: true`."""
    noise_level: float = field(default=1.0, metadata=between(0, 1000))
    """Factor on all noise."""
    noise: dict[str, float] = field(default_factory=dict, metadata=between(0, LARGEST))
    """Term -> half width of its uniform noise, in the term's unit before scaling."""
    bias: dict[str, float] = field(default_factory=dict, metadata=rescaled_by_term("_obs_", 1, between(0, LARGEST)))
    """Term -> half width of a constant error in each of the term's numbers, sampled for each episode, in the term's unit
    before scaling. Bias, delay and lost packets affect only groups with noise, and only while `add_noise` is on."""
    delay: dict[str, Steps] = field(default_factory=dict, metadata=between(0, LONGEST_DELAY))
    """Term -> range of its delay, in control steps. Each robot's delay is sampled for each episode."""
    dropped: dict[str, float] = field(default_factory=dict, metadata=UNIT)
    """Term -> share of the control steps in which its packet is lost. The values of the previous step are then kept."""
    clip: float = field(default=100.0, metadata=positive(LARGEST))
    """Absolute value at which scaled observations are clipped."""

    def trained(self) -> Self:
        """Return the settings of a trained policy's observations for play, evaluation and export."""
        return self
