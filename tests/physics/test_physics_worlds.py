"""The contract of every back-end, continued: worlds that stay apart, tensors that stay in place, memory, and the choice."""

from dataclasses import fields

import mujoco
import numpy as np
import pytest
import torch
from devices import engine_of
from reference import FIELDS, TOUCHING, CWorlds, States, assert_same, bits, heaps, random_states, roll, snapshot, standing

from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.physics import MANY_WORLDS, resolve_physics
from legged.physics.warp.mujoco_warp import absent_stages


def only(index: int) -> torch.Tensor:
    """(6,) true for one world."""
    mask = torch.zeros(6, dtype=torch.bool)
    mask[index] = True
    return mask


# ---- worlds that stay apart ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_written_state_reads_back(physics, robot):
    """Velocities are given and read in the base frame, which here is anywhere; the engines store the linear one in the
    world's.
    """
    states = heaps(robot, 6, seed=5)
    states.write(physics)
    for name in ("base_pos", "base_quat", "base_ang_vel", "dof_pos", "dof_vel"):
        assert torch.equal(getattr(physics.robot_state, name), getattr(states, name)), name
    torch.testing.assert_close(physics.robot_state.base_lin_vel, states.base_lin_vel, atol=1e-6, rtol=0.0)
    reference = CWorlds(robot, SimConfig(), states).observe()
    for name in ("base_lin_vel_w", "projected_gravity", "feet_pos", "feet_vel"):
        np.testing.assert_allclose(getattr(physics.robot_state, name), reference[name], atol=1e-5, err_msg=name)


def test_write_clears_forces_and_torques_of_its_worlds_only(physics, robot):
    states = standing(robot, 6)
    states.write(physics)
    roll(physics, states.dof_pos + 0.1, 60)
    torques, forces = physics.ctrl.clone(), physics.robot_state.contact_forces.clone()
    mask = only(2)
    states.write(physics, mask)
    assert (physics.ctrl[mask] == 0.0).all()
    assert (physics.robot_state.contact_forces[mask] == 0.0).all()
    assert torch.equal(physics.ctrl[~mask], torques[~mask])
    assert torch.equal(physics.robot_state.contact_forces[~mask], forces[~mask])
    assert (forces[:, :, 2].sum(dim=1) > 100.0).all()
    assert (torques != 0.0).any(dim=1).all()


@pytest.mark.slow
@pytest.mark.parametrize("written", [0, 3])
def test_writing_one_world_leaves_the_others_bit_identical(physics, robot, written):
    """In the middle of contact, now and for the next 20 steps, then as far as runs can be repeated; mujoco-warp's own
    reset_data drops everybody's contacts.
    """
    start, new = random_states(robot, 6, seed=6), heaps(robot, 6, seed=8)
    others = ~only(written)

    def run(write: bool) -> tuple[torch.Tensor, torch.Tensor]:
        start.write(physics)
        roll(physics, start.dof_pos, 40)
        before = snapshot(physics)
        if write:
            new.write(physics, only(written))
            assert torch.equal(bits(snapshot(physics)[others]), bits(before[others]))
            assert not torch.equal(physics.robot_state.base_pos[written], before[written, :3])
        return before, roll(physics, start.dof_pos, 20)

    before, expected = run(write=False)
    again, actual = run(write=True)
    assert_same(physics, again, before)  # runs are reproducible, else the next line says nothing
    assert_same(physics, actual[:, others], expected[:, others])
    assert not torch.equal(actual[:, written], expected[:, written])
    assert (physics.robot_state.contact_forces[others].norm(dim=2).sum(dim=1) > 100.0).all()


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """C MuJoCo writes its warnings of blow-ups to MUJOCO_LOG.TXT in the working directory."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("elsewhere")
def test_a_world_that_blows_up_is_confined_and_curable(physics, robot):
    """Neighbours keep their bits; NaN stays until the task writes a good state (no engine may reset it silently); then
    the world goes on as if nothing had been, down to the solver's warm start.
    """
    start = random_states(robot, 6, seed=9)
    broken = States(*(torch.full_like(getattr(start, field.name), torch.nan) for field in fields(start)))
    sick, others = 1, ~only(1)
    start.write(physics)
    expected = roll(physics, start.dof_pos, 60)

    start.write(physics)
    roll(physics, start.dof_pos, 20)
    broken.write(physics, only(sick))
    actual = roll(physics, start.dof_pos, 40)
    assert_same(physics, actual[:, others], expected[20:, others])
    assert actual[:, sick, :3].isnan().all()
    assert physics.robot_state.dof_pos[sick].isnan().all()

    start.write(physics)
    assert torch.isfinite(snapshot(physics)).all()
    assert_same(physics, roll(physics, start.dof_pos, 60), expected)


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("number", [torch.nan, torch.inf])
def test_a_single_bad_number_is_visible_after_a_step_wherever_it_began(physics, robot, number):
    """The task recognises a lost robot by the numbers of its state."""
    start = random_states(robot, 6, seed=13)
    names = [field.name for field in fields(start)]
    for world, name in enumerate(names):
        getattr(start, name)[world, 0] = number
    start.write(physics)
    roll(physics, standing(robot, 6).dof_pos, 1)
    for world, name in enumerate(names):
        numbers = torch.cat([getattr(physics.robot_state, other)[world] for other in names])
        assert not torch.isfinite(numbers).all(), name
    random_states(robot, 6, seed=13).write(physics)
    assert torch.isfinite(roll(physics, standing(robot, 6).dof_pos, 20)).all()


def test_push_changes_the_horizontal_velocity_of_its_worlds_only(physics, robot):
    states = heaps(robot, 6, seed=10)
    states.write(physics)
    before = snapshot(physics)
    velocity = physics.robot_state.base_lin_vel_w.clone()
    mask = torch.tensor([True, False, False, True, True, False])
    by = torch.tensor([[0.5, -1.0], [3.0, 3.0], [torch.nan, 1.0], [0.0, 0.25], [-2.0, 0.0], [9.0, 9.0]])
    physics.push(mask, by)
    physics.refresh()
    assert torch.equal(bits(snapshot(physics)[~mask]), bits(before[~mask]))
    expected = velocity[mask] + torch.nn.functional.pad(by[mask], (0, 1))
    torch.testing.assert_close(physics.robot_state.base_lin_vel_w[mask], expected, atol=1e-6, rtol=0.0)
    assert torch.equal(physics.robot_state.base_lin_vel_w[:, 2], velocity[:, 2])
    for name in ("base_pos", "base_quat", "base_ang_vel", "dof_pos", "dof_vel"):
        assert torch.equal(getattr(physics.robot_state, name), getattr(states, name)), name


# ---- memory --------------------------------------------------------------------------------------------------------------


def test_refresh_twice_is_refresh_once(physics, robot):
    """After steps, and after a reset in between, whose cleared forces must not come back."""
    states = standing(robot, 6)
    states.write(physics)
    roll(physics, states.dof_pos, 60)
    for mask in (torch.zeros(6, dtype=torch.bool), only(4)):
        states.write(physics, mask)
        before = snapshot(physics)
        physics.refresh()
        assert torch.equal(bits(snapshot(physics)), bits(before))


def test_tensors_stay_where_they_are(physics, robot):
    """The task keeps them and a CUDA graph knows their addresses."""
    states, engine = standing(robot, 6), engine_of(physics)

    def addresses() -> dict[str, int]:
        found = {name: getattr(engine.robot_state, name).data_ptr() for name in FIELDS}
        return {**found, "ctrl": engine.ctrl.data_ptr(), "overflowed": engine.overflowed.data_ptr()}

    before = addresses()
    states.write(physics, only(0))
    roll(physics, states.dof_pos, 3)
    physics.push(only(1), torch.ones(6, 2))
    physics.step()
    physics.refresh()
    assert addresses() == before


def test_state_is_float32_of_the_promised_shapes(physics):
    shapes = {name: tuple(getattr(physics.robot_state, name).shape) for name in FIELDS}
    vectors = dict.fromkeys(("base_pos", "base_lin_vel", "base_lin_vel_w", "base_ang_vel", "projected_gravity"), (6, 3))
    assert shapes == {
        **vectors,
        "base_quat": (6, 4),
        "dof_pos": (6, 12),
        "dof_vel": (6, 12),
        "feet_pos": (6, 4, 3),
        "feet_vel": (6, 4, 3),
        "contact_forces": (6, 13, 3),
    }
    assert all(getattr(physics.robot_state, name).dtype == torch.float32 for name in FIELDS)
    assert (physics.num_envs, physics.dt, physics.ctrl.shape) == (6, 0.005, (6, 12))
    assert (physics.overflowed.dtype, physics.overflowed.shape) == (torch.bool, (6,))


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"nconmax": 1}, {"njmax": 8}], ids=["contacts", "rows"])
def test_lost_contacts_are_reported_until_the_next_refresh(make_physics, robot, options):
    """Four feet need four contacts and sixteen rows a robot. In the air nothing is lost, and the flag is gone."""
    physics = make_physics("mujoco_warp", **options)
    states = standing(robot, 6, height=TOUCHING - 0.002)
    states.write(physics)
    assert not physics.overflowed.any()
    roll(physics, states.dof_pos, 3)
    assert physics.overflowed.all()
    standing(robot, 6, height=2.0).write(physics)
    roll(physics, states.dof_pos, 1)
    assert not physics.overflowed.any()


@pytest.mark.slow
def test_default_memory_holds_robots_lying_in_a_heap(make_physics, backend, robot):
    physics = make_physics(backend, num_envs=64)
    states = heaps(robot, 64, seed=11)
    states.write(physics)
    lost = torch.zeros(64, dtype=torch.bool)
    most = torch.zeros(64, dtype=torch.long)
    for _ in range(200):
        roll(physics, states.dof_pos, 1)
        lost |= physics.overflowed
        most = torch.maximum(most, (physics.robot_state.contact_forces.norm(dim=2) > 0.0).sum(dim=1))
    assert not lost.any()
    assert torch.isfinite(snapshot(physics)).all()
    assert most.max() >= 5  # shapes of one robot on the ground at once: it was a heap


# ---- choosing a back-end -------------------------------------------------------------------------------------------------


def test_auto_is_the_c_engine_for_few_worlds_without_a_gpu_and_mujoco_warp_on_one():
    assert resolve_physics("auto", torch.device("cpu")) == "mujoco"
    assert resolve_physics("auto", torch.device("cpu"), num_envs=MANY_WORLDS) == "mujoco_warp"
    assert resolve_physics("auto", torch.device("cuda:0")) == "mujoco_warp"


def test_a_named_engine_is_taken_where_it_runs():
    assert resolve_physics("mujoco", torch.device("cpu")) == "mujoco"
    assert resolve_physics("mujoco_warp", torch.device("cpu")) == "mujoco_warp"
    assert resolve_physics("mujoco_warp", torch.device("cuda:0")) == "mujoco_warp"


def test_the_c_engine_on_a_gpu_is_an_error_that_says_what_to_do():
    with pytest.raises(ConfigError, match=r"sim\.physics: 'mujoco' .* --sim-device cpu"):
        resolve_physics("mujoco", torch.device("cuda:0"))


@pytest.mark.slow
def test_make_physics_builds_what_is_named(make_physics, backend):
    built = engine_of(make_physics(backend))
    name, _, gpu = backend.partition(", ")
    assert (
        type(built).__name__
        == {
            "mujoco": "MujocoPhysics",
            "mujoco_warp": "MujocoWarpPhysics",
            "newton": "NewtonPhysics",
        }[name]
    )
    assert built.capturable == (name != "mujoco")
    assert built.qpos.device.type == (gpu or "cpu")


def test_copy_to_shows_one_world_as_it_is_now(physics, robot):
    """Into a C MjData for drawing, with kinematics of the present."""
    states = random_states(robot, 6, seed=12)
    states.write(physics)
    roll(physics, states.dof_pos, 10)
    data = mujoco.MjData(physics.model)
    physics.copy_to(4, data)
    state = physics.robot_state
    np.testing.assert_allclose(data.qpos, torch.cat([state.base_pos[4], state.base_quat[4], state.dof_pos[4]]), atol=1e-6)
    np.testing.assert_allclose(data.qvel[:3], state.base_lin_vel_w[4], atol=1e-6)
    np.testing.assert_allclose(data.qvel[6:], state.dof_vel[4], atol=1e-5)
    feet = [data.geom(name).xpos for name in robot.feet_names]
    np.testing.assert_allclose(feet, state.feet_pos[4], atol=1e-5)


@pytest.mark.parametrize(
    ("joint", "actuator", "left_out"),
    [
        ("", "", {"EULERDAMP", "FRICTIONLOSS"}),
        ('damping="1"', "", {"FRICTIONLOSS"}),
        ('frictionloss="1"', "", {"EULERDAMP"}),
        ("", 'damping="1"', {"FRICTIONLOSS"}),
    ],
)
def test_only_stages_without_work_are_left_out(joint, actuator, left_out):
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><body><joint name='j' {joint}/><geom size='.1'/></body></worldbody>"
        f"<actuator><motor joint='j' {actuator}/></actuator></mujoco>"
    )
    flags = absent_stages(model)
    assert {
        name for name in ("EULERDAMP", "FRICTIONLOSS") if flags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")
    } == left_out
