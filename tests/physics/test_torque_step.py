"""The step of robots that only torques move: for which models it is taken, and that others lose nothing."""

import shutil

import mujoco
import numpy as np
import pytest
import torch
from reference import CWorlds, random_states

from legged.config.schema import SimConfig
from legged.physics import make_physics as build_physics
from legged.physics.fused.torque_step import TorqueStep
from legged.physics.scene.robot_scene import build_model
from legged.robots.robot import Robot, load_robot


def changed(robot: Robot, folder, old: str, new: str) -> Robot:
    """The robot with a text of its model replaced."""
    text = robot.model_path.read_text()
    assert old in text
    shutil.copy(robot.folder / "robot.yaml", folder)
    (folder / robot.model_path.name).write_text(text.replace(old, new))
    return load_robot(str(folder))


def test_the_shipped_robot_is_moved_by_torques(robot):
    assert TorqueStep.moved_by_torques(build_model(robot, SimConfig()))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("jnt_stiffness", 5.0),
        ("dof_damping", 0.5),
        ("body_gravcomp", 1.0),
        ("actuator_damping", 0.1),
        ("actuator_gear", 2.0),
        ("actuator_gainprm", 3.0),
        ("actuator_biastype", mujoco.mjtBias.mjBIAS_AFFINE),
        ("actuator_dyntype", mujoco.mjtDyn.mjDYN_FILTER),
        ("jnt_actfrclimited", 1),
    ],
)
def test_a_model_with_more_than_torques_is_seen(robot, field, value):
    model = build_model(robot, SimConfig())
    getattr(model, field)[-1] = value
    assert not TorqueStep.moved_by_torques(model)


def test_a_model_in_a_fluid_is_seen(robot):
    model = build_model(robot, SimConfig())
    model.opt.density = 1.2
    assert not TorqueStep.moved_by_torques(model)


TREES = {
    "hinges after a free joint": ("<freejoint/>", "hinge", ("a", "b"), ""),
    "no free joint": (
        "<joint type='slide' name='x'/>",
        "hinge",
        ("a", "b"),
        "its joints are not a free one followed by hinges",
    ),
    "a slide": ("<freejoint/>", "slide", ("a", "b"), "its joints are not a free one followed by hinges"),
    "motors the other way round": ("<freejoint/>", "hinge", ("b", "a"), "its motors are not one for each hinge"),
    "a joint without motor": ("<freejoint/>", "hinge", ("a",), "its motors are not one for each hinge"),
}


@pytest.mark.parametrize("name", TREES)
def test_only_a_free_base_with_driven_hinges_is_stepped(name):
    """The launch numbers degrees of freedom as such a robot has them; others it would simulate wrongly without a word."""
    root, kind, driven, why_not = TREES[name]
    link = "<geom size='0.1' mass='1'/>"
    motors = "".join(f"<motor joint='{joint}'/>" for joint in driven)
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><body>{root}{link}<body><joint name='a' type='{kind}'/>{link}"
        f"<body><joint name='b' type='hinge'/>{link}</body></body></body></worldbody><actuator>{motors}</actuator></mujoco>"
    )
    assert TorqueStep.moved_by_torques(model)
    found = TorqueStep.why_not(model)
    assert found.startswith(why_not)
    assert bool(found) == bool(why_not)


@pytest.mark.parametrize("damping", ["", ' damping="1.5"'])
def test_torques_beyond_the_limits_move_as_in_c_mujoco(robot, tmp_path, damping):
    """With dampers in the knees too, which need mujoco-warp's own stages: on 20 steps, through contacts."""
    other = changed(robot, tmp_path, '<joint axis="0 1 0"', f'<joint{damping} axis="0 1 0"')
    sim = SimConfig(physics="mujoco_warp")
    physics = build_physics(other, sim, 4, torch.device("cpu"))
    states = random_states(other, 4, seed=8)
    states.write(physics)
    reference = CWorlds(other, sim, states)
    torques = 60.0 * torch.randn(4, 12, generator=torch.Generator().manual_seed(1))
    assert (torques.abs() > 80.0).any()
    physics.torques.copy_(torques)
    for _ in range(20):
        physics.step()
        reference.step(torques)
    physics.refresh()
    for name in ("base_pos", "base_quat", "dof_pos"):
        np.testing.assert_allclose(getattr(physics.state, name), reference.observe()[name], atol=5e-5, err_msg=name)
    assert bool(damping) != TorqueStep.moved_by_torques(physics.model)
