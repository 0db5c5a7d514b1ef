"""Tables of legged_gym's settings, and of its forks', and of the settings here."""


def _each(theirs: str, ours: str, names: str) -> dict[str, str]:
    return {f"{theirs}.{name}": f"{ours}.{name}" for name in names.split()}


MOVED = {
    "reward_scales.": "rewards.scales.",
    "obs_scales.": "normalization.obs_scales.",
    "noise_scales.": "noise.noise_scales.",
    "commands.lin_vel_x": "commands.ranges.lin_vel_x",
    "commands.lin_vel_y": "commands.ranges.lin_vel_y",
    "commands.ang_vel_yaw": "commands.ranges.ang_vel_yaw",
    "commands.heading": "commands.ranges.heading",
}
"""Beginning of a setting's path in a fork, or a whole path without a dot at its end -> legged_gym's path."""

SAME: dict[str, str] = {
    **_each("env", "env", "num_envs episode_length_s"),
    "commands.resampling_time": "commands.resampling_time_s",
    "commands.heading_command": "commands.heading_command",
    **_each("commands.ranges", "commands.ranges", "lin_vel_x lin_vel_y ang_vel_yaw heading"),
    **_each("control", "control", "control_type action_scale decimation"),
    **_each("domain_rand", "domain_rand", "randomize_friction randomize_base_mass added_mass_range"),
    "domain_rand.randomize_payload_mass": "domain_rand.randomize_base_mass",
    "domain_rand.payload_mass_range": "domain_rand.added_mass_range",
    **_each("domain_rand", "domain_rand", "push_robots push_interval_s max_push_vel_xy"),
    **_each("rewards", "rewards", "only_positive_rewards soft_dof_pos_limit soft_dof_vel_limit soft_torque_limit"),
    **_each("rewards", "rewards", "base_height_target max_contact_force"),
    "normalization.clip_observations": "observations.clip",
    "normalization.clip_actions": "control.clip_actions",
    "noise.add_noise": "observations.add_noise",
    "noise.noise_level": "observations.noise_level",
    "noise.noise_scales.gravity": "observations.noise.projected_gravity",
    **{
        f"{section}.{theirs}": f"observations.{kind}.{ours}"
        for section, kind in (("normalization.obs_scales", "scales"), ("noise.noise_scales", "noise"))
        for theirs, ours in (
            ("lin_vel", "base_lin_vel"),
            ("ang_vel", "base_ang_vel"),
            ("dof_pos", "dof_pos"),
            ("dof_vel", "dof_vel"),
            ("height_measurements", "heights"),
        )
    },
    "sim.dt": "sim.dt",
    "domain_rand.init_dof_pos_ratio_range": "init_state.dof_pos_factor",
    "domain_rand.init_base_vel_range": "init_state.base_velocity",
    "commands.zero_command_prob": "commands.standing_share",
}
"""Setting of an environment's configuration -> setting here of the same meaning."""
ABSENT = {
    "domain_rand.randomize_friction": False,
    "domain_rand.push_robots": False,
    "rewards.only_positive_rewards": False,
    "noise.add_noise": False,
    "commands.heading_command": False,
    "commands.ranges.lin_vel_x": [0.0, 0.0],
    "commands.ranges.lin_vel_y": [0.0, 0.0],
    "commands.ranges.ang_vel_yaw": [0.0, 0.0],
    **{f"noise.noise_scales.{name}": 0.0 for name in ("gravity", "lin_vel", "ang_vel", "dof_pos", "dof_vel")},
}
"""Setting -> value that it has here if a fork has no such setting. The defaults here would add what the fork does not do."""

OF_TERRAIN = _each(
    "terrain",
    "terrain",
    "horizontal_scale border_size curriculum max_init_terrain_level terrain_length terrain_width num_rows num_cols",
)
"""More such settings, for ground that is not a plane; then those of measured heights."""
OF_HEIGHTS = _each("terrain", "terrain", "measured_points_x measured_points_y")
OF_LEARNING: dict[str, str] = {
    "seed": "env.seed",
    **_each("policy", "train.policy", "init_noise_std actor_hidden_dims critic_hidden_dims activation"),
    **_each("algorithm", "train.algorithm", "value_loss_coef use_clipped_value_loss clip_param entropy_coef gamma lam"),
    **_each("algorithm", "train.algorithm", "num_learning_epochs num_mini_batches learning_rate schedule desired_kl"),
    "algorithm.max_grad_norm": "train.algorithm.max_grad_norm",
    **_each("runner", "train.runner", "num_steps_per_env max_iterations save_interval experiment_name run_name"),
}
"""Setting of a learner's configuration -> setting here."""
OF_RECURRENT = {
    "policy.rnn_type": "train.policy.rnn_type",
    "policy.rnn_hidden_size": "train.policy.rnn_hidden_dim",
    "policy.rnn_num_layers": "train.policy.rnn_num_layers",
}
"""More such settings, if `runner.policy_class_name` is recurrent."""

RANDOM_MODEL = (
    ("link_mass", "link_mass_range", ("link_mass",)),
    ("restitution", "restitution_range", ("restitution",)),
    ("motor_strength", "motor_strength_range", ("motor_strength",)),
    ("motor", "motor_strength_range", ("motor_strength",)),
    ("motor_torque", "randomize_motor_torque_range", ("motor_strength",)),
    ("com_displacement", "com_displacement_range", ("base_com_x", "base_com_y", "base_com_z")),
    ("base_com", "added_com_range", ("base_com_x", "base_com_y", "base_com_z")),
    *(
        entry
        for theirs, ours in (("kp", "p_gain"), ("kd", "d_gain"))
        for name in (theirs, theirs.capitalize(), f"{theirs.capitalize()}_factor")
        for entry in ((name, f"{name}_range", (ours,)), (name, f"randomize_{name}_range", (ours,)))
    ),
    ("gains", "stiffness_multiplier_range", ("p_gain",)),
    ("gains", "damping_multiplier_range", ("d_gain",)),
    ("motor_offset", "motor_offset_range", ("joint_offset",)),
    ("default_dof_pos", "randomize_default_dof_pos_range", ("joint_offset",)),
    ("joint_friction", "joint_friction_range", ("joint_friction",)),
    ("initial_joint_pos", "initial_joint_pos_range", ("init_state.dof_pos_factor",)),
)
"""Randomised properties of forks: randomize_<first> switches on the range <second>; the third are the properties or settings
here."""
OFFSET = "joint_offset"
"""Property here that is added to the measured angle. A fork's offset is added to the target, so its sign is the other one."""
HISTORY = ("frame_stack", "obs_history_length", "num_observation_history", "history_len", "include_history_steps")
"""Settings of `env`: number of steps of the policy's observations."""
ONE_STEP = ("num_one_step_observations", "num_single_obs", "num_one_step_obs")
"""Settings of `env`: number of the policy's observations in one step."""

NEAR = {
    r"init_state\.(lin|ang)_vel$|env\.randomize_start_vel": "init_state.base_velocity is the range that it is drawn from",
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
    r"terrain\.static_friction": "contacts have the friction of the robot's shapes here, averaged with it where it is mapped",
    r"control\.use_actuator_network": "legged_gym's file is not read, and the robot's gains stand for it;"
    " control.actuator.network names one that legged fit-actuator has fitted",
    r"asset\.fix_base_link": "the base of a legged robot floats here",
    r"asset\.disable_gravity": "gravity is never off",
    r"asset\.armature": "control.actuator.armature",
    r"asset\.dof_velocity_override": "velocity_limit of robot.yaml",
    r"asset\.(sdk_dof_range|collapse|.*_names?$)": "the robot's MJCF and robot.yaml",
    r"sim\.gravity": "it is 9.81 m/s^2 downward",
    r"sim\.substeps": "sim.dt is the step of the physics",
    r"runner\.(policy|algorithm)_class_name|runner_class_name": "networks and learner are those of train",
}
"""Pattern of a fork's setting -> the nearest setting here, or why no setting here is near."""
MINOR = (
    r"viewer\.|sim\.physx\.|sim\.(up_axis|use_gpu_pipeline|no_camera)|env\.(env_spacing|send_timeouts|num_actions|debug_viz)"
    r"|env\.record|env\.num_recording|terrain\.(vertical_scale|slope_tres?hold|dynamic_friction|simplify_grid|hf2mesh_method)"
    r"|asset\.(replace_cylinder|flip_visual|density|default_dof_drive|angular_damping|linear_damping|max_angular|max_linear"
    r"|thickness)|runner\.(resume|load_run|checkpoint|log_interval)|commands\.num_bins|depth\.|play\."
)
"""Settings of Isaac Gym, of drawing, and of the command line, which change no task here."""

OF_THE_ROBOT = {
    *("init_state.pos", "init_state.rot", "init_state.default_joint_angles", "control.stiffness", "control.damping"),
    *("control.actuator_net_file", "asset.file", "asset.name", "asset.foot_name", "asset.penalize_contacts_on"),
    "asset.terminate_after_contacts_on",
}
"""Settings that go into robot.yaml, or into the task's control tables."""

TERRAINS = (
    {"slope_up": 0.5, "slope_down": 0.5},
    *({name: 1.0} for name in ("rough_slope_down", "stairs_up", "stairs_down", "obstacles", "stepping_stones", "gap", "pit")),
)
"""Meaning of each entry of legged_gym's `terrain_proportions`: terrain type here -> its part of that entry."""
TERRAIN_FUNCTIONS: dict[tuple[str, ...], tuple[str, str, str]] = {
    (): ("flat", "flat", "flat"),
    ("pyramid_sloped_terrain",): ("slope_up", "flat", "slope_down"),
    ("pyramid_sloped_terrain", "random_uniform_terrain"): ("rough_slope_up", "", "rough_slope_down"),
    ("pyramid_stairs_terrain",): ("stairs_up", "flat", "stairs_down"),
    **{(f"{name}_terrain",): (name,) * 3 for name in ("stepping_stones", "gap", "pit")},
    ("discrete_obstacles_terrain",): ("obstacles",) * 3,
}
"""Isaac Gym's terrain functions -> type here, for a negative, no, and a positive slope or height of steps. With a positive
one the middle of a tile, where robots start, is its highest part.
"""

PARTS = {
    "base_lin_vel": {"self.base_lin_vel"},
    "base_ang_vel": {"self.base_ang_vel"},
    "projected_gravity": {"self.projected_gravity"},
    "commands": {"self.commands[:, :3]"},
    "dof_pos": {"self.dof_pos", "self.default_dof_pos"},
    "dof_vel": {"self.dof_vel"},
    "actions": {"self.actions"},
    "heights": {"torch.clip", "self.root_states[:, 2].unsqueeze", "1", "0.5", "self.measured_heights", "-1", "1.0"},
}
"""Observation term here -> names and numbers, but for scales, from which a fork computes the same."""
