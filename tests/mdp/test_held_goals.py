"""Goals of held joints: a walk by hand, its statistics, the motors that follow, and settings that do not fit."""

import math

import pytest
import torch
from helpers import ENGINE

from legged.config.randomization import HeldGoalsConfig
from legged.config.robot import RobotControlConfig
from legged.errors import ConfigError
from legged.mdp.disturbances import Disturbances
from legged.mdp.held_goals import HeldGoals
from legged.registry import make_task, task_config
from legged.robots.robot import load_robot

CPU, DT = torch.device("cpu"), 0.02
ARMS = ("shoulder", "elbow", "wrist")
STEP = ("domain_rand.held_goals.step", 0.2)
SIGNS = [1, -1, -1, 1, -1, 1, -1]
"""Signs of shoulder pitch, roll, yaw, elbow, wrist roll, pitch, yaw in the mirror."""


def walk(num_envs=1, held=ARMS, **settings):
    cfg = HeldGoalsConfig(**{"step": 0.2, **settings})
    return HeldGoals(cfg, load_robot("g1"), RobotControlConfig(held=held), num_envs, DT, CPU)


def arms(*overrides, num_envs=2):
    settings = [("env.num_envs", num_envs), *ENGINE, ("control.held", [*ARMS]), *overrides]
    return make_task(task_config("g1_flat", settings, on_cpu=True))


def after_steps(task, steps):
    for _ in range(steps):
        task.step(torch.zeros(task.num_envs, task.num_actions))


def test_targets_go_to_their_goals_in_a_straight_line_and_the_next_goals_begin_there():
    """A period of 0.08 s is 4 control steps. The left shoulder's pitch, 0.2 rad by default, may be 0.1 to 0.5 rad."""
    goals = walk(period_s=0.08, limits={"shoulder_pitch": (0.1, 0.5)})
    assert goals.WIDTH == 14
    drawn = torch.zeros(1, 14)
    goals.take(drawn)
    found = []
    for step in range(13):
        drawn[0, 0], drawn[0, 3] = (0.2, 0.1) if step < 4 else (0.4, 0.1) if step < 8 else (-1.0, 0.1)
        goals.act(None, torch.tensor([step > 0]))
        found.append(goals.offsets[0, [0, 3]].tolist())
    pitch, elbow = zip(*found, strict=True)
    # 0.2, then 0.3 instead of 0.6, then -0.1 instead of -0.7.
    assert pitch == pytest.approx([0, 0.05, 0.1, 0.15, 0.2, 0.225, 0.25, 0.275, 0.3, 0.2, 0.1, 0.0, -0.1], abs=1e-6)
    assert elbow == pytest.approx([0.025 * step for step in range(13)], abs=1e-6)


def test_a_new_episode_begins_at_the_default_angles_with_a_new_goal():
    goals = walk(2, period_s=0.04)
    goals.take(torch.full((2, 14), 0.1))
    for _ in range(4):
        goals.act(None, torch.tensor([True, True]))
    goals.act(None, torch.tensor([True, False]))
    assert goals.offsets[:, 0].tolist() == pytest.approx([0.2, 0.0])
    goals.act(None, torch.tensor([True, True]))
    assert goals.offsets[:, 0].tolist() == pytest.approx([0.25, 0.05])
    goals.end()
    assert not goals.offsets.any()


def test_the_right_arm_is_the_mirror_image_of_the_left_one():
    """With limits of the left arm only, as far as they are not the same on both sides."""
    goals = walk(mirrored=True, limits={"left_shoulder_roll": (0.0, 1.0)})
    assert goals.WIDTH == 7
    goals.take(torch.linspace(-0.3, 0.3, 7).view(1, 7))
    for _ in range(10):
        goals.act(None, torch.tensor([True]))
    left, right = goals.offsets[0].split(7)
    assert left[6] > 0.0
    assert right.tolist() == pytest.approx((left * torch.tensor(SIGNS)).tolist())


def test_a_free_walk_has_the_standard_deviation_and_the_speed_that_are_asked_for():
    """0.03 rad^2 each 0.5 s: after 8 goals a variance of 0.24 rad^2, and 0.346 rad/s (rms). Steps stay below 4 sigma."""
    torch.manual_seed(0)
    step = math.sqrt(0.03)
    task = arms(("domain_rand.held_goals", {"step": step, "limits": {"shoulder": [-9.0, 9.0]}}), num_envs=1)
    count = 20_000
    drawn = task.disturbances._draws.at_once(count)
    assert drawn.std().item() == pytest.approx(step, rel=0.01)
    assert drawn.abs().max() <= 4.0 * step
    many = walk(count, step=step)
    many._low, many._high = torch.full((14,), -9.0), torch.full((14,), 9.0)
    speeds = []
    for step_number in range(8 * 25 + 1):
        if step_number % 25 == 0:
            many.take(task.disturbances._draws.at_once(count))
        before = many.offsets.clone()
        many.act(None, torch.ones(count, dtype=torch.bool))
        speeds.append(((many.offsets - before) / DT).square().mean())
    assert many.offsets.var().item() == pytest.approx(8 * 0.03, rel=0.02)
    assert torch.stack(speeds[1:]).mean().sqrt().item() == pytest.approx(0.346, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("actuator", [{}, {"delay": [0, 2]}])
def test_motors_hold_joints_at_targets_that_move(actuator):
    """At the default angles at rest the torque is stiffness * offset; a delayed motor gets there later."""
    task = arms(STEP, ("control.actuator", actuator), ("domain_rand.held_goals.period_s", 0.1))
    control, held = task.control, list(task.control.held)
    torques = torch.zeros(2, 14)
    for _ in range(8):
        task.step(torch.zeros(2, 15))
        offsets = control.held_offsets.clone()
        control.set_actions(torch.zeros(2, 15))
        still = torch.zeros(2, 29)
        torques = control.compute(task.default_dof_pos + still, still)[:, held]
    if not actuator:
        most = control.torque_limits[held]
        torch.testing.assert_close(torques, (control.stiffness[held] * offsets).clamp(-most, most))
    assert torques.abs().max() > 0.1
    assert task._obs_held_targets() is control.held_offsets
    assert not task.posture_joints[held].any()
    assert arms().posture_joints[held].all()


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
def test_arms_follow_their_goals_in_the_air(engine):
    """After a second of a slow walk without gravity, the arms are where their targets are, to 0.05 rad."""
    weightless = ("domain_rand.ranges", {"gravity_z": [9.81, 9.81]})
    task = arms(STEP, weightless, ("domain_rand.held_goals.period_s", 1.0), ("sim.physics", engine))
    after_steps(task, 50)
    held = list(task.control.held)
    assert task.control.held_offsets.abs().max() > 0.2
    torch.testing.assert_close((task.dof_pos - task.default_dof_pos)[:, held], task.control.held_offsets, atol=0.05, rtol=0.0)


@pytest.mark.slow
def test_goals_grow_are_saved_and_end_with_play():
    settings = (STEP, ("domain_rand.held_goals.grow", [10, 20]), ("train.runner.num_steps_per_env", 24))
    task = arms(*settings)
    after_steps(task, 5)
    assert not task.control.held_offsets.any()
    task.load_progress({**task.progress(), "disturbances": {"steps": torch.tensor(15.0 * 24)}})
    task.disturbances.draw()
    half = task.disturbances._drawn.clone()
    task.disturbances.steps.fill_(1000.0 * 24)
    task.disturbances.draw()
    torch.testing.assert_close(half, 0.5 * task.disturbances._drawn)
    after_steps(task, 30)
    assert task.control.held_offsets.any()
    other = arms(*settings)
    other.load_state_dict(task.state_dict())
    torch.testing.assert_close(other.control.held_offsets, task.control.held_offsets)
    task.reset()
    assert not task.control.held_offsets.any()
    assert not task.cfg.domain_rand.nominal().held_goals.step


def test_a_task_whose_joints_stay_draws_the_numbers_that_it_drew():
    task = arms(("domain_rand.kicks", {"k": {"x": [0.0, 1.0]}}))
    assert isinstance(task.disturbances, Disturbances)
    assert task.disturbances._drawn.shape[1] == 7
    assert not task.control.held_offsets.any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([("control.held", [])], r"held_goals\.step: no joint is held"),
        ([("domain_rand.held_goals.limits", {"hip": [0.0, 1.0]})], r"held_goals\.limits: pattern 'hip' matches nothing"),
        (
            [("domain_rand.held_goals.limits", {"elbow": [3.0, 4.0]})],
            r"limits: 'left_elbow_joint' has the range .* got \[3\.0",
        ),
        ([("control.held", ["left_elbow"]), ("domain_rand.held_goals.mirrored", True)], r"control\.held names joints on one"),
        ([("domain_rand.held_goals.grow", [5, 5])], r"held_goals\.grow: expected \[first, last\]"),
    ],
)
def test_walks_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        arms(STEP, ("train.algorithm.symmetry", False), *changes)
