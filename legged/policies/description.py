"""The contents of policy.json: what a controller must know to run an exported policy, as plain data."""

import inspect
import math
from typing import Any

import mujoco

from legged.config.actuator import MOTORS
from legged.config.loader import to_dict
from legged.config.networks import ESTIMATED, groups_of
from legged.config.task import TaskConfig
from legged.deploy.contract import BASE_COMMANDS, CONTRACT_VERSION, need_of
from legged.envs import BaseTask, LeggedRobot, RobotTask, is_robot_task, is_velocity_task
from legged.envs.marks import unit_of
from legged.envs.motion_tracking import MotionTracking, is_tracking_task
from legged.mdp.observations import ObservationTerm
from legged.robots.crouched_pose import crouch

LAWS = {
    "P": "stiffness * (action_scale * action + default_joint_angles - q) - damping * dq",
    "V": "stiffness * (action_scale * action - dq) - damping * ddq, ddq over one sim_dt",
    "T": "action_scale * action",
}
"""Law of a joint -> formula of its torque [N m] from joint angle q [rad], velocity dq [rad/s] and the clipped action."""
SHARED = {
    "observation": "for each term clip(scale * value, -observation_clip, observation_clip), at its columns start to"
    " start + size, without noise",
    "history": "the last observation_history observations side by side, oldest first; at the start of an episode, all of"
    " them are its first observation",
}
"""Conventions of all tasks."""
MODEL_CONVENTIONS = {
    "units": "SI: m, s, rad, N, N m; positions and velocities in MuJoCo's generalised coordinates",
    **SHARED,
    "action": "actions = policy(observation), then clipped at plus and minus action_clip, one for each actuator",
    "control": "control_middle + control_reach * action, for each actuator, in the unit that it takes",
    "time": "every control_dt: observe, run the policy, hold its controls for control_dt",
}
"""Conventions of tasks whose world is a model with its own actuators."""
FRAMES = ("base frame", "yaw frame", "world frame")


def describe(task: BaseTask, trained: TaskConfig | None = None) -> dict[str, Any]:
    """Return the observation layout with units, frames and formulas, the joints, the control law and time steps. Keys are
    never renamed. The noise is that of `trained`, the configuration of the training. If `trained` is None, it is the task's.
    """
    cfg = task.cfg
    groups: list[dict[str, Any]] = []
    terms: list[dict[str, Any]] = []
    start, observed = 0, (trained or cfg).observations
    for name in groups_of(cfg, "actor"):
        group = task.observation_groups[name]
        width = group.buffer.shape[1]
        groups.append({"name": name, "start": start, "size": width // group.history, "history": group.history})
        level = observed.noise_level if observed.add_noise and observed.groups[name].noise else 0.0
        for term in group.terms:
            terms.append(describe_term(task, term, groups[-1], observed.noise.get(term.name, 0.0) * level))
        start += width
    return {
        "task": cfg.task,
        "observation": terms,
        "observation_history": groups[0]["history"],
        "observation_groups": groups,
        "observation_clip": cfg.observations.clip,
        "recurrent": describe_memory(task),
        **describe_estimator(task),
        **(describe_robot(task) if is_robot_task(task) else describe_model(task)),
        **(describe_commands(task) if is_velocity_task(task) else {}),
        **(describe_motions(task) if is_tracking_task(task) else {}),
    }


def describe_commands(task: LeggedRobot) -> dict[str, Any]:
    """Return the ranges and the dead zone of velocity commands, and lowest, usual and highest command of height and pitch."""
    low, high = task.command_sampler.full_ranges.t().tolist()
    usual, base = task.base_sampler.usual.tolist(), {}
    if "base_commands" in task.cfg.observations.groups["actor"].terms:
        ranges = task.base_sampler.ranges or [(value, value) for value in usual]
        entries = ([low, rest, high] for rest, (low, high) in zip(usual, ranges, strict=True))
        base = {"base_commands": dict(zip(BASE_COMMANDS, entries, strict=True))}
    return {
        **base,
        "command_ranges": dict(zip(("vx", "vy", "yaw_rate"), zip(low, high, strict=True), strict=True)),
        "command_dead_zone": task.cfg.commands.small_command,
    }


def describe_motions(task: MotionTracking) -> dict[str, Any]:
    """Return the compared bodies, and the files that hold the policy with one motion each."""
    motion = task.cfg.motion
    return {
        "motion": {
            "anchor": motion.anchor,
            "bodies": list(motion.bodies),
            "extremities": list(motion.extremities),
            "trackers": {tracker_name(name): len(frames.rows) for name, frames in task.motion.clips.items()},
            "use": "trackers: file -> number of its frames; its input time_step (1, 1) is the frame that the observation"
            " shows, from 0; the outputs joint_pos and joint_vel of this frame are the term reference; anchor_pos and"
            " anchor_ori follow from body_pos_w and body_quat_w of the anchor, world frame, bodies in the order of bodies",
        }
    }


def tracker_name(clip: str) -> str:
    """Return the name of the file with the policy and the motion `clip`."""
    return f"policy_{clip}.onnx"


def describe_robot(task: RobotTask) -> dict[str, Any]:
    """Return the joints of a task's robot and the control law."""
    cfg, robot, control = task.cfg, task.robot, task.control
    scale, bent = control.action_scale, crouch(robot)
    return {
        "contract_version": CONTRACT_VERSION,
        "robot": robot.name,
        "conventions": conventions(task),
        "imu_frame": {"body": robot.file.base},
        "joint_names": list(robot.joint_names),
        "action_joints": [robot.joint_names[i] for i in control.acted],
        "default_joint_angles": control.default_dof_pos.tolist(),
        "crouch_joint_angles": None if bent is None else bent.tolist(),
        "control_type": control.law or list(control.laws),
        "action_scale": scale if isinstance(scale, float) else scale.tolist(),
        "action_clip": cfg.control.clip_actions,
        "stiffness": control.nominal["p_gain"].tolist(),
        "damping": control.nominal["d_gain"].tolist(),
        "torque_limits": control.nominal["torque_limit"].tolist(),
        "position_limits": [pair if math.isfinite(sum(pair)) else None for pair in robot.dof_pos_limits.tolist()],
        "velocity_limits": robot.dof_vel_limits.tolist(),
        "control_dt": task.dt,
        "sim_dt": cfg.sim.dt,
        "actuator": {**to_dict(cfg.control.actuator), "network": MOTORS if cfg.control.actuator.network else ""},
    }


def describe_model(task: BaseTask) -> dict[str, Any]:
    """Return the conventions, actuators, control law and time steps of a task whose world is a model."""
    model = task.physics.model
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = model.actuator_ctrlrange.T
    return {
        "conventions": MODEL_CONVENTIONS,
        "joint_names": [model.joint(i).name for i in range(model.njnt)],
        "actuator_names": [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i) for i in range(model.nu)],
        "control_middle": [float(0.5 * (low[i] + high[i])) if limited[i] else 0.0 for i in range(model.nu)],
        "control_reach": [float(0.5 * (high[i] - low[i])) if limited[i] else 1.0 for i in range(model.nu)],
        "action_clip": task.cfg.control.clip_actions,
        "control_dt": task.dt,
        "sim_dt": task.cfg.sim.dt,
    }


def conventions(task: RobotTask) -> dict[str, str]:
    """Return the meaning of frames, orders and times, in words."""
    laws = task.control.laws
    law = LAWS[laws[0]] if task.control.law else "; ".join(f"{name} joints: {LAWS[name]}" for name in sorted(set(laws)))
    return {
        "imu_frame": "the frame of this body is the base frame; angular velocity and gravity are given in it, so measurements"
        " of an IMU with another orientation must be rotated into it",
        "needs": "input of a term: a sensor of the robot, the command, memory (the last actions), or an additional source",
        "scan": "height that a measured point reads from the height map: own is the height of the point's cell; lowest and"
        " highest are taken from three cells, this cell and the next ones along +x and +y",
        "noise": "half width of the uniform noise that the policy was trained with, in the term's unit before scaling",
        "crouch_joint_angles": "pose on the way from lying to standing; null if the robot has no such pose",
        "command_dead_zone": "norm below which the training set horizontal velocity commands to zero [m/s]",
        "base frame": f"fixed to the body '{task.robot.file.base}': x forward, y left, z up",
        "yaw frame": "origin at the base, z vertical, x where the base frame's x points, seen from above",
        "world frame": "z up",
        "quaternion": "(w, x, y, z), turns the base frame into the world frame",
        "units": "SI: m, s, rad, N m; numbers by joint are in the order of joint_names",
        **SHARED,
        "observation_groups": "groups lie side by side, each at its columns start to start + history * size, which hold its"
        " last observations, oldest first; start of a term is the term's first column in the oldest observation",
        "action": "actions = policy(observation), then clipped at plus and minus action_clip, one for each of action_joints;"
        " action_scale is one number, or one for each of action_joints; a joint without an action has action 0",
        "torque": f"clip({law}, -torque_limits, torque_limits), anew every sim_dt",
        "actuator": "the motors of the training: the section control.actuator of its configuration; delay in steps of sim_dt",
        "time": "every control_dt: observe, run the policy, hold its action for control_dt",
    }


def describe_term(task: BaseTask, term: ObservationTerm, group: dict[str, Any], noise: float) -> dict[str, Any]:
    """Return the description of an observation term. `noise` is the half width of its noise. The term's method has the unit
    in its decorator `@unit`, and frame and formula in its docstring.
    """
    method = getattr(type(task), f"_obs_{term.name}")
    text = " ".join((inspect.getdoc(method) or "").partition("\n\n")[0].split())
    entry: dict[str, Any] = {
        "name": term.name,
        "group": group["name"],
        "start": group["start"] + term.columns.start,
        "size": term.columns.stop - term.columns.start,
        "scale": [float(value) for value in term.scale],
        "needs": need_of(term.name),
        "noise": noise,
        "unit": unit_of(method),
        "frame": next((frame for frame in FRAMES if frame in text), None),
        "formula": text or None,
    }
    if is_robot_task(task) and term.name == "heights":
        points = [[round(value, 6) for value in point] for point in task.height_scan.points.tolist()]
        legged = task.cfg.observations
        entry |= {"points": points, "offset": legged.heights_offset, "limit": legged.heights_limit}
        entry["deepest"] = legged.deepest
        entry["scan"] = task.cfg.terrain.scan
    if is_robot_task(task) and term.name in ("dof_pos", "dof_vel"):
        seen = task.seen_joints[term.name]
        if len(seen) < task.robot.num_dof:
            entry["joints"] = [task.robot.joint_names[i] for i in seen]
    if is_robot_task(task) and term.name == "held_targets":
        entry["joints"] = [task.robot.joint_names[i] for i in task.control.held]
    if is_robot_task(task) and term.name in ("passive_pos", "passive_vel") and task.robot.passive is not None:
        entry |= {"joints": list(task.robot.passive.names), "default": task.passive_default_pos.tolist()}
    return entry


def describe_estimator(task: BaseTask) -> dict[str, Any]:
    """Return the outputs of a policy's estimator under the key `estimator`; an empty dictionary if it has no estimator."""
    if ESTIMATED not in task.observation_groups:
        return {}
    targets = []
    for term in task.observation_groups[ESTIMATED].terms:
        unit, size = unit_of(getattr(type(task), f"_obs_{term.name}")), term.columns.stop - term.columns.start
        scale = [float(value) for value in term.scale]
        targets.append({"name": term.name, "size": size, "scale": scale, "unit": unit})
    return {"estimator": {"targets": targets, "latent": task.cfg.train.policy.estimator.latent}}


def describe_memory(task: BaseTask) -> dict[str, Any] | None:
    """Return names and shape of a recurrent policy's hidden state, and its use; None for a policy without memory."""
    policy = task.cfg.train.policy
    if policy.rnn_type == "none":
        return None
    kept = ["h", "c"] if policy.rnn_type == "lstm" else ["h"]
    return {
        "rnn_type": policy.rnn_type,
        "shape": [policy.rnn_num_layers, "batch", policy.rnn_hidden_dim],
        "onnx_inputs": [f"{name}_in" for name in kept],
        "onnx_outputs": [f"{name}_out" for name in kept],
        "use": "ONNX: zeros at the start of an episode, then what the last call gave; TorchScript: batch 1, kept inside,"
        " reset() at the start of an episode",
        "reset": {"onnx": "zeros in onnx_inputs, in the rows of the batch whose episode begins", "torchscript": "reset()"},
    }
