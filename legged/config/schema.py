# ruff: noqa: F401  (names for other modules)
"""Configuration schema: every setting of a task file, with meaning, unit, default and bounds.

A file under `cfg/` states only the differences from the defaults. The sections of every task are in world.py, mdp.py and
learning.py. Those of a task with a robot are in robot.py, and those of velocity commands in legged.py.
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
    LeggedConfig,
    LeggedObservationsConfig,
    LeggedRewardsConfig,
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
from legged.config.robot import (
    HeightMapConfig,
    InitStateConfig,
    RobotConfig,
    RobotControlConfig,
    RobotDomainRandConfig,
    RobotObservationsConfig,
    RobotRewardsConfig,
    RobotTerminationsConfig,
    TerrainConfig,
)
from legged.config.task import TaskConfig
from legged.config.world import EnvConfig, NewtonSolver, SimConfig
