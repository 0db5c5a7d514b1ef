"""Plays a G1 policy of `legged export --format mjlab` in mjlab's own simulation of the robot, from the file alone.

    python docs/peers/play_mjlab.py policy.onnx --command 0.6 0 0 --seconds 10

Runs in an environment with mjlab 1.6, not with this package. mjlab has no program that plays ONNX files: its `play` takes
checkpoints. So mjlab's managers get from the metadata which terms to observe, their histories, scales and clips, and default
angles, gains and action scales. Prints, for every second, means over the robots and the number of falls so far.
"""

import argparse
import os
import re
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

os.environ["MUJOCO_GL"] = "disable"  # nothing is rendered, and stand-ins can't render

import numpy as np
from stand_ins import stand_in

stand_in()

import mjlab.tasks  # noqa: E402, F401  fills the registry
import onnxruntime  # noqa: E402
import torch  # noqa: E402
from mjlab.envs import ManagerBasedRlEnv  # noqa: E402
from mjlab.tasks.registry import load_env_cfg  # noqa: E402

KEPT = ("reset_base", "reset_robot_joints")
"""Events of the task that remain; the others disturb the robot."""


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--task", default="Mjlab-Velocity-Flat-Unitree-G1")
    parser.add_argument("--command", type=float, nargs=3, default=(0.6, 0.0, 0.0), help="vx, vy [m/s], yaw rate [rad/s]")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--robots", type=int, default=4)
    args = parser.parse_args()
    session = onnxruntime.InferenceSession(str(args.policy), providers=["CPUExecutionProvider"])
    env = ManagerBasedRlEnv(cfg=configured(args, session.get_modelmeta().custom_metadata_map), device="cpu")
    observations, _ = env.reset()
    falls, each = 0, round(1.0 / env.step_dt)
    for step in range(1, round(args.seconds / env.step_dt) + 1):
        rows = observations["actor"].numpy()
        actions = np.concatenate([session.run(None, {"obs": row[None]})[0] for row in rows])
        observations, _, terminated, _, _ = env.step(torch.tensor(actions))
        falls += int(terminated.sum())
        if step % each == 0:
            data = env.scene["robot"].data
            vx, vy, _ = data.root_link_lin_vel_b.mean(dim=0).tolist()
            turn, height = data.root_link_ang_vel_b[:, 2].mean().item(), data.root_link_pos_w[:, 2].mean().item()
            print(
                f"{step // each} s: {vx:.2f}, {vy:.2f} m/s, {turn:.2f} rad/s, height {height:.2f} m, {falls} falls",
                flush=True,
            )


def configured(args: argparse.Namespace, said: dict[str, str]) -> object:
    """Return mjlab's configuration of its task with what the metadata say and one command."""

    def numbers(key: str) -> list[list[float]]:
        return [[float(number) for number in entry.split(";")] for entry in said[key].split(",")]

    joints = said["joint_names"].split(",")
    by_joint = {
        key: {name: value for name, (value,) in zip(joints, numbers(key), strict=True)}
        for key in ("default_joint_pos", "joint_stiffness", "joint_damping", "action_scale")
    }
    cfg = load_env_cfg(args.task, play=True)
    cfg.scene.num_envs = args.robots
    cfg.events = {name: event for name, event in cfg.events.items() if name in KEPT}
    actor = cfg.observations["actor"]
    actor.enable_corruption = False
    terms = {}
    columns = [numbers(f"observation_terms_{key}") for key in ("scale", "clip", "history_length", "flatten_history_dim")]
    for name, scale, clip, (history,), (flat,) in zip(said["observation_names"].split(","), *columns, strict=True):
        term = deepcopy(actor.terms[name])
        term.noise, term.scale, term.clip = None, tuple(scale) if len(scale) > 1 else scale[0], tuple(clip)
        term.history_length, term.flatten_history_dim = int(history), bool(flat)
        terms[name] = term
    actor.terms = terms
    cfg.actions["joint_pos"].scale = by_joint["action_scale"]
    robot = cfg.scene.entities["robot"]
    robot.init_state.joint_pos = by_joint["default_joint_pos"]
    robot.articulation.actuators = tuple(
        replace(
            motors,
            target_names_expr=(name,),
            stiffness=by_joint["joint_stiffness"][name],
            damping=by_joint["joint_damping"][name],
        )
        for motors in robot.articulation.actuators
        for name in joints
        if any(re.fullmatch(pattern, name) for pattern in motors.target_names_expr)
    )
    twist, (vx, vy, yaw) = cfg.commands["twist"], args.command
    twist.heading_command, twist.ranges.heading, twist.rel_heading_envs, twist.rel_standing_envs = False, None, 0.0, 0.0
    twist.ranges.lin_vel_x, twist.ranges.lin_vel_y, twist.ranges.ang_vel_z = (vx, vx), (vy, vy), (yaw, yaw)
    twist.rel_forward_envs, twist.rel_world_envs = 0.0, 0.0
    twist.resampling_time_range = (1e9, 1e9)
    return cfg


if __name__ == "__main__":
    main()
