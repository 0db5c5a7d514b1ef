"""What every task has of a Markov decision process: control, observations, rewards, terminations, randomisation."""

from dataclasses import dataclass, field, replace
from typing import Self

from legged.config.actuator import LONGEST_DELAY, Steps
from legged.config.bounds import LARGEST, NAMES, TERMS, UNIT, between, positive, rescaled_by_entry, rescaled_by_term
from legged.config.randomization import DrawConfig, Range


@dataclass(frozen=True)
class ControlConfig:
    """From actions to what moves the robot."""

    decimation: int = field(default=4, metadata=between(1, 1000))
    """Physics steps per control step; a control law is computed anew at each."""
    clip_actions: float = field(default=100.0, metadata=positive(LARGEST))
    """Actions are clipped at plus and minus this."""


@dataclass(frozen=True)
class TerminationsConfig:
    """What ends an episode: `_terminate_<name>` terms, beside its length and numbers that are none."""

    failures: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Terms that end the episode in a failure: nothing is to be gained after it."""
    time_outs: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Terms that end it as time does: the learner bootstraps what would have come."""


@dataclass(frozen=True)
class DomainRandConfig:
    """What differs from robot to robot."""

    ranges: dict[str, Range | DrawConfig] = field(
        default_factory=dict, metadata=rescaled_by_entry("domain_rand.ranges", between(-LARGEST, LARGEST))
    )
    """Property -> range from which each robot's is drawn evenly at the start; or a mapping, which has the range as `range`,
    and beside it how and when. Properties: legged/physics/fields.py."""
    observed_ranges: dict[str, Range | DrawConfig] = field(
        default_factory=dict, metadata=rescaled_by_entry("domain_rand.ranges", between(-LARGEST, LARGEST))
    )
    """Property -> the same for properties that are observed (`_obs_rand_<property>`) and not drawn, or not by that range:
    play and evaluation put here what was drawn in training."""

    def nominal(self) -> Self:
        """Return the same with no property drawn, for showing and measuring; observations keep their scales."""
        return replace(self, ranges={}, observed_ranges={**self.observed_ranges, **self.ranges})


@dataclass(frozen=True)
class RewardsConfig:
    """Scales of the `_reward_<name>` terms."""

    scales: dict[str, float] = field(default_factory=dict, metadata=between(-LARGEST, LARGEST))
    """Term -> scale. A scale of 0 switches the term off."""
    times_dt: bool = True
    """Multiply scales by the control step, so that sums over time do not depend on it."""
    only_positive_rewards: bool = False
    """Clip the sum at zero (before `termination`) against early learning to fall."""


@dataclass(frozen=True)
class ObservationGroupConfig:
    """What one network sees, or several."""

    terms: tuple[str, ...] = field(default=(), metadata=NAMES)
    """`_obs_<name>` terms, side by side in this order."""
    history: int = field(default=1, metadata=between(1, 1000))
    """Steps of the terms that are seen side by side, oldest first; a new episode repeats its first."""
    noise: bool = False
    """Add uniform noise to the terms."""


@dataclass(frozen=True)
class ObservationsConfig:
    """Observation groups, and how their terms are scaled."""

    groups: dict[str, ObservationGroupConfig] = field(default_factory=dict)
    """Group -> what is in it. `actor` is what the policy sees; `train.policy` says which groups a network reads."""
    scales: dict[str, float] = field(default_factory=dict, metadata=between(-LARGEST, LARGEST))
    """Term -> factor; 1 where not named."""
    add_noise: bool = True
    """Add noise to the groups that ask for it."""
    noise_level: float = field(default=1.0, metadata=between(0, 1000))
    """Factor on all noise."""
    noise: dict[str, float] = field(default_factory=dict, metadata=between(0, LARGEST))
    """Term -> half width of its uniform noise, in the term's unit before scaling."""
    bias: dict[str, float] = field(default_factory=dict, metadata=rescaled_by_term("_obs_", 1, between(0, LARGEST)))
    """Term -> half width of the error of each of its numbers that stays for an episode, in the term's unit before scaling.
    Bias, delay and lost packets are seen by the groups that have noise, and only while `add_noise` is on."""
    delay: dict[str, Steps] = field(default_factory=dict, metadata=between(0, LONGEST_DELAY))
    """Term -> range from which each robot's delay is drawn for an episode, in control steps."""
    dropped: dict[str, float] = field(default_factory=dict, metadata=UNIT)
    """Term -> share of the control steps in which it does not arrive: the numbers of the step before are seen again."""
    clip: float = field(default=100.0, metadata=positive(LARGEST))
    """Scaled observations are clipped at plus and minus this."""

    def trained(self) -> Self:
        """Return what a policy observes once it is trained: in play, evaluation and export."""
        return self
