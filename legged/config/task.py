"""Configuration of any kind of task. If a task class has more sections, its `Config` is a subclass of TaskConfig."""

from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Self

from legged.config.bounds import NAME
from legged.config.learning import TrainConfig
from legged.config.mdp import ControlConfig, DomainRandConfig, ObservationsConfig, RewardsConfig, TerminationsConfig
from legged.config.origins import Origins
from legged.config.section import Section
from legged.config.world import EnvConfig, SimConfig

OF_FORKS = ("asset", "normalization", "noise")
"""Sections of legged_gym that have no settings here. They can be read, and hold the numbers of `custom`."""


@dataclass(frozen=True)
class TaskConfig(Section):
    """Configuration of a task: its world, its Markov decision process, and the training of its policy."""

    DISTURBANCES: ClassVar[tuple[str, ...]] = ("observations.add_noise",)
    """Dotted paths of the switches that measurements of a policy set to false."""

    task: str = field(default="", metadata=NAME)
    """Name of the task, set by the registry."""
    env: EnvConfig = field(default_factory=EnvConfig)
    """Number of robots, length of episodes, and seed."""
    sim: SimConfig = field(default_factory=SimConfig)
    """Physics time step, engine and contact solver."""
    control: ControlConfig = field(default_factory=ControlConfig)
    """Conversion of actions to controls of the robot."""
    terminations: TerminationsConfig = field(default_factory=TerminationsConfig)
    """Terms that end an episode."""
    domain_rand: DomainRandConfig = field(default_factory=DomainRandConfig)
    """Domain randomisation of the robots."""
    rewards: RewardsConfig = field(default_factory=RewardsConfig)
    """Reward terms."""
    observations: ObservationsConfig = field(default_factory=ObservationsConfig)
    """Observation groups of the networks."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """Settings of the learner."""
    custom: dict[str, Any] = field(default_factory=dict)
    """Free section for user-defined terms, which read it as `self.cfg.custom["name"]` or `self.cfg.rewards.name`."""
    origins: Origins = field(default_factory=Origins, repr=False, compare=False)
    """Sources of the settings. `compare=False` marks that this field is not a setting, so files neither set nor store it."""

    def __post_init__(self) -> None:
        sections = {f.name: getattr(self, f.name) for f in fields(self)} | dict.fromkeys(OF_FORKS, Section())
        for name, held in sections.items():
            if isinstance(held, Section):
                section = replace(held)  # another configuration may hold the same section
                object.__setattr__(section, "_custom", (self.custom, name, self.origins))
                object.__setattr__(self, name, section)

    def trained(self) -> Self:
        """Return the configuration for play and evaluation of a trained policy. Domain randomisation is off, and the settings
        of the observations are those that `observations.trained()` returns.
        """
        return replace(self, domain_rand=self.domain_rand.nominal(), observations=self.observations.trained())

    @property
    def dt(self) -> float:
        """Control step [s]."""
        return self.sim.dt * self.control.decimation
