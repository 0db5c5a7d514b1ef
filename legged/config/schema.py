"""The configuration schema: every field a task file can set, with its meaning, unit and default.

Defaults are legged_gym's (v1.0.2, arXiv 2109.11978) where it has the field. A file under `cfg/` states only what differs.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

from legged.config.origins import Origins

POSITIVE = {"above": 0}
AT_LEAST_0 = {"min": 0}
AT_LEAST_1 = {"min": 1}
UNIT = {"min": 0, "max": 1}
NOT_EMPTY = {"items": 1}
"""For lists: bounds hold for every item, and a list with any bound must not be empty."""

Range = tuple[float, float]
NewtonSolver = Literal["mujoco", "steel", "kamino", "featherstone", "xpbd", "semi_implicit"]


def _lattice(low: float, high: float, step: float = 0.1) -> tuple[float, ...]:
    """low, low + step, ... high."""
    return tuple(round(low + step * i, 6) for i in range(round((high - low) / step) + 1))


@dataclass(frozen=True)
class EnvConfig:
    """Size and length of the simulated batch."""

    num_envs: int = field(default=4096, metadata=AT_LEAST_1)
    """Robots simulated side by side, on each GPU."""
    episode_length_s: float = field(default=20.0, metadata=POSITIVE)
    """Time-out of an episode [s]."""
    seed: int = field(default=1, metadata=AT_LEAST_0)
    """Seed of torch's generators, and of the terrain; physics itself draws no random numbers. With several GPUs the robots of
    each have their own, seed + rank."""


@dataclass(frozen=True)
class SimConfig:
    """Physics time step, engine and contact solver."""

    physics: Literal["auto", "mujoco_warp", "mujoco", "newton"] = "auto"
    """Engine: `mujoco_warp` (GPU, or Warp's CPU device), `mujoco` (C engine, all CPU cores), `newton` (GPU, or Warp's CPU
    device), `auto` by device."""
    solver: NewtonSolver = "mujoco"
    """Solver of `newton`; the other engines have their own. Each comes with settings under which a quadruped stands:
    legged/physics/newton_solvers.py."""
    dt: float = field(default=0.005, metadata=POSITIVE)
    """Physics step [s]; the control step is `dt * control.decimation`."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Friction cone. Pyramidal, impratio 10: a standing ANYmal C sinks 1 cm from 2 s to 5 s; elliptic costs twice as much."""
    impratio: float = field(default=10.0, metadata=POSITIVE)
    """Stiffness of friction relative to the normal direction; 1 lets loaded feet creep outward, 100 needs 50 or more
    iterations."""
    iterations: int = field(default=10, metadata=AT_LEAST_1)
    """Cap of Newton solver iterations per physics step."""
    ls_iterations: int = field(default=20, metadata=AT_LEAST_1)
    """Cap of line-search iterations per solver iteration."""
    constraint_solver: Literal["auto", "fused", "rounds"] = "auto"
    """How mujoco_warp solves for contact forces: `rounds`, its own Newton solver, ten launches a round until the last world
    has converged; `fused`, the same iteration as one launch in which every world ends by itself; `auto`, `fused` for a model
    that it knows (pyramidal cones, 32 degrees of freedom)."""
    smooth_dynamics: Literal["auto", "fused", "stages"] = "auto"
    """How mujoco_warp computes what is not of contacts: `stages`, its own launches, dozens of them; `fused`, one for poses,
    inertias and bias forces, one for integration; `auto`, `fused` for a robot that torques alone move, where the constraint
    solver is fused too."""
    nconmax: int = field(default=24, metadata=AT_LEAST_1)
    """Contacts (and candidate pairs) allocated per robot in mujoco_warp and newton, in a pool all robots share."""
    njmax: int = field(default=96, metadata=AT_LEAST_1)
    """Constraint rows allocated per robot in mujoco_warp and in Newton's MuJoCo solver: 4 a contact in the pyramidal cone, 1
    a joint limit."""
    self_collisions: bool = False
    """Let the robot's shapes touch each other, except those of neighbouring bodies."""
    terrain_collider: Literal["cells", "convex"] = "cells"
    """How mujoco_warp and Newton's MuJoCo solver meet a height map: `cells`, our own kernel with vertical faces; `convex`,
    the general collider on one height field, ten times slower and with ramps for steps, for shapes unknown to `cells`."""
    threads: int = field(default=0, metadata=AT_LEAST_0)
    """Threads of the C engine; 0 takes all cores."""


@dataclass(frozen=True)
class TerrainConfig:
    """The ground: a plane, or tiles of several types in rows of growing difficulty."""

    mesh_type: Literal["plane", "height_map"] = "plane"
    """An infinite horizontal plane, or a height map of num_rows x num_cols tiles."""
    curriculum: bool = True
    """Robots move to harder rows while they succeed; otherwise all rows are hard, and robots stay where they are."""
    proportions: dict[str, float] = field(default_factory=dict)
    """Terrain type -> share of the columns; sums to 1. Types: legged/terrain/generators.py, TERRAIN_TYPES."""
    num_rows: int = field(default=10, metadata=AT_LEAST_1)
    """Levels of difficulty: row / num_rows."""
    num_cols: int = field(default=20, metadata=AT_LEAST_1)
    """Columns, each of one type."""
    terrain_length: float = field(default=8.0, metadata=POSITIVE)
    """Extent of a tile along x [m]."""
    terrain_width: float = field(default=8.0, metadata=POSITIVE)
    """Extent of a tile along y [m]."""
    border_size: float = field(default=25.0, metadata=AT_LEAST_0)
    """Width of the level ground around all tiles [m]."""
    horizontal_scale: float = field(default=0.1, metadata=POSITIVE)
    """Edge of a cell of the height map [m]."""
    slope_threshold: float = field(default=0.2, metadata=AT_LEAST_0)
    """On types made of steps, a difference between cells steeper than this (rise over run) is a vertical face."""
    max_init_terrain_level: int = field(default=5, metadata=AT_LEAST_0)
    """Highest row in which robots start training."""
    spawn_range: float = field(default=1.0, metadata=AT_LEAST_0)
    """Robots start at most this far from the middle of their tile, in x and in y [m]."""
    measured_points_x: tuple[float, ...] = field(
        default=tuple(round(0.1 * i - 0.8, 1) for i in range(17)), metadata=NOT_EMPTY
    )
    """Where heights are measured, forward of the base [m]."""
    measured_points_y: tuple[float, ...] = field(
        default=tuple(round(0.1 * i - 0.5, 1) for i in range(11)), metadata=NOT_EMPTY
    )
    """And to its left [m]."""


@dataclass(frozen=True)
class CommandRanges:
    """Largest commands that are sampled, and where a curriculum starts from."""

    lin_vel_x: Range = (-1.0, 1.0)
    """Forward velocity, base frame [m/s]."""
    lin_vel_y: Range = (-1.0, 1.0)
    """Leftward velocity, base frame [m/s]."""
    ang_vel_yaw: Range = (-1.0, 1.0)
    """Yaw rate [rad/s]; the clip of the heading controller in heading mode."""
    heading: Range = (-3.141592653589793, 3.141592653589793)
    """Heading in the world, heading mode only [rad]."""


@dataclass(frozen=True)
class CommandCurriculumConfig:
    """Ranges that widen, axis by axis, while the robots follow what they are asked."""

    enabled: bool = False
    """Start at `start` times the full ranges and widen; otherwise the full ranges from the first step."""
    start: float = field(default=0.3, metadata=UNIT)
    """Share of the full range that each axis starts with."""
    step: float = field(default=0.1, metadata=POSITIVE)
    """Share of the full range by which an axis is widened."""
    window_s: float = field(default=1.0, metadata=POSITIVE)
    """Time over which velocities are averaged before an axis is judged [s]."""
    threshold: float = field(default=0.75, metadata=UNIT)
    """Share of the velocity asked for that robots must reach on average before an axis is widened."""


@dataclass(frozen=True)
class CommandsConfig:
    """Velocity commands: sampling, heading mode, curriculum."""

    ranges: CommandRanges = CommandRanges()
    resampling_time_s: float = field(default=10.0, metadata=POSITIVE)
    """Time a command is held [s]."""
    heading_command: bool = True
    """Sample a heading and derive the yaw rate 0.5 * wrap(heading - yaw) from it at every step."""
    small_command: float = field(default=0.2, metadata=AT_LEAST_0)
    """Sampled horizontal velocities with a norm below this are set to zero [m/s]."""
    standing_share: float = field(default=0.0, metadata=UNIT)
    """Share of sampled commands that ask the robot to stand still."""
    single_axis_share: float = field(default=0.0, metadata=UNIT)
    """Share of sampled commands that keep one random axis only: walking straight, sideways, turning on the spot."""
    curriculum: CommandCurriculumConfig = CommandCurriculumConfig()


@dataclass(frozen=True)
class InitStateConfig:
    """State after a reset; the default joint angles and the spawn height are the robot's."""

    dof_pos_factor: Range = (0.5, 1.5)
    """Joint angles are the default ones times a number drawn from this range, per joint."""
    yaw: Range = (0.0, 0.0)
    """Heading of the base [rad]."""
    base_velocity: Range = (-0.5, 0.5)
    """Range of each component of the base's linear [m/s] and angular [rad/s] velocity."""


@dataclass(frozen=True)
class ControlConfig:
    """From actions to torques."""

    control_type: Literal["P", "V", "T"] = "P"
    """Action as joint position target (P), joint velocity target (V) or torque (T)."""
    stiffness: dict[str, float] = field(default_factory=dict)
    """Joint-name pattern -> P gain [N m/rad]; empty takes the robot's. A pattern is a part of the joint's name."""
    damping: dict[str, float] = field(default_factory=dict)
    """Joint-name pattern -> D gain [N m s/rad]; empty takes the robot's."""
    action_scale: float = field(default=0.5, metadata=POSITIVE)
    """Target = action_scale * action + default angle (P) [rad]."""
    decimation: int = field(default=4, metadata=AT_LEAST_1)
    """Physics steps per control step; the torque is recomputed at each."""
    clip_actions: float = field(default=100.0, metadata=POSITIVE)
    """Actions are clipped at plus and minus this."""


@dataclass(frozen=True)
class TerminationsConfig:
    """What ends an episode early, beside the robot's `terminate_after_contacts_on` shapes feeling more than 1 N."""

    min_base_height: float = field(default=0.0, metadata=AT_LEAST_0)
    """Lowest base height above the ground [m]; 0 is off."""
    max_tilt: float = field(default=0.0, metadata=AT_LEAST_0)
    """Largest angle between the base's up axis and the vertical [rad]; 0 is off."""


@dataclass(frozen=True)
class DomainRandConfig:
    """What differs from robot to robot, and disturbances."""

    randomize_friction: bool = True
    """Draw the friction of each robot's contacts."""
    friction_range: Range = (0.5, 1.25)
    """Coulomb friction of the contacts. PhysX averages foot and ground; MuJoCo takes the foot's (it has priority)."""
    friction_buckets: int = field(default=64, metadata=AT_LEAST_1)
    """Friction is drawn from this many values."""
    randomize_base_mass: bool = False
    """Add a mass to each robot's base."""
    added_mass_range: Range = (-5.0, 5.0)
    """Mass added to the base [kg]."""
    push_robots: bool = True
    """Set the base's horizontal velocity now and then, each robot at its own moment."""
    push_interval_s: float = field(default=15.0, metadata=POSITIVE)
    """Time between two pushes of a robot [s]."""
    max_push_vel_xy: float = field(default=1.0, metadata=AT_LEAST_0)
    """Range of a push's velocity, per world axis [m/s]."""


@dataclass(frozen=True)
class RewardsConfig:
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
        }
    )
    """Term -> scale; multiplied by the control step. A scale of 0 switches the term off."""
    only_positive_rewards: bool = True
    """Clip the sum at zero (before `termination`) against early learning to fall."""
    tracking_sigma: float = field(default=0.25, metadata=POSITIVE)
    """Tracking reward = exp(-error^2 / sigma)."""
    air_time_target_s: float = field(default=0.5, metadata=AT_LEAST_0)
    """Swings longer than this are rewarded by feet_air_time, shorter ones punished [s]."""
    base_height_target: float = field(default=0.5, metadata=POSITIVE)
    """Base height wanted by base_height [m]."""
    max_contact_force: float = field(default=500.0, metadata=POSITIVE)
    """Foot forces above this are penalised by feet_contact_forces [N]."""
    soft_dof_pos_limit: float = field(default=1.0, metadata=POSITIVE)
    """Share of a joint's range outside which dof_pos_limits counts."""
    soft_dof_vel_limit: float = field(default=1.0, metadata=POSITIVE)
    """Share of a joint's velocity limit above which dof_vel_limits counts."""
    soft_torque_limit: float = field(default=1.0, metadata=POSITIVE)
    """Share of a joint's effort limit above which torque_limits counts."""


STATE_TERMS = ("base_lin_vel", "base_ang_vel", "projected_gravity", "commands", "dof_pos", "dof_vel", "actions")


@dataclass(frozen=True)
class ObservationsConfig:
    """Observation groups, made of `_obs_<name>` terms in this order."""

    actor: tuple[str, ...] = field(default=STATE_TERMS, metadata=NOT_EMPTY)
    """What the policy sees, with noise."""
    actor_history: int = field(default=1, metadata=AT_LEAST_1)
    """Steps of the actor's terms that the policy sees side by side, oldest first; a new episode repeats its first."""
    critic: tuple[str, ...] = field(default=STATE_TERMS, metadata=NOT_EMPTY)
    """What the value function sees, without noise."""
    scales: dict[str, float] = field(
        default_factory=lambda: {"base_lin_vel": 2.0, "base_ang_vel": 0.25, "dof_vel": 0.05, "heights": 5.0}
    )
    """Term -> factor; 1 where not named. `commands` are scaled like the velocities they ask for."""
    add_noise: bool = True
    """Add uniform noise to the actor's terms."""
    noise_level: float = field(default=1.0, metadata=AT_LEAST_0)
    """Factor on all noise."""
    noise: dict[str, float] = field(
        default_factory=lambda: {
            "base_lin_vel": 0.1,
            "base_ang_vel": 0.2,
            "projected_gravity": 0.05,
            "dof_pos": 0.01,
            "dof_vel": 1.5,
            "heights": 0.1,
        }
    )
    """Term -> half width of its uniform noise, in the term's unit before scaling."""
    clip: float = field(default=100.0, metadata=POSITIVE)
    """Scaled observations are clipped at plus and minus this."""


@dataclass(frozen=True)
class PolicyConfig:
    """Networks of actor and critic: layers, before them `rnn_num_layers` recurrent ones if `rnn_type` says which kind."""

    actor_hidden_dims: tuple[int, ...] = field(default=(512, 256, 128), metadata=AT_LEAST_1)
    critic_hidden_dims: tuple[int, ...] = field(default=(512, 256, 128), metadata=AT_LEAST_1)
    activation: Literal["elu", "selu", "relu", "lrelu", "tanh", "sigmoid", "softplus", "gelu", "swish", "mish"] = "elu"
    """Activation function, by rsl-rl's names."""
    init_noise_std: float = field(default=1.0, metadata=POSITIVE)
    """Standard deviation of the actions before training."""
    obs_normalization: bool = False
    """Normalise observations by running mean and variance."""
    rnn_type: Literal["none", "lstm", "gru"] = "none"
    rnn_hidden_dim: int = field(default=256, metadata=AT_LEAST_1)
    rnn_num_layers: int = field(default=1, metadata=AT_LEAST_1)


@dataclass(frozen=True)
class AlgorithmConfig:
    """PPO, by rsl-rl's names."""

    value_loss_coef: float = 1.0
    use_clipped_value_loss: bool = True
    clip_param: float = field(default=0.2, metadata=POSITIVE)
    entropy_coef: float = 0.01
    num_learning_epochs: int = field(default=5, metadata=AT_LEAST_1)
    num_mini_batches: int = field(default=4, metadata=AT_LEAST_1)
    learning_rate: float = field(default=1e-3, metadata=POSITIVE)
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """`adaptive` follows desired_kl."""
    gamma: float = field(default=0.99, metadata=UNIT)
    lam: float = field(default=0.95, metadata=UNIT)
    desired_kl: float = field(default=0.01, metadata=POSITIVE)
    max_grad_norm: float = field(default=1.0, metadata=POSITIVE)
    use_mixed_precision: bool = False
    """Networks compute in bfloat16 while they learn; weights, losses and the optimiser stay float32."""
    symmetry: bool = False
    """Learn from every sample also as its mirror image, left for right (Mittal et al., arXiv 2403.04359)."""


@dataclass(frozen=True)
class RunnerConfig:
    """Length of training and what it writes."""

    num_steps_per_env: int = field(default=24, metadata=AT_LEAST_1)
    """Control steps per robot and iteration."""
    max_iterations: int = field(default=1500, metadata=AT_LEAST_1)
    """Iterations of the whole training; a resumed run goes on up to this number."""
    save_interval: int = field(default=50, metadata=AT_LEAST_1)
    """Iterations between two checkpoints."""
    loop: Literal["stock", "captured"] = "captured"
    """`captured`: rsl-rl's arithmetic without the host in between, on a GPU as CUDA graphs; it falls back to `stock` where
    a feature needs that, and says why. `stock`: rsl-rl's own training loop."""
    matmul: Literal["float32", "tf32"] = "tf32"
    """Matrix products of the networks on a GPU while training; `tf32` keeps 10 of the factors' 23 bits and is faster."""
    experiment_name: str = ""
    """Folder under logs/; the task's name when empty."""
    run_name: str = ""
    """Appended to the run folder's date and time."""


@dataclass(frozen=True)
class TrainConfig:
    """Everything the learner needs."""

    policy: PolicyConfig = PolicyConfig()
    algorithm: AlgorithmConfig = AlgorithmConfig()
    runner: RunnerConfig = RunnerConfig()


@dataclass(frozen=True)
class TaskConfig:
    """A whole task: one robot, its MDP and how it is trained."""

    task: str = ""
    """Name of the task; set by the registry."""
    robot: str = ""
    """Folder under resources/robots/, or a path to such a folder."""
    env: EnvConfig = EnvConfig()
    sim: SimConfig = SimConfig()
    terrain: TerrainConfig = TerrainConfig()
    commands: CommandsConfig = CommandsConfig()
    init_state: InitStateConfig = InitStateConfig()
    control: ControlConfig = field(default_factory=ControlConfig)
    terminations: TerminationsConfig = TerminationsConfig()
    domain_rand: DomainRandConfig = DomainRandConfig()
    rewards: RewardsConfig = field(default_factory=RewardsConfig)
    observations: ObservationsConfig = field(default_factory=ObservationsConfig)
    train: TrainConfig = TrainConfig()
    custom: dict[str, Any] = field(default_factory=dict)
    """Free space for a user's own terms: `self.cfg.custom["name"]`."""
    origins: Origins = field(default_factory=Origins, repr=False, compare=False)
    """Who set what; no setting itself (`compare` says so), so neither read from files nor written to them."""

    @property
    def dt(self) -> float:
        """Control step [s]."""
        return self.sim.dt * self.control.decimation
