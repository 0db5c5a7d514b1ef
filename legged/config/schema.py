"""Configuration schema: every setting of a task file, with meaning, unit, default and bounds.

A file under `cfg/` states only the differences from the defaults. The sections of every task are in world.py, mdp.py and
learning.py. Those of a legged robot with velocity commands are in legged.py.
"""

from legged.config.actuator import ActuatorConfig
from legged.config.learning import (
    AlgorithmConfig,
    DistillationConfig,
    EstimatorConfig,
    PolicyConfig,
    RunnerConfig,
    TrainConfig,
)
from legged.config.legged import (
    STATE_TERMS,
    CommandCurriculumConfig,
    CommandRanges,
    CommandsConfig,
    EvaluationConfig,
    InitStateConfig,
    LeggedConfig,
    LeggedControlConfig,
    LeggedDomainRandConfig,
    LeggedObservationsConfig,
    LeggedRewardsConfig,
    LeggedTerminationsConfig,
    TerrainConfig,
)
from legged.config.mdp import (
    ControlConfig,
    DomainRandConfig,
    ObservationGroupConfig,
    ObservationsConfig,
    Range,
    RewardsConfig,
    TerminationsConfig,
)
from legged.config.randomization import DrawConfig, ForceConfig, KickConfig
from legged.config.sensors import HeightMapConfig
from legged.config.task import TaskConfig
from legged.config.world import EnvConfig, NewtonSolver, SimConfig

__all__ = [
    "STATE_TERMS",
    "ActuatorConfig",
    "AlgorithmConfig",
    "CommandCurriculumConfig",
    "CommandRanges",
    "CommandsConfig",
    "ControlConfig",
    "DistillationConfig",
    "DomainRandConfig",
    "DrawConfig",
    "EnvConfig",
    "EstimatorConfig",
    "EvaluationConfig",
    "ForceConfig",
    "HeightMapConfig",
    "InitStateConfig",
    "KickConfig",
    "LeggedConfig",
    "LeggedControlConfig",
    "LeggedDomainRandConfig",
    "LeggedObservationsConfig",
    "LeggedRewardsConfig",
    "LeggedTerminationsConfig",
    "NewtonSolver",
    "ObservationGroupConfig",
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
