"""Each disturbance is what it says: two robots side by side, of which one has it."""

import math

import pytest
import torch
from helpers import CALM, ENGINE, JOINTS, TASK, small_config, small_task, zero_actions

from legged.config import override
from legged.evaluation.stress.disturbances import NOMINAL, PUSH_INTERVAL, Disturbance, declared, make_stressed
from legged.evaluation.tiles import on_terrain
from legged.mdp.control import control_gains
from legged.physics import FIELDS, RobotScene
from legged.registry import task_config
from legged.terrain import Terrain, TileSpec

AT_REST = [("init_state.dof_pos_factor", [1.0, 1.0]), ("init_state.base_velocity", [0.0, 0.0])]


def stressed(*rows, terrain=None, changes=()):
    """A task of robots that begin alike, each with its disturbance."""
    cfg = override(small_config(*AT_REST, *changes, num_envs=len(rows)), declared(rows))
    return make_stressed(rows, cfg, torch.device("cpu"), False, terrain)


def with_nominal(**disturbance):
    return stressed(NOMINAL, Disturbance("one", **disturbance))


def torques(task, actions):
    """Torques of the first physics step under some actions, nothing being moved."""
    task.actions.copy_(actions)
    task.set_controls()
    task.apply_control()
    return task.torques.clone()


@pytest.mark.slow
def test_robots_with_which_nothing_is_wrong_move_as_in_the_task_itself():
    plain, same = small_task(*AT_REST, num_envs=2), stressed(NOMINAL, NOMINAL)
    actions = torch.sin(torch.arange(2.0 * JOINTS)).view(2, JOINTS)
    for task in (plain, same):
        task.hold_commands(torch.tensor([0.5, 0.0, 0.0]))  # those that are sampled come after other random numbers
    for _ in range(5):
        for task in (plain, same):
            task.step(actions)
    assert torch.equal(plain.physics.qpos, same.physics.qpos)
    assert torch.equal(plain.get_observations()["actor"], same.get_observations()["actor"])


@pytest.mark.slow
def test_a_payload_weighs_on_the_feet():
    """8 kg are 78.5 N more, once both robots stand."""
    task = with_nominal(payload=8.0)
    total = torch.zeros(2)
    for step in range(150):
        task.step(zero_actions(task))
        total += task.contact_forces[:, :, 2].sum(dim=1) if step >= 100 else 0.0
    weight = total / 50
    assert float(weight[0]) == pytest.approx(task.robot.mass * 9.81, rel=0.01)
    assert float(weight[1] - weight[0]) == pytest.approx(8.0 * 9.81, rel=0.05)


def test_friction_is_that_of_all_shapes():
    task = with_nominal(friction=0.4)
    model = task.physics.model
    shapes = FIELDS["friction"].rows(RobotScene(task.robot, None), model)
    found = task.physics.batch.expand("geom_friction")[:, shapes, 0]
    assert (found[0] == model.geom_friction[shapes, 0]).all()
    assert found[1] == pytest.approx(0.4)
    assert len(shapes) >= 4


def test_weak_motors_give_their_share_of_every_torque_and_of_the_limit():
    """What is asked of them stays, and so does its limit; what the engine makes of it is 0.85 of it."""
    task = with_nominal(motors=0.85)
    for value in (0.1, 50.0):
        asked = torques(task, torch.full((2, JOINTS), value))
        assert torch.equal(asked[0], asked[1])
        assert (asked[0] != 0.0).all()
    assert torch.allclose(asked[0].abs(), torch.tensor(task.robot.torque_limits, dtype=torch.float32))
    gains = task.physics.batch.expand("actuator_gainprm")[:, :, 0]
    assert gains[1] == pytest.approx(0.85 * gains[0])
    assert gains[0] == pytest.approx(1.0)


@pytest.mark.parametrize(("seconds", "steps"), [(0.02, 1), (0.04, 2)])
def test_a_delay_lets_targets_arrive_a_control_step_later_or_two(seconds, steps):
    """The robot moves as one without delay to which the same was said that much later; it knows what it said."""
    task = with_nominal(delay=seconds)
    assert task.dt == pytest.approx(0.02)
    said = torch.sin(torch.arange(6.0 * JOINTS)).view(6, JOINTS)
    later = torch.cat([torch.zeros(steps, JOINTS), said])[:6]
    for now, then in zip(said, later, strict=True):
        task.step(torch.stack([then, now]))
        assert torch.equal(task.physics.qpos[0], task.physics.qpos[1])
        assert torch.equal(task.observation_terms.values[1, task.observation_terms.columns["actions"]], now)
    task.reset()
    task.step(torch.stack([torch.zeros(JOINTS), said[0]]))  # nothing of the episode before arrives
    assert torch.equal(task.physics.qpos[0], task.physics.qpos[1])


def test_zero_offsets_shift_what_is_held_and_what_is_observed():
    """The motor pulls by stiffness times offset away, until the joint is that much off."""
    task = with_nominal(zero_offset=0.05)
    offset = task.zero_offset[1]
    assert (task.zero_offset[0] == 0.0).all()
    assert 0.02 < float(offset.abs().max()) <= 0.05
    assert len(set(offset.tolist())) == JOINTS  # each joint has its own
    held = torques(task, zero_actions(task))
    assert torch.allclose(held[1] - held[0], -task.control.stiffness * offset, atol=1e-4)
    observed = task.observation_terms.values[:, task.observation_terms.columns["dof_pos"]]
    assert torch.allclose(observed[1] - observed[0], offset, atol=1e-6)
    assert torch.equal(task.physics.qpos[0], task.physics.qpos[1])


def test_a_sensor_askew_turns_gravity_and_rates():
    task = with_nominal(tilt=0.05)
    seen, rates = task._obs_projected_gravity(), task._obs_base_ang_vel()
    assert torch.equal(seen[0], task.projected_gravity[0])
    assert float(torch.linalg.vector_norm(seen[1] - task.projected_gravity[1])) == pytest.approx(
        2 * math.sin(0.025), rel=1e-3
    )
    task.base_ang_vel.copy_(torch.tensor([0.0, 0.0, 2.0]).expand(2, 3))
    rates = task._obs_base_ang_vel()
    assert rates[0].tolist() == [0.0, 0.0, 2.0]
    assert float(rates[1, :2].norm()) == pytest.approx(2.0 * math.sin(0.05), rel=1e-3)
    assert float(rates[1, 2]) == pytest.approx(2.0 * math.cos(0.05), rel=1e-4)


@pytest.mark.slow
def test_only_those_are_pushed_who_should_be(monkeypatch):
    task = with_nominal(push=1.0)
    pushed = torch.zeros(2)
    push = task.physics.push

    def note(mask, delta):
        pushed.add_(mask.float())
        assert float((task.physics.qvel[:, :2] + delta)[mask].abs().max() if mask.any() else 0.0) <= 1.0
        push(mask, delta)

    monkeypatch.setattr(task.physics, "push", note)
    for _ in range(round(PUSH_INTERVAL / task.dt)):
        task.step(zero_actions(task))
    assert pushed.tolist() == [0.0, 1.0]  # once an interval


# ---- the height map --------------------------------------------------------------------------------------------------


def on_steps(*rows):
    """Robots at the bottom of stairs, which their maps show once they are near."""
    exact = [("observations.add_noise", True), ("observations.noise_level", 0.0), ("observations.heights_limit", 1.0)]
    cfg = task_config("anymal_c", [("env.num_envs", len(rows)), *ENGINE, *CALM, *AT_REST, *exact], on_cpu=True)
    cfg = override(cfg, [*on_terrain(cfg, 8.0, 0.0), *declared(rows)])
    terrain = Terrain.of_tiles([[TileSpec("stairs_up", 0.2, tread=0.3)]], cfg.terrain, None)
    return make_stressed(rows, cfg, torch.device("cpu"), False, terrain)


def move(task, by):
    """Carry all robots by so much (2,) along x and y."""
    qpos = task.physics.qpos.clone()
    qpos[:, :2] += by
    task.physics.write(torch.ones(task.num_envs, dtype=torch.bool), qpos, task.physics.qvel.clone())
    task.sense()


def seen(task):
    """Heights of the ground as the robots' maps have them (N, P) [m]; on these stairs no limit cuts them."""
    found = task.observation_terms.errors._map
    found.advance(torch.zeros(task.num_envs, dtype=torch.bool))
    observed = found.read()
    found.cut_holes(observed)
    return task.base_pos[:, 2:] - task.cfg.observations.heights_offset - observed


def test_the_map_is_too_high_or_too_low_by_its_offset():
    task = on_steps(NOMINAL, *[Disturbance("one", map_height=0.05)] * 8)
    move(task, torch.tensor([1.3, 0.0]))
    heights = seen(task)
    assert torch.allclose(heights[0], task.measured_heights[0], atol=1e-6)
    error = heights[1:] - heights[0]
    assert torch.allclose(error.abs(), torch.full_like(error, 0.05), atol=1e-6)
    assert (error.std(dim=1) < 1e-6).all()
    assert {round(float(one), 3) for one in error[:, 0]} == {-0.05, 0.05}  # either way


def test_a_map_shifted_by_10_cm_shows_what_a_robot_sees_that_far_away():
    task = on_steps(NOMINAL, Disturbance("one", map_shift=0.1))
    shift = task._map_error[1, :2]
    assert float(shift.norm()) == pytest.approx(0.1)
    move(task, torch.tensor([1.35, 1.25]))
    heights = seen(task)
    assert not torch.equal(heights[0], heights[1])
    assert torch.equal(task.height_scan.heights[0], task.height_scan.heights[1])  # where both stand is the same
    move(task, -shift)  # the map has at a place what the ground has where the map should have been
    assert torch.equal(seen(task)[0], heights[1])


def test_holes_in_the_map_are_seen_as_level_ground():
    task = on_steps(NOMINAL, *[Disturbance("one", map_holes=0.2)] * 8)
    move(task, torch.tensor([1.3, 0.0]))
    heights, level = seen(task), task.base_pos[:, 2:] - task.cfg.observations.heights_offset
    holes = task._map_holes[1:]
    assert not task._map_holes[0].any()
    assert float(holes.float().mean()) == pytest.approx(0.2, abs=0.04)  # of 1496 points
    assert (heights[1:][holes] == level[1:].expand(8, 187)[holes]).all()
    assert torch.equal(heights[1:][~holes], heights[0].expand(8, -1)[~holes])
    assert len(heights[0].unique()) > 2  # there was something to see


def test_delays_of_the_task_stay_where_a_row_says_nothing():
    """Each robot keeps one of 1 to 3 physics steps; that of 20 ms has four, and eight of half the length."""
    rows = [NOMINAL] * 30 + [Disturbance("one", delay=0.02)]
    own = ("control.actuator.delay", [1, 3])
    task = stressed(*rows, changes=[own])
    assert set(task.control.actuator.delay[:30].tolist()) == {1, 2, 3}
    assert int(task.control.actuator.delay[30]) == 4
    before = task.control.actuator.delay.clone()
    task.reset()
    assert torch.equal(task.control.actuator.delay, before)
    halved = stressed(*rows, changes=[own, ("sim.dt", 0.0025), ("control.decimation", 8)])
    assert int(halved.control.actuator.delay[30]) == 8


def test_delays_of_the_task_are_kept_where_no_row_says_anything_of_them():
    """As for the lines beside them: neither another episode nor `delay_varies` draws another."""
    own = [("control.actuator.delay", [0, 6]), ("control.actuator.delay_varies", True)]
    task = stressed(*[NOMINAL] * 30, changes=own)
    before = task.control.actuator.delay.clone()
    assert set(before.tolist()) <= set(range(7))
    assert len(before.unique()) > 3
    task.reset()
    task.step(zero_actions(task))
    assert torch.equal(task.control.actuator.delay, before)


def test_what_else_is_drawn_differs_from_robot_to_robot_beside_the_rows():
    """The user asks for it after what the rows need."""
    rows = [NOMINAL, Disturbance("one", payload=4.0)]
    cfg = override(small_config(num_envs=2), [*declared(rows), ("domain_rand.ranges.p_gain", [0.5, 0.6])])
    task = make_stressed(rows, cfg, torch.device("cpu"), False, None)
    share = task.control.stiffness / torch.tensor(control_gains(task.robot, cfg.control)[0])
    assert bool(((share >= 0.5) & (share <= 0.6)).all())
    assert share[0, 0] != share[1, 0]


def test_disturbances_are_the_same_every_time():
    first, second = (with_nominal(zero_offset=0.05) for _ in range(2))
    assert torch.equal(first.zero_offset, second.zero_offset)
    assert first.cfg.task == TASK
