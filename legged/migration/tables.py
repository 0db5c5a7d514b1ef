"""Tables that map settings of legged_gym and its forks to settings of this package."""


def _pairs(text: str) -> dict[str, str]:
    """Return setting of a fork -> setting of this package. A line of `text` has the fork's section, this package's section,
    and names; a name that differs is written as theirs=ours.
    """
    pairs: dict[str, str] = {}
    for line in text.strip().splitlines():
        sections, _, names = line.partition(": ")
        theirs, ours = sections.split(" -> ")
        for old, _, new in (name.partition("=") for name in names.split()):
            pairs[f"{theirs}.{old}"] = f"{ours}.{new or old}"
    return pairs


MOVED = {
    **{f"{name}_scales.": f"{section}.{name}_scales." for section, name in (("normalization", "obs"), ("noise", "noise"))},
    "reward_scales.": "rewards.scales.",
    **_pairs("commands -> commands.ranges: lin_vel_x lin_vel_y ang_vel_yaw heading"),
}
"""Path in a fork -> path in legged_gym. A path with a dot at its end stands for all paths that begin with it."""

SAME = {"seed": "env.seed"} | _pairs("""
env -> env: num_envs episode_length_s
commands -> commands: resampling_time=resampling_time_s heading_command zero_command_prob=standing_share
commands.ranges -> commands.ranges: lin_vel_x lin_vel_y ang_vel_yaw heading
control -> control: control_type action_scale decimation
domain_rand -> domain_rand: randomize_friction randomize_base_mass added_mass_range
domain_rand -> domain_rand: push_robots push_interval_s max_push_vel_xy
domain_rand -> domain_rand: randomize_payload_mass=randomize_base_mass payload_mass_range=added_mass_range
domain_rand -> init_state: init_dof_pos_ratio_range=dof_pos_factor init_base_vel_range=base_velocity
rewards -> rewards: only_positive_rewards soft_dof_pos_limit soft_dof_vel_limit soft_torque_limit
rewards -> rewards: base_height_target max_contact_force
normalization -> observations: clip_observations=clip
normalization -> control: clip_actions
normalization.obs_scales -> observations.scales: lin_vel=base_lin_vel ang_vel=base_ang_vel dof_pos dof_vel
normalization.obs_scales -> observations.scales: height_measurements=heights
noise -> observations: add_noise noise_level
noise.noise_scales -> observations.noise: lin_vel=base_lin_vel ang_vel=base_ang_vel gravity=projected_gravity
noise.noise_scales -> observations.noise: dof_pos dof_vel height_measurements=heights
sim -> sim: dt
policy -> train.policy: init_noise_std actor_hidden_dims critic_hidden_dims activation
algorithm -> train.algorithm: value_loss_coef use_clipped_value_loss clip_param entropy_coef gamma lam desired_kl
algorithm -> train.algorithm: num_learning_epochs num_mini_batches learning_rate schedule max_grad_norm
runner -> train.runner: num_steps_per_env max_iterations save_interval experiment_name run_name
""")
"""Setting of a fork -> setting of this package with the same meaning."""
OF_TERRAIN = _pairs("""
terrain -> terrain: horizontal_scale border_size curriculum max_init_terrain_level
terrain -> terrain: terrain_length terrain_width num_rows num_cols
""")
"""More settings with the same meaning, which are mapped only if the ground is not a plane. Those of `OF_HEIGHTS` are mapped
only if heights are measured, and those of `OF_RECURRENT` only for recurrent policies."""
OF_HEIGHTS = _pairs("terrain -> terrain: measured_points_x measured_points_y")
OF_RECURRENT = _pairs("policy -> train.policy: rnn_type rnn_hidden_size=rnn_hidden_dim rnn_num_layers")
ABSENT = {
    **dict.fromkeys(("domain_rand.randomize_friction", "domain_rand.push_robots", "rewards.only_positive_rewards"), False),
    **dict.fromkeys(("noise.add_noise", "commands.heading_command"), False),
    **{f"commands.ranges.{name}": [0.0, 0.0] for name in ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")},
    **{f"noise.noise_scales.{name}": 0.0 for name in ("gravity", "lin_vel", "ang_vel", "dof_pos", "dof_vel")},
}
"""Setting of a fork -> value of its counterpart if the fork lacks the setting. This package's default would add something
that the fork does not do."""
OF_CONTACTS = (
    ("friction", "domain_rand.friction_range", "static_friction", 1.0),
    ("restitution", "domain_rand.ranges.restitution", "restitution", 0.0),
)
"""Property of contacts, setting of this package, and the ground's setting in a fork with its default."""
RANDOM_MODEL = {
    "link_mass": "link_mass",
    "motor_strength": "motor_strength motor:motor_strength motor_torque",
    "base_com_x base_com_y base_com_z": "com_displacement base_com:added_com",
    "p_gain": "kp Kp Kp_factor gains:stiffness_multiplier",
    "d_gain": "kd Kd Kd_factor gains:damping_multiplier",
    "joint_offset": "motor_offset default_dof_pos",
    "joint_friction": "joint_friction",
    "init_state.dof_pos_factor": "initial_joint_pos",
}
"""Property or setting of this package -> names in forks. In a fork, randomize_<name> is the switch, and <name>_range or
randomize_<name>_range is the range. If the range has another name, that name follows after a colon."""
HISTORY = (
    *("env.frame_stack", "env.obs_history_length", "env.num_observation_history"),
    *("env.history_len", "env.include_history_steps"),
)
"""Names of the setting for the number of steps in the policy's observations, in various forks."""
ONE_STEP = ("env.num_one_step_observations", "env.num_single_obs", "env.num_one_step_obs")
"""Names of the setting for the number of the policy's observations in one step, in various forks."""

NEAR = {
    r"init_state\.(lin|ang)_vel$|env\.randomize_start_vel": "init_state.base_velocity is the range of random velocities",
    r"env\.rand(omize)?_.*yaw|terrain\.yaw_init_range": "init_state.yaw",
    r"terrain\.[xy]_init_range|env\.rand(omize_start)?_y": "terrain.spawn_range",
    r"domain_rand\..*(delay|lag|latency)|sensor\..*latency": "control.actuator.delay [physics steps], observations.delay",
    r"domain_rand\..*(force|disturbance)": "domain_rand.forces",
    r"domain_rand\..*push.*ang|domain_rand\.max_push_(vel_ang|torque)": "domain_rand.kicks (roll, pitch, yaw)",
    r"domain_rand\..*gravity": "domain_rand.ranges.gravity_x, gravity_y, gravity_z",
    r"domain_rand\..*(com_|_com|com$)": "domain_rand.ranges.base_com_x, base_com_y, base_com_z",
    r"domain_rand\..*armature": "domain_rand.ranges.joint_armature",
    r"domain_rand\..*joint_damping": "domain_rand.ranges.joint_damping",
    r"domain_rand\..*inertia": "domain_rand.ranges.link_mass scales masses and inertias together",
    r"domain_rand\..*strength|domain_rand\..*torque": "domain_rand.ranges.motor_strength",
    r"domain_rand\..*(kp|stiffness)": "domain_rand.ranges.p_gain",
    r"domain_rand\..*(kd|damping)": "domain_rand.ranges.d_gain",
    r"domain_rand\..*(motor_offset|joint_offset|dof_pos)": "domain_rand.ranges.joint_offset, init_state.dof_pos_factor",
    r"commands\..*(clip|cutoff|min_norm)": "commands.small_command",
    r"commands\..*(curriculum|max_)": "commands.ranges with commands.curriculum",
    r"commands\.num_commands": "commands here are vx, vy, yaw rate and heading; others are tensors of your own class",
    r"rewards\..*terminal_body_height|termination\.z_low": "terminations.min_base_height",
    r"rewards\..*terminal_(body_ori|roll_pitch)|termination\.(roll|pitch)": "terminations.max_tilt",
    r"rewards\.sigma_rew_neg|rewards\.clip_": "rewards.only_positive_rewards",
    r"env\.(num_observations|num_privileged_obs)": "observations.groups",
    r"terrain\.(selected|terrain_kwargs|.*_kwargs)": "terrain.proportions and terrain.sizes choose types and their sizes",
    r"terrain\.restitution": "domain_rand.ranges.restitution",
    r"terrain\.static_friction": "the ground has no friction here; if friction is randomised, this value is averaged into"
    " domain_rand.friction_range",
    r"control\.use_actuator_network": "legged_gym's network file is not read, and the robot's gains replace it;"
    " control.actuator.network names a network from legged fit-actuator",
    r"asset\.fix_base_link": "the base of a legged robot floats here",
    r"asset\.disable_gravity": "gravity is never off",
    r"asset\.armature": "control.actuator.armature",
    r"asset\.dof_velocity_override": "velocity_limit of robot.yaml",
    r"asset\.(sdk_dof_range|collapse|.*_names?$)": "the robot's MJCF and robot.yaml",
    r"sim\.gravity": "gravity is 9.81 m/s^2 downward",
    r"sim\.substeps": "sim.dt is the step of the physics",
    r"runner\.(policy|algorithm)_class_name|runner_class_name": "train.policy, train.algorithm: networks and learner",
}
"""Pattern of a fork's setting -> the nearest setting of this package, or the reason why no setting is near."""
MINOR = (
    r"viewer\.|sim\.physx\.|sim\.(up_axis|use_gpu_pipeline|no_camera)|env\.(env_spacing|send_timeouts|num_actions|debug_viz)"
    r"|env\.record|env\.num_recording|terrain\.(vertical_scale|slope_tres?hold|dynamic_friction|simplify_grid|hf2mesh_method)"
    r"|asset\.(replace_cylinder|flip_visual|density|default_dof_drive|angular_damping|linear_damping|max_angular|max_linear"
    r"|thickness)|runner\.(resume|load_run|checkpoint|log_interval)|commands\.num_bins|depth\.|play\."
)
"""Settings of Isaac Gym, of drawing, and of the command line. They change no task of this package."""

OF_THE_ROBOT = (
    r"init_state\.(pos|rot|default_joint_angles)$|control\.(stiffness|damping|actuator_net_file)"
    r"|asset\.(file|name|foot_name|penalize_contacts_on|terminate_after_contacts_on)$"
)
"""Settings that go into robot.yaml, or into the task's control tables."""

TERRAINS = [
    *(["slope_up", "slope_down"], ["rough_slope_down"], ["stairs_up"], ["stairs_down"]),
    *(["obstacles"], ["stepping_stones"], ["gap"], ["pit"]),
]
"""Terrain types of this package for each entry of legged_gym's `terrain_proportions`."""
TERRAIN_FUNCTIONS = {
    "": ["flat"] * 3,
    "pyramid_sloped_terrain": ["slope_up", "flat", "slope_down"],
    "pyramid_sloped_terrain + random_uniform_terrain": ["rough_slope_up", "", "rough_slope_down"],
    "pyramid_stairs_terrain": ["stairs_up", "flat", "stairs_down"],
    **{f"{name}_terrain": [name] * 3 for name in ("stepping_stones", "gap", "pit")},
    "discrete_obstacles_terrain": ["obstacles"] * 3,
}
"""Isaac Gym's terrain functions -> terrain types of this package for a slope or step height that is negative, zero, and
positive. With a positive slope or step height, the middle of a tile is the highest part. Robots start there.
"""

PARTS = {
    **{name: {f"self.{name}"} for name in ("base_lin_vel", "base_ang_vel", "projected_gravity", "dof_vel", "actions")},
    "commands": {"self.commands[:, :3]"},
    "dof_pos": {"self.dof_pos", "self.default_dof_pos"},
    "heights": {"torch.clip", "self.root_states[:, 2].unsqueeze", "1", "0.5", "self.measured_heights", "-1", "1.0"},
}
"""Observation term of this package -> names and numbers in a fork's formula for the same values, without scales."""
