"""Poses, inertias and forces in one launch: those of C MuJoCo, for a shipped robot and for trees of all kinds of joints."""

import mujoco
import numpy as np
import pytest
import warp as wp
from mechanisms import CROOKED, EVERY_JOINT, FusedWorlds, c_worlds, packaged, random_motion, relative_error

from legged.config.world import SimConfig
from legged.physics.fused.smooth_dynamics import SmoothDynamics, shared_bytes
from legged.physics.scene import RobotScene
from legged.physics.warp.compile import launched
from legged.process.paths import data_folder
from legged.robots.robot import load_robot

MODELS = {
    "shipped": lambda robot: RobotScene(robot).model(SimConfig()),
    "crooked": lambda _: mujoco.MjModel.from_xml_string(CROOKED),
    "every joint": lambda _: mujoco.MjModel.from_xml_string(EVERY_JOINT),
    "half cheetah": lambda _: packaged("half_cheetah.xml"),
    "humanoid": lambda _: packaged("humanoid.xml"),
}
ROBOTS = sorted(path.parent.name for path in (data_folder("resources") / "robots").glob("*/robot.yaml"))
DRAWN = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_pos",
    "jnt_axis",
    "jnt_pos",
    "jnt_stiffness",
    "jnt_actfrcrange",
    "qpos_spring",
    "dof_armature",
    "dof_damping",
    "geom_pos",
    "actuator_gear",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_ctrlrange",
    "actuator_forcerange",
)
"""Arrays of a model in which worlds may differ."""


def check(fused: FusedWorlds, models: list[mujoco.MjModel], motion: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    """Check that a launch computes all that C MuJoCo does in each world's own model."""
    fused.write(*motion)
    with wp.ScopedDevice(fused.device):
        fused._step.begin()
    matrices = fused.mass_matrices()
    names = ("geom_xpos", "geom_xmat", "subtree_com", "cdof", "qfrc_passive", "qfrc_actuator", "qfrc_smooth")
    found = {name: fused.read(name) for name in names}
    for i, model in enumerate(models):
        (data,) = c_worlds(model, *(values[i : i + 1] for values in motion))
        mujoco.mj_forward(model, data)
        roots = np.unique(model.body_rootid[model.dof_bodyid])
        np.testing.assert_allclose(found["geom_xpos"][i], data.geom_xpos, atol=4e-6)
        np.testing.assert_allclose(found["geom_xmat"][i].reshape(-1, 9), data.geom_xmat, atol=2e-6)
        np.testing.assert_allclose(found["subtree_com"][i, roots], data.subtree_com[roots], atol=4e-6)
        np.testing.assert_allclose(found["cdof"][i], data.cdof, atol=5e-6)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        assert relative_error(matrices[i], full) < 1e-5
        for name in ("qfrc_passive", "qfrc_actuator", "qfrc_smooth"):
            assert relative_error(found[name][i], getattr(data, name)) < 1e-5, name


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_poses_inertias_and_forces_are_those_of_c_mujoco(robot, name, device):
    """In six worlds in any pose, moving fast, with quaternions of any length."""
    model = MODELS[name](robot)
    qpos, qvel, ctrl = random_motion(model, 6, seed=0)
    if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        qpos[:, 3:7] = np.float32(qpos[:, 3:7] * np.linspace(0.5, 2.0, 6)[:, None])
    check(FusedWorlds(model, 6, device=device), [model] * 6, (qpos, 3.0 * qvel, 20.0 * ctrl))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["crooked", "every joint"])
def test_worlds_may_differ_in_most_of_the_model(robot, name, device):
    """Every array that a randomisation may draw is read by world: each is C MuJoCo's world of its own model."""
    rng = np.random.default_rng(1)
    models = [MODELS[name](robot) for _ in range(4)]
    for model in models:
        for array in DRAWN:
            values = getattr(model, array)
            values[:] = np.float32(values * rng.uniform(0.8, 1.2, values.shape))
        model.geom_sameframe[:], model.body_sameframe[:] = (
            0,
            0,
        )  # short cuts of C MuJoCo for frames that are no longer the same
        model.jnt_axis[:] = np.float32(model.jnt_axis / np.linalg.norm(model.jnt_axis, axis=1, keepdims=True))
        model.body_iquat[:] = np.float32(model.body_iquat / np.linalg.norm(model.body_iquat, axis=1, keepdims=True))
        mujoco.mj_setConst(model, mujoco.MjData(model))
    drawn = {array: np.stack([getattr(model, array) for model in models]) for array in DRAWN}
    check(FusedWorlds(models[0], 4, drawn, device=device), models, random_motion(models[0], 4, seed=2))


def test_dampers_and_springs_that_only_some_worlds_have_are_felt(device):
    """The model itself has none, so that its own launch would not look for them."""
    models = [mujoco.MjModel.from_xml_string(CROOKED) for _ in range(3)]
    models[1].dof_damping[6:], models[2].jnt_stiffness[1:] = 0.7, 9.0
    drawn = {array: np.stack([getattr(model, array) for model in models]) for array in ("dof_damping", "jnt_stiffness")}
    check(FusedWorlds(models[0], 3, drawn, device=device), models, random_motion(models[0], 3, seed=3))


@pytest.mark.parametrize(
    ("sim", "one_launch"), [({}, True), ({"step": "fused"}, True), ({"tag": "stages"}, False), ({"step": "library"}, False)]
)
def test_a_shipped_robot_takes_one_launch_unless_asked_for_others(make_physics, sim, one_launch):
    physics = make_physics("mujoco_warp", **sim)
    modules = " ".join(build.module.name for build in launched(wp.get_device("cpu"), (physics._step,)))
    assert ("block_kernel" in modules) == one_launch
    assert ("mujoco_warp._src.smooth" in modules) != one_launch
    assert ("wide_kernel" in modules) == (sim.get("tag") == "stages")
    assert (physics.why_library == "") == one_launch


REFUSED = {
    "equality constraints of tendons": (
        "<actuator>",
        "<tendon><fixed name='t'><joint joint='tail' coef='1'/></fixed></tendon>"
        "<equality><tendon tendon1='t'/></equality><actuator>",
    ),
    "gravity compensation": ('<body name="tail"', '<body name="tail" gravcomp="1"'),
    "dampers or armature of actuators": ('<motor joint="tail"', '<motor joint="tail" armature="0.1"'),
    "nonlinear": ('axis="0 1 0"', 'axis="0 1 0" damping="1 2"'),
    "actuators with a state": ("<motor joint", '<general dyntype="filter" joint'),
    "neither a motor nor a position or velocity servo": ("<motor joint", '<general gaintype="affine" joint'),
    "neither a slide nor a hinge": ("<actuator>", '<actuator><adhesion body="tail" ctrlrange="0 1"/>'),
    "tendons with forces": (
        "<actuator>",
        '<tendon><fixed stiffness="1"><joint joint="tail" coef="1"/></fixed></tendon><actuator>',
    ),
    "mocap bodies": ("<worldbody>", '<worldbody><body mocap="true"/>'),
    "in a fluid": ("<option", '<option density="1.2"'),
    "disables spring": ("<worldbody>", '<option><flag spring="disable"/></option><worldbody>'),
    "enables optional features": ("<worldbody>", '<option><flag energy="enable"/></option><worldbody>'),
}


@pytest.mark.parametrize("reason", REFUSED)
def test_what_it_does_not_compute_is_refused(reason):
    old, new = REFUSED[reason]
    assert old in CROOKED
    assert reason in SmoothDynamics.why_not(mujoco.MjModel.from_xml_string(CROOKED.replace(old, new, 1)))


def test_what_it_computes_is_not_refused(robot):
    for name, build in MODELS.items():
        assert SmoothDynamics.why_not(build(robot), DRAWN) == "", name
    nothing = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    assert "no joints" in SmoothDynamics.why_not(nothing)


@pytest.mark.parametrize("array", ["body_gravcomp", "dof_dampingpoly", "actuator_armature", "tendon_stiffness"])
def test_worlds_that_differ_in_what_it_does_not_read_are_refused(array):
    assert array in SmoothDynamics.why_not(mujoco.MjModel.from_xml_string(CROOKED), ("geom_friction", array))


@pytest.mark.parametrize("name", ROBOTS)
def test_all_worlds_of_a_training_run_at_once(name):
    """An H100 has 132 multiprocessors of 228 KiB, so for 4096 worlds each has to hold 32, with the 2 KiB that CUDA and Warp
    take of each. A G1 once had room for 24, so that its launch took twice as long.
    """
    model = RobotScene(load_robot(name)).model(SimConfig())
    assert 132 * ((228 * 1024) // (shared_bytes(model) + 2 * 1024)) >= 4096
