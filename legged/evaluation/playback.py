"""Playback of an ONNX policy in C MuJoCo: one robot on a plane follows one command after another."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import mujoco
import numpy as np

from legged.config.world import SimConfig
from legged.evaluation.velocity_grid import Grid, mean_and_worst, number_or_null
from legged.physics import RobotScene
from legged.policies.foreign import ForeignPolicy
from legged.robots.robot import Robot

SETTLING_S = 2.0
"""Time from the start of a command to the start of the measurement [s]."""
FALLEN = 1.0
"""Tilt of the base that counts as a fall [rad]."""
SOLVER = SimConfig(physics="mujoco", iterations=50, ls_iterations=20)
"""Solver settings: pyramidal friction cones, and enough iterations to converge."""


class Moment(NamedTuple):
    """State of a robot at the end of a control step."""

    time: float
    """Time since the start [s]."""
    velocity: np.ndarray
    """(3,) vx, vy [m/s] and yaw rate [rad/s], base frame."""
    height: float
    """Height of the base above the ground [m]."""
    fallen: bool


class Stage:
    """A robot on a plane, controlled by a `ForeignPolicy`."""

    def __init__(self, robot: Robot, policy: ForeignPolicy, friction: float) -> None:
        """Build the model with `friction` between robot and ground."""
        self.robot, self.policy = robot, policy
        self.model = RobotScene(robot).model(replace(SOLVER, dt=policy.layout.sim_dt))
        self.model.geom_friction[[self.model.geom(name).id for name in robot.shape_names], 0] = friction
        if policy.layout.implicit_gains:
            _make_servos(self.model, policy)
        self._start = _standing(self.model, robot, policy)

    def walk(self, command: np.ndarray, seconds: float) -> Iterator[Moment]:
        """Yield the state after each control step of a walk that starts in the default pose with the feet on the ground. The
        walk ends after `seconds` or with a fall. `command` (3,) is vx, vy [m/s], yaw rate [rad/s].
        """
        model, policy, data = self.model, self.policy, mujoco.MjData(self.model)
        data.qpos[:] = self._start
        positions, rates = list(self.robot.qpos_columns), list(self.robot.qvel_columns)
        limits, servos = policy.torque_limits, policy.layout.implicit_gains
        policy.reset()
        steps = max(1, round(policy.layout.control_dt / model.opt.timestep))
        state = _base(data)
        fallen = False
        while data.time < seconds - 1e-9 and not fallen:
            targets = policy.act(command, *state, data.qpos[positions], data.qvel[rates])
            for _ in range(steps):
                if servos:
                    data.ctrl[:] = targets
                else:
                    torques = policy.stiffness * (targets - data.qpos[positions]) - policy.damping * data.qvel[rates]
                    data.ctrl[:] = np.clip(torques, -limits, limits)
                mujoco.mj_step(model, data)
            state = lin_vel, ang_vel, gravity = _base(data)
            fallen = not np.arccos(np.clip(-gravity[2], -1.0, 1.0)) <= FALLEN  # NaN counts as a fall
            yield Moment(float(data.time), np.array([*lin_vel[:2], ang_vel[2]]), float(data.qpos[2]), fallen)


def play(
    robot: Robot, policy: ForeignPolicy, commands: Sequence[Sequence[float]], seconds: float, friction: float
) -> list[dict[str, Any]]:
    """Let the robot follow each command for `seconds`, each time from the default pose on the ground. `friction` is the
    friction coefficient between robot and ground.

    Return a mapping for each command, with the command under `command`. `velocity` is the mean velocity after SETTLING_S,
    base frame [m/s, m/s, rad/s]. `lowest_base` is the smallest height of the base after SETTLING_S [m]. Both are None if the
    robot fell. `fell_after` is the time of the fall [s], or None without a fall.
    """
    stage, rows = Stage(robot, policy, friction), []
    for command in commands:
        moments = list(stage.walk(np.array(command, dtype=float), seconds))
        measured = [moment for moment in moments if moment.time > SETTLING_S] if not moments[-1].fallen else []
        velocity = np.mean([moment.velocity for moment in measured], axis=0).tolist() if measured else None
        height = min(moment.height for moment in measured) if measured else None
        fell_after = moments[-1].time if moments[-1].fallen else None
        row = {"command": list(map(float, command)), "velocity": velocity, "lowest_base": height, "fell_after": fell_after}
        rows.append(row)
    return rows


def follow(robot: Robot, policy: ForeignPolicy, grid: Grid, friction: float) -> dict[str, Any]:
    """Measure how well the robot follows each command of the grid. The errors of horizontal velocity [m/s] and yaw rate
    [rad/s] are root mean squares over the control steps from `grid.settle_s` to a fall or the end. Return the mean and the
    worst cell of each error, the share of falls, and "cells", which has both errors and `fell` for each command.
    """
    stage, cells, rows = Stage(robot, policy, friction), grid.cells, []
    for command in cells:
        errors, fell = [], False
        for moment in stage.walk(command, grid.hold_s):
            fell = moment.fallen
            if moment.time > grid.settle_s + 1e-9 and not fell:
                errors.append(moment.velocity - command)
        squares = np.mean(np.square(errors), axis=0) if errors else np.full(3, np.nan)
        rows.append((np.sqrt(squares[:2].sum()), np.sqrt(squares[2]), float(fell)))
    lin, ang, falls = np.array(rows).T
    return {
        "rmse_lin": mean_and_worst(lin, cells),
        "rmse_ang": mean_and_worst(ang, cells),
        "falls": float(falls.mean()),
        "cells": [
            {"command": cell, "rmse_lin": number_or_null(row[0]), "rmse_ang": number_or_null(row[1]), "fell": bool(row[2])}
            for cell, row in zip(cells.tolist(), rows, strict=True)
        ],
    }


def _base(data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return linear velocity [m/s], angular velocity [rad/s] and unit vector along gravity, each (3,), in the base frame."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, data.qpos[3:7])
    to_world = turn.reshape(3, 3)
    return to_world.T @ data.qvel[:3], data.qvel[3:6].copy(), -to_world[2]


def _make_servos(model: mujoco.MjModel, policy: ForeignPolicy) -> None:
    """Turn the motors of a model into position actuators, whose damping the integrator treats implicitly."""
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
    model.actuator_gainprm[:, 0] = policy.stiffness
    model.actuator_biasprm[:, 1], model.actuator_biasprm[:, 2] = -policy.stiffness, -policy.damping
    model.actuator_ctrllimited[:] = 0
    model.actuator_forcelimited[:] = 1
    model.actuator_forcerange[:] = np.stack([-policy.torque_limits, policy.torque_limits], axis=1)


def _standing(model: mujoco.MjModel, robot: Robot, policy: ForeignPolicy) -> np.ndarray:
    """Return the positions (nq,) of the policy's default pose, with the lowest shape 1 mm above the ground."""
    data = mujoco.MjData(model)
    data.qpos[:] = robot.default_qpos
    data.qpos[list(robot.qpos_columns)] = policy.default
    low, high = 0.0, 10.0 * robot.file.spawn_height
    for _ in range(40):  # bisection: `high` becomes the smallest height of the base without contacts
        data.qpos[2] = 0.5 * (low + high)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        low, high = (data.qpos[2], high) if data.ncon else (low, data.qpos[2])
    data.qpos[2] = high + 1e-3
    return data.qpos.copy()
