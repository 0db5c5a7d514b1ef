"""One contract for every back-end: the same numbers as C MuJoCo, worlds that stay apart, tensors that stay in place."""

import shutil

import mujoco
import numpy as np
import pytest
import torch
from devices import build, engine_of
from reference import FIELDS, TOUCHING, CWorlds, States, heaps, pd, random_states, roll, standing

from legged.config.world import SimConfig
from legged.physics import RobotScene
from legged.physics.mujoco import MujocoPhysics
from legged.robots.robot import load_robot

GRAVITY = 9.81
# What is no view of the engine's memory in any back-end: filled by refresh alone.
COMPUTED = ("base_lin_vel", "projected_gravity", "feet_pos", "feet_vel", "contact_forces")


def only(index: int, count: int = 6) -> torch.Tensor:
    mask = torch.zeros(count, dtype=torch.bool)
    mask[index] = True
    return mask


def feet_forces(physics, robot) -> torch.Tensor:
    """(N, F, 3)"""
    return physics.robot_state.contact_forces[:, list(robot.feet_indices)]


# ---- the same numbers as C MuJoCo ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("start", [random_states, heaps])
def test_state_is_that_of_c_mujoco(physics, robot, start):
    """Of robots on their feet, and of robots that fell on whatever came first. Outputs are poisoned before, so that one
    that nobody writes shows; torques are written once and must be held.
    """
    states = start(robot, 6, seed=1)
    states.write(physics)
    roll(physics, states.dof_pos, 150)
    states = States.of(physics)
    states.write(physics)
    reference = CWorlds(robot, SimConfig(), states)
    torques = pd(states.dof_pos, states.dof_vel, states.dof_pos + 0.1)
    physics.ctrl.copy_(torques)
    for name in COMPUTED:
        getattr(physics.robot_state, name).fill_(torch.nan)
    comparable = np.ones(6, dtype=bool)
    for _ in range(5):
        physics.step()
        reference.step(torques)
        if not as_in_c(physics):
            comparable &= ~reference.steep_capsules()
    physics.refresh()
    touching = (reference.observe()["contact_forces"][comparable] != 0.0).any(axis=2)
    assert touching.any(axis=1).sum() >= 4
    assert start is random_states or touching[:, [i for i in range(13) if i not in robot.feet_indices]].any()
    observed = reference.observe()
    for name in FIELDS:
        tolerance = {"contact_forces": 0.05, "dof_vel": 1e-3, "feet_vel": 1e-3}.get(name, 5e-5)
        actual, expected = getattr(physics.robot_state, name)[comparable], observed[name][comparable]
        np.testing.assert_allclose(actual, expected, atol=tolerance, rtol=1e-5, err_msg=name)


def as_in_c(physics) -> bool:
    """Whether a capsule that stands on the ground has friction along the directions that C MuJoCo gives it."""
    engine = engine_of(physics)
    return isinstance(engine, MujocoPhysics) or getattr(engine, "_contacts", None) is not None


def drift(physics, robot, sim: SimConfig) -> dict[str, float]:
    """Largest difference from C MuJoCo, by field, within 100 steps under random targets of std 0.5 rad, new every 4."""
    states = random_states(robot, physics.num_envs, seed=2)
    generator = torch.Generator().manual_seed(3)
    states.write(physics)
    reference = CWorlds(robot, sim, states)
    largest = dict.fromkeys(FIELDS, 0.0)
    default = torch.tensor(robot.default_dof_pos, dtype=torch.float32)
    for step in range(100):
        if step % 4 == 0:
            targets = default + 0.5 * torch.randn(physics.num_envs, robot.num_dof, generator=generator)
        roll(physics, targets, 1)
        reference.step_pd(targets)
        for name, expected in reference.observe().items():
            difference = np.abs(getattr(physics.robot_state, name) - expected).max().item()
            largest[name] = max(largest[name], difference) if np.isfinite(difference) else np.inf
    return largest


def position_drift(largest: dict[str, float]) -> float:
    return max(largest[name] for name in ("base_pos", "base_quat", "dof_pos"))


@pytest.mark.slow
def test_worlds_stay_those_of_c_mujoco_for_100_steps(physics, robot):
    """At the shipped solver options, through contacts that come and go, each engine under PD on its own joints."""
    largest = drift(physics, robot, SimConfig())
    assert position_drift(largest) <= 1e-4
    assert max(largest["feet_pos"], largest["projected_gravity"]) <= 1e-4
    assert max(largest["base_lin_vel"], largest["base_ang_vel"], largest["feet_vel"]) <= 2e-3
    assert largest["dof_vel"] <= 1e-2
    assert largest["contact_forces"] <= 1.0  # of 500 N


def test_a_cheaper_solver_drifts_but_stays_near(make_physics, robot):
    """Why the shipped caps are 10 / 20: at 5 / 10 float32 and float64 part, by centimetres within half a second."""
    options = {"iterations": 5, "ls_iterations": 10}
    largest = drift(make_physics("mujoco_warp", **options), robot, SimConfig(**options))
    assert 1e-4 < position_drift(largest) < 0.5


@pytest.mark.slow
def test_feet_are_right_on_legs_with_turned_bodies_and_joints_off_centre(robot, backend, tmp_path):
    """ANYmal C's bodies are all parallel and its hinges sit at their origins; another robot's need not."""
    spec = mujoco.MjSpec.from_file(str(robot.model_path))
    for i, body in enumerate(body for body in spec.bodies if body.name not in ("world", "base")):
        body.quat = np.array([1.0, 0.1 * (i % 3), -0.2, 0.05 * i]) / np.linalg.norm([1.0, 0.1 * (i % 3), -0.2, 0.05 * i])
        body.joints[0].pos = [0.01 * (i % 4), -0.02, 0.03]
    shutil.copy(robot.folder / "robot.yaml", tmp_path)
    (tmp_path / "anymal_c.xml").write_text(spec.to_xml())
    other = load_robot(str(tmp_path))
    physics = build(RobotScene(other), backend, 6)
    states = heaps(other, 6, seed=7)
    states.write(physics)
    reference = CWorlds(other, SimConfig(), states)
    np.testing.assert_allclose(physics.robot_state.feet_pos, reference.observe()["feet_pos"], atol=1e-5)
    np.testing.assert_allclose(physics.robot_state.feet_vel, reference.observe()["feet_vel"], atol=1e-5)
    parallel = CWorlds(robot, SimConfig(), states)
    assert np.abs(parallel.observe()["feet_pos"] - reference.observe()["feet_pos"]).max() > 0.05


# ---- contact forces ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_at_rest_the_ground_carries_the_weight(physics, robot):
    """Forces are those on the robot, so upward on feet; shapes in the air feel exactly nothing."""
    states = standing(robot, 6)
    states.write(physics)
    roll(physics, states.dof_pos, 300)
    forces = physics.robot_state.contact_forces
    torch.testing.assert_close(forces.sum(dim=1)[:, 2], torch.full((6,), robot.mass * GRAVITY), rtol=0.01, atol=0.0)
    assert (feet_forces(physics, robot)[:, :, 2] > 50.0).all()
    assert (forces.sum(dim=1)[:, :2].abs() < 5.0).all()  # friction sums to nothing
    others = [i for i in range(len(robot.contact_names)) if i not in robot.feet_indices]
    assert (forces[:, others] == 0.0).all()


def test_in_the_air_nothing_is_felt_and_the_robot_falls_freely(physics, robot):
    states = standing(robot, 6, height=2.0)
    states.write(physics)
    for _ in range(40):
        physics.step()
    physics.refresh()
    assert (physics.robot_state.contact_forces == 0.0).all()
    # Semi-implicit Euler over n steps of dt, of the centre of mass; without torques the legs fall along.
    fallen = GRAVITY * 0.005**2 * 40 * 41 / 2
    torch.testing.assert_close(physics.robot_state.base_pos[:, 2], torch.full((6,), 2.0 - fallen), atol=1e-4, rtol=0.0)
    torch.testing.assert_close(physics.robot_state.base_lin_vel[:, 2], torch.full((6,), -GRAVITY * 0.2), atol=1e-3, rtol=0.0)


@pytest.mark.slow
def test_friction_is_drawn_per_world(make_physics, backend, robot):
    """Standing robots pushed sideways in one batch: a slippery world slides v^2 / (2 mu g) = 0.5 m, a rough one stays."""
    physics = make_physics(backend, tag="randomized")
    friction = torch.tensor([0.1, 1.0, 0.1, 1.0, 0.1, 1.0])
    physics.randomize("friction", friction)
    states = standing(robot, 6, height=TOUCHING - 0.001)
    states.base_lin_vel[:, 1] = 1.0
    states.write(physics)
    start = physics.robot_state.feet_pos.mean(dim=1)[:, 1].clone()
    roll(physics, states.dof_pos, 200)
    slid = physics.robot_state.feet_pos.mean(dim=1)[:, 1] - start
    physics.randomize("friction", torch.ones(6))
    assert (slid[friction == 0.1] > 0.3).all()
    assert (slid[friction == 1.0].abs() < 0.1).all()


@pytest.mark.slow
def test_added_base_mass_is_drawn_per_world(make_physics, backend, robot):
    physics = make_physics(backend, tag="randomized")
    added = torch.tensor([-5.0, -2.0, 0.0, 2.0, 5.0, 10.0])
    physics.randomize("added_base_mass", added)
    states = standing(robot, 6)
    states.write(physics)
    roll(physics, states.dof_pos, 300)
    carried = physics.robot_state.contact_forces.sum(dim=1)[:, 2]
    physics.randomize("added_base_mass", torch.zeros(6))
    torch.testing.assert_close(carried, (robot.mass + added) * GRAVITY, rtol=0.005, atol=0.0)


@pytest.mark.slow
def test_added_base_mass_replaces_the_one_before(make_physics, backend, robot):
    """It is added to the model's mass, not to what the world weighs by now; none again means the model's."""
    physics = make_physics(backend, tag="randomized")
    physics.randomize("added_base_mass", torch.full((6,), 8.0))
    physics.randomize("added_base_mass", torch.zeros(6))
    states = random_states(robot, 6, seed=4)
    states.write(physics)
    once_changed = roll(physics, states.dof_pos, 40)[-1]
    untouched = make_physics(backend)
    states.write(untouched)
    torch.testing.assert_close(once_changed, roll(untouched, states.dof_pos, 40)[-1], atol=1e-2, rtol=1e-3)


def test_an_unknown_property_is_no_mass(make_physics, backend):
    """Every back-end names what was asked for and what it was made for."""
    physics = make_physics(backend, tag="randomized")
    with pytest.raises(ValueError, match=r"'added_mass'; did you mean 'added_base_mass'\? .*friction"):
        physics.randomize("added_mass", torch.full((6,), 30.0))
