"""Configuration of a robot that follows velocity commands: commands, their curriculum, and a grid for evaluations.

Fields that also exist in legged_gym (v1.0.2, arXiv 2109.11978) have the same defaults as there.
"""

from dataclasses import dataclass, field
from typing import TypeGuard

from legged.config.bounds import LARGEST, LONGEST_S, UNIT, between, positive, quantity, rescaled, rescaled_by_entry
from legged.config.mdp import ObservationGroupConfig, Range
from legged.config.robot import MOTION, RobotConfig, RobotObservationsConfig, RobotRewardsConfig
from legged.config.section import Section
from legged.config.task import TaskConfig

FASTEST = 20.0
"""Largest command of an evaluation [m/s, rad/s]. Reason: the area of the terrain grows with the square of the command."""
Axis = tuple[float, float, float]
"""One axis of a command grid: lowest value, highest value, and step."""
AXIS = between(-FASTEST, FASTEST)


@dataclass(frozen=True)
class CommandRanges:
    """Full ranges of the commands. A curriculum starts from a share of these ranges."""

    lin_vel_x: Range = field(default=(-1.0, 1.0), metadata=quantity("m/s", MOTION))
    """Forward velocity in the base frame [m/s]."""
    lin_vel_y: Range = field(default=(-1.0, 1.0), metadata=quantity("m/s", MOTION))
    """Leftward velocity in the base frame [m/s]."""
    ang_vel_yaw: Range = field(default=(-1.0, 1.0), metadata=quantity("rad/s", MOTION))
    """Yaw rate [rad/s]. In heading mode, the heading controller's yaw rate is clipped to this range, which a curriculum
    widens."""
    heading: Range = field(default=(-3.141592653589793, 3.141592653589793), metadata=quantity("rad", MOTION))
    """Heading in the world frame [rad]. It is used only in heading mode."""
    base_height: Range = field(default=(0.0, 0.0), metadata=rescaled("m", between(0, 100)))
    """Height of the base above the ground [m]; [0, 0] for rewards.base_height_target."""
    base_pitch: Range = field(default=(0.0, 0.0), metadata=quantity("rad", between(-1.5, 1.5)))
    """Pitch of the base or of commands.pitch_body, positive if it leans forward [rad]."""


@dataclass(frozen=True)
class CommandCurriculumConfig:
    """Curriculum that widens the range of each command axis while robots follow the commands on that axis well."""

    enabled: bool = False
    """Start with the share `start` of the full ranges and widen the ranges; otherwise use the full ranges from the start."""
    start: float = field(default=0.3, metadata=UNIT)
    """Initial share of the full range on each axis."""
    step: float = field(default=0.1, metadata=positive(1, low=1e-6))
    """Share of the full range that each widening adds to the range of an axis."""
    window_s: float = field(default=1.0, metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Time over which velocities are averaged before the curriculum decides whether to widen a range [s]."""
    threshold: float = field(default=0.75, metadata=UNIT)
    """Share of the commanded velocity that robots must reach on average before an axis is widened."""


@dataclass(frozen=True)
class WaypointsConfig:
    """Waypoints: places and headings to which some robots walk. A robot gets a new waypoint whenever it gets a new command.
    Velocity commands are proportional to the error in the yaw frame, and within the ranges of the commands.
    """

    share: float = field(default=0.0, metadata=UNIT)
    """Share of the robots that walk to waypoints. The others have sampled velocities."""
    radius: float = field(default=0.75, metadata=rescaled("m", between(0, 1000)))
    """Radius of the disc in which places are sampled uniformly [m]. Headings are uniform."""
    ahead: float = field(default=0.3, metadata=rescaled("m", between(-1000, 1000)))
    """Distance of the disc's centre ahead of the pose in which the episode began [m]."""
    gain: float = field(default=1.5, metadata=quantity("1/s", between(0, 100)))
    """Commanded velocity per error [1/s]."""
    place_error: Range = field(default=(0.1, 0.2), metadata=quantity("m", between(0, 100)))
    """Distance from the place below which the robot rests, and distance above which it walks again [m]."""
    heading_error: Range = field(default=(0.05, 0.12), metadata=quantity("rad", between(0, 100)))
    """Error of the heading below which the robot does not turn, and error above which it turns again [rad]."""


@dataclass(frozen=True)
class CommandsConfig(Section):
    """Velocity commands: ranges, heading mode, waypoints, curriculum."""

    ranges: CommandRanges = CommandRanges()
    """Ranges of the commands on each axis."""
    resampling_time_s: float = field(default=10.0, metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Time for which a command is held [s]."""
    heading_command: bool = True
    """Sample a heading instead of a yaw rate, and command the yaw rate 0.5 * wrap(heading - yaw) at every step."""
    small_command: float = field(default=0.2, metadata=quantity("m/s", between(0, 100)))
    """Norm below which a sampled horizontal velocity is set to zero [m/s]."""
    standing_share: float = field(default=0.0, metadata=UNIT)
    """Share of the sampled commands that are zero, so that the robot stands still."""
    single_axis_share: float = field(default=0.0, metadata=UNIT)
    """Share of the moving commands that use a single random axis: walking straight, walking sideways, or turning in place."""
    pitch_body: str = ""
    """Body whose pitch ranges.base_pitch commands, such as a torso above the joints of a waist. Without a name it is the
    base."""
    waypoints: WaypointsConfig = WaypointsConfig()
    """Waypoints that some robots walk to."""
    curriculum: CommandCurriculumConfig = CommandCurriculumConfig()
    """Curriculum that widens the ranges during training."""


@dataclass(frozen=True)
class LeggedRewardsConfig(RobotRewardsConfig):
    """Scales and parameters of the `_reward_<name>` terms."""

    scales: dict[str, float] = field(
        default_factory=lambda: {
            "tracking_lin_vel": 1.0,
            "tracking_ang_vel": 0.5,
            "lin_vel_z": -2.0,
            "ang_vel_xy": -0.05,
            "torques": -1e-5,
            "dof_acc": -2.5e-7,
            "feet_air_time": 1.0,
            "collision": -1.0,
            "action_rate": -0.01,
        },
        metadata=rescaled_by_entry("_reward_", between(-LARGEST, LARGEST), -1),
    )
    """Term -> scale, which is multiplied by the control step. A scale of 0 switches the term off."""
    only_positive_rewards: bool = True
    """Clip the sum of rewards (except `termination`) at zero. Otherwise a new policy may learn to end episodes by falls."""
    tracking_sigma: float = field(default=0.25, metadata=positive(LARGEST, low=1e-6))
    """Width `sigma` of the tracking rewards exp(-error^2 / sigma)."""
    air_time_target_s: float = field(default=0.5, metadata=rescaled("s", between(0, 100)))
    """Target of the swing time [s]. feet_air_time rewards longer swings and punishes shorter ones; single_stance is largest
    at this time."""


STATE_TERMS = ("base_lin_vel", "base_ang_vel", "projected_gravity", "commands", "dof_pos", "dof_vel", "actions")


@dataclass(frozen=True)
class LeggedObservationsConfig(RobotObservationsConfig):
    """Observations of the policy and the value function of a legged robot."""

    groups: dict[str, ObservationGroupConfig] = field(
        default_factory=lambda: {
            "actor": ObservationGroupConfig(STATE_TERMS, noise=True),
            "critic": ObservationGroupConfig(STATE_TERMS),
        }
    )
    """Observation groups. `actor`: the policy's observations, with noise. `critic`: the value function's, without noise."""


@dataclass(frozen=True)
class EvaluationConfig:
    """Settings of evaluations. Training does not use them."""

    vx: Axis = field(default=(-1.0, 1.0, 0.5), metadata=quantity("m/s", AXIS))
    """Forward velocities of the command grid: lowest, highest, step [m/s]."""
    vy: Axis = field(default=(-1.0, 1.0, 0.5), metadata=quantity("m/s", AXIS))
    """Leftward velocities of the command grid: lowest, highest, step [m/s]."""
    yaw: Axis = field(default=(-1.0, 1.0, 0.5), metadata=quantity("rad/s", AXIS))
    """Yaw rates of the command grid: lowest, highest, step [rad/s]."""
    stairs: float = field(default=0.36, metadata=positive(10))
    """Step height of stairs, as a share of rewards.base_height_target. A table of many trainings shows the success rate
    at this height, or at the next larger height that was measured."""


@dataclass(frozen=True)
class LeggedConfig(RobotConfig):
    """Configuration of a legged robot that follows velocity commands."""

    DISTURBANCES = (*RobotConfig.DISTURBANCES, "commands.curriculum.enabled")

    commands: CommandsConfig = field(default_factory=CommandsConfig)
    """Velocity commands."""
    rewards: LeggedRewardsConfig = field(default_factory=LeggedRewardsConfig)
    """Reward terms and their parameters."""
    observations: LeggedObservationsConfig = field(default_factory=LeggedObservationsConfig)
    """Observations of policy and value function."""
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    """Settings of evaluations."""


def follows_velocities(cfg: TaskConfig) -> TypeGuard[LeggedConfig]:
    """Return whether the robots follow velocity commands, so that a grid of commands can measure them."""
    return isinstance(cfg, LeggedConfig)
