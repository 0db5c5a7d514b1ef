"""The task on the C engine: observations, resets, terminations, and what rsl-rl relies on."""

from typing import ClassVar

import pytest
import torch
from helpers import small_config, small_task, zero_actions

from legged import make_task, registry
from legged.envs import LeggedRobot
from legged.errors import ConfigError, TermError
from legged.math import quat_rotate_inverse

BLOCKS = {  # name -> first column and scale, legged_gym's order
    "base_lin_vel": (0, 2.0),
    "base_ang_vel": (3, 0.25),
    "projected_gravity": (6, 1.0),
    "commands": (9, torch.tensor([2.0, 2.0, 0.25])),
    "dof_pos": (12, 1.0),
    "dof_vel": (24, 0.05),
    "actions": (36, 1.0),
}


def wave(task: LeggedRobot, step: int) -> torch.Tensor:
    """Actions that differ between joints, robots and steps, too small to fall over soon."""
    phase = torch.arange(task.num_envs * 12, dtype=torch.float32).view(task.num_envs, 12)
    return 0.2 * torch.sin(phase + 0.3 * step)


def fresh_observation(task: LeggedRobot) -> torch.Tensor:
    """(N, 48) from the engine's own numbers, by the definitions, without the task's terms."""
    qpos, qvel = task.physics._qpos.float(), task.physics._qvel.float()
    quat = qpos[:, 3:7]
    down = torch.tensor([0.0, 0.0, -1.0]).expand(task.num_envs, 3)
    default = torch.tensor([0.0, 0.4, -0.8, 0.0, 0.4, -0.8, 0.0, -0.4, 0.8, 0.0, -0.4, 0.8])
    blocks = {
        "base_lin_vel": quat_rotate_inverse(quat, qvel[:, :3]),
        "base_ang_vel": qvel[:, 3:6],
        "projected_gravity": quat_rotate_inverse(quat, down),
        "commands": task.commands[:, :3],
        "dof_pos": qpos[:, 7:] - default,
        "dof_vel": qvel[:, 6:],
        "actions": task.actions,
    }
    return torch.cat([blocks[name] * scale for name, (_, scale) in BLOCKS.items()], dim=1)


# ---- observations ----------------------------------------------------------------------------------------------------


def test_the_observation_is_legged_gym_s_48_numbers_in_its_order():
    task = small_task()
    for step in range(30):
        actions = wave(task, step)
        observations, *_ = task.step(actions)
        assert observations["actor"].shape == observations["critic"].shape == (4, 48)
        assert torch.allclose(observations["actor"], fresh_observation(task), atol=1e-5)
        assert torch.equal(observations["actor"], observations["critic"])
        assert torch.equal(observations["actor"][:, 36:], torch.where(task.reset_buf[:, None], 0.0, actions))
    columns = {term.name: term.columns.start for term in task.observation_groups["actor"].terms}
    assert columns == {name: first for name, (first, _) in BLOCKS.items()}
    assert observations["actor"][:, 9:12].abs().sum() > 0  # somebody is asked to move


@pytest.mark.slow
def test_only_the_actor_sees_noise():
    task = small_task(("observations.add_noise", True), num_envs=64)
    observations, *_ = task.step(zero_actions(task))
    exact = fresh_observation(task)
    assert torch.allclose(observations["critic"], exact, atol=1e-5)
    difference = (observations["actor"] - exact).abs().amax(dim=0)
    half = [0.2] * 3 + [0.05] * 3 + [0.05] * 3 + [0.0] * 3 + [0.01] * 12 + [0.075] * 12 + [0.0] * 12
    assert (difference <= torch.tensor(half) + 1e-5).all()
    assert (difference >= 0.8 * torch.tensor(half)).all()


def test_actions_are_clipped_before_they_are_used_or_seen():
    task = small_task(("control.clip_actions", 1.5))
    observations, *_ = task.step(torch.full((4, 12), -7.0))
    assert (observations["actor"][:, 36:] == -1.5).all()


@pytest.mark.slow
def test_the_first_observation_of_an_episode_shows_the_new_base_and_the_new_joints():
    task = small_task(("env.episode_length_s", 0.2))
    task.reset()
    assert torch.allclose(task.get_observations()["actor"], fresh_observation(task), atol=1e-5)
    for step in range(10):
        observations, _, dones, _ = task.step(wave(task, step))
    assert dones.all()
    seen = observations["actor"]
    assert torch.allclose(seen, fresh_observation(task), atol=1e-5)
    # What only a fresh state can show: level, at rest in the joints, at the spawn height, no last action.
    assert torch.allclose(seen[:, 6:9], torch.tensor([0.0, 0.0, -1.0]).expand(4, 3), atol=1e-6)
    assert (seen[:, 24:] == 0.0).all()
    assert torch.allclose(task.base_pos[:, 2], torch.tensor(0.6))
    assert (task.last_dof_vel == 0.0).all()
    assert (task.episode_length_buf == 0).all()


# ---- rewards ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_rewards_are_judged_on_the_command_that_the_policy_saw():
    scales = {name: 0.0 for name in small_config().rewards.scales} | {"tracking_lin_vel": 1.0}
    settings = [(f"rewards.scales.{name}", scale) for name, scale in scales.items()]
    task = small_task(*settings, ("commands.resampling_time_s", 0.1), ("commands.standing_share", 0.0))
    changes = 0
    for step in range(40):
        shown = task.get_observations()["actor"][:, 9:11] / 2.0
        _, reward, dones, _ = task.step(wave(task, step))
        assert not dones.any()
        velocity = task.base_lin_vel[:, :2]
        by_shown = 0.02 * torch.exp(-(shown - velocity).square().sum(dim=1) / 0.25)
        by_next = 0.02 * torch.exp(-(task.commands[:, :2] - velocity).square().sum(dim=1) / 0.25)
        assert torch.allclose(reward, by_shown, atol=1e-6)
        changes += int((~torch.isclose(by_shown, by_next, atol=1e-5)).any())
    assert changes >= 5  # every fifth step brings a new command; else this test shows nothing


# ---- what rsl-rl is given --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_what_a_step_returns_is_not_changed_by_the_next():
    task = small_task(("env.episode_length_s", 0.1))
    static = {buffer.data_ptr() for buffer in (task.rew_buf, task.reset_buf, task.time_out_buf)}
    static |= {group.buffer.data_ptr() for group in task.observation_groups.values()}
    observations, reward, dones, extras = task.step(wave(task, 0))
    given = [*observations.values(), reward, dones, extras["time_outs"]]
    assert not static & {tensor.data_ptr() for tensor in given}
    before = [tensor.clone() for tensor in given]
    for step in range(1, 6):  # the fifth step ends all episodes: every one of these changes
        task.step(wave(task, step))
    assert all(torch.equal(a, b) for a, b in zip(given, before, strict=True))
    assert not torch.equal(task.get_observations()["actor"], before[0])


def addresses(task: LeggedRobot) -> dict[str, int]:
    """Of every tensor of the task and its parts."""
    owners = {
        "task": vars(task),
        "state": vars(task.physics.robot_state),
        "physics": vars(task.physics),
        "rewards": vars(task.rewards),
        "contacts": vars(task.contacts),
        "control": vars(task.control),
        "commands": vars(task.command_sampler),
        "curriculum": vars(task.command_curriculum),
        "randomization": vars(task.randomization),
        "metrics": vars(task.metrics),
        **{name: vars(group) for name, group in task.observation_groups.items()},
    }
    return {
        f"{owner}.{name}": value.data_ptr()
        for owner, values in owners.items()
        for name, value in values.items()
        if isinstance(value, torch.Tensor)
    }


def test_no_tensor_ever_moves_since_a_graph_knows_their_addresses():
    settings = [("env.episode_length_s", 0.1), ("domain_rand.push_robots", True), ("domain_rand.push_interval_s", 0.1)]
    task = small_task(*settings, ("observations.add_noise", True), ("commands.heading_command", True))
    before = addresses(task)
    assert len(before) > 60
    for step in range(12):
        task.step(wave(task, step))
    task.reset()
    task.episode_length_buf = torch.ones(4, dtype=torch.long)
    assert addresses(task) == before


def test_assigning_episode_lengths_copies_them():
    task = small_task()
    mine = torch.tensor([3, 1, 4, 1])
    address = task.episode_length_buf.data_ptr()
    task.episode_length_buf = mine
    mine.zero_()
    assert task.episode_length_buf.tolist() == [3, 1, 4, 1]
    assert task.episode_length_buf.data_ptr() == address


def test_observing_neither_steps_nor_resets():
    task = small_task()
    task.step(wave(task, 0))
    first, lengths, qpos = task.get_observations(), task.episode_length_buf.clone(), task.physics._qpos.clone()
    for _ in range(5):
        again = task.get_observations()
    assert torch.equal(first["actor"], again["actor"])
    assert torch.equal(lengths, task.episode_length_buf)
    assert torch.equal(qpos, task.physics._qpos)
    assert first["actor"].data_ptr() != again["actor"].data_ptr()


@pytest.mark.slow
def test_the_log_comes_once_a_rollout_with_tensors_of_its_own():
    task = small_task(("train.runner.num_steps_per_env", 6), ("env.episode_length_s", 0.1))
    logs = {}
    for step in range(1, 25):
        _, _, _, extras = task.step(wave(task, step))
        if "log" in extras:
            logs[step] = extras["log"]
    assert list(logs) == [6, 12, 18, 24]
    storages = [value.untyped_storage().data_ptr() for log in logs.values() for value in log.values()]
    static = {value.data_ptr() for value in vars(task.metrics).values() if isinstance(value, torch.Tensor)}
    assert not static & set(storages)
    assert all(value.shape == () for log in logs.values() for value in log.values())
    # One of five steps ends all episodes; the fourth rollout, steps 19 to 24, has one such step, after 5 steps of life.
    assert float(logs[24]["Metrics/episode_length"]) == 5.0
    assert float(logs[6]["Metrics/falls"]) == 0.0
    assert {f"rew_{name}" for name in task.rewards.names} <= set(logs[6])


def test_the_logged_reward_is_the_mean_sum_of_ended_episodes_per_second_of_a_full_one():
    task = small_task(("train.runner.num_steps_per_env", 5), ("env.episode_length_s", 0.1))
    sums = torch.zeros(4)
    for step in range(5):
        _, reward, _, extras = task.step(wave(task, step))
        sums += reward
    total = sum(float(value) for name, value in extras["log"].items() if name.startswith("rew_"))
    assert total == pytest.approx(float(sums.mean()) / 0.1, rel=1e-4)


# ---- seeds -----------------------------------------------------------------------------------------------------------

RANDOM = [
    ("observations.add_noise", True),
    ("domain_rand.randomize_friction", True),
    ("domain_rand.randomize_base_mass", True),
    ("domain_rand.push_robots", True),
    ("domain_rand.push_interval_s", 0.2),
    ("commands.resampling_time_s", 0.2),
    ("env.episode_length_s", 0.5),
]


def trajectory(seed: int, **settings) -> list[torch.Tensor]:
    task = small_task(("env.seed", seed), *RANDOM, *settings.items())
    found = []
    for step in range(40):
        observations, reward, dones, _ = task.step(wave(task, step))
        found += [observations["actor"], reward, dones]
    return found


@pytest.mark.slow
def test_a_seed_fixes_the_whole_trajectory_whatever_the_number_of_threads():
    first, other = trajectory(3), trajectory(4)
    for again in (trajectory(3), trajectory(3, **{"sim.threads": 2})):
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.allclose(first[0], other[0], atol=1e-3)


# ---- tasks from outside ----------------------------------------------------------------------------------------------


class Hopper(LeggedRobot):
    """A task with a reward and an observation of its own."""

    MIRRORED: ClassVar = {**LeggedRobot.MIRRORED, "feet_height": "feet"}

    def _reward_height(self):
        return self.base_pos[:, 2] * self.cfg.custom["weight"]

    def _obs_feet_height(self):
        return self.feet_pos[:, :, 2]


class Reads(LeggedRobot):
    def _reward_reads(self):
        return self.base_pos[:, 2] * self.base_pos[0, 2].item()


class Masks(LeggedRobot):
    MIRRORED: ClassVar = {**LeggedRobot.MIRRORED, "masks": "joints"}

    def _obs_masks(self):
        return self.dof_pos[self.dof_pos > -100.0].view(self.num_envs, -1)


@pytest.fixture
def register(monkeypatch):
    monkeypatch.setattr(registry, "_REGISTERED", {})
    return registry.register


BASE = {"extends": "anymal_c_flat", "env": {"num_envs": 2}, "sim": {"physics": "mujoco", "threads": 1}}


@pytest.mark.slow
def test_a_subclass_with_terms_of_its_own_is_registered_from_outside(register):
    config = {
        **BASE,
        "rewards": {"scales": {"height": 2.0}},
        "observations": {
            "groups": {"actor": {"terms": ["feet_height", "commands"]}},
            "scales": {"feet_height": 10.0},
            "add_noise": False,
        },
        "custom": {"weight": 3.0},
    }
    register("hop", config, Hopper)
    task = make_task(registry.task_config("hop"))
    assert isinstance(task, Hopper)
    observations, *_ = task.step(zero_actions(task))
    assert observations["actor"].shape == (2, 7)
    assert torch.allclose(observations["actor"][:, :4], 10.0 * task.feet_pos[:, :, 2], atol=1e-5)
    assert torch.allclose(task.episode_sums["height"], 0.02 * 2.0 * 3.0 * task.base_pos[:, 2], atol=1e-6)


def test_a_term_that_only_the_subclass_has_is_unknown_to_the_base_class(register):
    register("hop", {**BASE, "rewards": {"scales": {"height": 2.0}}})
    with pytest.raises(ConfigError, match=r"rewards\.scales\.height: LeggedRobot has no reward 'height'"):
        registry.task_config("hop")


def test_a_reward_that_waits_for_the_gpu_is_refused_by_name_on_a_machine_without_one(register):
    register("reads", {**BASE, "rewards": {"scales": {"reads": 1.0}}}, Reads)
    cfg = registry.task_config("reads")
    with pytest.raises(TermError, match=r"_reward_reads: reads a value on the host \(\.item\(\)"):
        make_task(cfg)
    make_task(cfg, graph=False).step(torch.zeros(2, 12))  # --no-graph lets it run


def test_an_observation_that_indexes_by_a_mask_is_refused_by_name(register):
    register("masks", {**BASE, "observations": {"groups": {"actor": {"terms": ["masks"]}}}}, Masks)
    with pytest.raises(TermError, match="_obs_masks: indexes by a mask"):
        make_task(registry.task_config("masks"))


def test_a_control_step_is_decimation_physics_steps():
    task = small_task(("sim.dt", 0.004), ("control.decimation", 5))
    assert task.dt == pytest.approx(0.02)
    assert task.max_episode_length == 1000
    velocity = task.base_lin_vel[:, 2].clone()
    task.step(zero_actions(task))
    # In free fall from the spawn height the feet hang above the ground: 20 ms of gravity, moved a little by the legs.
    assert torch.allclose(task.physics._qvel[:, 2].float() - velocity, torch.tensor(-9.81 * 0.02), atol=0.15)
