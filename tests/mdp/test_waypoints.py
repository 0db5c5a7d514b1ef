"""Commands of height and pitch, and waypoints: by hand, by their statistics, and in a task."""

import math

import pytest
import torch
from helpers import small_task

from legged import make_task
from legged.config.legged import CommandRanges, CommandsConfig, WaypointsConfig
from legged.errors import ConfigError
from legged.mdp.commands import Commands
from legged.mdp.random_pool import RandomPool
from legged.mdp.waypoints import Waypoints
from legged.registry import task_config

CPU, DT = torch.device("cpu"), 0.02
RANGES = CommandRanges(lin_vel_x=(-0.5, 0.5), lin_vel_y=(-0.4, 0.4), ang_vel_yaw=(-1.0, 1.0))


def pose(x, y, yaw, count=1):
    half = torch.full((count, 1), 0.5 * yaw)
    zero = torch.zeros(count, 1)
    return torch.tensor([[x, y, 0.8]]).expand(count, 3), torch.cat([half.cos(), zero, zero, half.sin()], dim=1)


def walkers(count=1, standing=0.0, **settings):
    cfg = CommandsConfig(ranges=RANGES, heading_command=False, resampling_time_s=5.0, standing_share=standing)
    pool = RandomPool(count, CPU)
    commands = Commands(cfg, count, DT, CPU, None, pool)
    return commands, Waypoints(WaypointsConfig(**{"share": 1.0, **settings}), commands, pool)


def step(commands, waypoints, at, reset=False):
    commands.numbers.draw()
    commands.draw()
    mask = torch.full((len(commands.commands),), reset)
    commands.update(mask, at[1])
    waypoints.steer(mask, *at)
    return commands.commands[0, :3].tolist()


def test_velocities_are_proportional_to_the_error_in_the_yaw_frame_until_the_place_is_reached():
    """A waypoint at (2.0, 1.0) with heading 90 degrees; gain 1.5, at most 0.5, 0.4 m/s and 1 rad/s."""
    commands, waypoints = walkers()
    step(commands, waypoints, pose(1.7, 1.0, 0.0), reset=True)
    waypoints.target[:] = torch.tensor([[2.0, 1.0, 0.5 * math.pi]])
    for at, wanted in (
        ((1.7, 1.0, 0.0), (0.45, 0.0, 1.0)),
        ((2.0, 0.0, 0.5 * math.pi), (0.5, 0.0, 0.0)),  # a metre ahead, and the heading is right
        ((2.0, 1.25, 1.0), (-0.3156, -0.2026, 0.8562)),  # 0.25 m in the -y direction: (-0.2104, -0.1351) in the yaw frame
        ((2.0, 1.15, 1.5), (-0.2244, -0.0159, 0.1062)),  # nearer than 0.2 m, but not reached before
        ((2.0, 1.09, 1.55), (0.0, 0.0, 0.0)),  # below 0.10 m and 0.05 rad
        ((2.0, 1.19, 1.46), (0.0, 0.0, 0.0)),  # and up to 0.20 m and 0.12 rad nothing happens
        ((2.0, 1.21, 1.5708), (-0.315, 0.0, 0.0)),
    ):
        assert step(commands, waypoints, pose(*at)) == pytest.approx(wanted, abs=2e-4), at
        assert commands.is_moving.item() == any(abs(value) > 0.1 for value in wanted)


def test_a_heading_is_reached_by_the_shorter_turn():
    commands, waypoints = walkers()
    step(commands, waypoints, pose(0.0, 0.0, 3.0), reset=True)
    waypoints.target[:] = torch.tensor([[0.0, 0.0, -3.0]])
    assert step(commands, waypoints, pose(0.0, 0.0, 3.0))[2] == pytest.approx(1.5 * (2.0 * math.pi - 6.0), abs=1e-4)


def test_waypoints_are_uniform_in_a_disc_ahead_of_the_start():
    """The disc's mean squared radius is half of 0.75 m squared. The start looks to the left: the disc lies along y."""
    torch.manual_seed(0)
    commands, waypoints = walkers(40_000)
    step(commands, waypoints, pose(1.0, 2.0, 0.5 * math.pi, 40_000), reset=True)
    apart = waypoints.target[:, :2] - torch.tensor([1.0, 2.3])
    assert apart.norm(dim=1).max() <= 0.7501
    assert apart.mean(dim=0).abs().max() < 0.01
    assert apart.square().sum(dim=1).mean().item() == pytest.approx(0.5 * 0.75**2, rel=0.01)
    first = waypoints.target.clone()
    for number in range(250):
        before = waypoints.target.clone()
        step(commands, waypoints, pose(0.0, 0.0, 0.0, 40_000))
        assert torch.equal(before, waypoints.target) == (number < 249)  # new ones every 5 s, from the same start
    assert (waypoints.target[:, :2] - torch.tensor([1.0, 2.3])).norm(dim=1).max() <= 0.7501
    between = (waypoints.target - first)[:, :2].norm(dim=1)
    assert between.mean().item() == pytest.approx(0.75 * 128.0 / (45.0 * math.pi), rel=0.01)  # of two points of a disc


def test_some_robots_follow_sampled_commands_stand_or_are_held():
    torch.manual_seed(0)
    commands, waypoints = walkers(8, share=0.5)
    step(commands, waypoints, pose(0.0, 0.0, 0.0, 8), reset=True)
    assert waypoints.steered.tolist() == [False, True] * 4  # spread evenly over the columns of the terrain
    torch.testing.assert_close(commands.commands[::2], commands._sample[::2])
    commands.hold(torch.tensor([0.1, 0.2, 0.3]))
    step(commands, waypoints, pose(0.0, 0.0, 0.0, 8))
    torch.testing.assert_close(commands.commands[:, :3], torch.tensor([0.1, 0.2, 0.3]).expand(8, 3))
    commands, waypoints = walkers(2, standing=1.0)
    assert step(commands, waypoints, pose(0.0, 0.0, 0.0, 2), reset=True) == [0.0] * 3


def test_the_first_command_of_an_episode_is_new_however_long_it_lasts():
    """After 1e9 s, float32 cannot tell the first control step from the second."""
    commands = Commands(CommandsConfig(resampling_time_s=1e9), 2, 0.02, torch.device("cpu"))
    level = pose(0.0, 0.0, 0.0, 2)[1]
    commands.update(torch.tensor([True, True]), level)
    for reset in ([True, False], [False, False]):
        commands.update(torch.tensor(reset), level)
        assert commands.renewed.tolist() == reset


HEIGHTS = ("commands.ranges.base_height", [0.4, 0.6])
PITCHES = ("commands.ranges.base_pitch", [-0.2, 0.3])
TERMS = ("observations.groups.critic.terms", ["commands", "base_commands"])


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
def test_height_and_pitch_are_sampled_with_the_velocity(engine):
    rewards = [("rewards.scales.height_error", -1.0), ("rewards.scales.tilt_error", -1.0)]
    often = [("commands.resampling_time_s", 0.1), ("sim.physics", engine)]
    task = small_task(HEIGHTS, PITCHES, TERMS, ("commands.waypoints.share", 0.5), *rewards, *often, num_envs=16)
    found = [task.base_commands.clone()]
    for _ in range(20):
        velocity = task.commands[::2, :2].clone()
        task.step(torch.zeros(16, 12))
        changed = (task.base_commands != found[-1]).any(dim=1)
        assert torch.equal(changed, task.command_sampler.renewed)
        assert not ((task.commands[::2, :2] != velocity).any(dim=1) & ~changed[::2]).any()
        found.append(task.base_commands.clone())
    low, high = torch.cat(found).amin(dim=0), torch.cat(found).amax(dim=0)
    assert (low > torch.tensor([0.4, -0.2])).all()
    assert (high < torch.tensor([0.6, 0.3])).all()
    assert (high - low > torch.tensor([0.15, 0.4])).all()
    torch.testing.assert_close(task.observation_groups["critic"].buffer[:, 3:], task.base_commands)
    saved = task.state_dict()
    task.hold_commands(torch.zeros(3))
    assert task.base_commands[0].tolist() == pytest.approx([task.cfg.rewards.base_height_target, 0.0])
    task.load_state_dict(saved)
    torch.testing.assert_close(task.base_commands, found[-1])


def test_gravity_in_a_base_that_leans_forward_points_forward():
    """A pitch of 0.1 rad is a turn about y by 0.1 rad, so the sign of `tilt_error` is that of the engine."""
    task = small_task(num_envs=1)
    qpos = task.physics.qpos.clone()
    qpos[:, 3:7] = torch.tensor([math.cos(0.05), 0.0, math.sin(0.05), 0.0])
    task.physics.write(torch.ones(1, dtype=torch.bool), qpos, torch.zeros_like(task.physics.qvel))
    task.sense()
    assert task.projected_gravity[0].tolist() == pytest.approx([math.sin(0.1), 0.0, -math.cos(0.1)], abs=1e-6)


@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
def test_the_pitch_of_a_torso_is_that_of_the_base_and_of_the_waist(engine):
    """The base leans forward by 0.1 rad and the joint of the waist by 0.3 rad, so the torso leans by 0.4 rad."""
    task = make_task(
        task_config("g1_posture", [("sim.physics", engine), ("env.num_envs", 1), ("rewards.scales.tilt_error", -1.0)])
    )
    qpos = task.physics.qpos.clone()
    qpos[:, 3:] = 0.0
    qpos[:, 3:7] = torch.tensor([math.cos(0.05), 0.0, math.sin(0.05), 0.0])
    qpos[:, 7 + task.robot.joint_names.index("waist_pitch_joint")] = 0.3
    task.physics.write(torch.ones(1, dtype=torch.bool), qpos, torch.zeros_like(task.physics.qvel))
    task.sense()
    assert task.pitch_gravity[0].tolist() == pytest.approx([math.sin(0.4), 0.0, -math.cos(0.4)], abs=1e-5)
    assert task.projected_gravity[0, 0] == pytest.approx(math.sin(0.1), abs=1e-6)
    task.base_commands[:] = torch.tensor([0.7, 0.25])
    assert float(task._reward_tilt_error()) == pytest.approx((math.sin(0.4) - math.sin(0.25)) ** 2, abs=1e-5)


def test_a_body_that_the_robot_lacks_is_refused():
    with pytest.raises(ConfigError, match=r"commands\.pitch_body: there is no body 'bass'; did you mean 'base'\? \(bodies: "):
        small_task(("commands.pitch_body", "bass"))


def test_without_ranges_the_usual_height_is_commanded_and_no_numbers_are_drawn():
    plain, other = small_task(), small_task(("commands.ranges.base_pitch", [0.0, 0.2]))
    assert plain.base_commands[:, 0].tolist() == pytest.approx([plain.cfg.rewards.base_height_target] * 4)
    assert not plain.base_commands[:, 1].any()
    assert plain.waypoints is None
    assert other.numbers._values.shape[1] == plain.numbers._values.shape[1] + 2


def test_a_height_of_0_is_refused():
    with pytest.raises(
        ConfigError, match=r"commands\.ranges\.base_height: must be above 0 \[m\], or \[0, 0\], got \[0, 0\.5\]"
    ):
        small_task(("commands.ranges.base_height", [0.0, 0.5]))
