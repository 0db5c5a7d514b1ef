"""How episodes of the task end and begin: time-outs, falls, worlds that blow up, the state after a reset."""

import pytest
import torch
from helpers import small_config, small_task, zero_actions

from legged.envs import LeggedRobot

# MuJoCo writes its warnings about numbers that are not finite to MUJOCO_LOG.TXT in the working directory.
pytestmark = pytest.mark.usefixtures("workplace")


def standing(*settings, num_envs: int = 4) -> LeggedRobot:
    """Robots that begin at rest in the default pose."""
    rest = [("init_state.dof_pos_factor", [1.0, 1.0]), ("init_state.base_velocity", [0.0, 0.0])]
    return small_task(*rest, *settings, num_envs=num_envs)


def put(task: LeggedRobot, robot: int, height: float | None = None, quat: list[float] | None = None) -> None:
    """Move the base of one robot in the engine."""
    if height is not None:
        task.physics._qpos[robot, 2] = height
    if quat is not None:
        task.physics._qpos[robot, 3:7] = torch.tensor(quat, dtype=torch.float64)


def lay_on_its_back(task: LeggedRobot, robot: int) -> None:
    """The base touches the ground with its back, and nothing else does: half its height is 0.1 m."""
    put(task, robot, height=0.1, quat=[0.0, 1.0, 0.0, 0.0])


def pitched(degrees: float) -> list[float]:
    half = torch.deg2rad(torch.tensor(degrees)) / 2
    return [float(half.cos()), 0.0, float(half.sin()), 0.0]


# ---- time ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_episode_times_out_after_exactly_its_length_and_is_no_failure():
    task = standing(("env.episode_length_s", 0.6))
    assert task.max_episode_length == 30
    task.episode_length_buf = torch.tensor([0, 10, 0, 0])  # the second robot is ten steps ahead
    ends = []
    for step in range(1, 61):
        _, _, dones, extras = task.step(zero_actions(task))
        assert torch.equal(dones, extras["time_outs"])
        assert not task.terminated_buf.any()
        ends += [(step, robot) for robot in dones.nonzero().flatten().tolist()]
        assert (task.episode_length_buf[dones] == 0).all()
    assert ends == [(20, 1), (30, 0), (30, 2), (30, 3), (50, 1), (60, 0), (60, 2), (60, 3)]


@pytest.mark.slow
def test_a_fall_at_the_last_step_is_a_fall_and_no_time_out():
    task = standing(("env.episode_length_s", 0.6))
    task.episode_length_buf = torch.tensor([29, 29, 0, 0])
    lay_on_its_back(task, 0)
    lay_on_its_back(task, 2)
    _, _, dones, extras = task.step(zero_actions(task))
    assert dones.tolist() == [True, True, True, False]
    assert extras["time_outs"].tolist() == [False, True, False, False]
    assert task.terminated_buf.tolist() == [True, False, True, False]


# ---- failures --------------------------------------------------------------------------------------------------------


def test_an_episode_that_an_override_ends_as_legged_gyms_do_is_a_fall():
    """Of four robots that begin at steps 0 to 3 of 30, those at step 8 are ended; a time-out stays one, and what the override
    spares is neither.
    """

    class Ending(LeggedRobot):
        def check_termination(self):
            super().check_termination()
            self.reset_buf |= self.episode_length_buf == 8
            self.reset_buf &= self.commands[:, 0] < 5.0

    settings = [("env.episode_length_s", 0.6), ("rewards.scales.termination", -100.0)]
    task = Ending(small_config(*settings))
    task.command_sampler.hold(torch.zeros(3))
    task.episode_length_buf = torch.tensor([7, 29, 0, 29])
    task.commands[3, 0] = 9.0
    _, rewards, dones, extras = task.step(zero_actions(task))
    assert dones.tolist() == [True, True, False, False]
    assert extras["time_outs"].tolist() == [False, True, False, False]
    assert task.terminated_buf.tolist() == [True, False, False, False]
    assert rewards[0] == pytest.approx(-100.0 * task.dt, abs=0.2)
    assert rewards[1:].abs().max() < 0.2
    assert task.log_rollout()["Metrics/falls"] == 0.5


def test_a_base_that_touches_the_ground_ends_the_episode_of_that_robot_only():
    task = standing()
    lay_on_its_back(task, 2)
    _, _, dones, extras = task.step(zero_actions(task))
    assert dones.tolist() == [False, False, True, False]
    assert not extras["time_outs"].any()
    assert task.base_pos[2, 2] == pytest.approx(0.6)
    assert task.episode_length_buf.tolist() == [1, 1, 0, 1]


@pytest.mark.slow
def test_standing_on_the_feet_ends_nothing():
    task = standing()
    for _ in range(100):
        _, _, dones, _ = task.step(zero_actions(task))
        assert not dones.any()
    assert (task.contact_forces[:, task.feet_indices, 2] > 50.0).all()
    assert (task.base_pos[:, 2] > 0.4).all()


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "ends"), [(0.0, False), (0.55, False), (0.65, True)])
def test_a_lowest_base_height_can_be_set(limit, ends):
    task = standing(("terminations.min_base_height", limit))
    put(task, 1, height=1.5)
    _, _, dones, _ = task.step(zero_actions(task))  # the others are at 0.6 and fall 2 mm
    assert dones.tolist() == [ends, False, ends, ends]
    assert task.terminated_buf.tolist() == dones.tolist()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limit", "ends"), [(0.0, [False] * 4), (0.6, [False, False, True, True]), (2.0, [False] * 3 + [True])]
)
def test_a_largest_tilt_can_be_set(limit, ends):
    task = standing(("terminations.max_tilt", limit))
    for robot, degrees in enumerate((0.0, 20.0, 50.0, 179.0)):  # 0, 0.35, 0.87 and 3.12 rad
        put(task, robot, height=2.0, quat=pitched(degrees))
    _, _, dones, _ = task.step(zero_actions(task))
    assert dones.tolist() == ends


def test_termination_costs_what_its_scale_says_even_where_rewards_are_clipped_at_zero():
    task = standing(("rewards.scales.termination", -200.0), ("rewards.only_positive_rewards", True))
    lay_on_its_back(task, 0)
    _, reward, _, _ = task.step(zero_actions(task))
    assert -4.0 <= reward[0] < -3.9  # -200 * 0.02 beside at most 0.06 of tracking
    assert (reward[1:] >= 0.0).all()


# ---- worlds that blow up ---------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("where", ["qpos_base", "qpos_joint", "qvel", "inf"])
def test_a_world_that_blows_up_is_terminated_counted_reset_and_finite_at_once(where):
    length = ("train.runner.num_steps_per_env", 10)
    task, twin = standing(length), standing(length)
    for _ in range(4):
        task.step(zero_actions(task))
        twin.step(zero_actions(twin))
    target = {
        "qpos_base": (task.physics._qpos, 2, torch.nan),
        "qpos_joint": (task.physics._qpos, 12, torch.nan),
        "qvel": (task.physics._qvel, 8, torch.nan),
        "inf": (task.physics._qvel, 3, torch.inf),
    }
    tensor, column, number = target[where]
    tensor[1, column] = number
    observations, reward, dones, extras = task.step(zero_actions(task))
    others = twin.step(zero_actions(twin))
    assert dones.tolist() == [False, True, False, False]
    assert not extras["time_outs"].any()
    assert task.terminated_buf[1]
    assert reward[1] == 0.0
    for group in observations.values():
        assert torch.isfinite(group).all()
    assert torch.isfinite(reward).all()
    assert task.base_pos[1, 2] == pytest.approx(0.6)
    assert (task.episode_sums["torques"][1] == 0.0).all()
    # Neighbours don't notice: bit for bit what they are without it.
    rest = torch.tensor([0, 2, 3])
    assert torch.equal(observations["actor"][rest], others[0]["actor"][rest])
    assert torch.equal(reward[rest], others[1][rest])
    for _ in range(5):
        observations, reward, dones, extras = task.step(zero_actions(task))
        assert torch.isfinite(observations["actor"]).all()
        assert torch.isfinite(reward).all()
        assert not dones.any()  # the reset world is healthy again, and goes on falling towards the ground
    log = {name: float(value) for name, value in extras["log"].items()}
    assert log["Metrics/non_finite_worlds"] == 1.0
    assert log["Metrics/falls"] == 1.0
    assert log["Metrics/lin_vel_rmse"] == log["Metrics/lin_vel_rmse"]  # not NaN


def test_a_world_that_blows_up_does_not_stop_the_command_curriculum_or_poison_it():
    task = standing(("commands.curriculum.window_s", 0.1))
    task.physics._qvel[0, 0] = torch.nan
    for _ in range(10):
        task.step(zero_actions(task))
    assert torch.isfinite(task.command_curriculum.share).all()
    assert torch.isfinite(task.command_sampler.ranges).all()
    assert torch.isfinite(task.commands).all()


# ---- resets ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_reset_draws_joints_and_velocities_from_their_ranges():
    task = small_task(num_envs=500)
    task.reset()
    default = torch.tensor([0.0, 0.4, -0.8, 0.0, 0.4, -0.8, 0.0, -0.4, 0.8, 0.0, -0.4, 0.8])
    assert torch.allclose(task.default_dof_pos, default)
    turning = default != 0.0
    assert (task.dof_pos[:, ~turning] == 0.0).all()
    factor = task.dof_pos[:, turning] / default[turning]
    assert 0.5 <= factor.min() < 0.51
    assert 1.49 < factor.max() <= 1.5 + 1e-5
    assert torch.allclose(factor.mean(dim=0), torch.ones(8), atol=0.05)
    correlation = torch.corrcoef(factor.t()) - torch.eye(8)
    assert correlation.abs().max() < 0.2  # each joint by itself
    for velocity in (task.base_lin_vel, task.base_ang_vel):
        assert velocity.abs().max() <= 0.5
        assert (velocity.amax(dim=0) > 0.48).all()
        assert (velocity.amin(dim=0) < -0.48).all()
    assert torch.allclose(task.base_pos, torch.tensor([0.0, 0.0, 0.6]).expand(500, 3))
    assert torch.equal(task.base_quat, torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(500, 4))
    assert (task.dof_vel == 0.0).all()
    assert (task.contact_forces == 0.0).all()


def test_ranges_of_the_initial_state_can_be_set():
    task = small_task(("init_state.dof_pos_factor", [0.9, 1.0]), ("init_state.base_velocity", [0.1, 0.2]), num_envs=100)
    assert task.dof_pos[:, 1].min() >= 0.36
    assert task.dof_pos[:, 1].max() <= 0.4
    assert task.base_lin_vel.min() >= 0.1
    assert task.base_ang_vel.max() <= 0.2


def test_a_reset_in_the_middle_leaves_the_others_alone_and_gives_a_new_command():
    task = standing(("commands.standing_share", 0.0), ("commands.resampling_time_s", 100.0))
    for _ in range(10):
        task.step(zero_actions(task) + 0.1)
    before = task.commands.clone()
    task.contacts.last_air_time.fill_(0.7)
    lay_on_its_back(task, 3)
    task.step(zero_actions(task) + 0.1)
    assert task.reset_buf.tolist() == [False, False, False, True]
    assert torch.equal(task.commands[:3], before[:3])
    assert not torch.equal(task.commands[3], before[3])
    assert (task.episode_sums["torques"][:3] < 0.0).all()
    assert task.episode_sums["torques"][3] == 0.0
    assert (task.actions[3] == 0.0).all()
    assert (task.actions[:3] == 0.1).all()
    assert (task.contacts.last_air_time[3] == 0.0).all()
    assert (task.contacts.last_air_time[:3] > 0.0).all()


@pytest.mark.slow
def test_an_episode_does_not_depend_on_what_was_before_it():
    """Neither on the task's memory nor on the engine's, whose solver starts from the last solution."""
    whole_ranges = ("commands.curriculum.enabled", False)  # a curriculum is to remember
    used, fresh = small_task(whole_ranges), small_task(whole_ranges)
    for step in range(60):
        used.step(torch.full((4, 12), 0.3 * (-1.0) ** (step // 10)))
    for task in (used, fresh):
        torch.manual_seed(9)
        task.reset()
    for _ in range(60):
        torch.manual_seed(10)
        observations, reward, dones, _ = used.step(zero_actions(used))
        torch.manual_seed(10)
        other = fresh.step(zero_actions(fresh))
        assert torch.equal(observations["actor"], other[0]["actor"])
        assert torch.equal(reward, other[1])
        assert torch.equal(dones, other[2])


def test_pushes_change_the_horizontal_velocity_only_and_are_seen_at_once():
    settings = [
        ("domain_rand.push_robots", True),
        ("domain_rand.push_interval_s", 100.0),
        ("domain_rand.max_push_vel_xy", 1.0),
    ]
    task = standing(*settings)
    task.pushes.push_time_left.copy_(torch.tensor([0.05, 50.0, 50.0, 50.0]))
    speeds = []
    for _ in range(4):
        observations, *_ = task.step(zero_actions(task))
        speeds.append(task.base_lin_vel[:, :2].norm(dim=1))
        assert torch.allclose(observations["actor"][:, :3], 2.0 * task.base_lin_vel)
    speeds = torch.stack(speeds)
    pushed_at = int((speeds[:, 0] > 0.1).nonzero()[0])
    assert pushed_at in (1, 2)
    assert (speeds[:pushed_at] < 0.05).all()
    assert (speeds[:, 1:] < 0.05).all()


def test_a_reset_robot_is_not_pushed_out_of_its_initial_state():
    settings = [("domain_rand.push_robots", True), ("domain_rand.push_interval_s", 1.0), ("domain_rand.max_push_vel_xy", 3.0)]
    task = standing(*settings, ("env.episode_length_s", 0.02))
    task.pushes.push_time_left.zero_()
    task.step(zero_actions(task))
    assert task.reset_buf.all()
    assert (task.base_lin_vel == 0.0).all()


def test_construction_leaves_no_trace_of_the_trial_step():
    task = small_task()
    assert (task.episode_length_buf == 0).all()
    assert (task.actions == 0.0).all()
    assert all((sums == 0.0).all() for sums in task.episode_sums.values())
    assert torch.allclose(task.base_pos[:, 2], torch.tensor(0.6))
    assert (task.command_curriculum._steps == 0).all()
    cfg = small_config()
    assert task.command_curriculum.share.tolist() == pytest.approx([cfg.commands.curriculum.start] * 3)
