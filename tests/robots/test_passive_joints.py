"""Joints that no motor drives: where springs and loops put them, what tasks see of them, and what is refused."""

import math

import mujoco
import numpy as np
import pytest
import torch
from helpers import small_task

from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.physics import RobotScene, make_physics
from legged.robots.passive_joints import PassiveJoints, default_qpos
from legged.robots.robot import load_robot

LINKAGE = """
<mujoco>
  <worldbody>
    <body name="trunk"><freejoint/><geom size="0.1"/>
      <body name="crank"><joint name="crank" axis="0 1 0"/><geom size="0.02" mass="1"/>
        <body name="rod" pos="0 0 -0.2"><joint name="rod" axis="0 1 0"/><geom size="0.02" mass="1"/></body>
      </body>
      <body name="follower" pos="0.5 0 0"><joint name="follower" axis="0 1 0" {range}/><geom size="0.02" mass="1"/></body>
      <body name="ball" pos="0 0.3 0"><joint name="ball" type="ball"/><geom size="0.02" mass="1"/></body>
      <body name="bob" pos="0 -0.3 0">
        <joint name="bob" type="slide" axis="0 0 1" stiffness="50" springref="-0.04"/><geom size="0.02" mass="1"/>
      </body>
    </body>
  </worldbody>
  <equality><connect body1="rod" body2="follower" anchor="0.5 0 0"/></equality>
</mujoco>
"""
"""A parallelogram: trunk and rod of 0.5 m, crank and follower of 0.2 m; and two joints that are in no loop."""


@pytest.fixture
def linkage():
    """linkage(range): the model, its crank driven, and the default positions at a crank angle."""

    def linkage(angle: float, range_: str = ""):
        model = mujoco.MjModel.from_xml_string(LINKAGE.format(range=range_))
        passive = PassiveJoints.of(model, [1], [2, 3, 4, 5])
        return model, passive, default_qpos(model, [1], np.array([angle]), passive, "robot.yaml")

    return linkage


@pytest.mark.parametrize("angle", [0.0, 0.7, -1.2])
def test_a_parallelogram_closes_as_geometry_says(linkage, angle):
    model, passive, qpos = linkage(angle)
    assert passive.names == ("rod", "follower", "bob")
    rod, follower, bob = qpos[list(passive.qpos_columns)]
    assert rod == pytest.approx(-angle, abs=1e-6)  # it stays parallel to the trunk
    assert follower == pytest.approx(angle, abs=1e-6)
    assert bob == pytest.approx(-0.04, abs=1e-6)  # where its spring rests
    ball = model.joint("ball").qposadr[0]
    np.testing.assert_allclose(qpos[ball : ball + 4], [1, 0, 0, 0], atol=1e-9)


def test_poses_that_are_drawn_have_closed_loops_and_keep_ranges(linkage):
    model, passive, qpos = linkage(1.0, 'range="-40 70"')
    poses = passive.draw(qpos, (0.5, 1.5), 20, 0, "where")
    crank = poses[:, model.joint("crank").qposadr[0]]
    assert ((crank > 0.5) & (crank < math.radians(70.0) + 1e-6)).all()  # beyond, the follower would be out of range
    assert np.ptp(crank) > 0.4
    np.testing.assert_allclose(poses[:, passive.qpos_columns[1]], crank, atol=1e-5)
    np.testing.assert_array_equal(poses, passive.draw(qpos, (0.5, 1.5), 20, 0, "where"))


def test_loops_that_do_not_close_are_an_error(linkage):
    with pytest.raises(ConfigError, match=r"^robot\.yaml: at these angles the passive joints follower would be beyond"):
        linkage(1.3, 'range="-40 70"')
    model = mujoco.MjModel.from_xml_string(LINKAGE.format(range=""))
    passive = PassiveJoints.of(model, [1, 3], [2, 4, 5])  # crank and follower held apart: the rod is too short
    with pytest.raises(ConfigError, match=r"^robot\.yaml: the loops of the model's equality constraints do not close"):
        default_qpos(model, [1, 3], np.array([0.5, -0.9]), passive, "robot.yaml")


def test_cassie_at_home_is_as_menagerie_says():
    """Its keyframe, which gravity bends a little."""
    robot = load_robot("cassie")
    home = {"hip_roll": 0.0045, "hip_yaw": 0.0, "hip_pitch": 0.4973, "knee": -1.1997, "foot": -1.59681}
    angles = np.array([home[name.split("_", 1)[1]] for name in robot.joint_names])
    angles[5] = -angles[5]
    qpos = robot.passive.settle(angles, robot.default_qpos)
    found = dict(zip(robot.passive.names, qpos[list(robot.passive.qpos_columns)], strict=True))
    for side in ("left", "right"):
        for name, angle in {"shin": 0.0, "tarsus": 1.42671, "heel_spring": 0.0}.items():
            assert found[f"{side}_{name}"] == pytest.approx(angle, abs=0.01)
        for name, angle in {"foot_crank": -1.52439, "plantar_rod": 1.50645}.items():
            assert found[f"{side}_{name}"] == pytest.approx(angle, abs=0.04)  # its loop is 2 mm open there
    # The achilles rod keeps the sum of knee and tarsus near 13 degrees.
    for knee in (-0.8, -1.6, -2.0):
        angles[[3, 8]] = knee
        qpos = robot.passive.settle(angles, robot.default_qpos)
        assert math.degrees(knee + qpos[robot.passive.qpos_columns[1]]) == pytest.approx(13.0, abs=3.0)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
def test_a_task_of_cassie(engine):
    """Loops are closed after resets and stay so; joints are the driven ones; springs can be observed."""
    observed = ["base_ang_vel", "dof_pos", "passive_pos", "passive_vel", "actions"]
    settings = [
        ("robot", "cassie"),
        ("sim.physics", engine),
        ("sim.njmax", 128),
        ("observations.groups.actor.terms", observed),
        ("observations.groups.actor.noise", False),
    ]
    task = small_task(*settings, num_envs=4)
    assert task.num_actions == task.dof_pos.shape[1] == 10
    assert task.physics.qpos.shape[1] == 35
    columns, rates = list(task.robot.qpos_columns), list(task.robot.qvel_columns)
    assert gap(task) < 1e-5
    assert task.dof_pos.std(dim=0).min() >= 0.0
    assert not torch.equal(task.dof_pos[0], task.dof_pos[1])  # each has a pose of its own
    for _ in range(25):
        seen, *_ = task.step(torch.zeros(4, 10))
        assert torch.equal(task.dof_pos, task.physics.qpos[:, columns])
        assert torch.equal(task.dof_vel, task.physics.qvel[:, rates])
        assert gap(task) < 0.03
    assert task.dof_vel.abs().max() < 30.0
    passive = seen["actor"][:, 13:23]
    away = task.physics.qpos[:, list(task.robot.passive.qpos_columns)] - task.passive_default_pos
    alive = task.episode_length_buf > 0
    torch.testing.assert_close(passive[alive], away[alive])
    assert passive[:, [0, 2]].abs().max() > 1e-3  # shin and heel of the left leg give way
    columns, signs = task.mirror_images().groups["actor"]
    assert columns.tolist()[13:23] == [18, 19, 20, 21, 22, 13, 14, 15, 16, 17]
    assert signs.tolist()[13:23] == [1.0] * 10


def gap(task) -> float:
    """How far the loops of all worlds are open [m]."""
    model, data, most = task.physics.model, mujoco.MjData(task.physics.model), 0.0
    for qpos in task.physics.qpos.double().numpy():
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        equality = np.asarray(data.efc_type) == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert equality.sum() == 12
        most = max(most, float(np.abs(np.asarray(data.efc_pos)[equality]).max()))
    return most


def test_feet_behind_passive_joints_are_where_the_model_has_them():
    """With springs bent and loops open: kinematics need neither."""
    robot, sim = load_robot("cassie"), SimConfig(physics="mujoco")
    physics = make_physics(RobotScene(robot), sim, 5, torch.device("cpu"))
    random = np.random.default_rng(1)
    qpos, qvel = np.tile(robot.default_qpos, (5, 1)), random.normal(size=(5, 32))
    qpos[:, 7:] += 0.2 * random.normal(size=(5, 28))
    qpos[:, 2] = 2.0
    for column in (3, 10, 24):
        qpos[:, column : column + 4] /= np.linalg.norm(qpos[:, column : column + 4], axis=1, keepdims=True)
    physics.write(torch.ones(5, dtype=torch.bool), torch.tensor(qpos), torch.tensor(qvel))
    physics.refresh()
    data, velocity = mujoco.MjData(physics.model), np.zeros(6)
    for i in range(5):
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_forward(physics.model, data)
        for foot, name in enumerate(robot.feet_names):
            geom = physics.model.geom(name).id
            np.testing.assert_allclose(physics.robot_state.feet_pos[i, foot], data.geom_xpos[geom], atol=1e-5)
            mujoco.mj_objectVelocity(physics.model, data, mujoco.mjtObj.mjOBJ_GEOM, geom, velocity, 0)
            np.testing.assert_allclose(physics.robot_state.feet_vel[i, foot], velocity[3:], atol=1e-4)


def test_what_cannot_be():
    newton = SimConfig(physics="newton")
    with pytest.raises(ConfigError, match="newton does not simulate the joints of 'cassie' that no motor drives"):
        make_physics(RobotScene(load_robot("cassie")), newton, 1, torch.device("cpu"))
    with pytest.raises(ConfigError, match="passive_pos: 'anymal_c' has no passive hinges or slides"):
        small_task(("observations.groups.actor.terms", ["passive_pos"]))
