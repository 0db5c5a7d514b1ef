"""What a task does with what is randomised: by numbers worked by hand, in both engines alike, at its moments."""

from itertools import pairwise

import mujoco
import pytest
import torch
from devices import on_gpu
from helpers import small_config, small_task, zero_actions
from launches import counting

from legged.graph.step_graph import ForbidHostReads
from legged.physics import FIELDS
from legged.registry import make_task

EVERYTHING = {
    "friction": {"range": [0.4, 1.2], "when": "reset", "distribution": "log_uniform"},
    "restitution": {"range": [0.0, 0.5], "when": "reset"},
    "link_mass": {"range": [0.9, 1.1], "when": "reset", "each": True},
    "added_base_mass": {"range": [-1.0, 3.0], "when": "reset"},
    **{f"base_com_{axis}": {"range": [-0.05, 0.05], "when": "reset"} for axis in "xyz"},
    "joint_armature": {"range": [0.0, 0.02], "when": "reset"},
    **{f"gravity_{axis}": {"range": [-1.0, 1.0], "when": "interval", "interval_s": 0.1} for axis in "xyz"},
    "joint_damping": {"range": [0.0, 0.1], "when": "reset"},
    "joint_friction": [0.0, 0.2],
    "motor_strength": {"range": [0.8, 1.1], "when": "interval", "interval_s": 0.2, "distribution": "gaussian", "each": True},
    "actuator_gain": {"range": [-0.1, 0.1], "when": "reset"},
    "torque_limit": {"range": [0.8, 1.1], "when": "reset"},
    "velocity_limit": {"range": [0.9, 1.1], "when": "reset"},
    "p_gain": {"range": [0.9, 1.1], "when": "reset", "grow": [0, 10]},
    "d_gain": [0.9, 1.1],
    "joint_offset": {"range": [-0.02, 0.02], "when": "reset"},
}
KICKS = {"stumble": {"interval_s": [0.1, 0.2], "x": [-1.0, 1.0], "yaw": [-0.5, 0.5]}}
FORCES = {
    "pull": {"body": "LF_THIGH", "interval_s": [0.02, 0.06], "duration_s": [0.04, 0.1], "y": [-50.0, 50.0]},
    "lift": {"interval_s": [0.02, 0.06], "duration_s": [0.04, 0.1], "z": [0.0, 50.0]},
}
ALL = [("domain_rand.ranges", EVERYTHING), ("domain_rand.kicks", KICKS), ("domain_rand.forces", FORCES)]


def with_ranges(**ranges):
    return ("domain_rand.ranges", ranges)


def after(task, steps):
    for _ in range(steps):
        task.step(zero_actions(task))
    return task


# ---- by hand -------------------------------------------------------------------------------------------------------------


def forces_of(task):
    """What actuators exert on the joints after one physics step, (N, D) [N m]."""
    bound = task.physics.batch.bind("qfrc_actuator")
    task.physics.step()
    return torch.tensor(bound[:, 6:]).float()


@pytest.mark.slow
def test_a_motor_of_strength_0_8_gives_0_8_of_the_torque():
    task = small_task(with_ranges(motor_strength=[0.8, 0.8]), num_envs=2)
    task.physics.ctrl[:] = torch.linspace(-30.0, 30.0, 12)
    torch.testing.assert_close(forces_of(task), 0.8 * torch.linspace(-30.0, 30.0, 12).expand(2, -1))


@pytest.mark.slow
def test_a_torque_limit_of_a_half_halves_it_in_the_law_and_in_the_engine():
    task = small_task(with_ranges(torque_limit=[0.5, 0.5]), num_envs=2)
    limits = torch.as_tensor(task.robot.torque_limits, dtype=torch.float32)
    torch.testing.assert_close(task.control.torque_limits, 0.5 * limits.expand(2, -1))
    task.control.set_actions(torch.full((2, 12), 50.0))
    torch.testing.assert_close(task.control.compute(task.dof_pos, task.dof_vel), 0.5 * limits.expand(2, -1))
    task.physics.ctrl[:] = 1000.0
    torch.testing.assert_close(forces_of(task), 0.5 * limits.expand(2, -1))


@pytest.mark.slow
def test_gains_are_factors_on_those_of_the_law():
    """At 0.1 rad from the target and 2 rad/s: 1.5 * kp * 0.1 - 0.5 * kd * 2."""
    plain = small_task(num_envs=1).control
    task = small_task(with_ranges(p_gain=[1.5, 1.5], d_gain=[0.5, 0.5]), num_envs=1)
    task.control.set_actions(zero_actions(task))
    torques = task.control.compute(task.default_dof_pos - 0.1 + torch.zeros(1, 12), torch.full((1, 12), 2.0))
    torch.testing.assert_close(torques, (0.15 * plain.stiffness - plain.damping).view(1, -1))


@pytest.mark.slow
def test_a_zero_offset_of_0_05_rad_shifts_the_held_pose():
    """Encoders show 0.05 rad too much: motors come to rest 0.05 rad lower, and observations see nothing of it."""
    settings = [("init_state.dof_pos_factor", [1.0, 1.0]), ("init_state.base_velocity", [0.0, 0.0])]
    tasks = [
        small_task(with_ranges(joint_offset=[value, value], gravity_z=[9.81, 9.81]), *settings, num_envs=1)
        for value in (0.0, 0.05)
    ]
    straight, shifted = (after(task, 100) for task in tasks)
    torch.testing.assert_close(straight.dof_pos - shifted.dof_pos, torch.full((1, 12), 0.05), atol=2e-3, rtol=0.0)
    torch.testing.assert_close(shifted._obs_dof_pos(), straight._obs_dof_pos(), atol=2e-3, rtol=0.0)


def test_gravity_that_leans_accelerates_a_falling_robot_sideways():
    """0.02 s of a fall under (2, 0, -9.81 + 1): 0.04 m/s forward and -0.1762 m/s down."""
    task = small_task(with_ranges(gravity_x=[2.0, 2.0], gravity_z=[1.0, 1.0]), num_envs=1)
    start = task.physics.qpos.clone()
    start[:, 2] += 5.0
    task.physics.write(torch.ones(1, dtype=torch.bool), start, torch.zeros_like(task.physics.qvel))
    for _ in range(4):
        task.physics.ctrl.zero_()
        task.physics.step()
    velocity = task.physics.qvel[0, :3]
    assert velocity[0].item() == pytest.approx(0.04, abs=4e-3)
    assert velocity[2].item() == pytest.approx(-0.1762, abs=4e-3)


def test_velocity_limits_are_those_that_rewards_know():
    task = small_task(with_ranges(velocity_limit=[0.5, 0.5]), num_envs=2)
    torch.testing.assert_close(task.dof_vel_limits, 0.5 * torch.as_tensor(task.robot.dof_vel_limits).float().expand(2, -1))
    task.dof_vel[:] = task.dof_vel_limits + 0.25
    torch.testing.assert_close(task._reward_dof_vel_limits(), torch.full((2,), 12 * 0.25), atol=1e-3, rtol=0.0)


@pytest.mark.slow
def test_a_kick_adds_to_the_velocity_and_comes_at_its_time():
    """Every 0.1 s, which is 5 control steps: 0.5 m/s more sideways at once."""
    kick = {"interval_s": [0.1, 0.1], "y": [0.5, 0.5]}
    task = small_task(("domain_rand.kicks", {"k": kick}), num_envs=3)
    kicks = task.disturbances.kicks["k"]
    moments = [[], [], []]
    for step in range(1, 21):
        task.numbers.draw()
        task.disturbances.draw()
        before = task.physics._qvel.clone()
        task.disturbances.act(task.physics, torch.ones(3, dtype=torch.bool))
        change = task.physics._qvel - before
        for robot in range(3):
            if change[robot].any():
                moments[robot].append(step)
                assert change[robot].tolist() == pytest.approx([0.0, 0.5] + 16 * [0.0])
    assert all(b - a == 5 for steps in moments for a, b in pairwise(steps))
    assert all(len(steps) == 4 for steps in moments)
    assert kicks.time_left.max() <= 0.1 + 1e-6


@pytest.mark.slow
def test_a_force_acts_for_its_duration_and_accelerates_by_f_over_m():
    """52.13 N on the base of 52.13 kg, in a fall: 1 m/s^2 of the whole robot, for 3 control steps of 0.02 s."""
    task = small_task(num_envs=1)
    force = {"interval_s": [0.1, 0.1], "duration_s": [0.06, 0.06], "x": [task.robot.mass, task.robot.mass]}
    task = small_task(("domain_rand.forces", {"f": force}), ("sim.dt", 0.02), ("control.decimation", 1), num_envs=1)
    pushing = []
    everyone = torch.ones(1, dtype=torch.bool)
    for _ in range(40):
        task.numbers.draw()
        task.disturbances.draw()
        task.disturbances.act(task.physics, everyone)
        pushing.append(bool(task.physics.forces.any()))
    runs = "".join("x" if on else "." for on in pushing).strip(".").split("x" * 3)
    assert "xxxx" not in "".join("x" if on else "." for on in pushing)
    assert {run for run in runs[1:-1]} == {"." * 5}  # 0.1 s from the end of one to the next
    task.physics.forces.zero_()
    task.physics.forces[0, 1, 0] = task.robot.mass
    qpos = task.physics.qpos.clone()
    qpos[:, 2] += 5.0
    task.physics.write(everyone, qpos, torch.zeros_like(task.physics.qvel))
    assert not task.physics.forces.any()  # a new episode begins without
    task.physics.forces[0, 1, 0] = task.robot.mass
    model, batch = task.physics.model, task.physics.batch
    mass = torch.tensor(model.body_mass)
    centres = batch.bind("xipos")
    batch.forward()
    before = (torch.tensor(centres[0]) * mass[:, None]).sum(0) / mass.sum()
    for _ in range(5):
        task.physics.ctrl.zero_()
        task.physics.step()
    batch.forward()
    moved = (torch.tensor(centres[0]) * mass[:, None]).sum(0) / mass.sum() - before
    assert moved[0].item() == pytest.approx(0.02**2 * (1 + 2 + 3 + 4 + 5), rel=0.05)  # semi-implicit Euler, 1 m/s^2


@pytest.mark.slow
def test_a_force_ends_with_the_episode():
    force = {"interval_s": [0.02, 0.02], "duration_s": [10.0, 10.0], "x": [5.0, 5.0]}
    task = after(small_task(("domain_rand.forces", {"f": force}), num_envs=2), 5)
    assert (task.physics.forces[:, 1, 0] == 5.0).all()
    task.disturbances.act(task.physics, torch.tensor([True, False]))
    assert task.physics.forces[:, 1, 0].tolist() == [5.0, 0.0]


# ---- when ----------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_only_robots_that_are_reset_draw_again_and_the_start_is_kept():
    ranges = {name: draw for name, draw in EVERYTHING.items() if isinstance(draw, list) or draw["when"] == "reset"}
    task = small_task(("domain_rand.ranges", ranges), num_envs=4)
    before = {name: values.clone() for name, values in task.randomization.fields.items()}
    masses = task.physics.batch.expand("body_mass").copy()
    mask = torch.tensor([True, False, False, True])
    task.draw()
    task.reset_idx(mask)
    for name, values in task.randomization.fields.items():
        again = isinstance(ranges[name], dict)
        changed = (values != before[name]).view(4, -1).any(dim=1)
        assert changed.tolist() == (mask.tolist() if again else 4 * [False]), name
    assert ((task.physics.batch.expand("body_mass") != masses).any(axis=1)).tolist() == mask.tolist()


@pytest.mark.slow
def test_what_is_drawn_is_what_the_engine_has():
    """After resets, of fields from which constants are derived and of others; and the constants fit the masses."""
    task = after(small_task(*ALL, ("env.episode_length_s", 0.1)), 12)
    drawn, batch, model = task.randomization.fields, task.physics.batch, task.physics.model
    shapes = [model.geom(name).id for name in task.robot.shape_names]
    torch.testing.assert_close(torch.tensor(batch.expand("geom_friction")[:, shapes[0], 0]).float(), drawn["friction"])
    mass = drawn["link_mass"] * torch.tensor(model.body_mass[1:]).float()
    mass[:, 0] += drawn["added_base_mass"]
    torch.testing.assert_close(torch.tensor(batch.expand("body_mass")[:, 1:]).float(), mass)
    gain = drawn["motor_strength"] + drawn["actuator_gain"].unsqueeze(1)
    torch.testing.assert_close(torch.tensor(batch.expand("actuator_gainprm")[:, :, 0]).float(), gain)
    for world in range(4):
        own = batch.get_model(world)
        kept = own.body_invweight0.copy(), own.dof_invweight0.copy()
        mujoco.mj_setConst(own, mujoco.MjData(own))
        torch.testing.assert_close(torch.tensor(own.body_invweight0), torch.tensor(kept[0]))
        torch.testing.assert_close(torch.tensor(own.dof_invweight0), torch.tensor(kept[1]))


@pytest.mark.slow
def test_intervals_draw_each_robot_at_its_own_moments():
    """Every 0.1 s, which is 5 control steps."""
    draw = {"range": [-1.0, 1.0], "when": "interval", "interval_s": 0.1}
    task = small_task(with_ranges(gravity_x=draw), num_envs=16)
    moments = [[] for _ in range(16)]
    for step in range(20):
        before = task.randomization.fields["gravity_x"].clone()
        after(task, 1)
        for robot in (task.randomization.fields["gravity_x"] != before).nonzero().flatten().tolist():
            moments[robot].append(step)
    assert all(len(steps) == 4 and steps[-1] - steps[0] == 15 for steps in moments)
    assert len({steps[0] for steps in moments}) > 2
    found = torch.tensor(task.physics.batch.expand("opt.gravity")[:, 0]).float()
    torch.testing.assert_close(found, task.randomization.fields["gravity_x"])


@pytest.mark.slow
def test_a_range_grows_with_iterations_and_checkpoints_know_how_far():
    draw = {"range": [0.5, 1.5], "when": "reset", "grow": [0, 2]}
    settings = with_ranges(p_gain=draw), ("train.runner.num_steps_per_env", 10), ("env.episode_length_s", 0.02)
    task = small_task(*settings, num_envs=200)
    assert (task.randomization.fields["p_gain"] == 1.0).all()
    after(task, 10)
    halfway = (task.randomization.fields["p_gain"] - 1.0).abs().max()
    assert 0.2 < halfway <= 0.25 + 1e-6
    progress = task.progress()
    after(task, 20)
    assert (task.randomization.fields["p_gain"] - 1.0).abs().max() > 0.45
    other = small_task(*settings, num_envs=50)
    other.load_progress(progress)
    other.reset()
    assert 0.2 < (other.randomization.fields["p_gain"] - 1.0).abs().max() <= 0.25 + 0.03


@pytest.mark.slow
def test_a_state_that_is_put_back_gives_the_same_steps():
    torch.manual_seed(3)
    task = after(small_task(*ALL, ("env.episode_length_s", 0.1)), 7)
    state = task.state_dict()
    torch.manual_seed(4)
    first = after(task, 9).physics.qpos.clone()
    torch.manual_seed(9)
    other = small_task(*ALL, ("env.episode_length_s", 0.1))
    other.load_state_dict(state)
    torch.manual_seed(4)
    assert torch.equal(after(other, 9).physics.qpos, first)


# ---- both engines, and a graph -------------------------------------------------------------------------------------------


def run(engine, steps=35):
    """Everything drawn, through resets, kicks and forces; joint angles, base and what was drawn."""
    name, _, gpu = engine.partition(", ")
    cfg = small_config(*ALL, ("env.episode_length_s", 0.4), ("sim.physics", name))
    torch.manual_seed(0)
    task = make_task(cfg, "cuda:0" if gpu else "cpu", graph=not gpu)
    torch.manual_seed(1)
    task.reset()
    for step in range(steps):
        torch.manual_seed(step)
        task.step(zero_actions(task))
    return task


@pytest.fixture(scope="module")
def in_c():
    return run("mujoco")


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco_warp", "newton"])
def test_all_engines_make_the_same_of_everything(in_c, engine):
    """35 control steps in the air and on the ground, with resets in between; the fused step takes all of it, and Newton's
    MuJoCo solver.
    """
    other = run(engine)
    assert other.physics.why_library == ""
    torch.testing.assert_close(other.randomization.drawn, in_c.randomization.drawn)
    torch.testing.assert_close(other.physics.forces, in_c.physics.forces)
    assert in_c.physics.forces.any()
    assert in_c.contact_forces.any()
    torch.testing.assert_close(other.dof_pos, in_c.dof_pos, atol=2e-4, rtol=0.0)
    torch.testing.assert_close(other.base_pos, in_c.base_pos, atol=2e-5, rtol=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp", "newton", on_gpu("mujoco_warp, cuda"), on_gpu("newton, cuda")])
def test_a_step_in_which_everything_is_drawn_can_be_captured(engine):
    name, _, gpu = engine.partition(", ")
    cfg = small_config(*ALL, ("env.episode_length_s", 0.1), ("sim.physics", name))
    task = make_task(cfg, "cuda:0" if gpu else "cpu", graph=bool(gpu))
    with torch.inference_mode():
        for _ in range(8):
            with ForbidHostReads():
                task._step()
    if gpu:
        assert task.captured


@pytest.mark.slow
def test_everything_adds_few_launches():
    """A third of them beside the step; and what is not asked for adds none (test_launches.py)."""
    counts = []
    for settings in ([], ALL):
        task = make_task(small_config(*settings, ("sim.physics", "mujoco_warp"), num_envs=2))
        with torch.no_grad(), counting() as launches:
            task.step_in_place(zero_actions(task))
        counts.append(launches.total())
    assert counts[1] - counts[0] <= 66, counts


def test_every_field_is_among_those_that_are_drawn_here():
    assert set(EVERYTHING) == set(FIELDS)


@pytest.mark.slow
def test_a_force_does_not_go_on_into_episodes_that_begin_outside_of_a_step():
    """It lasts for 5 s; `reset()` ends it before, and the next step, too short for another one, is free of it."""
    force = {"x": [100.0, 200.0], "interval_s": [0.02, 0.04], "duration_s": [5.0, 5.0]}
    task = small_task(("domain_rand.forces", {"pull": force}))
    for _ in range(5):
        task.step(torch.zeros(4, 12))
    pulled = task.disturbances.forces["pull"].force
    assert (pulled[:, 0] >= 100.0).all()
    task.reset()
    assert not pulled.any()
    assert not task.physics.forces.any()
    task.step(torch.zeros(4, 12))
    assert not task.physics.forces.any()


@pytest.mark.slow
def test_what_grows_begins_with_nothing_also_where_its_range_leaves_out_0():
    """Halfway from iteration 100 to 200 it is half of what is drawn: 0.25 to 0.5 m/s, -150 to -100 N."""
    steps = 24
    kick = {"x": [0.5, 1.0], "interval_s": [0.02, 0.02], "grow": [100, 200]}
    force = {"z": [-300.0, -200.0], "interval_s": [0.02, 0.02], "grow": [100, 200]}
    task = small_task(
        ("domain_rand.kicks", {"kick": kick}),
        ("domain_rand.forces", {"pull": force}),
        ("train.runner.num_steps_per_env", steps),
    )
    kicks, forces = task.disturbances.kicks["kick"], task.disturbances.forces["pull"]
    for begun, share in ((0, 0.0), (150, 0.5), (200, 1.0)):
        task.disturbances.steps.fill_(begun * steps)
        task.disturbances.draw()
        for drawn, low, high in ((kicks.velocity[:, 0], 0.5, 1.0), (forces.drawn[:, 2], -300.0, -200.0)):
            assert (drawn >= share * low - 1e-5).all()
            assert (drawn <= share * high + 1e-5).all()
