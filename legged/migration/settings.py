"""Settings of legged_gym -> settings here, with conversions of their values."""

SAME: dict[str, str] = {
    "env.num_envs": "env.num_envs",
    "env.episode_length_s": "env.episode_length_s",
    "commands.resampling_time": "commands.resampling_time_s",
    "commands.heading_command": "commands.heading_command",
    "commands.ranges.lin_vel_x": "commands.ranges.lin_vel_x",
    "commands.ranges.lin_vel_y": "commands.ranges.lin_vel_y",
    "commands.ranges.ang_vel_yaw": "commands.ranges.ang_vel_yaw",
    "commands.ranges.heading": "commands.ranges.heading",
    "control.control_type": "control.control_type",
    "control.action_scale": "control.action_scale",
    "control.decimation": "control.decimation",
    "domain_rand.randomize_friction": "domain_rand.randomize_friction",
    "domain_rand.randomize_base_mass": "domain_rand.randomize_base_mass",
    "domain_rand.added_mass_range": "domain_rand.added_mass_range",
    "domain_rand.randomize_payload_mass": "domain_rand.randomize_base_mass",
    "domain_rand.payload_mass_range": "domain_rand.added_mass_range",
    "domain_rand.push_robots": "domain_rand.push_robots",
    "domain_rand.push_interval_s": "domain_rand.push_interval_s",
    "domain_rand.max_push_vel_xy": "domain_rand.max_push_vel_xy",
    "rewards.only_positive_rewards": "rewards.only_positive_rewards",
    "rewards.tracking_sigma": "rewards.tracking_sigma",
    "rewards.soft_dof_pos_limit": "rewards.soft_dof_pos_limit",
    "rewards.soft_dof_vel_limit": "rewards.soft_dof_vel_limit",
    "rewards.soft_torque_limit": "rewards.soft_torque_limit",
    "rewards.base_height_target": "rewards.base_height_target",
    "rewards.max_contact_force": "rewards.max_contact_force",
    "normalization.clip_observations": "observations.clip",
    "normalization.clip_actions": "control.clip_actions",
    "normalization.obs_scales.lin_vel": "observations.scales.base_lin_vel",
    "normalization.obs_scales.ang_vel": "observations.scales.base_ang_vel",
    "normalization.obs_scales.dof_pos": "observations.scales.dof_pos",
    "normalization.obs_scales.dof_vel": "observations.scales.dof_vel",
    "normalization.obs_scales.height_measurements": "observations.scales.heights",
    "noise.add_noise": "observations.add_noise",
    "noise.noise_level": "observations.noise_level",
    "noise.noise_scales.lin_vel": "observations.noise.base_lin_vel",
    "noise.noise_scales.ang_vel": "observations.noise.base_ang_vel",
    "noise.noise_scales.gravity": "observations.noise.projected_gravity",
    "noise.noise_scales.dof_pos": "observations.noise.dof_pos",
    "noise.noise_scales.dof_vel": "observations.noise.dof_vel",
    "noise.noise_scales.height_measurements": "observations.noise.heights",
    "sim.dt": "sim.dt",
}
"""Setting of an environment's configuration -> setting here of the same meaning."""

OF_TERRAIN: dict[str, str] = {
    f"terrain.{name}": f"terrain.{name}"
    for name in (
        "horizontal_scale",
        "border_size",
        "curriculum",
        "max_init_terrain_level",
        "terrain_length",
        "terrain_width",
        "num_rows",
        "num_cols",
    )
}
"""Settings of terrain that is not a plane -> setting here of the same meaning."""
OF_HEIGHTS = {f"terrain.{name}": f"terrain.{name}" for name in ("measured_points_x", "measured_points_y")}
"""Settings of measured heights -> setting here of the same meaning."""

OF_LEARNING: dict[str, str] = {
    "seed": "env.seed",
    "policy.init_noise_std": "train.policy.init_noise_std",
    "policy.actor_hidden_dims": "train.policy.actor_hidden_dims",
    "policy.critic_hidden_dims": "train.policy.critic_hidden_dims",
    "policy.activation": "train.policy.activation",
    **{
        f"algorithm.{name}": f"train.algorithm.{name}"
        for name in (
            "value_loss_coef",
            "use_clipped_value_loss",
            "clip_param",
            "entropy_coef",
            "num_learning_epochs",
            "num_mini_batches",
            "learning_rate",
            "schedule",
            "gamma",
            "lam",
            "desired_kl",
            "max_grad_norm",
        )
    },
    **{
        f"runner.{name}": f"train.runner.{name}"
        for name in ("num_steps_per_env", "max_iterations", "save_interval", "experiment_name", "run_name")
    },
}
"""Setting of a learner's configuration -> setting here."""
OF_RECURRENT = {
    "policy.rnn_type": "train.policy.rnn_type",
    "policy.rnn_hidden_size": "train.policy.rnn_hidden_dim",
    "policy.rnn_num_layers": "train.policy.rnn_num_layers",
}
"""Settings of recurrent policies (`runner.policy_class_name`) -> setting here of the same meaning."""

TERRAINS: tuple[dict[str, float], ...] = (
    {"slope_up": 0.5, "slope_down": 0.5},
    {"rough_slope_down": 1.0},
    {"stairs_up": 1.0},
    {"stairs_down": 1.0},
    {"obstacles": 1.0},
    {"stepping_stones": 1.0},
    {"gap": 1.0},
    {"pit": 1.0},
)
"""Meaning of each entry of `terrain_proportions`: terrain type here -> its part of that entry."""

REWARDS = {"feet_stumble": "stumble"}
"""Reward of legged_gym -> its name here. In legged_gym the scale of that name has no method, so it has no effect."""
SAME_REWARDS = {
    *("action_rate", "ang_vel_xy", "base_height", "collision", "dof_acc", "dof_pos_limits", "dof_vel", "dof_vel_limits"),
    *("feet_air_time", "feet_contact_forces", "lin_vel_z", "no_fly", "orientation", "stand_still", "stumble", "termination"),
    *("torque_limits", "torques", "tracking_ang_vel", "tracking_lin_vel"),
}
"""Rewards of legged_gym (v1.0.2) that exist here; a reward of another name has a formula of the fork's own."""

_DRAWING = "play.py and its window have a camera of their own"
_PHYSX = "PhysX's own; the contact solver's settings here are sim.iterations, sim.cone, sim.impratio and the like"
_MODEL = "the robot's MJCF says it"
_FLAGS = "an option of legged train: --resume, --load-run, --checkpoint"
ELSEWHERE: dict[str, str] = {
    "env.env_spacing": "on a plane robots do not see each other, and all stand at its origin",
    "env.send_timeouts": "the learner always bootstraps what time-outs cut off",
    "env.num_actions": "the robot's MJCF has so many motors as there are actions",
    "terrain.vertical_scale": "heights are not rounded here",
    "terrain.slope_treshold": "stairs have vertical faces here, slopes never (terrain.slope_threshold)",
    "terrain.slope_threshold": "stairs have vertical faces here, slopes never (terrain.slope_threshold)",
    "terrain.static_friction": "contacts have the friction of the robot's shapes here, averaged with it where it is mapped",
    "terrain.dynamic_friction": "MuJoCo has one coefficient of friction",
    "terrain.restitution": "MuJoCo's contacts have none of their own",
    "terrain.selected": "terrain.proportions and terrain.sizes choose one type and its size here",
    "terrain.terrain_kwargs": "terrain.proportions and terrain.sizes choose one type and its size here",
    "commands.num_commands": "commands here are vx, vy, yaw rate and heading; others are tensors of your own class",
    "init_state.lin_vel": "init_state.base_velocity is the range from which it is drawn",
    "init_state.ang_vel": "init_state.base_velocity is the range from which it is drawn",
    "control.use_actuator_network": "legged_gym's file is not read, and the robot's gains stand for it;"
    " control.actuator.network names one that legged fit-actuator has fitted",
    "asset.fix_base_link": "the base of a legged robot floats here",
    "asset.disable_gravity": "gravity is never off",
    "asset.collapse_fixed_joints": _MODEL,
    "asset.replace_cylinder_with_capsule": _MODEL,
    "asset.flip_visual_attachments": _MODEL,
    "asset.armature": f"{_MODEL}; control.actuator.armature sets another one",
    "asset.density": _MODEL,
    "asset.default_dof_drive_mode": "control.control_type says what drives the joints",
    "asset.angular_damping": _PHYSX,
    "asset.linear_damping": _PHYSX,
    "asset.max_angular_velocity": _PHYSX,
    "asset.max_linear_velocity": _PHYSX,
    "asset.thickness": _PHYSX,
    "sim.substeps": "sim.dt is the step of the physics",
    "sim.gravity": "it is 9.81 m/s^2 downward",
    "sim.up_axis": "z is up",
    "runner.resume": _FLAGS,
    "runner.load_run": _FLAGS,
    "runner.checkpoint": _FLAGS,
    "runner.resume_path": _FLAGS,
}
"""Setting without counterpart here -> the reason."""
SECTIONS_ELSEWHERE = {
    "viewer.": _DRAWING,
    "sim.physx.": _PHYSX,
    "domain_rand.": "domain_rand.ranges draws of the model what docs/randomisation.md lists",
}
"""Sections without counterpart here -> the reason, for all settings whose path begins so."""

OF_THE_ROBOT = (
    "init_state.pos",
    "init_state.rot",
    "init_state.default_joint_angles",
    "control.stiffness",
    "control.damping",
    "control.actuator_net_file",
    "asset.file",
    "asset.name",
    "asset.foot_name",
    "asset.penalize_contacts_on",
    "asset.terminate_after_contacts_on",
)
"""Settings that go into robot.yaml, or into the task's control tables."""
