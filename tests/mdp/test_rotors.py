"""Inertia of rotors and gears behind joints: a motor whose torque falls with its speed needs some, or it shakes."""

import re

import mujoco
import numpy as np
import pytest
import torch
from helpers import small_config, small_task

from legged.config.actuator import ActuatorConfig
from legged.config.robot import RobotControlConfig
from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.mdp.actuators.actuator import check_actuator
from legged.mdp.actuators.motor_curve import MotorCurve, with_rotors
from legged.physics.scene.robot_scene import RobotScene, robot_source
from legged.robots.robot import load_robot

DT = 0.005
D = 12
EFFORT = 80.0  # of ANYmal C's joints [N m]
ANYDRIVE = {"model": "dc_motor", "stall_torque": {"H": 120.0, "K": 120.0}, "no_load_speed": {"H": 7.5, "K": 7.5}}


def lifted_knee(armature: float, dt: float, seconds: float) -> np.ndarray:
    """The speed of LF_KFE [rad/s] over physics steps, which gives all that it can, in C MuJoCo without weight."""
    robot = with_rotors(load_robot("anymal_c"), ActuatorConfig(**ANYDRIVE, armature={"K": armature}))
    model = RobotScene(robot).model(SimConfig(dt=dt))
    model.opt.gravity[:] = 0.0
    data, knee = mujoco.MjData(model), robot.joint_names.index("LF_KFE")
    data.qpos[:], column = robot.default_qpos, robot.qvel_columns[knee]
    data.qpos[2] = 5.0
    line = MotorCurve(torch.tensor([120.0]), torch.tensor([7.5]))
    speeds = []
    for _ in range(round(seconds / dt)):
        _, high = line.limits(torch.tensor([data.qvel[column]]), torch.tensor([EFFORT]))
        data.ctrl[knee] = high.item()
        mujoco.mj_step(model, data)
        speeds.append(data.qvel[column])
    return np.array(speeds)


def test_a_motor_with_its_rotor_comes_up_to_its_no_load_speed_and_stays_there():
    speeds = lifted_knee(0.1, DT, 0.1)
    assert np.all(np.diff(speeds[:8]) > 0.0), speeds
    assert speeds[-1] == pytest.approx(7.5, abs=0.05)
    # until it bends at 2.5 rad/s the motor gives its effort: 80 N m on 0.114 kg m^2 for one step of 5 ms make 3.5 rad/s
    assert speeds[0] == pytest.approx(80.0 * DT / 0.114, rel=0.02)


def test_what_the_start_refuses_does_push_and_brake_in_turn():
    speeds = lifted_knee(0.0, DT, 0.1)
    assert np.all(np.diff(np.sign(np.diff(speeds))) != 0.0), speeds  # up, down, up
    assert np.abs(np.diff(speeds)).min() > 3.0
    steady = lifted_knee(0.0, 0.0008, 0.1)  # at a step that is short enough it does not
    assert steady[-20:] == pytest.approx(np.full(20, 7.5), abs=0.1)


def test_a_line_that_is_too_steep_for_the_physics_step_is_refused_and_the_numbers_in_the_error_do():
    robot, dt = load_robot("anymal_c"), 0.005
    knee = robot.joint_names.index("LF_KFE")
    assert robot.inertia[knee] == pytest.approx(0.0143, abs=2e-4)  # 1 / (M^-1)_ii of the model in its default pose
    with pytest.raises(ConfigError) as error:
        check_actuator(robot, RobotControlConfig(actuator=ActuatorConfig(**ANYDRIVE)), dt)
    told = re.search(
        r"^control.actuator.stall_torque: '.._KFE' turns 0.014 kg m\^2 with the leg in the air, .* 120 N m at rest and 0 N m "
        r"at 7.5 rad/s: .* 0.005 s .* \(control.actuator.armature, ([0-9.]+) kg m\^2 or more\), or make sim.dt ([0-9.]+) s",
        str(error.value),
    )
    assert told is not None, error.value
    enough, short = map(float, told.groups())
    assert enough == pytest.approx(120.0 * dt / (2.0 * 7.5) - 0.0143, rel=0.1)
    assert short == pytest.approx(2.0 * 0.0143 * 7.5 / 120.0, rel=0.1)
    check_actuator(robot, RobotControlConfig(actuator=ActuatorConfig(**ANYDRIVE)), short)
    heavy = RobotControlConfig(actuator=ActuatorConfig(**ANYDRIVE, armature={"K": enough}))
    check_actuator(robot, heavy, dt)
    check_actuator(with_rotors(robot, heavy.actuator), heavy, dt)  # what a robot has is not added once more
    ideal = ActuatorConfig(**{**ANYDRIVE, "joints": ("HAA", "HFE")})  # their legs are heavy enough
    check_actuator(robot, RobotControlConfig(actuator=ideal), dt)


@pytest.mark.parametrize(
    ("drawn", "fits"), [([0.5, 1.0], True), ([0.3, 1.0], False), ([0.0, 0.0], False), ({"range": [0.3, 1.0]}, False)]
)
def test_a_line_that_is_too_steep_at_the_slowest_speed_that_is_drawn_is_refused(drawn, fits):
    """A motor whose speed is drawn as 0 gave no number at all: 0 / 0 where the joint is at rest."""
    motor = {**ANYDRIVE, "armature": {"K": 0.1, "H": 0.1}}
    changes = [(f"control.actuator.{name}", value) for name, value in motor.items()]
    changes += [("domain_rand.ranges.velocity_limit", drawn)]
    if fits:
        small_config(*changes)
        return
    with pytest.raises(ConfigError, match=r"velocity_limit: its lowest value, 0.*'.._KFE'.*at least 0\.36$"):
        small_config(*changes)  # 120 N m * 0.005 s / (0.114 kg m^2 * 7.5 rad/s) = 0.70 = 2 * 0.35
    small_config(*changes, ("control.actuator.model", "ideal"))  # of which only rewards know


def test_rotors_of_the_configuration_are_those_of_the_model_in_every_form():
    robot = load_robot("anymal_d")  # 0.1 kg m^2 each in its file
    assert np.array_equal(robot.armature, np.full(D, 0.1))
    assert with_rotors(robot, ActuatorConfig()) is robot
    other = with_rotors(robot, ActuatorConfig(armature={"KFE": 0.25, "LF_KFE": 0.0}))
    expected = np.where([("KFE" in name) for name in robot.joint_names], 0.25, 0.1)
    expected[robot.joint_names.index("LF_KFE")] = 0.0
    assert np.array_equal(other.armature, expected)
    assert other.inertia - robot.inertia == pytest.approx(expected - 0.1)
    columns = list(robot.qvel_columns)
    assert np.array_equal(RobotScene(other).model(SimConfig()).dof_armature[columns], expected)
    text = robot_source(other, False)
    assert mujoco.MjModel.from_xml_string(text).dof_armature[columns] == pytest.approx(expected)
    assert robot_source(robot, False) == str(robot.model_path)
    with pytest.raises(ConfigError, match=r"control\.actuator\.armature: .*'KNEE'"):
        with_rotors(robot, ActuatorConfig(armature={"KNEE": 0.1}))


def test_a_task_simulates_the_rotors_that_its_file_states():
    task = small_task(("sim.physics", "mujoco"), ("control.actuator.armature", {"KFE": 0.05}))
    expected = np.where(["KFE" in name for name in task.robot.joint_names], 0.05, 0.0)
    assert np.array_equal(task.physics.model.dof_armature[list(task.robot.qvel_columns)], expected)
