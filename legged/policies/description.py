"""What a robot's controller must know to run an exported policy, as plain data: policy.json."""

import inspect
import re
from typing import Any

from legged.envs import LeggedRobot
from legged.envs.terms import HEIGHTS_LIMIT, HEIGHTS_OFFSET
from legged.mdp.observations import ObservationTerm

LAWS = {
    "P": "stiffness * (action_scale * action + default_joint_angles - q) - damping * dq",
    "V": "stiffness * (action_scale * action - dq) - damping * ddq, ddq over one sim_dt",
    "T": "action_scale * action",
}
"""control_type -> torque [N m] at joint angle q [rad] and velocity dq [rad/s]; action clipped at action_clip."""
FRAMES = ("base frame", "yaw frame", "world frame")


def describe(task: LeggedRobot) -> dict[str, Any]:
    """Observation layout with units, frames and formulas, joints, control law, time; keys are never renamed."""
    cfg, robot, control = task.cfg, task.robot, task.control
    group = task.observation_groups["actor"]
    low, high = task.command_sampler.full_ranges.t().tolist()
    return {
        "task": cfg.task,
        "robot": robot.name,
        "conventions": conventions(task),
        "observation": [describe_term(task, term) for term in group.terms],
        "observation_history": group.history,
        "observation_clip": cfg.observations.clip,
        "recurrent": describe_memory(task),
        "command_ranges": dict(zip(("vx", "vy", "yaw_rate"), zip(low, high, strict=True), strict=True)),
        "joint_names": list(robot.joint_names),
        "default_joint_angles": control.default_dof_pos.tolist(),
        "control_type": cfg.control.control_type,
        "action_scale": cfg.control.action_scale,
        "action_clip": cfg.control.clip_actions,
        "stiffness": control.stiffness.tolist(),
        "damping": control.damping.tolist(),
        "torque_limits": control.torque_limits.tolist(),
        "control_dt": task.dt,
        "sim_dt": cfg.sim.dt,
    }


def conventions(task: LeggedRobot) -> dict[str, str]:
    """Frames, orders and the way of time, in words."""
    law = LAWS[task.cfg.control.control_type]
    return {
        "base frame": f"fixed to the body '{task.robot.file.base}': x forward, y left, z up",
        "yaw frame": "origin at the base, z vertical, x where the base frame's x points, seen from above",
        "world frame": "z up",
        "quaternion": "(w, x, y, z), turns the base frame into the world frame",
        "units": "SI: m, s, rad, N m; numbers by joint are in the order of joint_names",
        "observation": "for each term clip(scale * value, -observation_clip, observation_clip), at its columns start to"
        " start + size, without noise",
        "history": "the last observation_history observations side by side, oldest first; at the start of an episode all are"
        " the first one",
        "action": "actions = policy(observation), then clipped at plus and minus action_clip, one for each joint",
        "torque": f"clip({law}, -torque_limits, torque_limits), anew every sim_dt",
        "time": "every control_dt: observe, run the policy, hold its action for control_dt",
    }


def describe_term(task: LeggedRobot, term: ObservationTerm) -> dict[str, Any]:
    """One observation term; unit, frame and formula are those that its method's docstring says."""
    text = " ".join((inspect.getdoc(getattr(type(task), f"_obs_{term.name}")) or "").partition("\n\n")[0].split())
    unit = re.search(r"\[([^\]]*)\]\.?$", text)
    entry: dict[str, Any] = {
        "name": term.name,
        "start": term.columns.start,
        "size": term.columns.stop - term.columns.start,
        "scale": [float(value) for value in term.scale],
        "unit": unit.group(1) if unit else None,
        "frame": next((frame for frame in FRAMES if frame in text), None),
        "formula": text or None,
    }
    if term.name == "heights":
        points = [[round(value, 6) for value in point] for point in task.height_scan.points.tolist()]
        entry |= {"points": points, "offset": HEIGHTS_OFFSET, "limit": HEIGHTS_LIMIT}
    return entry


def describe_memory(task: LeggedRobot) -> dict[str, Any] | None:
    """How to keep the hidden state of a recurrent policy; None for one that has none."""
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
    }
