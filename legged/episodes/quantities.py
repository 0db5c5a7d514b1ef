"""The recorded quantities of a control step, as tensors with names, units and columns; and the joints of a task."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from legged.envs import BaseTask, LeggedRobot

AXES = ("x", "y", "z")
FLAGS = ("failed", "timed_out")
"""Columns for how an episode ended, before those of the terms."""


@dataclass(frozen=True)
class Quantity:
    """A quantity of N robots at the end of a control step."""

    name: str
    read: Callable[[], Tensor]
    """Return the current values (N, ...)."""
    unit: str
    what: str
    """Description, with the frame if the quantity has one."""
    columns: tuple[str, ...] = ()
    """Names along the second axis of the values, if there is one."""


@dataclass(frozen=True)
class Joint:
    """A joint with a motor."""

    name: str
    unit: str
    """Unit of the joint's position: rad, or m for a slide."""
    qpos: int
    """Column of the generalised positions."""
    qvel: int
    range: tuple[float, float] | None
    """Lowest and highest position; None without stops."""
    max_velocity: float | None
    max_torque: float | None
    """Largest nominal torque [N m], or force [N] of a slide, either way; None without a limit."""

    def described(self) -> dict[str, Any]:
        """Return plain values, for a JSON file."""
        return {**vars(self), "range": None if self.range is None else list(self.range)}


def quantities_of(task: BaseTask) -> list[Quantity]:
    """Return the recorded quantities of a task; `ended` comes last."""
    physics = task.physics
    model = physics.model
    rewards = task.rewards
    found = [
        Quantity("qpos", lambda: physics.qpos, "m, rad", "generalised positions in MuJoCo's layout", _coordinates(model, 0)),
        Quantity(
            "qvel", lambda: physics.qvel, "m/s, rad/s", "generalised velocities, MuJoCo's layout", _coordinates(model, 1)
        ),
        Quantity("action", lambda: task.actions, "1", "what the policy asked for, clipped", _actions(task)),
        Quantity("reward", lambda: task.rew_buf, "1", "sum of the parts; below 0 it may have been cut off"),
        Quantity("reward_parts", lambda: rewards.last.t(), "1", "scale times term of this step", rewards.names),
        *(_of_legs(task) if isinstance(task, LeggedRobot) else _of_motors(task)),
    ]
    terms = task.terminations

    def ended() -> Tensor:
        return torch.stack([terms.failed, terms.timed_out, *terms.found], dim=1)

    return [*found, Quantity("ended", ended, "1", "failed, out of time, and by which terms", (*FLAGS, *terms.names))]


def joints_of(task: BaseTask) -> list[Joint]:
    """Return the joints with a motor, in the order of the motors; none if a motor drives something other than one joint."""
    if isinstance(task, LeggedRobot):
        robot = task.robot
        limits = task.control.nominal["torque_limit"].tolist()
        return [
            Joint(
                name=name,
                unit="rad",
                qpos=robot.qpos_columns[i],
                qvel=robot.qvel_columns[i],
                range=_finite_pair(robot.dof_pos_limits[i]),
                max_velocity=float(robot.dof_vel_limits[i]),
                max_torque=limits[i],
            )
            for i, name in enumerate(robot.joint_names)
        ]
    model = task.physics.model
    if not _all_motors(model):
        return []
    numbers = model.actuator_trnid[:, 0]
    largest = _largest_torques(model)
    return [
        Joint(
            name=model.joint(j).name,
            unit="m" if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE else "rad",
            qpos=int(model.jnt_qposadr[j]),
            qvel=int(model.jnt_dofadr[j]),
            range=_finite_pair(model.jnt_range[j]) if model.jnt_limited[j] else None,
            max_velocity=None,
            max_torque=float(largest[i]) if np.isfinite(largest[i]) else None,
        )
        for i, j in enumerate(numbers.tolist())
    ]


def _of_legs(task: LeggedRobot) -> list[Quantity]:
    """Return the quantities of legged robots."""
    robot, joints, feet = task.robot, task.robot.joint_names, task.robot.feet_names
    feet_columns = task.feet_indices
    return [
        Quantity("base_lin_vel", lambda: task.base_lin_vel, "m/s", "velocity of the base, base frame", AXES),
        Quantity("base_ang_vel", lambda: task.base_ang_vel, "rad/s", "angular velocity of the base, base frame", AXES),
        Quantity("ground", lambda: task.height_scan.ground, "m", "height of the ground below the base, world frame"),
        Quantity("joint_pos", lambda: task.dof_pos, "rad", "angles of the joints with a motor", joints),
        Quantity("joint_vel", lambda: task.dof_vel, "rad/s", "and their velocities", joints),
        Quantity("torque", lambda: task.torques, "N m", "torques of the last physics step", joints),
        Quantity(
            "command",
            lambda: task.commands[:, :3],
            "m/s, m/s, rad/s",
            "velocity that was asked for in this step, base frame",
            ("vx", "vy", "yaw"),
        ),
        Quantity("feet_pos", lambda: task.feet_pos, "m", "centres of the feet, world frame, by x, y, z", feet),
        Quantity(
            "feet_force",
            lambda: task.contact_forces.index_select(1, feet_columns),
            "N",
            "contact forces on the feet at the last physics step, world frame, by x, y, z",
            feet,
        ),
        Quantity("feet_contact", lambda: task.contacts.in_contact, "1", "1 in contact, now or in the previous step", feet),
        Quantity(
            "contact_force",
            lambda: task.contact_forces.norm(dim=2),
            "N",
            "size of the contact force on every tracked shape",
            robot.contact_names,
        ),
    ]


def _of_motors(task: BaseTask) -> list[Quantity]:
    """Return the quantities of a model with motors on its joints; nothing for other actuators."""
    model, physics, joints = task.physics.model, task.physics, joints_of(task)
    if not joints:
        return []
    device = physics.device
    names = tuple(joint.name for joint in joints)
    units = "rad" if all(joint.unit == "rad" for joint in joints) else "rad, m"
    positions = torch.tensor([joint.qpos for joint in joints], device=device)
    velocities = torch.tensor([joint.qvel for joint in joints], device=device)
    low, high = torch.full((2, len(joints)), torch.inf, device=device).mul_(torch.tensor([[-1.0], [1.0]], device=device))
    limited = torch.as_tensor(model.actuator_ctrllimited, device=device).bool()
    ranges = torch.as_tensor(model.actuator_ctrlrange, dtype=torch.float32, device=device)
    low, high = torch.where(limited, ranges[:, 0], low), torch.where(limited, ranges[:, 1], high)
    per_control = torch.as_tensor(_torque_per_control(model), dtype=torch.float32, device=device)
    return [
        Quantity("joint_pos", lambda: physics.qpos.index_select(1, positions), units, "joints with a motor", names),
        Quantity("joint_vel", lambda: physics.qvel.index_select(1, velocities), f"{units} per s", "and velocities", names),
        Quantity("torque", lambda: physics.ctrl.clamp(low, high) * per_control, "N m", "torques of the motors", names),
    ]


def _all_motors(model: mujoco.MjModel) -> bool:
    """Return whether every actuator is a motor on one hinge or slide, with a torque proportional to its control."""
    numbers = model.actuator_trnid[:, 0]
    kinds = model.jnt_type[numbers] if (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT).all() else np.array([])
    scalar = np.isin(kinds, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    return bool(
        model.nu
        and len(kinds) == model.nu
        and scalar.all()
        and (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED).all()
        and (model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE).all()
        and (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE).all()
        and not model.actuator_forcelimited.any()
    )


def _torque_per_control(model: mujoco.MjModel) -> np.ndarray:
    return model.actuator_gear[:, 0] * model.actuator_gainprm[:, 0]


def _largest_torques(model: mujoco.MjModel) -> np.ndarray:
    """Return (nu,) how much every motor can do [N m]; infinite without a range of controls."""
    reach = np.abs(model.actuator_ctrlrange).max(axis=1)
    return np.where(model.actuator_ctrllimited.astype(bool), np.abs(_torque_per_control(model)) * reach, np.inf)


def _actions(task: BaseTask) -> tuple[str, ...]:
    """Return the name of the joint or actuator of each action."""
    if isinstance(task, LeggedRobot):
        return tuple(task.robot.joint_names[i] for i in task.control.acted)
    model = task.physics.model
    return tuple(model.actuator(i).name or f"actuator {i}" for i in range(model.nu))


def _coordinates(model: mujoco.MjModel, derivative: int) -> tuple[str, ...]:
    """Return the names of the generalised positions, or with `derivative` 1 of the velocities: `<joint>.<what>`."""
    linear, angular = AXES, tuple(f"w{axis}" for axis in AXES)
    quaternion = ("qw", "qx", "qy", "qz")
    parts = {
        mujoco.mjtJoint.mjJNT_FREE: (*linear, *(angular if derivative else quaternion)),
        mujoco.mjtJoint.mjJNT_BALL: angular if derivative else quaternion,
    }
    found: list[str] = []
    for i in range(model.njnt):
        name = model.joint(i).name or f"joint {i}"
        inner = parts.get(mujoco.mjtJoint(int(model.jnt_type[i])))
        found += [name] if inner is None else [f"{name}.{part}" for part in inner]
    return tuple(found)


def _finite_pair(limits: np.ndarray) -> tuple[float, float] | None:
    low, high = (float(value) for value in limits)
    return (low, high) if np.isfinite([low, high]).all() else None
