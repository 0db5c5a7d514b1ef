"""Configuration of a legged robot that follows velocity commands. Its sections extend those that all tasks have.

Fields that also exist in legged_gym (v1.0.2, arXiv 2109.11978) have the same defaults as there.
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
from legged.config.section import Section
from legged.config.sensors import HeightLimitsConfig, HeightMapConfig
from legged.config.task import TaskConfig

MOTION = between(-100, 100)
"""Bounds of velocities [m/s] or [rad/s], of angles [rad], and of factors on angles."""
MEASURED = rescaled("m", items(500, between(-100, 100)))
FASTEST = 20.0
"""Largest command of an evaluation [m/s, rad/s]. Reason: the area of the terrain grows with the square of the command."""
Axis = tuple[float, float, float]
"""One axis of a command grid: lowest value, highest value, and step."""
AXIS = between(-FASTEST, FASTEST)
Law = Literal["P", "V", "T"]
"""Control law of a joint."""


@dataclass(frozen=True)
class TerrainConfig(Section):
    """Terrain: a plane, or tiles of several types in rows of rising difficulty."""

    mesh_type: Literal["plane", "height_map"] = "plane"
    """Shape of the ground: an infinite horizontal plane, or a height map of num_rows x num_cols tiles."""
    curriculum: bool = True
    """Move robots to harder rows after success, and to easier rows after failure. Without a curriculum, robots stay in their
    row, and each row has a random difficulty of 0.5, 0.75 or 0.9."""
    scale: float = field(default=1.0, metadata={**positive(100, low=0.01), "rescaled": "m"})
    """Factor on all lengths of the terrain types; 1 suits a robot that is half a metre high."""
    proportions: dict[str, float] = field(default_factory=dict, metadata=UNIT)
    """Terrain type -> share of the columns; the shares sum to 1. Types: legged/terrain/generators.py, TERRAIN_TYPES."""
    sizes: dict[str, float | Range] = field(default_factory=dict, metadata=rescaled_by_entry("terrain.sizes.", positive(100)))
    """Terrain type -> size of all its tiles, or range [low, high] of their sizes, in the type's unit. In a range the
    size changes linearly, from the easier end at difficulty 0 to the harder end at difficulty 1. An entry replaces the type's
    default sizes."""
    num_rows: int = field(default=10, metadata=between(1, 1000))
    """Number of rows. In a curriculum, row r = 0, 1, 2 ... has the difficulty r / num_rows."""
    num_cols: int = field(default=20, metadata=between(1, 1000))
    """Number of columns. All tiles of a column have the same terrain type."""
    terrain_length: float = field(default=8.0, metadata=rescaled("m", positive(1000, low=0.01)))
    """Length of a tile along x [m]."""
    terrain_width: float = field(default=8.0, metadata=rescaled("m", positive(1000, low=0.01)))
    """Length of a tile along y [m]."""
    border_size: float = field(default=25.0, metadata=rescaled("m", between(0, 1000)))
    """Width of the level border around the tiles [m]."""
    horizontal_scale: float = field(default=0.1, metadata=rescaled("m", positive(10, low=1e-3)))
    """Edge length of a cell of the height map [m]."""
    slope_threshold: float = field(default=0.2, metadata=between(0, 1000))
    """In terrain types with steps: slope (rise over run) above which a vertical face separates two neighbouring cells."""
    max_init_terrain_level: int = field(default=5, metadata=between(0, 999))
    """Highest row in which robots start the training."""
    spawn_range: float = field(default=1.0, metadata=rescaled("m", between(0, 1000)))
    """Largest distance of a robot's start from the middle of its tile, in x and in y [m]."""
    measured_points_x: tuple[float, ...] = field(default=tuple(round(0.1 * i - 0.8, 1) for i in range(17)), metadata=MEASURED)
    """Forward (x) coordinates of the points at which the ground's height is measured, in the base's yaw frame [m]."""
    measured_points_y: tuple[float, ...] = field(default=tuple(round(0.1 * i - 0.5, 1) for i in range(11)), metadata=MEASURED)
    """Leftward (y) coordinates of the points at which the ground's height is measured, in the base's yaw frame [m]."""
    scan: Literal["lowest", "own", "highest"] = "lowest"
    """Height that a measured point reads from the height map. `own`: the height of the point's cell. `lowest` (as in
    legged_gym) or `highest`: the lowest or highest of three heights, of this cell and of the next cells along +x and +y."""


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
class CommandsConfig(Section):
    """Velocity commands: ranges, heading mode, curriculum."""

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
    curriculum: CommandCurriculumConfig = CommandCurriculumConfig()
    """Curriculum that widens the ranges during training."""


@dataclass(frozen=True)
class InitStateConfig(Section):
    """State after a reset. The robot's files set the default joint angles and the spawn height."""

    dof_pos_factor: Range = field(default=(0.5, 1.5), metadata=MOTION)
    """Range of a random factor on each default joint angle."""
    yaw: Range = field(default=(0.0, 0.0), metadata=quantity("rad", MOTION))
    """Range of the heading of the base [rad]."""
    base_velocity: Range = field(default=(-0.5, 0.5), metadata=rescaled("m/s", MOTION))
    """Range of each component of the base's linear [m/s] and angular [rad/s] velocity."""


@dataclass(frozen=True)
class LeggedControlConfig(ControlConfig):
    """Conversion of actions to joint torques."""

    control_type: Law | dict[str, Law] = "P"
    """Meaning of an action: joint position target (P), joint velocity target (V), or torque (T). One law, or joint-name
    pattern -> law. Wheels need V or T, unless they are `held`."""
    stiffness: dict[str, float] = field(default_factory=dict, metadata=quantity("N m/rad", between(0, LARGEST)))
    """Joint-name pattern -> P gain [N m/rad]; empty for the robot's gains. A pattern is a part of the joint's name."""
    damping: dict[str, float] = field(default_factory=dict, metadata=quantity("N m s/rad", between(0, LARGEST)))
    """Joint-name pattern -> D gain [N m s/rad]; empty for the robot's gains."""
    action_scale: float | dict[str, float] = field(default=0.5, metadata=quantity("rad", positive(LARGEST)))
    """Scale of the actions: one number, or joint-name pattern -> number. Law P: target = action_scale * action + default
    angle [rad]. Laws V and T: target = action_scale * action [rad/s] or [N m]."""
    held: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Name patterns of joints without an action. These joints need law P: their gains hold them at their default angles."""
    actuator: ActuatorConfig = field(default_factory=ActuatorConfig)
    """Properties of real motors: torque limits that depend on speed, friction, delay, learned actuator models."""

    @property
    def laws(self) -> set[str]:
        """All control laws that `control_type` names."""
        return {self.control_type} if isinstance(self.control_type, str) else set(self.control_type.values())


@dataclass(frozen=True)
class LeggedTerminationsConfig(TerminationsConfig):
    """Terms that end an episode."""

    failures: tuple[str, ...] = field(default=("contact", "base_height", "tilt"), metadata=TERMS)
    """Terms that count as failures. `contact`: a shape of the robot's `terminate_after_contacts_on` has a contact force
    above 1 N (or 1 % of the robot's weight, if smaller). `base_height`, `tilt`: the base is below min_base_height, or
    tilted by more than max_tilt."""
    time_outs: tuple[str, ...] = field(default=("left_terrain",), metadata=TERMS)
    """Terms that count as time-outs. `left_terrain`: the robot left the map, which does not count as a failure."""
    min_base_height: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Lowest height of the base above the ground [m]; 0 switches `base_height` off."""
    max_tilt: float = field(default=0.0, metadata=quantity("rad", between(0, 10)))
    """Largest angle between the base's up axis and the vertical [rad]; 0 switches `tilt` off."""


@dataclass(frozen=True)
class LeggedDomainRandConfig(DomainRandConfig):
    """Domain randomisation and disturbances."""

    randomize_friction: bool = True
    """Randomise the friction of each robot's contacts."""
    friction_range: Range = field(default=(0.5, 1.25), metadata=between(0, 100))
    """Range of the Coulomb friction of the robot's shapes. In MuJoCo a contact with the ground has the robot's
    friction, because the robot's shapes have priority. In PhysX a contact has the mean friction of robot and ground."""
    friction_buckets: int = field(default=64, metadata=between(1, 1_000_000))
    """Number of different friction values."""
    randomize_base_mass: bool = False
    """Randomise the mass of each robot's base."""
    added_mass_range: Range = field(default=(-5.0, 5.0), metadata=rescaled("kg", between(-10_000, 10_000)))
    """Range of the mass added to the base [kg]."""
    push_robots: bool = True
    """Give each robot's base a random horizontal velocity at intervals. Robots are pushed at different times."""
    push_interval_s: float = field(default=15.0, metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Time between two pushes of a robot [s]."""
    max_push_vel_xy: float = field(default=1.0, metadata=rescaled("m/s", between(0, 100)))
    """Largest velocity that a push gives to the base along the x and y axes of the world [m/s]."""
    kicks: dict[str, KickConfig] = field(default_factory=dict)
    """Any name -> sudden changes of the base's velocity. A kick adds to the velocity that push_robots has set."""
    forces: dict[str, ForceConfig] = field(default_factory=dict)
    """Any name -> a temporary force on a body of the robot."""

    observed_forces: dict[str, ForceConfig] = field(default_factory=dict)
    """Any name -> a force that is observed (`_obs_push_force`) but does not act. Play and evaluation move the entries of
    `forces` to this setting, so that the observation keeps its size and scale."""

    def nominal(self) -> Self:
        plain = super().nominal()
        by_flag: dict[str, Range | DrawConfig] = {}  # play and evaluation set the flags of these two ranges to false
        if self.randomize_friction:
            by_flag["friction"] = self.friction_range
        if self.randomize_base_mass:
            by_flag["added_base_mass"] = self.added_mass_range
        ranges = {**by_flag, **plain.observed_ranges}
        forces = {**self.observed_forces, **self.forces}
        return replace(plain, kicks={}, forces={}, observed_ranges=ranges, observed_forces=forces)


@dataclass(frozen=True)
class LeggedRewardsConfig(RewardsConfig):
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
    feet_clearance_target: float = field(default=0.1, metadata=rescaled("m", between(0, 100)))
    """Target of feet_clearance: height of a swinging foot above the lowest foot [m]."""
    base_height_target: float = field(default=0.5, metadata=rescaled("m", positive(100)))
    """Target of base_height: height of the base above the ground [m]."""
    max_contact_force: float = field(default=500.0, metadata=rescaled("N", positive(LARGEST)))
    """Limit of the contact force of a foot [N]. The term feet_contact_forces punishes larger forces."""
    soft_dof_pos_limit: float = field(default=1.0, metadata=positive(10))
    """Allowed share of a joint's range, about the middle of the range. The term dof_pos_limits punishes angles outside."""
    soft_dof_vel_limit: float = field(default=1.0, metadata=positive(10))
    """Allowed share of a joint's velocity limit. The term dof_vel_limits punishes higher speeds."""
    soft_torque_limit: float = field(default=1.0, metadata=positive(10))
    """Allowed share of a joint's effort limit. The term torque_limits punishes larger torques."""


STATE_TERMS = ("base_lin_vel", "base_ang_vel", "projected_gravity", "commands", "dof_pos", "dof_vel", "actions")


@dataclass(frozen=True)
class LeggedObservationsConfig(ObservationsConfig):
    """Observations of the policy and the value function of a legged robot."""

    groups: dict[str, ObservationGroupConfig] = field(
        default_factory=lambda: {
            "actor": ObservationGroupConfig(STATE_TERMS, noise=True),
            "critic": ObservationGroupConfig(STATE_TERMS),
        }
    )
    """Observation groups. `actor`: the policy's observations, with noise. `critic`: the value function's, without noise."""
    scales: dict[str, float] = field(
        default_factory=lambda: {"base_lin_vel": 2.0, "base_ang_vel": 0.25, "dof_vel": 0.05, "heights": 5.0},
        metadata=rescaled_by_entry("_obs_", between(-LARGEST, LARGEST), -1),
    )
    """Term -> factor. Without an entry, `commands` have the factors of base_lin_vel and base_ang_vel; other terms have 1."""
    noise: dict[str, float] = field(
        default_factory=lambda: {
            "base_lin_vel": 0.1,
            "base_ang_vel": 0.2,
            "projected_gravity": 0.05,
            "dof_pos": 0.01,
            "dof_vel": 1.5,
            "heights": 0.1,
        },
        metadata=rescaled_by_entry("_obs_", between(0, LARGEST)),
    )
    """Term -> half width of its uniform noise, in the term's unit before scaling."""
    heights_offset: float = field(default=0.5, metadata=rescaled("m", between(-100, 100)))
    """An observed height is 0 if the ground is this far below the base [m]."""
    heights_limit: float = field(default=1.0, metadata=rescaled("m", positive(100)))
    """Largest absolute value of an observed height [m]."""
    depth_limit: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Largest observed depth of low ground [m]. A value above heights_limit has no effect; 0 switches this limit off."""
    once_trained: HeightLimitsConfig = field(default_factory=HeightLimitsConfig)
    """Limits of observed heights that replace the training's limits in play, evaluation and export."""
    height_map: HeightMapConfig = field(default_factory=HeightMapConfig)
    """Errors of the observed height map, in addition to the noise of single points."""

    @property
    def deepest(self) -> float:
        """Largest observed depth of the ground [m]."""
        return min(self.heights_limit, self.depth_limit or self.heights_limit)

    def trained(self) -> Self:
        limits, depths = self.once_trained, self.once_trained.depth_limit or self.depth_limit
        return replace(self, heights_limit=limits.heights_limit or self.heights_limit, depth_limit=depths)


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
class LeggedConfig(TaskConfig):
    """Configuration of a legged robot that follows velocity commands."""

    robot: str = ""
    """Robot: the name of a folder under resources/robots/, or the path of a folder relative to the configuration file."""
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    """Terrain under the robots."""
    commands: CommandsConfig = field(default_factory=CommandsConfig)
    """Velocity commands."""
    init_state: InitStateConfig = field(default_factory=InitStateConfig)
    """State after a reset."""
    control: LeggedControlConfig = field(default_factory=LeggedControlConfig)
    """Conversion of actions to joint torques."""
    terminations: LeggedTerminationsConfig = field(default_factory=LeggedTerminationsConfig)
    """Terms that end an episode."""
    domain_rand: LeggedDomainRandConfig = field(default_factory=LeggedDomainRandConfig)
    """Domain randomisation and disturbances."""
    rewards: LeggedRewardsConfig = field(default_factory=LeggedRewardsConfig)
    """Reward terms and their parameters."""
    observations: LeggedObservationsConfig = field(default_factory=LeggedObservationsConfig)
    """Observations of policy and value function."""
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    """Settings of evaluations."""
