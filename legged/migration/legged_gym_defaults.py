"""Values of legged_gym's configuration classes (v1.0.2), so that files which extend them can be read without legged_gym."""

from collections.abc import Mapping
from typing import Any

from legged.migration.found import MEMBER_OF, Found, Place

GRID_X = [round(0.1 * i - 0.8, 1) for i in range(17)]
GRID_Y = [round(0.1 * i - 0.5, 1) for i in range(11)]

ENVIRONMENT: dict[str, Any] = {
    "env": {
        "num_envs": 4096,
        "num_observations": 235,
        "num_privileged_obs": None,
        "num_actions": 12,
        "env_spacing": 3.0,
        "send_timeouts": True,
        "episode_length_s": 20,
    },
    "terrain": {
        "mesh_type": "trimesh",
        "horizontal_scale": 0.1,
        "vertical_scale": 0.005,
        "border_size": 25,
        "curriculum": True,
        "static_friction": 1.0,
        "dynamic_friction": 1.0,
        "restitution": 0.0,
        "measure_heights": True,
        "measured_points_x": GRID_X,
        "measured_points_y": GRID_Y,
        "selected": False,
        "terrain_kwargs": None,
        "max_init_terrain_level": 5,
        "terrain_length": 8.0,
        "terrain_width": 8.0,
        "num_rows": 10,
        "num_cols": 20,
        "terrain_proportions": [0.1, 0.1, 0.35, 0.25, 0.2],
        "slope_treshold": 0.75,
    },
    "commands": {
        "curriculum": False,
        "max_curriculum": 1.0,
        "num_commands": 4,
        "resampling_time": 10.0,
        "heading_command": True,
        "ranges": {
            "lin_vel_x": [-1.0, 1.0],
            "lin_vel_y": [-1.0, 1.0],
            "ang_vel_yaw": [-1.0, 1.0],
            "heading": [-3.14, 3.14],
        },
    },
    "init_state": {
        "pos": [0.0, 0.0, 1.0],
        "rot": [0.0, 0.0, 0.0, 1.0],
        "lin_vel": [0.0, 0.0, 0.0],
        "ang_vel": [0.0, 0.0, 0.0],
        "default_joint_angles": {},
    },
    "control": {"control_type": "P", "stiffness": {}, "damping": {}, "action_scale": 0.5, "decimation": 4},
    "asset": {
        "file": "",
        "name": "legged_robot",
        "foot_name": "None",
        "penalize_contacts_on": [],
        "terminate_after_contacts_on": [],
        "disable_gravity": False,
        "collapse_fixed_joints": True,
        "fix_base_link": False,
        "default_dof_drive_mode": 3,
        "self_collisions": 0,
        "replace_cylinder_with_capsule": True,
        "flip_visual_attachments": True,
        "density": 0.001,
        "angular_damping": 0.0,
        "linear_damping": 0.0,
        "max_angular_velocity": 1000.0,
        "max_linear_velocity": 1000.0,
        "armature": 0.0,
        "thickness": 0.01,
    },
    "domain_rand": {
        "randomize_friction": True,
        "friction_range": [0.5, 1.25],
        "randomize_base_mass": False,
        "added_mass_range": [-1.0, 1.0],
        "push_robots": True,
        "push_interval_s": 15,
        "max_push_vel_xy": 1.0,
    },
    "rewards": {
        "scales": {
            "termination": 0.0,
            "tracking_lin_vel": 1.0,
            "tracking_ang_vel": 0.5,
            "lin_vel_z": -2.0,
            "ang_vel_xy": -0.05,
            "orientation": 0.0,
            "torques": -1e-5,
            "dof_vel": 0.0,
            "dof_acc": -2.5e-7,
            "base_height": 0.0,
            "feet_air_time": 1.0,
            "collision": -1.0,
            "feet_stumble": 0.0,
            "action_rate": -0.01,
            "stand_still": 0.0,
        },
        "only_positive_rewards": True,
        "tracking_sigma": 0.25,
        "soft_dof_pos_limit": 1.0,
        "soft_dof_vel_limit": 1.0,
        "soft_torque_limit": 1.0,
        "base_height_target": 1.0,
        "max_contact_force": 100.0,
    },
    "normalization": {
        "obs_scales": {"lin_vel": 2.0, "ang_vel": 0.25, "dof_pos": 1.0, "dof_vel": 0.05, "height_measurements": 5.0},
        "clip_observations": 100.0,
        "clip_actions": 100.0,
    },
    "noise": {
        "add_noise": True,
        "noise_level": 1.0,
        "noise_scales": {
            "dof_pos": 0.01,
            "dof_vel": 1.5,
            "lin_vel": 0.1,
            "ang_vel": 0.2,
            "gravity": 0.05,
            "height_measurements": 0.1,
        },
    },
    "viewer": {"ref_env": 0, "pos": [10, 0, 6], "lookat": [11.0, 5, 3.0]},
    "sim": {
        "dt": 0.005,
        "substeps": 1,
        "gravity": [0.0, 0.0, -9.81],
        "up_axis": 1,
        "physx": {
            "num_threads": 10,
            "solver_type": 1,
            "num_position_iterations": 4,
            "num_velocity_iterations": 0,
            "contact_offset": 0.01,
            "rest_offset": 0.0,
            "bounce_threshold_velocity": 0.5,
            "max_depenetration_velocity": 1.0,
            "max_gpu_contact_pairs": 2**23,
            "default_buffer_size_multiplier": 5,
            "contact_collection": 2,
        },
    },
}
"""Values of LeggedRobotCfg."""

LEARNING: dict[str, Any] = {
    "seed": 1,
    "runner_class_name": "OnPolicyRunner",
    "policy": {
        "init_noise_std": 1.0,
        "actor_hidden_dims": [512, 256, 128],
        "critic_hidden_dims": [512, 256, 128],
        "activation": "elu",
    },
    "algorithm": {
        "value_loss_coef": 1.0,
        "use_clipped_value_loss": True,
        "clip_param": 0.2,
        "entropy_coef": 0.01,
        "num_learning_epochs": 5,
        "num_mini_batches": 4,
        "learning_rate": 1e-3,
        "schedule": "adaptive",
        "gamma": 0.99,
        "lam": 0.95,
        "desired_kl": 0.01,
        "max_grad_norm": 1.0,
    },
    "runner": {
        "policy_class_name": "ActorCritic",
        "algorithm_class_name": "PPO",
        "num_steps_per_env": 24,
        "max_iterations": 1500,
        "save_interval": 50,
        "experiment_name": "test",
        "run_name": "",
        "resume": False,
        "load_run": -1,
        "checkpoint": -1,
        "resume_path": None,
    },
}
"""Values of LeggedRobotCfgPPO."""

LEFT_OUT: dict[str, dict[str, Any]] = {
    "policy": {
        "init_noise_std": 1.0,
        "actor_hidden_dims": [256, 256, 256],
        "critic_hidden_dims": [256, 256, 256],
        "activation": "elu",
    },
    "algorithm": {
        "value_loss_coef": 1.0,
        "use_clipped_value_loss": True,
        "clip_param": 0.2,
        "entropy_coef": 0.0,
        "num_learning_epochs": 1,
        "num_mini_batches": 1,
        "learning_rate": 1e-3,
        "schedule": "fixed",
        "gamma": 0.998,
        "lam": 0.95,
        "desired_kl": 0.01,
        "max_grad_norm": 1.0,
    },
}
"""Defaults of rsl_rl (v1.0.2) for settings that are missing in a section without base class."""


def _angles(haa: float, front_hfe: float) -> dict[str, float]:
    """Return ANYmal's default pose, in which the hind legs mirror the front ones [rad]."""
    legs = (("LF", 1), ("LH", -1), ("RF", 1), ("RH", -1))
    joints = (("HAA", haa, False), ("HFE", front_hfe, True), ("KFE", -2.0 * front_hfe, True))
    return {f"{leg}_{joint}": angle * (sign if turns else 1) for joint, angle, turns in joints for leg, sign in legs}


ROBOT = "{LEGGED_GYM_ROOT_DIR}/resources/robots"
KNOWN: dict[str, tuple[str, Mapping[str, Any]]] = {
    "LeggedRobotCfg": ("", ENVIRONMENT),
    "LeggedRobotCfgPPO": ("", LEARNING),
    "AnymalCRoughCfg": (
        "LeggedRobotCfg",
        {
            "init_state": {"pos": [0.0, 0.0, 0.6], "default_joint_angles": _angles(0.0, 0.4)},
            "control": {
                "stiffness": dict.fromkeys(("HAA", "HFE", "KFE"), 80.0),
                "damping": dict.fromkeys(("HAA", "HFE", "KFE"), 2.0),
                "use_actuator_network": True,
                "actuator_net_file": "{LEGGED_GYM_ROOT_DIR}/resources/actuator_nets/anydrive_v3_lstm.pt",
            },
            "asset": {
                "file": f"{ROBOT}/anymal_c/urdf/anymal_c.urdf",
                "name": "anymal_c",
                "foot_name": "FOOT",
                "penalize_contacts_on": ["SHANK", "THIGH"],
                "terminate_after_contacts_on": ["base"],
                "self_collisions": 1,
            },
            "domain_rand": {"randomize_base_mass": True, "added_mass_range": [-5.0, 5.0]},
            "rewards": {"base_height_target": 0.5, "max_contact_force": 500.0},
        },
    ),
    "AnymalCRoughCfgPPO": ("LeggedRobotCfgPPO", {"runner": {"experiment_name": "rough_anymal_c"}}),
    "A1RoughCfg": (
        "LeggedRobotCfg",
        {
            "init_state": {
                "pos": [0.0, 0.0, 0.42],
                "default_joint_angles": {
                    **{f"{leg}_hip_joint": angle for leg, angle in (("FL", 0.1), ("RL", 0.1), ("FR", -0.1), ("RR", -0.1))},
                    **{f"{leg}_thigh_joint": angle for leg, angle in (("FL", 0.8), ("RL", 1.0), ("FR", 0.8), ("RR", 1.0))},
                    **{f"{leg}_calf_joint": -1.5 for leg in ("FL", "RL", "FR", "RR")},
                },
            },
            "control": {"stiffness": {"joint": 20.0}, "damping": {"joint": 0.5}, "action_scale": 0.25},
            "asset": {
                "file": f"{ROBOT}/a1/urdf/a1.urdf",
                "name": "a1",
                "foot_name": "foot",
                "penalize_contacts_on": ["thigh", "calf"],
                "terminate_after_contacts_on": ["base"],
                "self_collisions": 1,
            },
            "rewards": {
                "soft_dof_pos_limit": 0.9,
                "base_height_target": 0.25,
                "scales": {"torques": -0.0002, "dof_pos_limits": -10.0},
            },
        },
    ),
    "A1RoughCfgPPO": ("LeggedRobotCfgPPO", {"runner": {"experiment_name": "rough_a1"}}),
}
"""Class -> its base class, and the values that it changes."""


def known_class(name: str, made: dict[str, type]) -> type | None:
    """Return a class of legged_gym by its name, with nested classes for sections; None for an unknown name. Classes in `made`
    are reused.
    """
    if name not in KNOWN:
        return None
    if name not in made:
        parent, data = KNOWN[name]
        made[name] = _as_class(name, data, known_class(parent, made), Place(f"legged_gym's {name}", 0))
    return made[name]


def _as_class(name: str, data: Mapping[str, Any], parent: Any, place: Place) -> type:
    own: dict[str, Any] = {MEMBER_OF: place}
    for key, value in data.items():
        # A table of names is a value; a nested class of legged_gym is a section.
        if isinstance(value, Mapping) and key not in ("default_joint_angles", "stiffness", "damping"):
            own[key] = _as_class(key, value, getattr(parent, key, None), place)
        else:
            own[key] = Found(value, place)
    return type(name, () if parent is None else (parent,), own)
