"""Poses and velocities of named bodies are those of C MuJoCo, for all kinds of joints, engines and robots."""

from contextlib import nullcontext
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from helpers import CALM
from launches import counting

from legged import LeggedRobot, registry
from legged.errors import ConfigError
from legged.mdp.kernels.task import TaskKernels
from legged.mdp.sensors import BodyStates
from legged.physics import RobotScene
from legged.registry import make_task, register, task_config
from legged.robots.robot import load_robot

N = 5
KERNELS = pytest.mark.parametrize("kernels", [None, TaskKernels(nullcontext)], ids=["torch", "kernels"])
MECHANISM = """
<mujoco><worldbody>
  <body name="floating" pos="1 2 3"><freejoint/><geom size=".1"/>
    <body name="two" pos=".1 .2 .3" quat=".8 .6 0 0">
      <joint name="a" axis="0 1 1" pos=".1 0 .2" ref="20"/><joint name="b" axis="1 0 0" pos="0 .3 0"/><geom size=".1"/>
      <body name="welded" pos="0 0 .5" quat=".6 0 .8 0"><geom size=".1"/>
        <body name="swinging" pos=".2 0 0"><joint type="ball" pos=".1 .1 0"/><geom size=".1"/>
          <body name="sliding" pos=".1 0 0"><joint type="slide" axis="1 2 0" ref=".3"/><joint axis="0 0 1"/><geom size=".1"/>
  </body></body></body></body></body>
  <body name="rail" pos="0 -1 0" quat=".6 0 0 .8"><joint type="slide" axis="0 0 1"/><geom size=".1"/></body>
  <body name="fixed" pos="4 5 6"><geom size=".1"/></body>
</worldbody></mujoco>"""


def states(model: mujoco.MjModel) -> tuple[torch.Tensor, torch.Tensor]:
    """Random positions and velocities of N worlds."""
    random = np.random.default_rng(2)
    qpos, qvel = np.tile(model.qpos0, (N, 1)), random.standard_normal((N, model.nv))
    for row in qpos:
        mujoco.mj_integratePos(model, row, random.standard_normal(model.nv), 1.0)
    return torch.tensor(qpos, dtype=torch.float32), torch.tensor(qvel, dtype=torch.float32)


def assert_mujocos(sensor: BodyStates, model: mujoco.MjModel, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
    """Compare a sensor with C MuJoCo's kinematics and `mj_objectVelocity` of the same states."""
    data, found = mujoco.MjData(model), np.zeros(6)
    for world in range(len(qpos)):
        data.qpos[:], data.qvel[:] = qpos[world].double().numpy(), qvel[world].double().numpy()
        mujoco.mj_forward(model, data)
        for k, name in enumerate(sensor.names):
            body = model.body(name).id
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, found, 0)
            quat = sensor.quat[world, k].numpy()
            np.testing.assert_allclose(sensor.pos[world, k], data.xpos[body], atol=2e-5)
            np.testing.assert_allclose(quat * np.sign(quat @ data.xquat[body]), data.xquat[body], atol=2e-5)
            np.testing.assert_allclose(sensor.ang_vel[world, k], found[:3], rtol=1e-5, atol=2e-5)
            np.testing.assert_allclose(sensor.lin_vel[world, k], found[3:], rtol=1e-5, atol=5e-5)


def measured(model: mujoco.MjModel, names, kernels, qpos: torch.Tensor, qvel: torch.Tensor) -> BodyStates:
    """The sensor, after one update."""
    physics = SimpleNamespace(model=model, num_envs=N, device=torch.device("cpu"), qpos=qpos, qvel=qvel)
    sensor = BodyStates(physics, names, kernels)
    sensor.update()
    return sensor


@KERNELS
def test_joints_of_all_kinds_are_followed(kernels):
    model = mujoco.MjModel.from_xml_string(MECHANISM)
    names = [model.body(i).name for i in range(1, model.nbody)]
    qpos, qvel = states(model)
    assert_mujocos(measured(model, names[::-1], kernels, qpos, qvel), model, qpos, qvel)


def test_a_hinge_and_its_arm_by_hand():
    """A body 2 m from a hinge about z that turned by 90 degrees, at 3 rad/s: at (0, 2, 1), 6 m/s along -x."""
    xml = """<mujoco><worldbody><body pos="0 0 1"><joint axis="0 0 1"/><geom size=".1"/>
    <body name="end" pos="2 0 0"><geom size=".1"/></body></body></worldbody></mujoco>"""
    qpos, qvel = torch.full((N, 1), torch.pi / 2), torch.full((N, 1), 3.0)
    sensor = measured(mujoco.MjModel.from_xml_string(xml), ["end"], None, qpos, qvel)
    root = 0.5**0.5
    for found, wanted in (
        (sensor.pos, [0.0, 2.0, 1.0]),
        (sensor.quat, [root, 0.0, 0.0, root]),
        (sensor.lin_vel, [-6.0, 0.0, 0.0]),
        (sensor.ang_vel, [0.0, 0.0, 3.0]),
    ):
        torch.testing.assert_close(found, torch.tensor([[wanted]]).expand_as(found))


@KERNELS
@pytest.mark.parametrize("name", ["anymal_c", "g1", "cassie", "go2w"])
def test_all_bodies_of_robots_are_followed(kernels, name):
    model = RobotScene(load_robot(name)).model(task_config(f"{name}_flat").sim)
    names = [model.body(i).name for i in range(1, model.nbody)]
    qpos, qvel = states(model)
    assert_mujocos(measured(model, names, kernels, qpos, qvel), model, qpos, qvel)


class Tracking(LeggedRobot):
    """A task that reads three bodies."""

    def make_sensors(self):
        bodies = BodyStates(self.physics, ("LF_SHANK", "base", "RH_THIGH"), self.kernels)
        return {**super().make_sensors(), "bodies": bodies}

    def _metric_shank(self):
        return self.sensors["bodies"].pos[:, 0, 2]


@pytest.fixture
def tracking(monkeypatch):
    """tracking(engine): the task above."""
    monkeypatch.setattr(registry, "_REGISTERED", {})
    register("tracking", {"extends": "anymal_c_flat"}, Tracking)

    def tracking(engine, *settings):
        given = [("env.num_envs", N), ("sim.physics", engine), ("sim.threads", 1), ("env.episode_length_s", 0.1)]
        return make_task(task_config("tracking", [*given, *CALM, *settings], on_cpu=True))

    return tracking


@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp", "newton"])
def test_a_task_measures_bodies_after_steps_and_after_resets(tracking, engine):
    """Episodes of five steps: the states at the end of each step, those of new episodes among them."""
    task = tracking(engine)
    torch.manual_seed(1)
    for _ in range(7):
        task.step(torch.randn(N, 12))
        assert_mujocos(task.sensors["bodies"], task.physics.model, task.physics.qpos, task.physics.qvel)
        torch.testing.assert_close(task.sensors["bodies"].pos[:, 1], task.base_pos)
    before = task.sensors["bodies"].pos.clone()
    saved = task.state_dict()
    task.step(torch.randn(N, 12))
    task.load_state_dict(saved)
    task.sense()
    torch.testing.assert_close(task.sensors["bodies"].pos, before)


def test_bodies_are_one_launch_for_each_measurement(tracking):
    task, found = tracking("mujoco_warp"), []
    for sensors in (task.sensors, {}):
        task.sensors = sensors
        task.sense()
        with torch.no_grad(), counting() as launches:
            task.sense()
        found.append(launches.total())
    assert found[0] - found[1] == 1


def test_a_body_that_is_not_there_is_refused_by_name():
    model = mujoco.MjModel.from_xml_string(MECHANISM)
    with pytest.raises(ConfigError, match=r"^BodyStates: there is no body 'weldet'; did you mean 'welded'\?"):
        measured(model, ["weldet"], None, *states(model))
