"""Newton's solvers: what every one of them must keep of the contract, and how near to C MuJoCo it comes.

Newton's MuJoCo solver meets the whole contract (tests/physics/test_physics.py). The others are other physics: they
stand, carry their weight, and keep their worlds apart.
"""

import importlib.util
from dataclasses import dataclass, fields, replace
from typing import get_args

import numpy as np
import pytest
import torch
from reference import TOUCHING, CWorlds, States, bits, pd, random_states, roll, snapshot, standing

from legged.config.robot import TerrainConfig
from legged.config.world import NewtonSolver, SimConfig
from legged.errors import ConfigError
from legged.physics import Physics, RobotScene, engine_name, make_physics, resolve_physics
from legged.terrain import Terrain, TileSpec

N = 4
GRAVITY = 9.81


@dataclass(frozen=True)
class Tolerance:
    """How far a solver may be from C MuJoCo."""

    height: float
    """Of the base after a second of standing [m]."""
    weight: float
    """Share by which the mean force of the ground misses the robot's weight."""
    fall: float
    """Of the speed after 0.2 s of free fall [m/s]."""


TOLERANCES = {
    "mujoco": Tolerance(1e-4, 2e-3, 1e-3),  # the same equations, in float32
    "steel": Tolerance(5e-3, 2e-3, 2e-3),  # another complementarity solver, without MuJoCo's soft contacts: 2 mm higher
    "kamino": Tolerance(5e-3, 2e-3, 4e-3),  # the same, on bodies, which turn by steps of first order
    "featherstone": Tolerance(0.03, 0.03, 2e-3),  # feet creep outward, for friction is viscous; forces chatter
    "semi_implicit": Tolerance(0.04, 0.03, 0.02),  # that, and joints are springs that stretch
    "xpbd": Tolerance(0.025, 0.01, 0.02),  # joints give way to torques less than they should: 1.5 cm higher
}


SLOW = ("steel", "kamino")
"""Solvers whose kernels take long to compile or to load."""


@pytest.fixture(
    params=[pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in TOLERANCES], scope="module"
)
def solver(request) -> str:
    return request.param


@pytest.fixture
def newton(solver, make_physics) -> Physics:
    """Four worlds, in whatever state the last test left them."""
    return make_physics("newton", num_envs=N, tag="randomized", solver=solver)


def only(index: int) -> torch.Tensor:
    return torch.arange(N) == index


def test_every_solver_has_its_tolerances():
    assert set(TOLERANCES) == set(get_args(NewtonSolver))


@pytest.mark.slow
def test_it_stands_like_c_mujoco_and_the_ground_carries_its_weight(newton, solver, robot):
    """A second under PD. Shapes in the air feel nothing, friction sums to nothing."""
    tolerance, states = TOLERANCES[solver], standing(robot, N)
    reference = CWorlds(robot, SimConfig(), standing(robot, 1))
    states.write(newton)
    roll(newton, states.dof_pos, 160)
    forces = torch.zeros_like(newton.robot_state.contact_forces)
    for _ in range(40):
        roll(newton, states.dof_pos, 1)
        forces += newton.robot_state.contact_forces / 40
    for _ in range(200):
        reference.step_pd(states.dof_pos[:1])
    height = float(reference.observe()["base_pos"][0, 2])
    assert (newton.robot_state.base_pos[:, 2] - height).abs().max() < tolerance.height
    assert (newton.robot_state.projected_gravity[:, 2] < -0.999).all()
    weight = robot.mass * GRAVITY
    total = forces.sum(dim=1)
    torch.testing.assert_close(total[:, 2], torch.full((N,), weight), rtol=tolerance.weight, atol=0.0)
    assert (total[:, :2].abs() < 0.1 * weight).all()
    others = [i for i in range(len(robot.contact_names)) if i not in robot.feet_indices]
    assert (forces[:, others] == 0.0).all()
    assert not newton.overflowed.any()


@pytest.mark.slow
def test_it_falls_freely_and_turns_freely(newton, solver, robot):
    """Off the ground, with a spin: speed is g t, and the spin about the vertical stays. The base's origin is not its centre
    of mass, so wrong conventions of velocity show.
    """
    states = standing(robot, N, height=2.0)
    turning = torch.zeros(N, 3)
    turning[:, 2] = 2.0
    sideways = torch.tensor([0.5, -0.25, 0.0]).repeat(N, 1)
    states = replace(states, base_ang_vel=turning, base_lin_vel=sideways)
    states.write(newton)
    reference = CWorlds(robot, SimConfig(), states)
    for _ in range(40):
        torques = pd(newton.robot_state.dof_pos, newton.robot_state.dof_vel, states.dof_pos)
        newton.ctrl.copy_(torques)
        newton.step()
        reference.step_pd(states.dof_pos)
    newton.refresh()
    expected = {name: torch.from_numpy(value).float() for name, value in reference.observe().items()}
    assert (newton.robot_state.contact_forces == 0.0).all()
    fall = TOLERANCES[solver].fall
    torch.testing.assert_close(newton.robot_state.base_lin_vel_w[:, 2], torch.full((N,), -GRAVITY * 0.2), atol=fall, rtol=0.0)
    loose = 10.0 * fall
    torch.testing.assert_close(newton.robot_state.base_lin_vel_w, expected["base_lin_vel_w"], atol=loose, rtol=0.0)
    torch.testing.assert_close(newton.robot_state.base_ang_vel, expected["base_ang_vel"], atol=2.0 * loose, rtol=0.0)
    torch.testing.assert_close(newton.robot_state.base_pos, expected["base_pos"], atol=loose, rtol=0.0)


def test_written_state_reads_back(newton, robot):
    states = random_states(robot, N, seed=5)
    states.write(newton)
    for name in ("base_pos", "base_quat", "base_ang_vel", "dof_pos", "dof_vel"):
        assert torch.equal(getattr(newton.robot_state, name), getattr(states, name)), name
    torch.testing.assert_close(newton.robot_state.base_lin_vel, states.base_lin_vel, atol=1e-6, rtol=0.0)


@pytest.mark.slow
def test_writing_a_world_and_blowing_it_up_leaves_the_others_bit_identical(newton, robot):
    """In the middle of contact, now and for the next steps; and the sick world is cured by a write, to the last bit."""
    start = random_states(robot, N, seed=6)
    broken = States(*(torch.full_like(getattr(start, field.name), torch.nan) for field in fields(start)))
    sick, others = 1, ~only(1)
    start.write(newton)
    expected = roll(newton, start.dof_pos, 20)

    start.write(newton)
    roll(newton, start.dof_pos, 10)
    before = snapshot(newton)
    broken.write(newton, only(sick))
    assert torch.equal(bits(snapshot(newton)[others]), bits(before[others]))
    actual = roll(newton, start.dof_pos, 10)
    assert torch.equal(bits(actual[:, others]), bits(expected[10:, others]))
    assert not torch.isfinite(snapshot(newton)[sick]).all()  # by which the task recognises it

    start.write(newton)
    assert torch.isfinite(snapshot(newton)).all()
    assert torch.equal(bits(roll(newton, start.dof_pos, 20)), bits(expected))


@pytest.mark.slow
def test_the_recorded_step_is_the_eager_one(newton, robot, monkeypatch):
    """What a solver decides on the host is fixed when its step is recorded; nothing it decides may change later."""
    states = random_states(robot, N, seed=7)
    states.write(newton)
    recorded = roll(newton, states.dof_pos, 6)
    monkeypatch.setattr(newton, "_advance", newton._step)
    states.write(newton)
    assert torch.equal(bits(roll(newton, states.dof_pos, 6)), bits(recorded))


def test_a_push_is_felt_by_its_worlds_only(newton, robot):
    states = random_states(robot, N, seed=10)
    states.base_pos[:, 2] += 1.0
    states.write(newton)
    roll(newton, states.dof_pos, 3)
    before, velocity = snapshot(newton), newton.robot_state.base_lin_vel_w.clone()
    mask = torch.tensor([True, False, False, True])
    by = torch.tensor([[0.5, -1.0], [3.0, 3.0], [torch.nan, 1.0], [-2.0, 0.25]])
    newton.push(mask, by)
    newton.refresh()
    assert torch.equal(bits(snapshot(newton)[~mask]), bits(before[~mask]))
    torch.testing.assert_close(newton.robot_state.base_lin_vel_w[mask, :2], velocity[mask, :2] + by[mask])
    newton.step()
    newton.refresh()
    felt = newton.robot_state.base_lin_vel_w[:, :2] - velocity[:, :2]
    torch.testing.assert_close(felt[mask], by[mask], atol=0.1, rtol=0.0)
    assert (felt[~mask].abs() < 0.1).all()


@pytest.mark.slow
def test_friction_is_drawn_per_world(newton, robot):
    """Standing robots pushed sideways: a slippery one slides v^2 / (2 mu g) = 0.5 m, a rough one stays."""
    friction = torch.tensor([0.1, 1.0, 0.1, 1.0])
    newton.randomize("friction", friction)
    states = standing(robot, N, height=TOUCHING - 0.001)
    states.base_lin_vel[:, 1] = 1.0
    states.write(newton)
    start = newton.robot_state.feet_pos.mean(dim=1)[:, 1].clone()
    roll(newton, states.dof_pos, 150)
    slid = newton.robot_state.feet_pos.mean(dim=1)[:, 1] - start
    newton.randomize("friction", torch.ones(N))
    assert (slid[friction == 0.1] > 0.3).all()
    assert (slid[friction == 1.0].abs() < 0.12).all()


@pytest.mark.slow
def test_added_base_mass_is_drawn_per_world(newton, solver, robot):
    added = torch.tensor([-5.0, 0.0, 5.0, 10.0])
    newton.randomize("added_base_mass", added)
    states = standing(robot, N)
    states.write(newton)
    roll(newton, states.dof_pos, 110)
    carried = torch.zeros(N)
    for _ in range(40):
        roll(newton, states.dof_pos, 1)
        carried += newton.robot_state.contact_forces.sum(dim=1)[:, 2] / 40
    newton.randomize("added_base_mass", torch.zeros(N))
    tolerance = TOLERANCES[solver].weight + 0.015  # it has not quite come to rest; nor has it in C MuJoCo
    torch.testing.assert_close(carried, (robot.mass + added) * GRAVITY, rtol=tolerance, atol=0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "memory"),
    [("mujoco", {"nconmax": 1}), ("mujoco", {"njmax": 8}), ("steel", {"njmax": 8}), ("xpbd", {"nconmax": 1})],
)
def test_lost_contacts_are_reported_until_the_next_refresh(make_physics, robot, solver, memory):
    """Of robots with all their legs in the ground. (SolverMuJoCo makes room for the contacts it starts with, whatever it is
    asked.) In the air nothing is lost, and the flag is gone.
    """
    physics = make_physics("newton", num_envs=N, solver=solver, **memory)
    states = standing(robot, N, height=0.2)
    states.write(physics)
    assert not physics.overflowed.any()
    physics.step()
    standing(robot, N, height=2.0).write(physics)
    assert physics.overflowed.all()
    roll(physics, states.dof_pos, 1)
    assert not physics.overflowed.any()


# ---- other grounds and shapes -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("collider", "near"), [("cells", 0.01), ("convex", 0.01)])
def test_it_stands_on_terrain_like_c_mujoco(robot, collider, near):
    """On bumps and on a slope of 15 degrees; but with our collider (mujoco, cells), the ground is one height field here, and
    many in C MuJoCo. There contacts lie below the ground, and feet roll as if they were thicker: 8 mm further.
    """
    cfg = TerrainConfig(mesh_type="height_map", terrain_length=4.0, terrain_width=4.0, border_size=2.0)
    tiles = [[TileSpec("rough_slope_up", 0.0), TileSpec("slope_up", 15.0)]]
    terrain = Terrain.of_tiles(tiles, cfg, np.random.default_rng(1))
    states = standing(robot, 2)
    states.base_pos[:] = torch.tensor(terrain.origins[0], dtype=torch.float32) - torch.tensor([1.2, 0.0, 0.0])
    ground = terrain.height_map.height_at(states.base_pos[:, 0].numpy(), states.base_pos[:, 1].numpy())
    states.base_pos[:, 2] = torch.tensor(ground, dtype=torch.float32) + 0.65
    found = []
    other = SimConfig(physics="newton", solver="mujoco", terrain_collider=collider)
    for sim in (SimConfig(physics="mujoco", threads=1), other):
        physics = make_physics(RobotScene(robot, terrain), sim, 2, torch.device("cpu"))
        states.write(physics)
        roll(physics, states.dof_pos, 200)
        found.append(physics.robot_state)
    torch.testing.assert_close(found[1].base_pos, found[0].base_pos, atol=near, rtol=0.0)
    torch.testing.assert_close(found[1].projected_gravity, found[0].projected_gravity, atol=0.02, rtol=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["mujoco", "steel"])
def test_legs_touch_each_other_if_asked(robot, solver):
    """In the air with the hips turned inward, as far as they go: left and right thighs meet, and push apart alike."""
    states = standing(robot, 2, height=2.0)
    states.dof_pos[:, 0::6], states.dof_pos[:, 3::6] = -0.72, 0.72
    thighs = [i for i, name in enumerate(robot.contact_names) if "THIGH" in name]
    for asked in (True, False):
        sim = SimConfig(physics="newton", solver=solver, self_collisions=asked)
        physics = make_physics(RobotScene(robot), sim, 2, torch.device("cpu"))
        states.write(physics)
        roll(physics, states.dof_pos, 1)
        forces = physics.robot_state.contact_forces
        assert (forces[:, thighs].norm(dim=2) > 100.0).all() == asked
        assert (forces != 0.0).any() == asked
        assert (forces.sum(dim=1).norm(dim=1) < 1.0).all()


# ---- choosing a solver ---------------------------------------------------------------------------------------------------


def test_names_of_engines_say_the_solver():
    cpu = torch.device("cpu")
    assert engine_name(SimConfig(physics="newton", solver="xpbd"), cpu) == "newton_xpbd"
    assert engine_name(SimConfig(solver="xpbd"), cpu) == "mujoco"


def test_newton_missing_is_an_error_that_says_how_to_install_it(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr("legged.physics.find_spec", lambda name: None if name == "newton" else find(name))
    with pytest.raises(ConfigError, match=r"sim\.physics: 'newton' .* not installed here: pip install newton"):
        resolve_physics("newton", torch.device("cpu"))
    assert resolve_physics("mujoco", torch.device("cpu")) == "mujoco"
