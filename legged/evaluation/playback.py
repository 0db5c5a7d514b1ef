"""What a foreign policy does in C MuJoCo: one robot on a plane, one command after the other."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged.config.schema import SimConfig
from legged.physics import RobotScene
from legged.policies.foreign import ForeignPolicy
from legged.robots.robot import Robot

SETTLING_S = 2.0
"""Time after which velocities are measured [s]."""
FALLEN = 1.0
"""Lean of the base beyond which a robot has fallen [rad]."""
SOLVER = SimConfig(physics="mujoco", iterations=50, ls_iterations=20)
"""Pyramidal cones and the step of our tasks, solved to the end."""


@dataclass(frozen=True)
class Played:
    """What came of a command."""

    command: tuple[float, ...]
    """vx, vy [m/s], yaw rate [rad/s]."""
    velocity: tuple[float, ...]
    """The same as they were on average after the first seconds, base frame; NaN where it fell before."""
    height: float
    """Lowest height of the base after the first seconds [m]."""
    fell_after: float | None
    """When it fell [s]; None if it did not."""


def play(
    robot: Robot, policy: ForeignPolicy, commands: Sequence[Sequence[float]], seconds: float, friction: float
) -> list[Played]:
    """Play every command for so long [s], from the default pose with the feet on the ground, at that friction."""
    model = RobotScene(robot).model(SOLVER)
    model.geom_friction[[model.geom(name).id for name in robot.shape_names], 0] = friction
    start = _standing(model, robot, policy)
    return [_play(model, robot, policy, start, np.array(command, dtype=float), seconds) for command in commands]


def _standing(model: mujoco.MjModel, robot: Robot, policy: ForeignPolicy) -> np.ndarray:
    """Return positions (nq,) in the policy's default pose with the lowest shape 1 mm above the ground."""
    data = mujoco.MjData(model)
    data.qpos[:] = robot.default_qpos
    data.qpos[list(robot.qpos_columns)] = policy.default
    low, high = 0.0, 10.0 * robot.file.spawn_height
    for _ in range(40):  # the height from which on nothing touches
        data.qpos[2] = 0.5 * (low + high)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        low, high = (data.qpos[2], high) if data.ncon else (low, data.qpos[2])
    data.qpos[2] = high + 1e-3
    return data.qpos.copy()


def _play(
    model: mujoco.MjModel, robot: Robot, policy: ForeignPolicy, start: np.ndarray, command: np.ndarray, seconds: float
) -> Played:
    data = mujoco.MjData(model)
    data.qpos[:] = start
    positions, rates = list(robot.qpos_columns), list(robot.qvel_columns)
    policy.reset()
    steps = max(1, round(policy.layout.control_dt / model.opt.timestep))
    turn, measured, lowest = np.zeros(9), [], np.inf
    fell_after = None
    while data.time < seconds - 1e-9 and fell_after is None:
        mujoco.mju_quat2Mat(turn, data.qpos[3:7])
        to_world = turn.reshape(3, 3)
        lin_vel, ang_vel, gravity = to_world.T @ data.qvel[:3], data.qvel[3:6].copy(), -to_world[2]
        targets = policy.act(command, lin_vel, ang_vel, gravity, data.qpos[positions], data.qvel[rates])
        for _ in range(steps):
            torques = policy.stiffness * (targets - data.qpos[positions]) - policy.damping * data.qvel[rates]
            data.ctrl[:] = np.clip(torques, -robot.torque_limits, robot.torque_limits)
            mujoco.mj_step(model, data)
        if data.time > SETTLING_S:
            measured.append([*lin_vel[:2], ang_vel[2]])
            lowest = min(lowest, float(data.qpos[2]))
        if not (np.arccos(np.clip(-gravity[2], -1.0, 1.0)) <= FALLEN):
            fell_after = float(data.time)
    velocity = np.mean(measured, axis=0) if measured and fell_after is None else np.full(3, np.nan)
    return Played(tuple(command.tolist()), tuple(velocity.tolist()), lowest, fell_after)
