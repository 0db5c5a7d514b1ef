"""The step of blocks of worlds on a CPU: in whatever company, on however many threads; and when it is taken."""

import re

import mujoco
import numpy as np
import pytest
import torch
from mechanisms import EVERY_ROW, FusedWorlds, relative_error
from reference import heaps, snapshot

from legged.config.world import SimConfig
from legged.physics import MANY_WORLDS, Physics, RobotScene, make_physics
from legged.physics.fused.block_step import BlockStep
from legged.physics.fused.wide_solver import WIDE
from legged.physics.mujoco import MujocoPhysics
from legged.physics.warp.mujoco_warp import MujocoWarpPhysics

CPU = torch.device("cpu")
COUNT = 2 * WIDE + 5
"""Worlds: two blocks, and a part of one."""


def rolled(robot, count: int, threads: int, broken: int | None = None) -> torch.Tensor:
    """Return what is seen of the first `count` of some heaps of robots once they have landed, one with a broken velocity."""
    physics = make_physics(RobotScene(robot), SimConfig(physics="mujoco_warp", threads=threads), count, CPU)
    states = heaps(robot, COUNT, seed=3)
    qpos, qvel = states.qpos[:count].clone(), states.qvel[:count].clone()
    if broken is not None:
        qvel[broken, 2] = torch.nan
    physics.write(torch.ones(count, dtype=torch.bool), qpos, qvel)
    for _ in range(60):  # they land after 30
        physics.step()
    physics.refresh()
    return snapshot(physics)


@pytest.mark.slow
def test_numbers_of_a_world_depend_on_neither_threads_nor_company(robot):
    alone = rolled(robot, COUNT, threads=1)
    assert torch.isfinite(alone).all()
    assert torch.equal(rolled(robot, COUNT, threads=3), alone)
    assert torch.equal(rolled(robot, 3, threads=2), alone[:3])
    beside_a_broken_one = rolled(robot, COUNT, threads=2, broken=1)
    others = torch.arange(COUNT) != 1
    assert torch.equal(beside_a_broken_one[others], alone[others])
    assert not torch.isfinite(beside_a_broken_one[1]).all()


@pytest.mark.slow
def test_blocks_go_where_launches_of_single_stages_go():
    """With rows of every kind, those of equalities among them, which mujoco-warp makes between the two halves of a step."""
    model = mujoco.MjModel.from_xml_string(EVERY_ROW)
    rng = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (COUNT, 1)) + np.pad(rng.uniform(-0.2, 0.2, (COUNT, model.nq - 7)), ((0, 0), (7, 0)))
    qpos[:, 2] += rng.uniform(-2e-3, 0.05, COUNT)
    qvel = rng.normal(0.0, 0.5, (COUNT, model.nv))
    single, blocks = FusedWorlds(model, COUNT), FusedWorlds(model, COUNT)
    assert blocks._contacts is not None
    step = BlockStep(blocks._step, blocks._contacts, threads=2).recorded()
    for worlds in (single, blocks):
        worlds.write(qpos, qvel, np.zeros((COUNT, 0)))
    seen = set()
    for _ in range(50):
        single.step()
        step()
        seen |= {name for name in ("ne", "nf", "nl") if single.read(name).any()}
    assert seen == {"ne", "nf", "nl"}
    assert single.read("nefc").max() > 3 + 4
    for name in ("qpos", "qvel"):
        assert relative_error(blocks.read(name), single.read(name)) < 1e-3, name


def by_itself(robot, num_envs: int, **sim: object) -> Physics:
    """Return the physics that `auto` takes on a CPU."""
    return make_physics(RobotScene(robot), SimConfig(**sim), num_envs, CPU)  # type: ignore[arg-type]


def test_many_robots_are_simulated_in_blocks_and_few_by_the_c_engine(robot):
    many, few = by_itself(robot, MANY_WORLDS), by_itself(robot, 4)
    assert isinstance(many, MujocoWarpPhysics)
    assert isinstance(few, MujocoPhysics)
    assert many.why_library == many.why_c_engine == few.why_c_engine == ""


@pytest.mark.parametrize(
    ("sim", "why"),
    [
        ({"cone": "elliptic"}, "cones are elliptic"),
        ({"step": "library"}, "sim.step=library"),
        ({"njmax": 1000}, "1000 constraint rows .* exceed 512"),
    ],
)
def test_what_does_not_fit_blocks_is_the_c_engines(robot, sim, why):
    physics = by_itself(robot, MANY_WORLDS, **sim)
    assert isinstance(physics, MujocoPhysics)
    assert re.search(why, physics.why_c_engine)
