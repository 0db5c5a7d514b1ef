"""legged_gym v1.0.2: values of its configuration classes, so that files that extend them run without legged_gym, and digests
of its methods, by which `child.py` recognises them.
"""

from typing import Any

from legged.config.yaml_files import parse

KNOWN: dict[str, tuple[str, dict[str, Any]]] = parse(
    """
LeggedRobotCfg:
- ""
- env: {num_envs: 4096, num_observations: 235, num_privileged_obs: null, num_actions: 12, env_spacing: 3.0,
    send_timeouts: true, episode_length_s: 20}
  terrain: {mesh_type: trimesh, horizontal_scale: 0.1, vertical_scale: 0.005, border_size: 25, curriculum: true,
    static_friction: 1.0, dynamic_friction: 1.0, restitution: 0.0, measure_heights: true,
    measured_points_x: [-0.8, -0.7, -0.6, -0.5, -0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8],
    measured_points_y: [-0.5, -0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5], selected: false, terrain_kwargs: null,
    max_init_terrain_level: 5, terrain_length: 8.0, terrain_width: 8.0, num_rows: 10, num_cols: 20,
    terrain_proportions: [0.1, 0.1, 0.35, 0.25, 0.2], slope_treshold: 0.75}
  commands: {curriculum: false, max_curriculum: 1.0, num_commands: 4, resampling_time: 10.0, heading_command: true,
    ranges: {lin_vel_x: [-1.0, 1.0], lin_vel_y: [-1.0, 1.0], ang_vel_yaw: [-1.0, 1.0], heading: [-3.14, 3.14]}}
  init_state: {pos: [0.0, 0.0, 1.0], rot: [0.0, 0.0, 0.0, 1.0], lin_vel: [0.0, 0.0, 0.0], ang_vel: [0.0, 0.0, 0.0],
    default_joint_angles: {}}
  control: {control_type: P, stiffness: {}, damping: {}, action_scale: 0.5, decimation: 4}
  asset: {file: "", name: legged_robot, foot_name: None, penalize_contacts_on: [], terminate_after_contacts_on: [],
    disable_gravity: false, collapse_fixed_joints: true, fix_base_link: false, default_dof_drive_mode: 3,
    self_collisions: 0, replace_cylinder_with_capsule: true, flip_visual_attachments: true, density: 0.001,
    angular_damping: 0.0, linear_damping: 0.0, max_angular_velocity: 1000.0, max_linear_velocity: 1000.0, armature: 0.0,
    thickness: 0.01}
  domain_rand: {randomize_friction: true, friction_range: [0.5, 1.25], randomize_base_mass: false,
    added_mass_range: [-1.0, 1.0], push_robots: true, push_interval_s: 15, max_push_vel_xy: 1.0}
  rewards: {only_positive_rewards: true, tracking_sigma: 0.25, soft_dof_pos_limit: 1.0, soft_dof_vel_limit: 1.0,
    soft_torque_limit: 1.0, base_height_target: 1.0, max_contact_force: 100.0,
    scales: {termination: 0.0, tracking_lin_vel: 1.0, tracking_ang_vel: 0.5, lin_vel_z: -2.0, ang_vel_xy: -0.05,
      orientation: 0.0, torques: -0.00001, dof_vel: 0.0, dof_acc: -2.5e-7, base_height: 0.0, feet_air_time: 1.0,
      collision: -1.0, feet_stumble: 0.0, action_rate: -0.01, stand_still: 0.0}}
  normalization: {clip_observations: 100.0, clip_actions: 100.0,
    obs_scales: {lin_vel: 2.0, ang_vel: 0.25, dof_pos: 1.0, dof_vel: 0.05, height_measurements: 5.0}}
  noise: {add_noise: true, noise_level: 1.0,
    noise_scales: {dof_pos: 0.01, dof_vel: 1.5, lin_vel: 0.1, ang_vel: 0.2, gravity: 0.05, height_measurements: 0.1}}
  viewer: {ref_env: 0, pos: [10, 0, 6], lookat: [11.0, 5, 3.0]}
  sim: {dt: 0.005, substeps: 1, gravity: [0.0, 0.0, -9.81], up_axis: 1,
    physx: {num_threads: 10, solver_type: 1, num_position_iterations: 4, num_velocity_iterations: 0, contact_offset: 0.01,
      rest_offset: 0.0, bounce_threshold_velocity: 0.5, max_depenetration_velocity: 1.0, max_gpu_contact_pairs: 8388608,
      default_buffer_size_multiplier: 5, contact_collection: 2}}
LeggedRobotCfgPPO:
- ""
- seed: 1
  runner_class_name: OnPolicyRunner
  policy: {init_noise_std: 1.0, actor_hidden_dims: [512, 256, 128], critic_hidden_dims: [512, 256, 128], activation: elu}
  algorithm: {value_loss_coef: 1.0, use_clipped_value_loss: true, clip_param: 0.2, entropy_coef: 0.01,
    num_learning_epochs: 5, num_mini_batches: 4, learning_rate: 0.001, schedule: adaptive, gamma: 0.99, lam: 0.95,
    desired_kl: 0.01, max_grad_norm: 1.0}
  runner: {policy_class_name: ActorCritic, algorithm_class_name: PPO, num_steps_per_env: 24, max_iterations: 1500,
    save_interval: 50, experiment_name: test, run_name: "", resume: false, load_run: -1, checkpoint: -1, resume_path: null}
AnymalCRoughCfg:
- LeggedRobotCfg
- init_state: {pos: [0.0, 0.0, 0.6],
    default_joint_angles: {LF_HAA: 0.0, LH_HAA: 0.0, RF_HAA: 0.0, RH_HAA: 0.0, LF_HFE: 0.4, LH_HFE: -0.4, RF_HFE: 0.4,
      RH_HFE: -0.4, LF_KFE: -0.8, LH_KFE: 0.8, RF_KFE: -0.8, RH_KFE: 0.8}}
  control: {stiffness: {HAA: 80.0, HFE: 80.0, KFE: 80.0}, damping: {HAA: 2.0, HFE: 2.0, KFE: 2.0},
    use_actuator_network: true, actuator_net_file: "{LEGGED_GYM_ROOT_DIR}/resources/actuator_nets/anydrive_v3_lstm.pt"}
  asset: {file: "{LEGGED_GYM_ROOT_DIR}/resources/robots/anymal_c/urdf/anymal_c.urdf", name: anymal_c, foot_name: FOOT,
    penalize_contacts_on: [SHANK, THIGH], terminate_after_contacts_on: [base], self_collisions: 1}
  domain_rand: {randomize_base_mass: true, added_mass_range: [-5.0, 5.0]}
  rewards: {base_height_target: 0.5, max_contact_force: 500.0}
AnymalCRoughCfgPPO:
- LeggedRobotCfgPPO
- runner: {experiment_name: rough_anymal_c}
A1RoughCfg:
- LeggedRobotCfg
- init_state: {pos: [0.0, 0.0, 0.42],
    default_joint_angles: {FL_hip_joint: 0.1, RL_hip_joint: 0.1, FR_hip_joint: -0.1, RR_hip_joint: -0.1,
      FL_thigh_joint: 0.8, RL_thigh_joint: 1.0, FR_thigh_joint: 0.8, RR_thigh_joint: 1.0, FL_calf_joint: -1.5,
      RL_calf_joint: -1.5, FR_calf_joint: -1.5, RR_calf_joint: -1.5}}
  control: {stiffness: {joint: 20.0}, damping: {joint: 0.5}, action_scale: 0.25}
  asset: {file: "{LEGGED_GYM_ROOT_DIR}/resources/robots/a1/urdf/a1.urdf", name: a1, foot_name: foot,
    penalize_contacts_on: [thigh, calf], terminate_after_contacts_on: [base], self_collisions: 1}
  rewards: {soft_dof_pos_limit: 0.9, base_height_target: 0.25, scales: {torques: -0.0002, dof_pos_limits: -10.0}}
A1RoughCfgPPO:
- LeggedRobotCfgPPO
- runner: {experiment_name: rough_a1}
""",
    "legged_gym's defaults",
)
"""Class -> its base class, and the values that it changes."""
DEFAULTS = KNOWN["LeggedRobotCfg"][1] | KNOWN["LeggedRobotCfgPPO"][1]
"""Values of the two base classes."""

LEFT_OUT: dict[str, dict[str, Any]] = parse(
    """
policy: {init_noise_std: 1.0, actor_hidden_dims: [256, 256, 256], critic_hidden_dims: [256, 256, 256], activation: elu}
algorithm: {value_loss_coef: 1.0, use_clipped_value_loss: true, clip_param: 0.2, entropy_coef: 0.0, num_learning_epochs: 1,
  num_mini_batches: 1, learning_rate: 0.001, schedule: fixed, gamma: 0.998, lam: 0.95, desired_kl: 0.01, max_grad_norm: 1.0}
""",
    "rsl_rl's defaults",
)
"""Defaults of rsl_rl (v1.0.2) for settings that are missing in a section without base class."""

DIGESTS: dict[str, str] = parse(
    """{
  compute_observations: 1953807c49, check_termination: 9c8403c5f0, _compute_torques: ee0fdf72c9,
  _resample_commands: 804ff386bf, _reset_dofs: b547a32c83, _reset_root_states: 360ef0ee7c, _push_robots: caffd10a86,
  _process_rigid_shape_props: 905c308373, _process_rigid_body_props: 5806bc4f9f, _post_physics_step_callback: 6e6dd517ce,
  update_command_curriculum: a920085e37, _update_terrain_curriculum: f651954ab5, _get_heights: 263469215b,
  _reward_lin_vel_z: c2a2287d80, _reward_ang_vel_xy: 1e24c2a235, _reward_orientation: 1b80541e12,
  _reward_base_height: 57f11d28aa, _reward_torques: dd08be1120, _reward_dof_vel: 32f4ab754e, _reward_dof_acc: 5b45086bd3,
  _reward_action_rate: 5956398c61, _reward_collision: 82d624d144, _reward_termination: be8c5f2e1f,
  _reward_dof_pos_limits: e9d8a70ad2, _reward_dof_vel_limits: bdafcc8802, _reward_torque_limits: ec651eb438,
  _reward_tracking_lin_vel: a6b729d6aa, _reward_tracking_ang_vel: 78c25d96b7, _reward_feet_air_time: 5eece809cb,
  _reward_stumble: 96fd1ee4f4, _reward_stand_still: 2535ce36ac, _reward_feet_contact_forces: c3b8a19aaa,
  _reward_no_fly: 09d8ca2a11
}""",
    "digests",
)
"""Method of legged_gym -> digest of its syntax tree (`child.digest`). Names alone say nothing of a fork's formulas."""
