"""The configuration of a task of any kind. A task class with sections of its own has a subclass of it as `Config`."""

from dataclasses import dataclass, field, replace
from typing import Any, Self

from legged.config.bounds import NAME
from legged.config.learning import TrainConfig
from legged.config.mdp import ControlConfig, DomainRandConfig, ObservationsConfig, RewardsConfig, TerminationsConfig
from legged.config.origins import Origins
from legged.config.world import EnvConfig, SimConfig


@dataclass(frozen=True)
class TaskConfig:
    """A whole task: its world, its Markov decision process and how a policy is trained."""

    task: str = field(default="", metadata=NAME)
    """Name of the task; set by the registry."""
    env: EnvConfig = field(default_factory=EnvConfig)
    """Size and length of the simulated batch."""
    sim: SimConfig = field(default_factory=SimConfig)
    """Physics time step, engine and contact solver."""
    control: ControlConfig = field(default_factory=ControlConfig)
    """From actions to what moves the robot."""
    terminations: TerminationsConfig = field(default_factory=TerminationsConfig)
    """What ends an episode."""
    domain_rand: DomainRandConfig = field(default_factory=DomainRandConfig)
    """What differs from robot to robot."""
    rewards: RewardsConfig = field(default_factory=RewardsConfig)
    """Reward terms."""
    observations: ObservationsConfig = field(default_factory=ObservationsConfig)
    """What networks see."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """Everything the learner needs."""
    custom: dict[str, Any] = field(default_factory=dict)
    """Free space for a user's own terms: `self.cfg.custom["name"]`."""
    origins: Origins = field(default_factory=Origins, repr=False, compare=False)
    """Who set what; no setting itself (`compare` says so), so neither read from files nor written to them."""

    def trained(self) -> Self:
        """Return the configuration in which a trained policy is shown and measured: with nothing drawn, and with what it is
        to observe otherwise than in training.
        """
        return replace(self, domain_rand=self.domain_rand.nominal(), observations=self.observations.trained())

    @property
    def dt(self) -> float:
        """Control step [s]."""
        return self.sim.dt * self.control.decimation
