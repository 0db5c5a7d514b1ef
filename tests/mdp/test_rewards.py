"""Every reward term against its formula, on a state written by hand: two robots, numbers that can be worked on paper."""

import inspect
import math

import pytest
import torch
from helpers import small_task

from legged.envs import LeggedRobot
from legged.registry import task_config

# Names of the terms of legged_gym that exist on flat ground, as its users write them in a configuration, and those of bipeds.
TERMS = [
    "tracking_lin_vel",
    "tracking_ang_vel",
    "lin_vel_z",
    "ang_vel_xy",
    "orientation",
    "base_height",
    "height_error",
    "tilt_error",
    "torques",
    "dof_vel",
    "dof_acc",
    "action_rate",
    "collision",
    "termination",
    "dof_pos_limits",
    "dof_vel_limits",
    "torque_limits",
    "feet_air_time",
    "stumble",
    "stand_still",
    "feet_contact_forces",
    "no_fly",
    "single_stance",
    "uneven_steps",
    "feet_slide",
    "feet_clearance",
    "posture",
    "self_collision",
]


@pytest.fixture(scope="module")
def built():
    return small_task(
        ("rewards.tracking_sigma", 0.25),
        ("rewards.base_height_target", 0.5),
        ("rewards.air_time_target_s", 0.5),
        ("rewards.max_contact_force", 300.0),
        ("rewards.soft_dof_pos_limit", 0.9),
        ("rewards.soft_dof_vel_limit", 0.5),
        ("rewards.soft_torque_limit", 0.75),
        ("rewards.scales.self_collision", -1.0),
        ("sim.self_collisions", True),
        num_envs=2,
    )


@pytest.fixture
def task(built):
    """The task with everything that a reward can see at zero or neutral; on the C engine these are plain tensors."""
    zero = (built.base_lin_vel, built.base_ang_vel, built.base_pos, built.dof_vel, built.last_dof_vel, built.torques)
    for tensor in (
        *zero,
        built.actions,
        built.last_actions,
        built.commands,
        built.contact_forces,
        built.sensors["self_collision"].forces,
        built.contacts.last_air_time,
        built.contacts.air_time,
        built.feet_pos,
        built.feet_vel,
    ):
        tensor.zero_()
    contacts = built.contacts
    for flags in (built.terminated_buf, built.time_out_buf, built.is_moving, contacts.first_contact, contacts.in_contact):
        flags.fill_(False)
    built.dof_pos.copy_(built.default_dof_pos.expand(2, 12))
    built.projected_gravity.copy_(torch.tensor([0.0, 0.0, -1.0]).expand(2, 3))
    return built


def value(task, name: str) -> list[float]:
    result = getattr(task, f"_reward_{name}")()
    assert result.shape == (2,)
    assert result.dtype == torch.float32
    return result.tolist()


def near(*values: float):
    return pytest.approx(list(values), rel=1e-5, abs=1e-7)


def test_the_terms_are_those_that_are_tested_here():
    assert LeggedRobot.terms("_reward_") == set(TERMS)


def test_every_term_is_tested_here_and_documented():
    source = inspect.getsource(inspect.getmodule(test_every_term_is_tested_here_and_documented))
    for name in TERMS:
        assert f'"{name}")' in source
        assert getattr(LeggedRobot, f"_reward_{name}").__doc__


def test_shipped_scales_name_terms_and_none_is_switched_off_by_mistake():
    scales = task_config("anymal_c_flat").rewards.scales
    assert set(scales) <= set(TERMS)
    assert scales["tracking_lin_vel"] > 0.0
    assert all(scale != 0.0 for scale in scales.values())


def test_tracking_lin_vel_is_a_bell_over_the_horizontal_error(task):
    task.commands[:, :3] = torch.tensor([[1.0, 0.5, 9.0], [0.0, 0.0, 9.0]])
    task.base_lin_vel.copy_(torch.tensor([[0.7, 0.1, 7.0], [0.0, 0.0, 7.0]]))
    # |(0.3, 0.4)|^2 = 0.25, over sigma 0.25; vertical velocity and yaw rate play no part.
    assert value(task, "tracking_lin_vel") == near(math.exp(-1.0), 1.0)


def test_tracking_ang_vel_is_a_bell_over_the_yaw_rate_error(task):
    task.commands[:, :3] = torch.tensor([[9.0, 9.0, 0.5], [9.0, 9.0, -0.3]])
    task.base_ang_vel.copy_(torch.tensor([[5.0, 5.0, -0.5], [5.0, 5.0, -0.3]]))
    assert value(task, "tracking_ang_vel") == near(math.exp(-4.0), 1.0)


def test_lin_vel_z_squares_the_vertical_velocity(task):
    task.base_lin_vel.copy_(torch.tensor([[5.0, 5.0, -0.3], [1.0, 1.0, 0.0]]))
    assert value(task, "lin_vel_z") == near(0.09, 0.0)


def test_ang_vel_xy_squares_roll_and_pitch_rates(task):
    task.base_ang_vel.copy_(torch.tensor([[0.3, -0.4, 5.0], [0.0, 2.0, 5.0]]))
    assert value(task, "ang_vel_xy") == near(0.25, 4.0)


def test_orientation_squares_the_horizontal_part_of_gravity(task):
    task.projected_gravity.copy_(torch.tensor([[0.6, 0.0, -0.8], [0.1, -0.2, -0.97]]))
    assert value(task, "orientation") == near(0.36, 0.05)


def test_base_height_squares_the_distance_to_the_target(task):
    task.base_pos.copy_(torch.tensor([[3.0, 4.0, 0.4], [0.0, 0.0, 0.8]]))
    assert value(task, "base_height") == near(0.01, 0.09)


def test_height_error_squares_the_distance_to_the_commanded_height(task):
    task.base_pos.copy_(torch.tensor([[3.0, 4.0, 0.4], [0.0, 0.0, 0.8]]))
    task.base_commands[:, 0] = torch.tensor([0.6, 0.8])
    assert value(task, "height_error") == near(0.04, 0.0)


def test_tilt_error_squares_what_leans_otherwise_than_commanded(task):
    """Leaning forward by 0.1 rad moves gravity forward by its sine; a roll counts as in `orientation`."""
    task.projected_gravity.copy_(torch.tensor([[math.sin(0.1), 0.0, -math.cos(0.1)], [math.sin(0.1), 0.2, -0.97]]))
    task.base_commands[:, 1] = torch.tensor([0.3, 0.1])
    assert value(task, "tilt_error") == near((math.sin(0.3) - math.sin(0.1)) ** 2, 0.04)


def test_torques_are_squared_and_summed(task):
    task.torques[0, :3] = torch.tensor([1.0, -2.0, 3.0])
    task.torques[1] = 2.0
    assert value(task, "torques") == near(14.0, 48.0)


def test_dof_vel_is_squared_and_summed(task):
    task.dof_vel[0, 4:6] = torch.tensor([3.0, -4.0])
    task.dof_vel[1] = -1.0
    assert value(task, "dof_vel") == near(25.0, 12.0)


def test_dof_acc_squares_the_change_of_velocity_over_a_control_step(task):
    task.dof_vel[0, 0], task.last_dof_vel[0, 0] = 0.5, 0.1
    task.dof_vel[1, :2], task.last_dof_vel[1, :2] = 1.0, 1.02
    # 0.4 / 0.02 = 20; twice -0.02 / 0.02 = -1.
    assert value(task, "dof_acc") == pytest.approx([400.0, 2.0], rel=1e-4)


def test_action_rate_squares_the_change_of_the_actions(task):
    task.actions[0, :2], task.last_actions[0, :2] = torch.tensor([1.0, 2.0]), torch.tensor([0.5, 4.0])
    task.actions[1] = task.last_actions[1] = 3.0
    assert value(task, "action_rate") == near(4.25, 0.0)


def shape(task, name: str) -> int:
    return task.robot.contact_names.index(name)


def test_collision_counts_thighs_and_shanks_that_feel_more_than_a_tenth_of_a_newton(task):
    task.contact_forces[0, shape(task, "LF_THIGH")] = torch.tensor([0.0, 0.0, 50.0])
    task.contact_forces[0, shape(task, "RH_SHANK")] = torch.tensor([0.08, 0.08, 0.0])  # 0.113 N
    task.contact_forces[1, shape(task, "LF_SHANK")] = torch.tensor([0.09, 0.0, 0.0])  # too little
    task.contact_forces[1, shape(task, "LF_FOOT")] = 100.0  # feet and base are not penalised
    task.contact_forces[1, shape(task, "base")] = 100.0
    assert value(task, "collision") == near(2.0, 0.0)


def test_termination_is_failing_not_timing_out(task):
    task.terminated_buf[0] = True
    task.time_out_buf[1] = True
    assert value(task, "termination") == near(1.0, 0.0)


def test_dof_pos_limits_measures_how_far_joints_are_outside_the_soft_limits(task):
    # LF_HAA has -0.72 .. 0.49: middle -0.115, half width 0.605, nine tenths of it 0.5445: -0.6595 .. 0.4295.
    # LF_HFE has -9.42478 .. 9.42478: nine tenths are 8.482302.
    task.dof_pos[0, :2] = torch.tensor([0.4795, -8.582302])
    task.dof_pos[1, 0] = -0.6695
    assert value(task, "dof_pos_limits") == pytest.approx([0.15, 0.01], abs=1e-5)


def test_dof_vel_limits_measures_the_excess_over_half_of_20_at_most_1_a_joint(task):
    task.dof_vel[0, :3] = torch.tensor([10.25, -10.5, 9.9])
    task.dof_vel[1, :2] = torch.tensor([-30.0, 10.5])
    assert value(task, "dof_vel_limits") == near(0.75, 1.5)


def test_torque_limits_measures_the_excess_over_three_quarters_of_80(task):
    task.torques[0, :3] = torch.tensor([65.0, -62.0, 59.0])
    task.torques[1, 0] = -80.0
    assert value(task, "torque_limits") == near(7.0, 20.0)


def set_air_time(task) -> None:
    """Feet 0 and 2 of both robots touch down after 0.7 and 0.4 s; foot 1 swung long ago and stands."""
    task.contacts.last_air_time.copy_(torch.tensor([0.7, 0.9, 0.4, 0.0]).expand(2, 4))
    task.contacts.first_contact.copy_(torch.tensor([True, False, True, False]).expand(2, 4))


def test_feet_air_time_pays_the_excess_over_half_a_second_at_touch_down(task):
    set_air_time(task)
    task.is_moving.copy_(torch.tensor([True, False]))
    assert value(task, "feet_air_time") == near(0.2 - 0.1, 0.0)


def test_feet_air_time_is_paid_for_turning_on_the_spot_and_not_for_standing(task):
    set_air_time(task)
    # Through the sampler, which decides what counts as moving.
    task.command_sampler.hold(torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]))
    assert value(task, "feet_air_time") == near(0.1, 0.0)


def test_stumble_is_a_foot_whose_horizontal_force_is_above_five_times_the_vertical(task):
    task.contact_forces[0, shape(task, "RF_FOOT")] = torch.tensor([30.0, -42.0, -10.0])  # 51.6 > 50
    task.contact_forces[0, shape(task, "LF_FOOT")] = torch.tensor([30.0, 42.0, 10.0])  # two feet count once
    task.contact_forces[1, shape(task, "RF_FOOT")] = torch.tensor([30.0, 39.0, 10.0])  # 49.2 < 50
    task.contact_forces[1, shape(task, "RF_SHANK")] = torch.tensor([30.0, 0.0, 0.0])  # no foot
    assert value(task, "stumble") == near(1.0, 0.0)


def test_stand_still_sums_joint_deviations_while_no_motion_is_commanded(task):
    task.dof_pos[:, :2] += torch.tensor([0.1, -0.2])
    task.is_moving.copy_(torch.tensor([False, True]))
    assert value(task, "stand_still") == near(0.3, 0.0)


def test_self_collision_counts_physics_steps_with_a_strong_contact(task):
    forces = task.sensors["self_collision"].forces
    assert forces.shape == (2, task.cfg.control.decimation)
    forces[0, :3] = torch.tensor([10.1, 9.9, 500.0])
    forces[1, 1] = 10.0  # not above
    assert value(task, "self_collision") == near(2.0, 0.0)
    assert task.sensors["self_collision"].largest.tolist() == [500.0, 10.0]


def test_feet_contact_forces_measures_the_excess_over_the_allowed_force(task):
    task.contact_forces[0, shape(task, "LF_FOOT")] = torch.tensor([0.0, 240.0, 320.0])  # 400 N
    task.contact_forces[0, shape(task, "RF_FOOT")] = torch.tensor([0.0, 0.0, 310.0])
    task.contact_forces[1, shape(task, "LF_FOOT")] = torch.tensor([0.0, 0.0, 299.0])
    task.contact_forces[1, shape(task, "LF_THIGH")] = torch.tensor([0.0, 0.0, 999.0])  # no foot
    assert value(task, "feet_contact_forces") == near(110.0, 0.0)


@pytest.mark.parametrize(
    ("vertical", "expected"), [([9.0, 0, 0, 0], 1.0), ([9.0, 0, 0, 0.2], 0.0), ([0, 0, 0, 0], 0.0), ([0.05, 0, 9.0, 0], 1.0)]
)
def test_no_fly_is_exactly_one_foot_on_the_ground(task, vertical, expected):
    task.contact_forces[0, task.feet_indices, 2] = torch.tensor(vertical, dtype=torch.float32)
    assert value(task, "no_fly")[0] == expected


def test_single_stance_pays_steps_of_which_one_foot_stands(task):
    """Half the target of 0.5 s and the swing, up to the target, then less; a robot with several feet on the ground, or with
    none, gets nothing, nor who may rest.
    """
    task.contacts.air_time.copy_(torch.tensor([[0.0, 0.3, 0.2, 0.1], [0.0, 0.7, 0.1, 0.1]]))
    task.is_moving.fill_(True)
    task.contacts.in_contact[:, 0] = True
    assert value(task, "single_stance") == near(0.55, 0.55)
    task.contacts.air_time[0, 1], task.contacts.air_time[1, 1] = 0.5, 1.1
    assert value(task, "single_stance") == near(0.75, 0.0)
    task.is_moving[1] = False
    task.contacts.in_contact[0, 1] = True
    assert value(task, "single_stance") == near(0.0, 0.0)
    task.contacts.in_contact.fill_(False)
    task.is_moving.fill_(True)
    assert value(task, "single_stance") == near(0.0, 0.0)


def test_uneven_steps_is_the_difference_of_the_last_swings(task):
    task.contacts.last_air_time.copy_(torch.tensor([[0.3, 0.25, 0.1, 0.2], [0.4, 0.4, 0.4, 0.4]]))
    task.is_moving.fill_(True)
    assert value(task, "uneven_steps") == near(0.2, 0.0)
    task.is_moving.fill_(False)
    assert value(task, "uneven_steps") == near(0.0, 0.0)


def test_feet_slide_sees_feet_on_the_ground_only(task):
    task.feet_vel[:, 0] = torch.tensor([0.3, 0.4, 9.0])
    task.feet_vel[:, 1] = torch.tensor([1.0, 0.0, 0.0])
    task.contacts.in_contact[0, :2] = True
    task.contacts.in_contact[1, 1] = True
    assert value(task, "feet_slide") == near(0.25 + 1.0, 1.0)


def test_feet_clearance_is_about_feet_that_swing(task):
    """The target is 0.1 m above the lowest foot: 0.06 m too low at 0.5 m/s, and 0.05 m too high at 2 m/s."""
    task.feet_pos[:, :, 2] = torch.tensor([1.0, 1.04, 1.15, 1.0])
    task.feet_vel[:, 1] = torch.tensor([0.3, 0.4, 9.0])
    task.feet_vel[:, 2] = torch.tensor([0.0, 2.0, 9.0])
    task.contacts.in_contact[:, 0] = True
    task.contacts.in_contact[1, 2] = True
    assert value(task, "feet_clearance") == near(0.06**2 * 0.5 + 0.05**2 * 2.0, 0.06**2 * 0.5)


def test_posture_leaves_hips_and_knees_that_swing_alone(task):
    """HAA spreads a leg; HFE and KFE swing it."""
    names = task.robot.joint_names
    for name, angle in (("LF_HAA", 0.3), ("RH_HAA", -0.4), ("LF_HFE", 1.0), ("LF_KFE", 1.0)):
        task.dof_pos[0, names.index(name)] += angle
    assert value(task, "posture") == near(0.25, 0.0)


def test_the_reward_of_a_step_is_the_sum_of_the_terms_that_have_a_scale():
    scales = task_config("anymal_c_flat").rewards.scales
    chosen = {name: 0.0 for name in scales} | {"base_height": -2.0, "tracking_lin_vel": 3.0}
    task = small_task(*((f"rewards.scales.{name}", scale) for name, scale in chosen.items()), num_envs=2)
    assert set(task.rewards.names) == {"base_height", "tracking_lin_vel"}
    _, reward, dones, _ = task.step(torch.zeros(2, 12))
    assert not dones.any()
    expected = 0.02 * (-2.0 * task._reward_base_height() + 3.0 * task._reward_tracking_lin_vel())
    assert torch.allclose(reward, expected, atol=1e-7)
    assert torch.allclose(task.episode_sums["base_height"], -0.04 * task._reward_base_height(), atol=1e-7)
