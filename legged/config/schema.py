# ruff: noqa: F401  (names for other modules)
"""Configuration schema: every setting of a task file, with meaning, unit, default and bounds.

A file under `cfg/` states only the differences from the defaults. The sections of every task are in world.py, mdp.py and
learning.py. Those of a task with a robot are in robot.py, and those of velocity commands in legged.py.
"""

from legged.config.actuator import ActuatorConfig
from legged.config.learning import PolicyConfig, RunnerConfig
from legged.config.legged import STATE_TERMS, CommandCurriculumConfig, CommandRanges, CommandsConfig, LeggedConfig
from legged.config.mdp import ObservationGroupConfig, Range
from legged.config.randomization import DrawConfig, ForceConfig, KickConfig
from legged.config.robot import HeightMapConfig, RobotConfig, RobotControlConfig, RobotDomainRandConfig, TerrainConfig
from legged.config.task import TaskConfig
from legged.config.world import NewtonSolver, SimConfig
