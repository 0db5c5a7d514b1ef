"""The configuration of a legged robot that follows velocity commands: its sections beside those that every task has.

Defaults are legged_gym's (v1.0.2, arXiv 2109.11978) where it has the field.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, Self

from legged.config.actuator import ActuatorConfig
from legged.config.bounds import (
    LARGEST,
    LONGEST_S,
    TERMS,
    UNIT,
    between,
    items,
    positive,
    quantity,
    rescaled,
    rescaled_by_entry,
    rescaled_by_term,
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
from legged.config.sensors import HeightLimitsConfig, HeightMapConfig
from legged.config.task import TaskConfig

MOTION = between(-100, 100)
"""Bounds of velocities [m/s] or [rad/s], of angles [rad] and of factors on them."""
MEASURED = rescaled("m", items(500, between(-100, 100)))
FASTEST = 20.0
"""A command that is judged, at most [m/s, rad/s]: the ground that fast robots need grows with the square of it."""
Axis = tuple[float, float, float]
"""Lowest value, highest value, and the step between two."""
AXIS = between(-FASTEST, FASTEST)


@dataclass(frozen=True)
class TerrainConfig:
    """The ground: a plane, or tiles of several types in rows of growing difficulty."""

    mesh_type: Literal["plane", "height_map"] = "plane"
    """An infinite horizontal plane, or a height map of num_rows x num_cols tiles."""
    curriculum: bool = True
    """Robots move to harder rows while they succeed; otherwise all rows are hard, and robots stay where they are."""
    scale: float = field(default=1.0, metadata={**positive(100, low=0.01), "rescaled": "m"})
    """Factor on all lengths that the types are made of, treads and sizes alike; 1 suits a robot half a metre high."""
    proportions: dict[str, float] = field(default_factory=dict, metadata=UNIT)
    """Terrain type -> share of the columns; sums to 1. Types: legged/terrain/generators.py, TERRAIN_TYPES."""
    sizes: dict[str, float | Range] = field(default_factory=dict, metadata=rescaled_by_entry("terrain.sizes", positive(100)))
    """Terrain type -> size of all its tiles, in its unit, or the lowest and highest size: evenly from the easier one in the
    first row to the harder one at difficulty 1. In place of the type's own."""
    num_rows: int = field(default=10, metadata=between(1, 1000))
    """Levels of difficulty: row / num_rows."""
    num_cols: int = field(default=20, metadata=between(1, 1000))
    """Columns, each of one type."""
    terrain_length: float = field(default=8.0, metadata=rescaled("m", positive(1000, low=0.01)))
    """Extent of a tile along x [m]."""
    terrain_width: float = field(default=8.0, metadata=rescaled("m", positive(1000, low=0.01)))
    """Extent of a tile along y [m]."""
    border_size: float = field(default=25.0, metadata=rescaled("m", between(0, 1000)))
    """Width of the level ground around all tiles [m]."""
    horizontal_scale: float = field(default=0.1, metadata=rescaled("m", positive(10, low=1e-3)))
    """Edge of a cell of the height map [m]."""
    slope_threshold: float = field(default=0.2, metadata=between(0, 1000))
    """On types made of steps, a difference between cells steeper than this (rise over run) is a vertical face."""
    max_init_terrain_level: int = field(default=5, metadata=between(0, 999))
    """Highest row in which robots start training."""
    spawn_range: float = field(default=1.0, metadata=rescaled("m", between(0, 1000)))
    """Robots start at most this far from the middle of their tile, in x and in y [m]."""
    measured_points_x: tuple[float, ...] = field(default=tuple(round(0.1 * i - 0.8, 1) for i in range(17)), metadata=MEASURED)
    """Where heights are measured, forward of the base [m]."""
    measured_points_y: tuple[float, ...] = field(default=tuple(round(0.1 * i - 0.5, 1) for i in range(11)), metadata=MEASURED)
    """Where heights are measured, to the left of the base [m]."""
    scan: Literal["lowest", "own", "highest"] = "lowest"
    """What a measured point reads of the height map: the `lowest` of its cell and the next ones in x and y, as in legged_gym;
    its cell's `own` height; or the `highest` of the three."""


@dataclass(frozen=True)
class CommandRanges:
    """Largest commands that are sampled, and where a curriculum starts from."""

    lin_vel_x: Range = field(default=(-1.0, 1.0), metadata=quantity("m/s", MOTION))
    """Forward velocity, base frame [m/s]."""
    lin_vel_y: Range = field(default=(-1.0, 1.0), metadata=quantity("m/s", MOTION))
    """Leftward velocity, base frame [m/s]."""
    ang_vel_yaw: Range = field(default=(-1.0, 1.0), metadata=quantity("rad/s", MOTION))
    """Yaw rate [rad/s]; in heading mode the clip of the heading controller, which a curriculum widens too."""
    heading: Range = field(default=(-3.141592653589793, 3.141592653589793), metadata=quantity("rad", MOTION))
    """Heading in the world, heading mode only [rad]."""


@dataclass(frozen=True)
class CommandCurriculumConfig:
    """Ranges that widen, axis by axis, while the robots follow what they are asked."""

    enabled: bool = False
    """Start at `start` times the full ranges and widen; otherwise the full ranges from the first step."""
    start: float = field(default=0.3, metadata=UNIT)
    """Share of the full range that each axis starts with."""
    step: float = field(default=0.1, metadata=positive(1, low=1e-6))
    """Share of the full range by which an axis is widened."""
    window_s: float = field(default=1.0, metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Time over which velocities are averaged before an axis is judged [s]."""
    threshold: float = field(default=0.75, metadata=UNIT)
    """Share of the velocity asked for that robots must reach on average before an axis is widened."""


@dataclass(frozen=True)
class CommandsConfig:
    """Velocity commands: sampling, heading mode, curriculum."""

    ranges: CommandRanges = CommandRanges()
    """Lowest and highest command on each axis."""
    resampling_time_s: float = field(default=10.0, metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Time a command is held [s]."""
    heading_command: bool = True
    """Sample a heading and derive the yaw rate 0.5 * wrap(heading - yaw) from it at every step."""
    small_command: float = field(default=0.2, metadata=quantity("m/s", between(0, 100)))
    """Sampled horizontal velocities with a norm below this are set to zero [m/s]."""
    standing_share: float = field(default=0.0, metadata=UNIT)
    """Share of sampled commands that ask the robot to stand still."""
    single_axis_share: float = field(default=0.0, metadata=UNIT)
    """Share of sampled commands that keep one random axis only: walking straight, sideways, turning on the spot."""
    curriculum: CommandCurriculumConfig = CommandCurriculumConfig()
    """How the ranges widen during training."""


@dataclass(frozen=True)
class InitStateConfig:
    """State after a reset; the default joint angles and the spawn height are the robot's."""

    dof_pos_factor: Range = field(default=(0.5, 1.5), metadata=MOTION)
    """Joint angles are the default ones times a number drawn from this range, per joint."""
    yaw: Range = field(default=(0.0, 0.0), metadata=quantity("rad", MOTION))
    """Heading of the base [rad]."""
    base_velocity: Range = field(default=(-0.5, 0.5), metadata=rescaled("m/s", MOTION))
    """Range of each component of the base's linear [m/s] and angular [rad/s] velocity."""


@dataclass(frozen=True)
class LeggedControlConfig(ControlConfig):
    """From actions to joint torques."""

    control_type: Literal["P", "V", "T"] = "P"
    """Action as joint position target (P), joint velocity target (V) or torque (T)."""
    stiffness: dict[str, float] = field(default_factory=dict, metadata=quantity("N m/rad", between(0, LARGEST)))
    """Joint-name pattern -> P gain [N m/rad]; empty takes the robot's. A pattern is a part of the joint's name."""
    damping: dict[str, float] = field(default_factory=dict, metadata=quantity("N m s/rad", between(0, LARGEST)))
    """Joint-name pattern -> D gain [N m s/rad]; empty takes the robot's."""
    action_scale: float | dict[str, float] = field(default=0.5, metadata=quantity("rad", positive(LARGEST)))
    """Target = action_scale * action + default angle (P) [rad]; one number, or joint-name pattern -> number."""
    held: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Patterns of joints that have no action (P): their motors hold the default angle with the gains that they have."""
    actuator: ActuatorConfig = field(default_factory=ActuatorConfig)
    """How the motors differ from ideal ones: torque over speed, friction, delay, learned laws."""


@dataclass(frozen=True)
class LeggedTerminationsConfig(TerminationsConfig):
    """What ends an episode early."""

    failures: tuple[str, ...] = field(default=("contact", "base_height", "tilt"), metadata=TERMS)
    """`contact`: one of the robot's `terminate_after_contacts_on` shapes feels more than 1 N, or 1 % of a weight below
    100 N; `base_height` and `tilt` have their limits below."""
    time_outs: tuple[str, ...] = field(default=("left_terrain",), metadata=TERMS)
    """`left_terrain`: a robot that walked off the map is not judged for it."""
    min_base_height: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Lowest height of the base above the ground [m]; 0 switches `base_height` off."""
    max_tilt: float = field(default=0.0, metadata=quantity("rad", between(0, 10)))
    """Largest angle between the base's up axis and the vertical [rad]; 0 switches `tilt` off."""


@dataclass(frozen=True)
class LeggedDomainRandConfig(DomainRandConfig):
    """What differs from robot to robot, and disturbances."""

    randomize_friction: bool = True
    """Draw the friction of each robot's contacts."""
    friction_range: Range = field(default=(0.5, 1.25), metadata=between(0, 100))
    """Coulomb friction of the contacts. PhysX averages foot and ground; MuJoCo takes the foot's (it has priority)."""
    friction_buckets: int = field(default=64, metadata=between(1, 1_000_000))
    """Friction is drawn from this many values."""
    randomize_base_mass: bool = False
    """Add a mass to each robot's base."""
    added_mass_range: Range = field(default=(-5.0, 5.0), metadata=rescaled("kg", between(-10_000, 10_000)))
    """Mass added to the base [kg]."""
    push_robots: bool = True
    """Set the base's horizontal velocity now and then, each robot at its own moment."""
    push_interval_s: float = field(default=15.0, metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Time between two pushes of a robot [s]."""
    max_push_vel_xy: float = field(default=1.0, metadata=rescaled("m/s", between(0, 100)))
    """Range of a push's velocity, per world axis [m/s]."""
    kicks: dict[str, KickConfig] = field(default_factory=dict)
    """Any name -> sudden changes of the base's velocity, which they add to where push_robots sets it."""
    forces: dict[str, ForceConfig] = field(default_factory=dict)
    """Any name -> a force on a body of the robot for a time."""

    observed_forces: dict[str, ForceConfig] = field(default_factory=dict)
    """The same for forces that are observed (`_obs_push_force`) and do not act: play and evaluation put here what acted in
    training."""

    def nominal(self) -> Self:
        plain = super().nominal()
        by_flag: dict[str, Range | DrawConfig] = {}  # who measures switches these two off by their flags
        if self.randomize_friction:
            by_flag["friction"] = self.friction_range
        if self.randomize_base_mass:
            by_flag["added_base_mass"] = self.added_mass_range
        ranges = {**by_flag, **plain.observed_ranges}
        forces = {**self.observed_forces, **self.forces}
        return replace(plain, kicks={}, forces={}, observed_ranges=ranges, observed_forces=forces)


@dataclass(frozen=True)
class LeggedRewardsConfig(RewardsConfig):
    """Scales of the `_reward_<name>` terms and the numbers inside them."""

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
        metadata=rescaled_by_term("_reward_", -1, between(-LARGEST, LARGEST)),
    )
    """Term -> scale; multiplied by the control step. A scale of 0 switches the term off."""
    only_positive_rewards: bool = True
    """Clip the sum at zero (before `termination`) against early learning to fall."""
    tracking_sigma: float = field(default=0.25, metadata=positive(LARGEST, low=1e-6))
    """Tracking reward = exp(-error^2 / sigma)."""
    air_time_target_s: float = field(default=0.5, metadata=rescaled("s", between(0, 100)))
    """Swings longer than this are rewarded by feet_air_time, shorter ones punished; single_stance pays them most [s]."""
    feet_clearance_target: float = field(default=0.1, metadata=rescaled("m", between(0, 100)))
    """Height of a swinging foot above the lowest foot that feet_clearance wants [m]."""
    base_height_target: float = field(default=0.5, metadata=rescaled("m", positive(100)))
    """Base height wanted by base_height [m]."""
    max_contact_force: float = field(default=500.0, metadata=rescaled("N", positive(LARGEST)))
    """Foot forces above this are penalised by feet_contact_forces [N]."""
    soft_dof_pos_limit: float = field(default=1.0, metadata=positive(10))
    """Share of a joint's range outside which dof_pos_limits counts."""
    soft_dof_vel_limit: float = field(default=1.0, metadata=positive(10))
    """Share of a joint's velocity limit above which dof_vel_limits counts."""
    soft_torque_limit: float = field(default=1.0, metadata=positive(10))
    """Share of a joint's effort limit above which torque_limits counts."""


STATE_TERMS = ("base_lin_vel", "base_ang_vel", "projected_gravity", "commands", "dof_pos", "dof_vel", "actions")


@dataclass(frozen=True)
class LeggedObservationsConfig(ObservationsConfig):
    """What the policy and the value function of a legged robot see."""

    groups: dict[str, ObservationGroupConfig] = field(
        default_factory=lambda: {
            "actor": ObservationGroupConfig(STATE_TERMS, noise=True),
            "critic": ObservationGroupConfig(STATE_TERMS),
        }
    )
    """`actor`: what the policy sees, with noise; `critic`: what the value function sees, without."""
    scales: dict[str, float] = field(
        default_factory=lambda: {"base_lin_vel": 2.0, "base_ang_vel": 0.25, "dof_vel": 0.05, "heights": 5.0},
        metadata=rescaled_by_term("_obs_", -1, between(-LARGEST, LARGEST)),
    )
    """Term -> factor; 1 where not named. `commands` are scaled like the velocities they ask for."""
    noise: dict[str, float] = field(
        default_factory=lambda: {
            "base_lin_vel": 0.1,
            "base_ang_vel": 0.2,
            "projected_gravity": 0.05,
            "dof_pos": 0.01,
            "dof_vel": 1.5,
            "heights": 0.1,
        },
        metadata=rescaled_by_term("_obs_", 1, between(0, LARGEST)),
    )
    """Term -> half width of its uniform noise, in the term's unit before scaling."""
    heights_offset: float = field(default=0.5, metadata=rescaled("m", between(-100, 100)))
    """Observed heights are relative to this far below the base [m]."""
    heights_limit: float = field(default=1.0, metadata=rescaled("m", positive(100)))
    """Observed heights are at most this large, up or down [m]."""
    depth_limit: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Low ground is observed at most this deep, if heights_limit is more; 0: heights_limit alone [m]."""
    once_trained: HeightLimitsConfig = field(default_factory=HeightLimitsConfig)
    """What a policy is told of heights in play, evaluation and export, if that is less than in training."""
    height_map: HeightMapConfig = field(default_factory=HeightMapConfig)
    """What is wrong with the map of heights, beside the noise of its points."""

    @property
    def deepest(self) -> float:
        """How deep ground is observed at most [m]."""
        return min(self.heights_limit, self.depth_limit or self.heights_limit)

    def trained(self) -> Self:
        limits, depths = self.once_trained, self.once_trained.depth_limit or self.depth_limit
        return replace(self, heights_limit=limits.heights_limit or self.heights_limit, depth_limit=depths)


@dataclass(frozen=True)
class EvaluationConfig:
    """What policies of the task are judged by; training does not read it."""

    vx: Axis = field(default=(-1.0, 1.0, 0.5), metadata=quantity("m/s", AXIS))
    """Forward velocities of the command grid: lowest, highest, step [m/s]."""
    vy: Axis = field(default=(-1.0, 1.0, 0.5), metadata=quantity("m/s", AXIS))
    """Leftward velocities of the command grid: lowest, highest, step [m/s]."""
    yaw: Axis = field(default=(-1.0, 1.0, 0.5), metadata=quantity("rad/s", AXIS))
    """Yaw rates of the command grid: lowest, highest, step [rad/s]."""
    stairs: float = field(default=0.36, metadata=positive(10))
    """Steps, as a share of rewards.base_height_target, whose success a table of several tasks states; of the sizes that were
    measured it is the next larger one."""


@dataclass(frozen=True)
class LeggedConfig(TaskConfig):
    """A robot that follows velocity commands: what its task has beside every task's sections."""

    robot: str = ""
    """Folder under resources/robots/, or a path to such a folder, relative to the file that names it."""
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    """The ground."""
    commands: CommandsConfig = field(default_factory=CommandsConfig)
    """Velocity commands."""
    init_state: InitStateConfig = field(default_factory=InitStateConfig)
    """State after a reset."""
    control: LeggedControlConfig = field(default_factory=LeggedControlConfig)
    """From actions to joint torques."""
    terminations: LeggedTerminationsConfig = field(default_factory=LeggedTerminationsConfig)
    """What ends an episode."""
    domain_rand: LeggedDomainRandConfig = field(default_factory=LeggedDomainRandConfig)
    """What differs from robot to robot, and disturbances."""
    rewards: LeggedRewardsConfig = field(default_factory=LeggedRewardsConfig)
    """Reward terms and their numbers."""
    observations: LeggedObservationsConfig = field(default_factory=LeggedObservationsConfig)
    """What policy and value function see."""
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    """What its policies are judged by."""
