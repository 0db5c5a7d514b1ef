"""Configuration of a task with a robot: its ground, control, initial states, randomisation, rewards and observations.

Fields that also exist in legged_gym (v1.0.2, arXiv 2109.11978) have the same defaults as there.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, Self, TypeGuard

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
    ObservationsConfig,
    Range,
    RewardsConfig,
    TerminationsConfig,
)
from legged.config.randomization import DrawConfig, ForceConfig, HeldGoalsConfig, KickConfig
from legged.config.section import Section
from legged.config.task import TaskConfig

MOTION = between(-100, 100)
"""Bounds of velocities [m/s] or [rad/s], of angles [rad], and of factors on angles."""
MEASURED = rescaled("m", items(500, between(-100, 100)))
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
class InitStateConfig(Section):
    """State after a reset. The robot's files set the default joint angles and the spawn height."""

    dof_pos_factor: Range = field(default=(0.5, 1.5), metadata=MOTION)
    """Range of a random factor on each default joint angle."""
    yaw: Range = field(default=(0.0, 0.0), metadata=quantity("rad", MOTION))
    """Range of the heading of the base [rad]."""
    base_velocity: Range = field(default=(-0.5, 0.5), metadata=rescaled("m/s", MOTION))
    """Range of each component of the base's linear [m/s] and angular [rad/s] velocity."""


@dataclass(frozen=True)
class RobotControlConfig(ControlConfig):
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
    """Name patterns of joints without an action. These joints need law P: their gains hold them at their default angles, or
    at moving goals (domain_rand.held_goals)."""
    actuator: ActuatorConfig = field(default_factory=ActuatorConfig)
    """Properties of real motors: torque limits that depend on speed, friction, delay, learned actuator models."""

    @property
    def laws(self) -> set[str]:
        """All control laws that `control_type` names."""
        return {self.control_type} if isinstance(self.control_type, str) else set(self.control_type.values())


@dataclass(frozen=True)
class RobotTerminationsConfig(TerminationsConfig):
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
class RobotDomainRandConfig(DomainRandConfig):
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
    held_goals: HeldGoalsConfig = field(default_factory=HeldGoalsConfig)
    """Random walk of the joints without an action."""
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
        still = HeldGoalsConfig()
        return replace(plain, kicks={}, forces={}, held_goals=still, observed_ranges=ranges, observed_forces=forces)


@dataclass(frozen=True)
class RobotRewardsConfig(RewardsConfig):
    """Scales of the `_reward_<name>` terms, and parameters of a robot's terms."""

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


@dataclass(frozen=True)
class HeightMapConfig:
    """Errors of the height map from which a robot reads the observation term `heights`. The term's bias, noise, delay and
    lost packets come in addition. The errors of the map appear only in groups with `noise: true`. Each half width is that
    of a uniform distribution around 0.
    """

    offset: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Half width of the map's vertical offset [m]. The offset is sampled for each episode."""
    shift: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Half width of the map's shift along each horizontal world axis [m]. The shift is sampled for each episode."""
    drift: float = field(default=0.0, metadata=rescaled("m/s", between(0, 100)))
    """Half width of the speed at which the vertical offset drifts [m/s]. The speed is sampled for each episode."""
    shift_drift: float = field(default=0.0, metadata=rescaled("m/s", between(0, 100)))
    """Half width of the speed at which the shift drifts along each axis [m/s]. The speed is sampled for each episode."""
    holes: float = field(default=0.0, metadata=between(0, 1))
    """Share of the map's points that are missing. Different points are missing in each episode. The observation of a missing
    point is 0, as on level ground with the base at the height `observations.heights_offset`."""
    lost: float = field(default=0.0, metadata=between(0, 1))
    """Probability that a robot has no map during an episode and must walk blindly. When success on terrain is measured, all
    robots have a map."""


@dataclass(frozen=True)
class HeightLimitsConfig:
    """Limits of the term `heights` in play, evaluation and export. A limit of 0 keeps the limit of the training."""

    heights_limit: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Limit that replaces observations.heights_limit [m]."""
    depth_limit: float = field(default=0.0, metadata=rescaled("m", between(0, 100)))
    """Limit that replaces observations.depth_limit [m]."""


@dataclass(frozen=True)
class RobotObservationsConfig(ObservationsConfig):
    """Observations of the policy and the value function of a robot, and limits of observed heights."""

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
    joints: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Name patterns of the joints that the terms `dof_pos` and `dof_vel` observe; empty for all joints."""
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
class RobotConfig(TaskConfig):
    """Configuration of a task with a robot on its ground."""

    DISTURBANCES = (
        *TaskConfig.DISTURBANCES,
        "domain_rand.randomize_friction",
        "domain_rand.randomize_base_mass",
        "domain_rand.push_robots",
    )

    robot: str = ""
    """Robot: the name of a folder under resources/robots/, or the path of a folder relative to the configuration file."""
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    """Terrain under the robots."""
    init_state: InitStateConfig = field(default_factory=InitStateConfig)
    """State after a reset."""
    control: RobotControlConfig = field(default_factory=RobotControlConfig)
    """Conversion of actions to joint torques."""
    terminations: RobotTerminationsConfig = field(default_factory=RobotTerminationsConfig)
    """Terms that end an episode."""
    domain_rand: RobotDomainRandConfig = field(default_factory=RobotDomainRandConfig)
    """Domain randomisation and disturbances."""
    rewards: RobotRewardsConfig = field(default_factory=RobotRewardsConfig)
    """Reward terms and their parameters."""
    observations: RobotObservationsConfig = field(default_factory=RobotObservationsConfig)
    """Observations of policy and value function."""


def has_robot(cfg: TaskConfig) -> TypeGuard[RobotConfig]:
    """Return whether the task has a robot, on a ground that the section `terrain` sets."""
    return isinstance(cfg, RobotConfig)
