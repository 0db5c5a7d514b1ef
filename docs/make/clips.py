"""Make the motions in resources/motions/g1: `python docs/make/clips.py`.

Walk and turn are recordings of the policy `g1_flat` in C MuJoCo. Squat and kick follow from keyframes of feet, centre of mass
and pelvis, by splines and inverse kinematics.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch

from legged.commandline.command import run_main
from legged.deploy.command_parser import CommandParser
from legged.episodes.recorder import Wish, roll_out
from legged.math import quat_conjugate, quat_multiply, rotation_vector
from legged.motion.checks import quality_of
from legged.motion.clip import Clip, make_clip, write_clip
from legged.motion.kinematics import Skeleton
from legged.policies.restore import policy_of
from legged.process.paths import data_folder, relative
from legged.robots.robot import load_robot

FPS = 50.0
SETTLE_S, RECORDED_S = 0.5, 6.0
"""Time before a recording's first frame, and its length [s]."""
ARMS_OUT = 0.25
"""Angle by which the arms of the turn are held further out than the policy, which was trained without self-collisions, holds
them. Otherwise a hand is up to 15 mm inside a hip [rad]."""
FEET = ("left_ankle_roll_link", "right_ankle_roll_link")
FORWARD = 0.035
"""A centre of mass this far in front of the ankles is above the middle of the soles [m]."""
INWARD = 0.01
"""Above a single foot, the centre of mass is this far inside of the ankle, so that the ankle does not reach its stop [m]."""
DAMPING, STEPS, CLOSE = 1e-4, 100, 1e-6
"""Damping of the least squares, largest number of steps, and length of a step that counts as solved [m, rad]."""


class Pose(NamedTuple):
    """Targets of a frame, in the world frame."""

    feet: np.ndarray
    """(2, 3) positions of the ankles, left and right [m]."""
    centre: np.ndarray
    """(2,) horizontal position of the centre of mass [m]."""
    height: float
    """Height of the base [m]."""
    pitch: float = 0.0
    """Pitch of the base, positive forward [rad]."""
    toes: float = 0.0
    """Pitch of the left foot, positive with the toes down [rad]."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = CommandParser("clips", __doc__, "python docs/make/clips.py")
    parser.add_argument("--out", type=Path, default=Path("resources/motions/g1"), help="folder; resources/motions/g1")
    out = parser.parse_args(argv).out
    robot = load_robot("g1")
    skeleton = Skeleton(robot)
    makers: dict[str, Callable[[], Clip]] = {
        "walk": lambda: recorded("walk", (0.6, 0.0, 0.0)),
        "turn": lambda: recorded("turn", (0.0, 0.0, -0.5), ARMS_OUT),
        "squat": lambda: squat(skeleton),
        "kick": lambda: kick(skeleton),
    }
    for name, make in makers.items():
        clip = make()
        write_clip(clip, robot, out / f"{name}.npz")
        print(
            f"written: {relative(out / f'{name}.npz')}, {clip.seconds:.1f} s",
            *quality_of(clip, skeleton).findings(),
            sep="; ",
        )
    return 0


def recorded(name: str, command: tuple[float, float, float], arms_out: float = 0.0) -> Clip:
    """Return a clip of the policy `g1_flat` that follows a velocity command [m/s, m/s, rad/s], with its arms further out by
    `arms_out` [rad].
    """
    policy = policy_of(str(data_folder("resources") / "policies" / "g1_flat"), None)
    changes = (("env.episode_length_s", SETTLE_S + RECORDED_S + 0.1), ("sim.physics", "mujoco"))
    episodes, _ = roll_out(policy, Wish(1, 1, command=command, changes=changes), torch.device("cpu"))
    robot = load_robot("g1")
    first = round(SETTLE_S * FPS)
    qpos = episodes.of(0)["qpos"][first : first + round(RECORDED_S * FPS) + 1].astype(np.float64)
    low, high = robot.dof_pos_limits.T
    outward = [arms_out * (1.0 if "left" in joint else -1.0) * ("shoulder_roll" in joint) for joint in robot.joint_names]
    joints = (qpos[:, list(robot.qpos_columns)] + outward).clip(low, high)  # the engine's limits are soft
    start = np.array([*qpos[0, :2], 0.0])
    return make_clip(name, FPS, qpos[:, :3] - start, qpos[:, 3:7], joints, name)


# ---- keyframes -------------------------------------------------------------------------------------------------------


def blend(start: float, end: float) -> Callable[[float], float]:
    """Return a function of time that rises smoothly from 0 at `start` to 1 at `end` [s]: a quintic without speed and
    acceleration at both ends.
    """

    def rise(time: float) -> float:
        x = min(max((time - start) / (end - start), 0.0), 1.0)
        return x * x * x * (10.0 - 15.0 * x + 6.0 * x * x)

    return rise


def squat(skeleton: Skeleton) -> Clip:
    """The pelvis goes down by 0.24 m and up again; the arms come forward."""
    feet, centre, height = standing(skeleton)
    middle = feet[:, :2].mean(axis=0) + np.array([FORWARD, 0.0])
    shift, down, up, back = blend(0.3, 1.3), blend(1.0, 2.6), blend(2.9, 4.5), blend(4.2, 5.2)

    def pose(time: float) -> Pose:
        forward, deep = shift(time) - back(time), down(time) - up(time)
        target = centre + forward * (middle - centre)
        return Pose(feet, target, height - 0.24 * deep, 0.35 * deep)

    def arms(time: float) -> dict[str, float]:
        return {"shoulder_pitch": -0.9 * (down(time) - up(time)), "waist_pitch": 0.15 * (down(time) - up(time))}

    return solved("squat", skeleton, 5.5, pose, arms)


def kick(skeleton: Skeleton) -> Clip:
    """The weight moves over the right foot; the left one is lifted, swings forward, and comes back."""
    feet, centre, height = standing(skeleton)
    above = feet[1, :2] + np.array([FORWARD, INWARD])
    shift, lift, swing = blend(0.3, 1.8), blend(1.8, 2.6), blend(2.8, 3.3)
    retreat, lower, back = blend(3.4, 4.2), blend(4.3, 5.1), blend(5.2, 6.7)

    def pose(time: float) -> Pose:
        side, high, far = shift(time) - back(time), lift(time) - lower(time), swing(time) - retreat(time)
        foot = feet[0] + [0.38 * far - 0.05 * high, -0.05 * high, 0.22 * high + 0.14 * far]
        return Pose(
            np.array([foot, feet[1]]), centre + side * (above - centre), height - 0.02 * side, toes=0.3 * high - 0.3 * far
        )

    return solved("kick", skeleton, 7.0, pose, lambda _time: {})


def standing(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the ankles (2, 3), the centre of mass (2,) and the height of the base in the default pose, on the ground [m]."""
    robot, data = skeleton.robot, skeleton.data
    data.qpos[:] = robot.default_qpos
    data.qpos[:3] = 0.0, 0.0, robot.height
    mujoco.mj_kinematics(skeleton.model, data)
    mujoco.mj_comPos(skeleton.model, data)
    feet = skeleton.indices(FEET, "standing")
    return data.xpos[feet].copy(), data.subtree_com[skeleton.base, :2].copy(), robot.height


# ---- inverse kinematics ----------------------------------------------------------------------------------------------


def solved(
    name: str,
    skeleton: Skeleton,
    seconds: float,
    pose: Callable[[float], Pose],
    offsets: Callable[[float], dict[str, float]],
) -> Clip:
    """Return the clip whose legs and base follow the targets `pose` of each time [s]. `offsets` are added to the default
    angles of the joints whose names contain a key [rad].
    """
    robot, data = skeleton.robot, skeleton.data
    data.qpos[:] = robot.default_qpos
    data.qpos[:3] = 0.0, 0.0, robot.height
    frames = []
    for frame in range(round(seconds * FPS) + 1):
        extra = offsets(frame / FPS)
        for joint, column, default in zip(robot.joint_names, robot.qpos_columns, robot.default_dof_pos, strict=True):
            for part in extra:
                if part in joint:
                    data.qpos[column] = default + extra[part]
        reach(skeleton, pose(frame / FPS))
        frames.append(data.qpos.copy())
    qpos = np.array(frames)
    return make_clip(name, FPS, qpos[:, :3], qpos[:, 3:7], qpos[:, list(robot.qpos_columns)], name)


def reach(skeleton: Skeleton, pose: Pose) -> None:
    """Move the base and the legs in `skeleton.data` until feet, centre of mass and base have the targets of `pose`. The right
    foot stays level. The method is damped least squares.

    Raises:
        ValueError: the targets can't be reached.
    """
    model, data, robot = skeleton.model, skeleton.data, skeleton.robot
    legs = [
        name.startswith(("left", "right")) and any(part in name for part in ("hip", "knee", "ankle"))
        for name in robot.joint_names
    ]
    columns = [*range(6), *np.array(robot.qvel_columns)[legs]]
    feet, base = skeleton.indices(FEET, "feet"), skeleton.base
    toes, flat, leaning = (pitched(angle) for angle in (pose.toes, 0.0, pose.pitch))
    targets = [(feet[0], toes, pose.feet[0]), (feet[1], flat, pose.feet[1]), (base, leaning, None)]
    for _ in range(STEPS):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        errors, rows = [], []
        for body, quat, pos in targets:
            along, about = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, along, about, data.xpos[body], body)
            errors.append(turn_to(quat, data.xquat[body]))
            rows.append(about)
            wanted = slice(3) if pos is not None else slice(2, 3)
            target = pos if pos is not None else [pose.height]
            errors.append(target - data.xpos[body, wanted])
            rows.append(along[wanted])
        centre = np.zeros((3, model.nv))
        mujoco.mj_jacSubtreeCom(model, data, centre, base)
        errors.append(pose.centre - data.subtree_com[base, :2])
        rows.append(centre[:2])
        jacobian, error = np.concatenate(rows)[:, columns], np.concatenate(errors)
        step = np.zeros(model.nv)
        step[columns] = np.linalg.solve(jacobian.T @ jacobian + DAMPING**2 * np.eye(len(columns)), jacobian.T @ error)
        mujoco.mj_integratePos(model, data.qpos, step, 1.0)
        if np.abs(step).max() < CLOSE:
            break
    if np.abs(error).max() > 1e-3:
        raise ValueError(f"the targets are missed by {np.abs(error).max():.3f} m or rad")


def pitched(angle: float) -> np.ndarray:
    """Return the quaternion (4,) of a turn about y [rad]."""
    return np.array([np.cos(0.5 * angle), 0.0, np.sin(0.5 * angle), 0.0])


def turn_to(wanted: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Return the turn (3,) from the orientation `quat` to `wanted`, world frame [rad]."""
    goal, now = torch.from_numpy(wanted), torch.from_numpy(quat.copy())
    return rotation_vector(quat_multiply(goal, quat_conjugate(now))).numpy()


if __name__ == "__main__":
    sys.exit(main())
