"""Every robot under resources/robots against its data sheet: masses, geometry, limits, symmetry, and how it stands."""

import mujoco
import numpy as np
import pytest
import torch
from reference import roll
from robot_facts import FACTS

from legged.config.robot import RobotControlConfig
from legged.config.world import SimConfig
from legged.mdp.control import control_gains
from legged.physics import RobotScene, make_physics
from legged.robots.patterns import match_values
from legged.robots.robot import Robot, load_robot

STIFF_CONTACTS = {"cone": "elliptic", "impratio": 100.0, "iterations": 100, "ls_iterations": 50}


@pytest.fixture(scope="module", params=sorted(FACTS))
def robot(request) -> Robot:
    return load_robot(request.param)


@pytest.fixture(scope="module")
def facts(robot):
    return FACTS[robot.name]


@pytest.fixture(scope="module")
def model(robot) -> mujoco.MjModel:
    return RobotScene(robot).model(SimConfig())


def posed(model: mujoco.MjModel, robot: Robot, angles: np.ndarray) -> mujoco.MjData:
    """Base at the origin, level, so that world and base frame are the same; passive joints as in the default pose."""
    data = mujoco.MjData(model)
    data.qpos[:] = robot.default_qpos
    data.qpos[list(robot.qpos_columns)] = angles
    if robot.passive is not None and not angles.any():
        data.qpos[list(robot.passive.qpos_columns)] = 0.0
    mujoco.mj_forward(model, data)
    return data


def test_mass_centre_and_inertia(robot, facts, model):
    assert robot.mass == pytest.approx(facts.mass, abs=1e-4)
    assert model.body_mass.sum() == pytest.approx(facts.mass, abs=1e-4)
    base = model.body(robot.file.base)
    centre = posed(model, robot, robot.default_dof_pos).subtree_com[base.id]
    np.testing.assert_allclose(centre, facts.centre, atol=1e-5)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, base.iquat)
    turn = turn.reshape(3, 3)
    inertia = turn @ np.diag(base.inertia) @ turn.T
    np.testing.assert_allclose(np.diag(inertia), facts.base_inertia, rtol=1e-4)


def test_joints_and_their_limits(robot, facts, model):
    assert robot.joint_names == facts.joints
    np.testing.assert_allclose(robot.torque_limits, match_values(facts.effort, facts.joints, "effort"))
    np.testing.assert_allclose(robot.dof_vel_limits, match_values(facts.speed, facts.joints, "speed"))
    for i, name in enumerate(facts.joints):
        expected = facts.ranges[max((key for key in facts.ranges if key in name), key=len)]
        np.testing.assert_allclose(robot.dof_pos_limits[i], expected, atol=5e-6, err_msg=name)
    joints = [model.joint(name) for name in facts.joints]
    expected = match_values(facts.armature, facts.joints, "armature") if facts.armature else np.zeros(len(joints))
    np.testing.assert_allclose([joint.armature[0] for joint in joints], expected, rtol=1e-4)


@pytest.mark.parametrize("pose", ["default", "zero"])
def test_feet_are_where_the_links_put_them(robot, facts, model, pose):
    angles = robot.default_dof_pos if pose == "default" else np.zeros(robot.num_dof)
    data = posed(model, robot, angles)
    assert robot.feet_names == tuple(sorted(facts.feet, key=robot.feet_names.index))
    for shapes, name in zip(robot.feet_shapes, robot.feet_names, strict=True):
        body = data.body(model.geom(shapes[0]).bodyid[0])
        at = data.geom(shapes[0]).xpos if facts.foot_point is None else body.xpos + body.xmat.reshape(3, 3) @ facts.foot_point
        np.testing.assert_allclose(at, facts.feet[name][pose == "zero"], atol=1e-5, err_msg=name)


def test_default_pose_is_within_the_limits(robot):
    low, high = robot.dof_pos_limits.T
    assert (robot.default_dof_pos > low).all()
    assert (robot.default_dof_pos < high).all()


def test_left_and_right_are_mirror_images(robot, model):
    """Of joints with their limits and gains, of feet, and of the model: the mirrored pose has the mirrored feet."""
    mirror = robot.mirror
    assert mirror is not None
    partners, signs = list(mirror.joints), np.array(mirror.signs)
    assert [partners[i] for i in partners] == list(range(robot.num_dof))
    np.testing.assert_allclose(robot.default_dof_pos[partners] * signs, robot.default_dof_pos, atol=1e-9)
    for limit in (robot.torque_limits, robot.dof_vel_limits, *control_gains(robot, RobotControlConfig())):
        np.testing.assert_array_equal(limit[partners], limit)
    low, high = robot.dof_pos_limits.T
    np.testing.assert_allclose(np.where(signs > 0, low[partners], -high[partners]), low, atol=1e-9)
    angles = np.random.default_rng(0).uniform(np.maximum(low, -np.pi), np.minimum(high, np.pi))
    here, there = posed(model, robot, angles), posed(model, robot, angles[partners] * signs)
    for shapes, others in zip(robot.feet_shapes, (robot.feet_shapes[i] for i in mirror.feet), strict=True):
        place = np.mean([here.geom(name).xpos for name in shapes], axis=0)
        image = np.mean([there.geom(name).xpos for name in others], axis=0)
        np.testing.assert_allclose(place * [1, -1, 1], image, atol=1e-3)


def test_drawn_shapes_neither_collide_nor_weigh(robot):
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    drawn = [i for i in range(model.ngeom) if not model.geom(i).name]
    assert len(drawn) > 20
    assert (model.geom_contype[drawn] == 0).all()
    assert (model.geom_conaffinity[drawn] == 0).all()
    assert (model.geom_group[drawn] == 2).all()
    shapes = [model.geom(name).id for name in robot.shape_names]
    assert (model.geom_group[shapes] == 3).all()
    assert (model.geom_priority[shapes] == 1).all()
    kinds = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("SPHERE", "CAPSULE", "CYLINDER", "BOX")}
    assert set(model.geom_type[shapes]) <= kinds  # all that the terrain's own collider knows


@pytest.mark.slow
def test_standing_robot_keeps_its_height(robot, facts):
    """A robot that topples does so as stiffly as a statue: its joints stay where its gains hold them."""
    sim = SimConfig(physics="mujoco", **STIFF_CONTACTS)
    physics = make_physics(RobotScene(robot), sim, 1, torch.device("cpu"))
    start = torch.tensor(robot.default_qpos, dtype=torch.float32).unsqueeze(0)
    start[:, 2] = 0.001 - lowest_foot(physics.model, robot)
    physics.write(torch.ones(1, dtype=torch.bool), start, torch.zeros_like(physics.qvel))
    physics.refresh()
    targets = start[:, list(robot.qpos_columns)]
    own = facts.gains or map(torch.tensor, control_gains(robot, RobotControlConfig()))
    gains = dict(zip(("stiffness", "damping"), own, strict=True))
    state = physics.robot_state
    if facts.standing is not None:
        roll(physics, targets, 400, **gains)
        assert state.base_pos[0, 2].item() == pytest.approx(facts.standing, abs=0.005)
        assert state.projected_gravity[0, 2].item() < -0.999
        return
    for _ in range(400):
        roll(physics, targets, 1, **gains)
        if state.projected_gravity[0, 2] > -np.cos(np.radians(30.0)):
            break
        assert (state.dof_pos - targets).abs().max() < 0.6
    assert _ * physics.dt == pytest.approx(facts.topples, abs=0.15)


def lowest_foot(model: mujoco.MjModel, robot: Robot) -> float:
    """Lowest point of the feet in the default pose, base at the origin; they are spheres and capsules."""
    data = posed(model, robot, robot.default_dof_pos)
    geoms = [model.geom(name).id for shapes in robot.feet_shapes for name in shapes]
    reach = model.geom_size[geoms, 0] + np.abs(data.geom_xmat[geoms, 8]) * model.geom_size[geoms, 1]
    return float((data.geom_xpos[geoms, 2] - reach).min())


def test_robot_has_a_licence(robot):
    text = (robot.folder / "PROVENANCE.md").read_text()
    assert "BSD-3-Clause" in text or "Apache-2.0" in text or "MIT" in text
