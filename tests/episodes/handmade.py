"""Episodes made by hand, of a robot with two feet and four joints: numbers are known without any simulation."""

import numpy as np

from legged.episodes.stored import Episodes

JOINTS = ("left_hip", "right_hip", "left_knee", "right_knee")
FEET = ("left_foot", "right_foot")
CONTACTS = (*FEET, "shin")
PARTS = ("tracking", "torques")
TERMS = ("contact", "tilt")
DT, LIMIT = 0.02, 40.0


def columns(*names: str, unit: str = "1") -> dict:
    return {"unit": unit, "what": "by hand", "columns": list(names)}


ABOUT = {
    "format": 1,
    "task": "by_hand",
    "checkpoint": "model_7.pt",
    "run": "logs/by_hand/a_run",
    "dt": DT,
    "reward_unit": DT,
    "terminations": list(TERMS),
    "feet": list(FEET),
    "contacts": list(CONTACTS),
    "contact_threshold": 1.0,
    "joints": [
        {
            "name": name,
            "unit": "rad",
            "qpos": 7 + i,
            "qvel": 6 + i,
            "range": [-1.0, 2.0],
            "max_velocity": 8.0,
            "max_torque": LIMIT,
        }
        for i, name in enumerate(JOINTS)
    ],
    "arrays": {
        "qpos": columns(*(f"base.{k}" for k in range(7)), *JOINTS),
        "qvel": columns(*(f"base.{k}" for k in range(6)), *JOINTS),
        "action": columns(*JOINTS),
        "reward": columns(),
        "reward_parts": columns(*PARTS),
        "base_lin_vel": columns("x", "y", "z"),
        "base_ang_vel": columns("x", "y", "z"),
        "ground": columns(),
        "joint_pos": columns(*JOINTS),
        "joint_vel": columns(*JOINTS),
        "torque": columns(*JOINTS),
        "command": columns("vx", "vy", "yaw"),
        "feet_pos": columns(*FEET),
        "feet_force": columns(*FEET),
        "feet_contact": columns(*FEET),
        "contact_force": columns(*CONTACTS),
    },
}
SHAPES = {"reward": (), "ground": (), "feet_pos": (2, 3), "feet_force": (2, 3)}


def made_by_hand(*lengths: int, failed: tuple[bool, ...] = (), ended_by: tuple[tuple[bool, bool], ...] = ()) -> Episodes:
    """Episodes of those lengths, all zero but for an upright base; the caller writes what matters."""
    rows, count = sum(lengths), len(lengths)
    arrays = {
        name: np.zeros((rows, *SHAPES.get(name, (len(ABOUT["arrays"][name]["columns"]),))), dtype=np.float32)
        for name in ABOUT["arrays"]
    }
    arrays["qpos"][:, 2], arrays["qpos"][:, 3] = 0.5, 1.0
    failures = np.array(failed or [False] * count)
    return Episodes(
        {
            **arrays,
            "episode_start": np.array([0, *np.cumsum(lengths)]),
            "robot": np.arange(count),
            "failed": failures,
            "timed_out": ~failures,
            "ended_by": np.array(ended_by or [[False] * len(TERMS)] * count),
            "first_qpos": np.zeros((count, 11), dtype=np.float32),
            "first_qvel": np.zeros((count, 10), dtype=np.float32),
        },
        dict(ABOUT),
    )
