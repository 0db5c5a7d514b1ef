"""The configuration schema: every field a task file can set, with its meaning, unit, default and bounds.

Defaults are legged_gym's (v1.0.2, arXiv 2109.11978) where it has the field. A file under `cfg/` states only what differs.
The sections are in world.py, mdp.py and learning.py.
"""

from dataclasses import dataclass, field
from typing import Any

from legged.config.bounds import NAME
from legged.config.learning import AlgorithmConfig, PolicyConfig, RunnerConfig, TrainConfig
from legged.config.mdp import (
    STATE_TERMS,
    CommandCurriculumConfig,
    CommandRanges,
    CommandsConfig,
    ControlConfig,
    DomainRandConfig,
    InitStateConfig,
    ObservationsConfig,
    Range,
    RewardsConfig,
    TerminationsConfig,
)
from legged.config.origins import Origins
from legged.config.world import EnvConfig, NewtonSolver, SimConfig, TerrainConfig

__all__ = [
    "STATE_TERMS",
    "AlgorithmConfig",
    "CommandCurriculumConfig",
    "CommandRanges",
    "CommandsConfig",
    "ControlConfig",
    "DomainRandConfig",
    "EnvConfig",
    "InitStateConfig",
    "NewtonSolver",
    "ObservationsConfig",
    "PolicyConfig",
    "Range",
    "RewardsConfig",
    "RunnerConfig",
    "SimConfig",
    "TaskConfig",
    "TerminationsConfig",
    "TerrainConfig",
    "TrainConfig",
]


@dataclass(frozen=True)
class TaskConfig:
    """A whole task: one robot, its MDP and how it is trained."""

    task: str = field(default="", metadata=NAME)
    """Name of the task; set by the registry."""
    robot: str = ""
    """Folder under resources/robots/, or a path to such a folder, relative to the file that names it."""
    env: EnvConfig = field(default_factory=EnvConfig)
    """Size and length of the simulated batch."""
    sim: SimConfig = field(default_factory=SimConfig)
    """Physics time step, engine and contact solver."""
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    """The ground."""
    commands: CommandsConfig = field(default_factory=CommandsConfig)
    """Velocity commands."""
    init_state: InitStateConfig = field(default_factory=InitStateConfig)
    """State after a reset."""
    control: ControlConfig = field(default_factory=ControlConfig)
    """From actions to torques."""
    terminations: TerminationsConfig = field(default_factory=TerminationsConfig)
    """What ends an episode early."""
    domain_rand: DomainRandConfig = field(default_factory=DomainRandConfig)
    """What differs from robot to robot, and disturbances."""
    rewards: RewardsConfig = field(default_factory=RewardsConfig)
    """Reward terms and their numbers."""
    observations: ObservationsConfig = field(default_factory=ObservationsConfig)
    """What policy and value function see."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """Everything the learner needs."""
    custom: dict[str, Any] = field(default_factory=dict)
    """Free space for a user's own terms: `self.cfg.custom["name"]`."""
    origins: Origins = field(default_factory=Origins, repr=False, compare=False)
    """Who set what; no setting itself (`compare` says so), so neither read from files nor written to them."""

    @property
    def dt(self) -> float:
        """Control step [s]."""
        return self.sim.dt * self.control.decimation
