"""Episodes are recorded whole, as many of each robot as was decided before, with what each step was like at its end."""

import copy

import numpy as np
import pytest
import torch
from helpers import CALM, ENGINE, JOINTS, POLICY, small_task, stand

from legged.envs import LeggedRobot
from legged.envs.final_observation import keep_final_step
from legged.episodes import recorder
from legged.episodes.recorder import Wish, joints_of, quantities_of, record_episodes, roll_out, shares_of, spread
from legged.episodes.stored import TIME_UP
from legged.policies.restore import policy_of
from legged.registry import make_task, register, task_config
from legged.terrain import TERRAIN_TYPES

pytestmark = pytest.mark.slow

LENGTHS = (3, 7, 11, 40)


class EndsAtItsTime(LeggedRobot):
    """Robot i fails after LENGTHS[i] steps; the last one's time is up before."""

    def _terminate_own_time(self) -> torch.Tensor:
        return self.episode_length_buf >= torch.tensor(LENGTHS, device=self.device)


def task_of_known_lengths() -> EndsAtItsTime:
    register("ends_at_its_time", {"extends": "anymal_c_flat"}, EndsAtItsTime)
    changes = [("env.num_envs", 4), ("env.episode_length_s", 0.4), ("terminations.failures", ["own_time"])]
    torch.set_num_threads(1)
    return make_task(task_config("ends_at_its_time", [*ENGINE, *CALM, *changes], on_cpu=True))


def test_every_robot_contributes_a_number_that_was_decided_before():
    assert shares_of(7, 3).tolist() == [3, 2, 2]
    assert shares_of(4, 4).tolist() == [1, 1, 1, 1]
    episodes, _ = record_episodes(task_of_known_lengths(), stand, 6)
    # The first four that end would all be of the first robot: 3, 6, 9, 12 steps.
    assert episodes.lengths.tolist() == [3, 7, 11, 20, 3, 7]
    assert episodes["robot"].tolist() == [0, 1, 2, 3, 0, 1]
    assert episodes["failed"].tolist() == [True, True, True, False, True, True]
    assert episodes["timed_out"].tolist() == [False, False, False, True, False, False]
    assert episodes["ended_by"][:, 0].tolist() == episodes["failed"].tolist()


@pytest.mark.parametrize("longest", [1, 2, 100])
def test_chunks_do_not_matter(longest, monkeypatch):
    monkeypatch.setattr(recorder, "LONGEST_CHUNK", longest)
    got, _ = record_episodes(task_of_known_lengths(), stand, 6)
    monkeypatch.setattr(recorder, "LONGEST_CHUNK", 5)
    want, _ = record_episodes(task_of_known_lengths(), stand, 6)
    for name, array in want.arrays.items():
        np.testing.assert_array_equal(got[name], array)


def test_a_row_is_the_step_before_the_next_episode_begins():
    """Beside the same steps made by hand, on a task that keeps its final step."""
    episodes, _ = record_episodes(task_of_known_lengths(), stand, 4)
    task = task_of_known_lengths()
    final = keep_final_step(task)
    observations = task.reset()
    first = task.physics.qpos.clone()
    np.testing.assert_array_equal(episodes["first_qpos"], first.numpy())
    open_rows = {robot: episodes.of(robot) for robot in range(4)}
    for step in range(20):
        command = task.commands.clone()
        observations, rewards, dones, _ = task.step(stand(observations))
        for robot, length in enumerate((3, 7, 11, 20)):
            if step >= length:
                continue
            one = {name: array[step] for name, array in open_rows[robot].items()}
            np.testing.assert_array_equal(one["qpos"], final.qpos[robot].numpy())
            np.testing.assert_array_equal(one["qvel"], final.qvel[robot].numpy())
            np.testing.assert_array_equal(one["command"], command[robot, :3].numpy())
            assert one["reward"] == float(rewards[robot])
            np.testing.assert_array_equal(one["joint_pos"], one["qpos"][7:])
            if not dones[robot]:  # a reset has cleared them
                np.testing.assert_array_equal(one["torque"], task.torques[robot].numpy())
            assert bool(dones[robot]) == (step == length - 1)
    last = episodes.of(0)
    assert not np.array_equal(last["qpos"][-1], task.reset_qpos[0].numpy())  # of the fall, not of the next start


def test_parts_add_up_to_the_reward():
    task = small_task(("rewards.only_positive_rewards", False), ("env.episode_length_s", 0.2))
    episodes, _ = record_episodes(task, stand, 4)
    np.testing.assert_allclose(episodes["reward_parts"].sum(axis=1), episodes["reward"], atol=1e-6)
    assert np.abs(episodes["reward"]).max() > 0.0


def test_feet_forces_carry_a_robot_that_stands():
    task = small_task(("env.episode_length_s", 2.0), num_envs=2)
    episodes, _ = record_episodes(task, stand, 2, command=(0.0, 0.0, 0.0))
    up = episodes.of(0)["feet_force"][-20:, :, 2].sum(axis=1)
    assert up.mean() == pytest.approx(9.81 * task.robot.mass, rel=0.05)
    assert episodes.of(0)["feet_contact"][-1].tolist() == [1.0] * 4
    assert (episodes["command"] == 0.0).all()


def test_curricula_and_places_are_those_of_the_policy():
    task = small_task(("commands.curriculum.enabled", True), ("env.episode_length_s", 0.2))
    task.load_progress({"command_curriculum": {"share": torch.full_like(task.command_curriculum.share, 0.75)}})
    before, seen = copy.deepcopy(task.progress()), []
    record_episodes(task, stand, 4, place=lambda: seen.append(copy.deepcopy(task.progress())))
    (found,) = seen
    torch.testing.assert_close(found, before)


def test_robots_are_spread_over_all_levels_and_stay_there():
    torch.set_num_threads(1)
    stairs = {**dict.fromkeys(TERRAIN_TYPES, 0.0), "stairs_up": 1.0}
    small = [("terrain.num_rows", 4), ("terrain.num_cols", 2), ("terrain.border_size", 2.0), ("terrain.proportions", stairs)]
    changes = [("env.num_envs", 8), ("env.episode_length_s", 0.1), *small, *ENGINE]
    task = make_task(task_config("anymal_c", changes, on_cpu=True))
    record_episodes(task, stand, 16, place=lambda: spread(task))
    # Fractions of i times 0.618...: 0, .618, .236, .854, .472, .090, .708, .326; times four rows.
    assert task.terrain_curriculum.levels.tolist() == [0, 2, 0, 3, 1, 0, 2, 1]
    assert task.terrain_curriculum.columns.tolist() == [0] * 4 + [1] * 4
    tiles = task.terrain.origins[task.terrain_curriculum.levels, task.terrain_curriculum.columns]
    np.testing.assert_allclose(task.env_origins, tiles, atol=1e-6)


def test_joints_of_every_kind_of_robot_are_found():
    cassie = make_task(task_config("cassie_flat", [("env.num_envs", 1), *ENGINE], on_cpu=True))
    names = cassie.robot.joint_names
    assert [joint["name"] for joint in joints_of(cassie)] == list(names)
    qpos = next(quantity for quantity in quantities_of(cassie) if quantity.name == "qpos")
    assert len(qpos.columns) == cassie.physics.model.nq > 7 + len(names)  # passive joints lie between
    for joint in joints_of(cassie):
        assert qpos.columns[joint["qpos"]].endswith(joint["name"])
    cheetah = make_task(task_config("half_cheetah", [("env.num_envs", 1), *ENGINE], on_cpu=True))
    found = {joint["name"]: joint["max_torque"] for joint in joints_of(cheetah)}
    # Gears of Gymnasium's half_cheetah.xml, at controls up to 1.
    assert found == {"bthigh": 120.0, "bshin": 90.0, "bfoot": 60.0, "fthigh": 120.0, "fshin": 60.0, "ffoot": 30.0}


def test_limits_are_the_robots_own_where_gains_and_limits_are_drawn():
    drawn = {"p_gain": [0.9, 1.1], "torque_limit": [0.8, 1.1], "joint_offset": [-0.02, 0.02]}
    joints = joints_of(small_task(("domain_rand.ranges", drawn)))
    assert [joint["max_torque"] for joint in joints] == [80.0] * JOINTS


def test_torques_of_motors_are_their_controls_times_the_gear():
    task = make_task(task_config("half_cheetah", [("env.num_envs", 1), ("env.episode_length_s", 0.3), *ENGINE], on_cpu=True))
    actions = torch.tensor([[0.5, -0.25, 1.0, -1.0, 0.0, 0.1]])
    episodes, _ = record_episodes(task, lambda _: actions, 1)
    np.testing.assert_allclose(episodes["torque"][0], [60.0, -22.5, 60.0, -120.0, 0.0, 3.0], rtol=1e-6)
    model = task.physics.model
    work = model.actuator_gear[:, 0] * actions[0].numpy()
    np.testing.assert_allclose(episodes["torque"][-1], work, rtol=1e-6)


def test_a_shipped_policy_walks_its_episodes():
    torch.set_num_threads(1)
    wish = Wish(3, 2, changes=(("env.episode_length_s", 1.0), ("sim.threads", 1)), command=(0.5, 0.0, 0.0))
    episodes, cfg = roll_out(policy_of(str(POLICY)), wish, torch.device("cpu"), where="sim.physics")
    assert (len(episodes), cfg.env.num_envs, cfg.observations.add_noise) == (3, 2, False)
    assert [episodes.ended(i) for i in range(3)] == [[TIME_UP]] * 3
    assert episodes.lengths.tolist() == [50] * 3
    assert episodes.of(0)["base_lin_vel"][-10:, 0].mean() == pytest.approx(0.5, abs=0.15)
    assert len(episodes.about["joints"]) == JOINTS
    assert episodes.columns("torque") == [joint["name"] for joint in episodes.about["joints"]]


def test_as_trained_keeps_what_the_training_had():
    policy = policy_of(str(POLICY))
    wish = Wish(1, 1, as_trained=True, changes=(("env.episode_length_s", 0.1), ("sim.threads", 1)))
    _, cfg = roll_out(policy, wish, torch.device("cpu"))
    assert cfg.observations.add_noise
    assert cfg.domain_rand.push_robots == policy.cfg.domain_rand.push_robots
    assert cfg.domain_rand.randomize_friction
    assert cfg.domain_rand.ranges == policy.cfg.domain_rand.ranges
