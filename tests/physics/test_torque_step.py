"""The step in few launches: that of C MuJoCo, for shipped robots, for gymnasium's, and for trees of all kinds of joints."""

import shutil

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp
from mechanisms import CROOKED, EVERY_JOINT, FusedWorlds, c_worlds, packaged, random_motion, random_tree, relative_error
from reference import CWorlds, random_states

from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.physics import make_physics as build_physics
from legged.physics.fused.constraint_solver import ConstraintSolver, ask_for_dense_rows
from legged.physics.scene import RobotScene
from legged.robots.robot import Robot, load_robot


def changed(robot: Robot, folder, old: str, new: str) -> Robot:
    """Return the robot with a text of its model replaced."""
    text = robot.model_path.read_text()
    assert old in text
    shutil.copy(robot.folder / "robot.yaml", folder)
    (folder / robot.model_path.name).write_text(text.replace(old, new))
    return load_robot(str(folder))


def test_a_model_with_another_integrator_is_refused(robot):
    model = RobotScene(robot).model(SimConfig())
    ask_for_dense_rows(model)
    for integrator, reason in (("EULER", ""), ("IMPLICITFAST", "the model's integrator is not Euler")):
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
        with wp.ScopedDevice("cpu"):
            assert ConstraintSolver.why_not(mjw.put_model(model), mjw.make_data(model, njmax=20)) == reason


def test_what_keeps_a_robot_off_is_said(robot, tmp_path):
    """An error where the fused step is demanded; otherwise a reason, and the solver alone is ours."""
    other = changed(robot, tmp_path, '<joint axis="0 1 0"', '<joint damping="1.5 1" axis="0 1 0"')
    with pytest.raises(ConfigError, match=r"sim\.step=fused: the model has nonlinear dampers; sim\.step=auto"):
        build_physics(RobotScene(other), SimConfig(physics="mujoco_warp", step="fused"), 1, torch.device("cpu"))
    physics = build_physics(RobotScene(other), SimConfig(physics="mujoco_warp"), 1, torch.device("cpu"))
    assert physics.why_library == "the model has nonlinear dampers"


@pytest.mark.slow
@pytest.mark.parametrize("damping", ["", ' damping="1.5"', ' damping="1.5 .01"'])
def test_torques_beyond_the_limits_move_as_in_c_mujoco(robot, tmp_path, damping):
    """With dampers in the knees too, and with such as need mujoco-warp's own stages: on 20 steps, through contacts."""
    other = changed(robot, tmp_path, '<joint axis="0 1 0"', f'<joint{damping} axis="0 1 0"')
    sim = SimConfig(physics="mujoco_warp")
    physics = build_physics(RobotScene(other), sim, 4, torch.device("cpu"))
    states = random_states(other, 4, seed=8)
    states.write(physics)
    reference = CWorlds(other, sim, states)
    torques = 60.0 * torch.randn(4, 12, generator=torch.Generator().manual_seed(1))
    assert (torques.abs() > 80.0).any()
    physics.ctrl.copy_(torques)
    for _ in range(20):
        physics.step()
        reference.step(torques)
    physics.refresh()
    for name in ("base_pos", "base_quat", "dof_pos"):
        np.testing.assert_allclose(getattr(physics.robot_state, name), reference.observe()[name], atol=5e-5, err_msg=name)
    assert bool(physics.why_library) == (damping == ' damping="1.5 .01"')


ALONG = {"half cheetah": ("half_cheetah.xml", 0.01, 1.0), "humanoid": ("humanoid.xml", 0.003, 0.4)}


@pytest.mark.slow
@pytest.mark.parametrize("name", ALONG)
def test_every_step_of_a_rollout_is_that_of_c_mujoco(name, device):
    """Each of 100 states that a rollout of C MuJoCo under random controls passes, through contacts and limits, is a world
    that makes one step. What float32 leaves of a stiff contact's force is 1e-4 of it.
    """
    file, dt, most = ALONG[name]
    model = packaged(file, timestep=dt)
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    data.qvel[:] = 0.1 * rng.normal(size=model.nv)
    before, after, accelerations, forces = [], [], [], []
    touching = 0
    for k in range(1000):
        if k % 5 == 0:
            data.ctrl[:] = np.float32(rng.uniform(-1.5 * most, 1.5 * most, model.nu))
        data.qpos[:], data.qvel[:] = np.float32(data.qpos), np.float32(data.qvel)
        start = [values.copy() for values in (data.qpos, data.qvel, data.ctrl)]
        mujoco.mj_step(model, data)
        if k % 10 == 0:
            before.append(start)
            after.append([data.qpos.copy(), data.qvel.copy()])
            accelerations.append(data.qacc.copy())
            forces.append(data.qfrc_actuator.copy())
            touching += data.ncon > 0
    assert touching > 30
    fused = FusedWorlds(model, len(before), device=device)
    fused.write(*(np.stack(column) for column in zip(*before, strict=True)))
    fused.step()
    for i, (qpos, qvel) in enumerate(after):
        assert relative_error(fused.read("qpos")[i], qpos) < 1e-5, i
        assert relative_error(fused.read("qvel")[i], qvel) < 1e-4, i
        assert relative_error(fused.read("qacc")[i], accelerations[i]) < 1e-3, i
        assert relative_error(fused.read("qfrc_actuator")[i], forces[i]) < 1e-6, i


FREELY = {
    "half cheetah": lambda: without_contacts(packaged("half_cheetah.xml", timestep=0.01)),
    "humanoid": lambda: without_contacts(packaged("humanoid.xml", timestep=0.003)),
    "crooked": lambda: without_contacts(mujoco.MjModel.from_xml_string(CROOKED)),
    "every joint": lambda: without_contacts(mujoco.MjModel.from_xml_string(EVERY_JOINT)),
}


def without_contacts(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return the model with nothing that touches and no limits of joints: what then moves it is smooth."""
    model.geom_contype[:], model.geom_conaffinity[:], model.jnt_limited[:] = 0, 0, 0
    return model


def difference(model: mujoco.MjModel, worlds: int, steps: int, seed: int, device: str) -> float:
    """Return the largest difference of positions and velocities from C MuJoCo after `steps` without constraints, in units of
    the largest of either.
    """
    motion = random_motion(model, worlds, seed)
    fused, datas = FusedWorlds(model, worlds, device=device), c_worlds(model, *motion)
    fused.write(*motion)
    for _ in range(steps):
        fused.step(constrained=False)
        for data in datas:
            mujoco.mj_step(model, data)
    assert not any(data.nefc for data in datas)
    found = {name: fused.read(name) for name in ("qpos", "qvel")}
    return max(relative_error(found[name][i], getattr(data, name)) for name in found for i, data in enumerate(datas))


@pytest.mark.slow
@pytest.mark.parametrize("name", FREELY)
def test_a_hundred_steps_without_contacts_are_those_of_c_mujoco(name, device):
    model = FREELY[name]()
    assert difference(model, worlds=8, steps=100, seed=4, device=device) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("joints", "passive"), [(2, True), (7, False), (20, True)])
def test_random_trees_move_as_in_c_mujoco(joints, passive, device):
    """Two trees of as many joints, of slides and hinges in any place: a hundred steps of three worlds each."""
    for seed in range(2):
        model = random_tree(100 * joints + seed, joints, passive)
        assert model.nv == joints
        assert difference(model, worlds=3, steps=100, seed=seed, device=device) < 1e-4, seed


@pytest.mark.slow
@pytest.mark.parametrize("passive", [False, True])
def test_random_trees_are_held_by_their_limits_as_in_c_mujoco(passive, device):
    """One step of 20 worlds of each of two trees, of which most are beyond some limit."""
    for seed in range(2):
        model = random_tree(seed, 7, passive, limited=True)
        model.opt.iterations = 50
        motion = random_motion(model, 20, seed)
        fused, datas = FusedWorlds(model, 20, device=device), c_worlds(model, *motion)
        fused.write(*motion)
        fused.step()
        for i, data in enumerate(datas):
            mujoco.mj_step(model, data)
            assert fused.read("nefc")[i] == data.nefc
            for name in ("qpos", "qvel", "qacc", "qfrc_constraint"):
                assert relative_error(fused.read(name)[i], getattr(data, name)) < 1e-4, name
        assert sum(data.nefc > 1 for data in datas) > 10


def test_a_world_that_is_no_number_harms_no_neighbour(device):
    """Also where dampers are integrated implicitly, which takes a round more of the solver."""
    model = without_contacts(mujoco.MjModel.from_xml_string(EVERY_JOINT))
    motion = random_motion(model, 3, seed=0)
    found = []
    for bad in (False, True):
        fused = FusedWorlds(model, 3, device=device)
        motion[1][1, 2] = np.nan if bad else 0.0
        fused.write(*motion)
        for _ in range(5):
            fused.step(constrained=False)
        found.append(fused.read("qpos"))
    assert np.isfinite(found[0]).all()
    assert not np.isfinite(found[1][1]).all()
    np.testing.assert_array_equal(found[0][[0, 2]], found[1][[0, 2]])
