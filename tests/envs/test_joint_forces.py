"""Forces at joints, and forces of any direction: against C MuJoCo, by their statistics, alike with kernels."""

from contextlib import nullcontext

import mujoco
import numpy as np
import pytest
import torch
from helpers import ENGINE, small_task

from legged.config.randomization import ForceConfig
from legged.config.robot import RobotDomainRandConfig
from legged.errors import ConfigError
from legged.mdp.disturbances import Disturbances
from legged.mdp.kernels.task import TaskKernels
from legged.mdp.random_pool import RandomPool
from legged.registry import make_task, task_config
from legged.state import state_of

N, CPU = 64, torch.device("cpu")
ALWAYS = {"interval_s": [0.02, 0.02], "duration_s": [0.1, 0.1]}


def punched(num_envs, joints, engine="mujoco", **settings):
    """G1s that are hit all the time, at random poses."""
    force = {"joints": joints, "size": [100.0, 500.0], **ALWAYS, **settings}
    changes = [("env.num_envs", num_envs), *ENGINE, ("sim.physics", engine), ("init_state.dof_pos_factor", [0.0, 2.0])]
    return make_task(task_config("g1_flat", [*changes, ("domain_rand.forces", {"punch": force})], on_cpu=True))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp", "newton"])
def test_a_force_at_a_joint_moves_the_robot_as_one_at_its_anchor(engine):
    """C MuJoCo's generalised forces of the force at the anchor are those of force and torque at the centre of mass."""
    torch.manual_seed(0)
    task = punched(8, ["_joint"], engine)
    for _ in range(5):
        task.step(torch.zeros(8, 29))
    model, data, punch = task.physics.model, mujoco.MjData(task.physics.model), task.disturbances.forces["punch"]
    joints = set()
    for robot in range(8):
        force, number = punch.force[robot].double().numpy(), int(punch.joint[robot])
        assert 100.0 <= np.linalg.norm(force) <= 500.0
        joint = model.joint(task.robot.joint_names[number])
        body = int(model.jnt_bodyid[joint.id])
        data.qpos[:] = task.physics.qpos[robot].numpy()
        mujoco.mj_fwdPosition(model, data)
        wanted, found = np.zeros(model.nv), np.zeros(model.nv)
        mujoco.mj_applyFT(model, data, force, np.zeros(3), data.xanchor[joint.id], body, wanted)
        wrenches = task.physics.forces[robot].double().numpy()
        assert [k for k in range(model.nbody) if wrenches[k].any()] == [body]
        mujoco.mj_applyFT(model, data, wrenches[body, :3].copy(), wrenches[body, 3:].copy(), data.xipos[body], body, found)
        np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=2e-2)
        joints.add(number)
    assert len(joints) > 3


def test_directions_are_uniform_on_the_sphere_and_sizes_and_joints_in_their_ranges():
    """The mean direction is 0, each squared component has the mean 1/3, and each of four joints has a quarter."""
    torch.manual_seed(0)
    task = small_task(("domain_rand.forces", {"f": {"joints": ["HAA"], "size": [200.0, 300.0], **ALWAYS}}))
    force = task.disturbances.forces["f"]
    force.take(task.disturbances._draws.at_once(40_000))
    force.turn()
    size = force.drawn[:, :3].norm(dim=1)
    assert (size.min().item(), size.max().item()) == pytest.approx((200.0, 300.0), abs=0.1)
    assert size.mean().item() == pytest.approx(250.0, abs=1.0)
    direction = force.drawn[:, :3] / size[:, None]
    assert direction.mean(dim=0).abs().max() < 0.015
    torch.testing.assert_close(direction.square().mean(dim=0), torch.full((3,), 1 / 3), atol=0.01, rtol=0.0)
    shares = torch.bincount(force.drawn[:, 5].long(), minlength=4) / 40_000
    torch.testing.assert_close(shares, torch.full((4,), 0.25), atol=0.01, rtol=0.0)


@pytest.mark.slow
def test_a_force_on_a_body_may_have_any_direction_too_and_grows_from_nothing():
    force = {"body": "LF_THIGH", "size": [50.0, 50.0], "grow": [10, 20], **ALWAYS}
    task = small_task(("domain_rand.forces", {"f": force}), ("train.runner.num_steps_per_env", 24))
    for begun, size in ((0, 0.0), (15, 25.0), (20, 50.0)):
        task.disturbances.steps.fill_(24.0 * begun)
        task.disturbances.draw()
        assert task.disturbances.forces["f"].drawn[:, :3].norm(dim=1).tolist() == pytest.approx([size] * 4, abs=1e-3)
    for _ in range(5):
        task.step(torch.zeros(4, 12))
    wrenches = task.physics.forces[:, task.physics.model.body("LF_THIGH").id]
    assert wrenches[:, :3].norm(dim=1).tolist() == pytest.approx([50.0] * 4, abs=1e-3)
    assert not wrenches[:, 3:].any()


@pytest.mark.slow
def test_a_force_at_a_joint_lasts_and_ends_as_one_on_a_body():
    """0.08 s of each 0.12 s are four of six control steps of 0.02 s; the joint stays the same meanwhile."""
    force = {"joints": ["_joint"], "size": [1.0, 2.0], "interval_s": [0.04, 0.04], "duration_s": [0.08, 0.08]}
    task = small_task(("robot", "g1"), ("domain_rand.forces", {"f": force}), num_envs=2)
    mask, acting, joints = torch.ones(2, dtype=torch.bool), [], []
    for _ in range(30):
        task.numbers.draw()
        task.disturbances.draw()
        task.disturbances.act(task.physics, mask)
        acting.append(bool(task.physics.forces[0].any()))
        joints.append(int(task.disturbances.forces["f"].joint[0]))
    shown = "".join("x" if on else "." for on in acting).strip(".")
    assert shown[:16] == "xxxx..xxxx..xxxx"
    first = acting.index(True)
    assert len(set(joints[first : first + 6])) == 1
    assert len(set(joints)) > 2
    task.disturbances.act(task.physics, torch.tensor([True, False]))
    assert not task.physics.forces[1].any()


class Engine:
    """An engine with a model and forces alone."""

    def __init__(self, task):
        self.model, self.num_envs, self.device = task.physics.model, N, CPU
        torch.manual_seed(1)
        self.qpos, self.qvel = torch.randn(N, self.model.nq), torch.randn(N, self.model.nv)
        self.forces = torch.zeros(N, self.model.nbody, 6)


@pytest.mark.parametrize("others", [False, True])
def test_kernels_do_the_same(others):
    """Alone, and besides forces on bodies, which a kernel handles."""
    task = small_task(num_envs=1)
    hit = ForceConfig(joints=("KFE", "HAA"), interval_s=(0.05, 0.2), duration_s=(0.04, 0.1), size=(10.0, 50.0))
    pull = ForceConfig(body="LF_THIGH", interval_s=(0.05, 0.2), duration_s=(0.04, 0.1), y=(-50.0, 50.0))
    cfg = RobotDomainRandConfig(forces={"hit": hit, **({"pull": pull} if others else {})})
    pools, parts, engines = [], [], []
    for kernels in (None, TaskKernels(nullcontext)):
        torch.manual_seed(3)
        pools.append(RandomPool(N, CPU))
        engines.append(Engine(task))
        parts.append(Disturbances(cfg, engines[-1], 0.02, 24, pools[-1], kernels, task.robot.joint_names))
    for step in range(20):
        mask = torch.rand(N) < 0.9
        for part, pool, engine in zip(parts, pools, engines, strict=True):
            torch.manual_seed(step)
            pool.draw()
            part.draw()
            part.act(engine, mask)
        for one, other in zip(*(state_of(part).values() for part in parts), strict=True):
            torch.testing.assert_close(one, other, rtol=0.0, atol=0.0)
        torch.testing.assert_close(engines[1].forces, engines[0].forces, rtol=1e-5, atol=1e-4)
        assert not engines[1].forces[~mask].any()
    assert engines[1].forces.any()
    assert parts[1].steps == 20.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("force", "message"),
    [
        ({"joints": ["HAA"]}, r"forces\.f: it pushes nothing; give a range for x, y or z, or for size"),
        ({"joints": ["hip"], "x": [0, 1]}, r"forces\.f\.joints: pattern 'hip' matches nothing"),
        ({"joints": ["HAA"], "body": "base", "x": [0, 1]}, r"forces\.f\.joints: the force acts on the body 'base' already"),
        ({"x": [0, 1], "size": [0, 1]}, r"forces\.f\.size: a force of any direction has no x, y and z"),
    ],
)
def test_forces_that_do_not_fit_are_refused(force, message):
    with pytest.raises(ConfigError, match=message):
        small_task(("domain_rand.forces", {"f": force}))
