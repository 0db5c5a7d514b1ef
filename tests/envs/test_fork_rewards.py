"""Rewards of legged_gym's forks, run as they stand, and what the guard says of those that no graph could hold."""

import copy
import pickle
from dataclasses import replace

import pytest
import torch
from helpers import JOINTS, small_config
from torch import Tensor

from legged.envs import LeggedRobot
from legged.errors import ConfigError, TermError
from legged.math import get_euler_xyz, quat_rotate, quat_rotate_inverse, wrap_to_pi

ROBOTS = 4


class Fork(LeggedRobot):
    """Rewards in the style of legged_gym, unitree_rl_gym, HIMLoco and their like, in the names that these use."""

    def _init_buffers(self):
        super()._init_buffers()
        self.hip_ids = [i for i, name in enumerate(self.dof_names) if "HAA" in name]
        self.leg_phase = torch.zeros(self.num_envs, self.feet_num, device=self.device)
        self.desired_height = 0.52

    def advance(self):
        super().advance()
        phase = (self.episode_length_buf * self.dt) % 0.8 / 0.8
        self.leg_phase.copy_(torch.stack([phase, (phase + 0.5) % 1.0, (phase + 0.5) % 1.0, phase], dim=-1))

    def _reward_base_height_of_root(self):
        height = torch.mean(self.root_states[:, 2].unsqueeze(1) - self.measured_heights, dim=1)
        return torch.square(height - self.desired_height)

    def _reward_alive(self):
        return 1.0

    def _reward_hip_pos(self):
        return torch.sum(torch.square(self.dof_pos[:, [0, 3, 6, 9]]), dim=1)

    def _reward_hips_by_names(self):
        return torch.abs(self.dof_pos[:, self.hip_ids] - self.default_dof_pos[self.hip_ids]).sum(dim=1)

    def _reward_joint_power(self):
        return torch.sum(torch.abs(self.dof_vel) * torch.abs(self.torques), dim=1)

    def _reward_power_of_substeps(self):
        return torch.mean(torch.sum(torch.square(self.substep_torques * self.substep_dof_vel), dim=-1), dim=-1)

    def _reward_exceeded_substeps(self):
        return self.substep_exceed_dof_pos_limits.to(torch.float32).sum(dim=-1).mean(dim=-1)

    def _reward_smoothness_by_axis(self):
        change = self.actions - 2 * self.last_actions[:, :, 0] + self.last_actions[:, :, 1]
        return torch.sum(torch.square(change), dim=1)

    def _reward_hips_by_axis(self):
        return torch.sum(torch.square(self.dof_pos[:, self.hip_ids] - self.default_dof_pos[:, self.hip_ids]), dim=1)

    def _reward_better_tracking(self):
        return ~self.reset_buf * (self._reward_tracking_lin_vel() - self.rwd_linVelTrackPrev) / self.dt

    def _reward_power_distribution(self):
        return torch.var(torch.abs(self.torques * self.dof_vel), dim=1)

    def _reward_smoothness(self):
        return torch.sum(torch.square(self.actions - self.last_actions - self.last_actions + self.last_last_actions), dim=1)

    def _reward_foot_clearance(self):
        local = self.feet_pos - self.root_states[:, 0:3].unsqueeze(1)
        relative = self.feet_vel - self.root_states[:, 7:10].unsqueeze(1)
        heights = torch.zeros(self.num_envs, self.feet_num, device=self.device)
        speeds = torch.zeros_like(heights)
        for i in range(len(self.feet_indices)):
            heights[:, i] = quat_rotate_inverse(self.base_quat, local[:, i, :])[:, 2]
            speeds[:, i] = torch.norm(quat_rotate_inverse(self.base_quat, relative[:, i, :])[:, :2], dim=1)
        return torch.sum(torch.square(heights + 0.35) * speeds, dim=1)

    def _reward_contact_phase(self):
        res = torch.zeros(self.num_envs, dtype=torch.float, device=self.device)
        for i in range(self.feet_num):
            is_stance = self.leg_phase[:, i] < 0.55
            touching = self.contact_forces[:, self.feet_indices[i], 2] > 1
            res += ~(touching ^ is_stance)
        return res

    def _reward_swing_height(self):
        touching = torch.norm(self.contact_forces[:, self.feet_indices, :3], dim=2) > 1.0
        return torch.sum(torch.square(self.feet_pos[:, :, 2] - 0.08) * ~touching, dim=(1))

    def _reward_contact_no_vel(self):
        touching = torch.norm(self.contact_forces[:, self.feet_indices, :3], dim=2) > 1.0
        return torch.sum(torch.square((self.feet_vel * touching.unsqueeze(-1))[:, :, :3]), dim=(1, 2))

    def _reward_collisions(self):
        forces = torch.norm(self.contact_forces[:, self.penalised_contact_indices, :], dim=-1)
        return torch.sum(1.0 * (forces > 0.1), dim=1)

    def _reward_over_limits(self):
        return torch.sum((torch.abs(self.torques) - self.torque_limits * 0.9).clip(min=0.0), dim=1)

    def _reward_relative_torques(self):
        return torch.sum(torch.square(self.torques / self.torque_limits.unsqueeze(0)), dim=1)

    def _reward_torques_by_gains(self):
        return torch.sum(torch.square(self.torques / self.p_gains), dim=1)

    def _reward_torque_change(self):
        return torch.sum(torch.square(self.torques - self.last_torques), dim=1)

    def _reward_sliding_of_env(self):
        sliding = self.env.last_contacts * self.env.cfg.rewards.tracking_sigma
        return torch.sum(sliding * self.env.foot_velocities.norm(dim=2), dim=1)

    def _reward_fell(self):
        return self.reset_buf * ~self.time_out_buf

    def _reward_joint_limits(self):
        out = -(self.dof_pos - self.dof_pos_limits[:, 0]).clip(max=0.0)
        out += (self.dof_pos - self.dof_pos_limits[:, 1]).clip(min=0.0)
        return torch.sum(out, dim=1)

    def _reward_base_acceleration(self):
        change = (self.last_root_vel - self.root_states[:, 7:13]) / self.dt
        return torch.sum(torch.square(change), dim=1)

    def _reward_touch_down(self):
        touching = self.contact_forces[:, self.feet_indices, 2] > 1.0
        filtered = torch.logical_or(touching, self.last_contacts)
        self.last_contacts = touching
        landed = (self.feet_air_time > 0.0) * filtered
        self.feet_air_time += self.dt
        swing = torch.sum((self.feet_air_time - 0.5) * landed, dim=1)
        self.feet_air_time *= ~filtered
        return swing * (torch.norm(self.commands[:, :2], dim=1) > 0.1)

    def _reward_roll_and_pitch(self):
        roll, pitch, _ = get_euler_xyz(self.base_quat)
        return torch.square(wrap_to_pi(roll)) + torch.square(wrap_to_pi(pitch))

    def _reward_leaning(self):
        return torch.sum(torch.abs(self.rpy[:, :2]), dim=1)

    def _reward_heading(self):
        forward = quat_rotate(self.base_quat, self.forward_vec)
        return torch.abs(wrap_to_pi(self.commands[:, 3] - torch.atan2(forward[:, 1], forward[:, 0])))

    def _reward_upright(self):
        return torch.square(1.0 + torch.sum(self.projected_gravity * self.gravity_vec, dim=1) * -1.0)

    def _reward_near_target(self):
        return torch.sum(torch.square(self.joint_pos_target - self.dof_pos), dim=1)

    def _reward_joint_mirror(self):
        left, right = self.dof_pos[:, [1, 2, 7, 8]], self.dof_pos[:, [4, 5, 10, 11]]
        return torch.sum(torch.square(left - right), dim=-1)

    def _reward_stumbles(self):
        feet = self.contact_forces[:, self.feet_indices, :]
        return torch.any(torch.norm(feet[:, :, :2], dim=2) > 5 * torch.abs(feet[:, :, 2]), dim=1)

    def _reward_standing(self):
        still = torch.norm(self.commands[:, :2], dim=1) < 0.1
        return torch.sum(torch.abs(self.dof_pos - self.default_dof_pos), dim=1) * still

    def _reward_weighted_pose(self):
        weights = torch.tensor([1.0, 0.1, 0.1] * 4, device=self.device)
        return torch.exp(-torch.sum(torch.square(self.dof_pos - self.default_dof_pos) * weights, dim=1))

    def _reward_feet_distance(self):
        spread = self.foot_positions[:, [0, 1], 1] - self.foot_positions[:, [2, 3], 1]
        return torch.clip(0.05 - torch.abs(spread), 0.0, 1.0).sum(dim=1)

    def _reward_time_out_share(self):
        return (self.episode_length_buf > 0.5 * self.max_episode_length_s / self.dt).float()

    def _reward_scaled_commands(self):
        error = self.commands[:, :3] * self.commands_scale - torch.cat(
            (self.base_lin_vel[:, :2], self.base_ang_vel[:, 2:]), 1
        )
        return torch.exp(-error.square().sum(dim=1) / self.cfg.rewards.tracking_sigma)

    def _reward_root_velocity(self):
        value = torch.zeros(self.num_envs, device=self.device)
        value[:] = self.root_states[:, 9]
        return value.square() * self.obs_scales.lin_vel


REWARDS = sorted(Fork.terms("_reward_") - LeggedRobot.terms("_reward_"))


def with_all_rewards(device: str, *overrides) -> Fork:
    """All of these rewards, in a task that the guard has let pass, after ten steps."""
    cfg = small_config(("rewards.only_positive_rewards", False), *overrides)
    cfg.rewards.scales.update(dict.fromkeys(REWARDS, 1.0))
    task = Fork(cfg, device)
    torch.manual_seed(1)
    for _ in range(10):
        task.step(torch.randn(ROBOTS, JOINTS))
    return task


@pytest.fixture(scope="module")
def fork() -> Fork:
    return with_all_rewards("cpu")


@pytest.mark.gpu
def test_all_rewards_are_captured_on_a_gpu():
    task = with_all_rewards("cuda", ("sim.physics", "mujoco_warp"))
    assert task.captured
    assert task.rewards.last.isfinite().all()
    assert task.rewards.last.abs().sum(dim=1)[[task.rewards.names.index("alive"), task.rewards.names.index("hip_pos")]].all()
    with pytest.raises(AttributeError, match="only if a term reads it"):
        task.last_dof_pos  # noqa: B018


def test_a_reward_that_counts_air_times_itself_finds_those_of_the_contacts():
    task = with_all_rewards("cpu")
    paid = 0
    for _ in range(120):
        task.step(3.0 * torch.randn(ROBOTS, JOINTS))
        contacts = task.contacts
        swing = ((contacts.last_air_time - 0.5) * contacts.first_contact).sum(dim=1)
        wanted = swing * (task.commands[:, :2].norm(dim=1) > 0.1) * ~task.reset_buf
        found = task.rewards.last[task.rewards.names.index("touch_down")] / (task.reward_scales["touch_down"])
        compared = ~task.reset_buf  # commands and contacts of the others are those of new episodes
        torch.testing.assert_close(found[compared], wanted[compared], atol=1e-5, rtol=1e-5)
        paid += int((wanted != 0.0).sum())
    assert paid > 20


def test_there_are_many_rewards():
    assert len(REWARDS) >= 30


@pytest.mark.slow
@pytest.mark.parametrize("name", REWARDS)
def test_a_reward_of_a_fork_gives_numbers(fork, name):
    last = fork.rewards.last[fork.rewards.names.index(name)]
    assert last.isfinite().all()
    value = getattr(fork, f"_reward_{name}")()
    assert value == 1.0 if isinstance(value, float) else value.shape == (ROBOTS,)


SAME = {
    "collisions": "collision",
    "joint_limits": "dof_pos_limits",
    "stumbles": "stumble",
    "smoothness_by_axis": "smoothness",
}


@pytest.mark.parametrize("name", SAME)
def test_a_reward_of_theirs_is_as_large_as_ours(fork, name):
    found = getattr(fork, f"_reward_{name}")()
    torch.testing.assert_close(found.float(), getattr(fork, f"_reward_{SAME[name]}")())


def test_a_number_counts_for_every_robot(fork):
    assert fork.rewards.last[fork.rewards.names.index("alive")].tolist() == pytest.approx([fork.dt] * ROBOTS)


@pytest.mark.parametrize("value", [None, "1", [1.0]], ids=str)
def test_what_is_no_reward_is_named(value):
    task = type("Mine", (LeggedRobot,), {"_reward_lin_vel_z": lambda self: value})
    with pytest.raises(TermError, match=r"_reward_lin_vel_z: must return a tensor \(4,\), got "):
        task(small_config())


# ---- numbers under `rewards` of a fork -----------------------------------------------------------------------------------


def test_own_numbers_of_rewards_are_those_of_custom():
    class Mine(LeggedRobot):
        def _reward_lin_vel_z(self):
            assert self.cfg.rewards.tracking_sigma == 0.25  # a setting of the same name comes first
            return self.rew_buf * 0.0 + self.cfg.rewards.cycle_time

    cfg = small_config(("custom", {"cycle_time": 0.64, "tracking_sigma": 7.0}))
    task = Mine(cfg)
    task.step(torch.zeros(ROBOTS, JOINTS))
    row = task.rewards.last[task.rewards.names.index("lin_vel_z")]
    assert row.tolist() == pytest.approx([0.64 * cfg.rewards.scales["lin_vel_z"] * task.dt] * ROBOTS)


def test_own_numbers_of_other_sections_and_in_brackets_are_found_too():
    cfg = small_config(("custom", {"selected": "hurdle"}))
    assert cfg.terrain.selected == cfg.commands.selected == cfg["env"]["selected"] == "hurdle"
    assert cfg.asset.selected == cfg.normalization.selected == "hurdle"  # sections that have no settings here
    assert cfg["rewards"]["tracking_sigma"] == cfg.rewards.tracking_sigma
    with pytest.raises(AttributeError, match=r"custom has no 'selecte', and neither has terrain; did you mean 'selected'\?"):
        cfg.terrain.selecte  # noqa: B018


def test_a_number_is_written_where_a_mask_is_true():
    class Mine(LeggedRobot):
        def _reward_lin_vel_z(self):
            reward, each = torch.ones_like(self.base_pos[:, 0]), torch.ones_like(self.dof_pos)
            reward[self.episode_length_buf % 2 == 1] = 0.25
            each[self.dof_pos > 100.0] = 7.0
            each[self.episode_length_buf < 0] = reward.sum()
            return reward * each.mean(dim=1)

    cfg = small_config()
    task = Mine(cfg)
    task.step(torch.zeros(ROBOTS, JOINTS))
    row = task.rewards.last[task.rewards.names.index("lin_vel_z")]
    assert row.tolist() == pytest.approx([0.25 * cfg.rewards.scales["lin_vel_z"] * task.dt] * ROBOTS)


def test_own_numbers_are_those_of_their_own_configuration():
    one = small_config(("custom", {"cycle_time": 0.64}))
    for two in (replace(one, custom={"cycle_time": 0.8}), copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
        two.custom["cycle_time"] = 0.8
        assert (one.rewards.cycle_time, two.rewards.cycle_time) == (0.64, 0.8)
        assert two.rewards == one.rewards


def test_a_number_that_is_nowhere_is_named_with_its_nearest():
    rewards = small_config(("custom.cycle_time", 0.64)).rewards
    with pytest.raises(AttributeError, match=r"command line: custom has no 'cycle_tim', .*did you mean 'cycle_time'\?"):
        rewards.cycle_tim  # noqa: B018
    with pytest.raises(AttributeError, match=r"custom has no 'tracking_sigm', .*did you mean 'tracking_sigma'\?"):
        rewards.tracking_sigm  # noqa: B018
    assert not hasattr(rewards, "__nothing__")


def test_a_misspelled_setting_of_rewards_is_refused_whatever_custom_has():
    with pytest.raises(ConfigError, match=r"rewards\.cycle_time"):
        small_config(("custom", {"cycle_time": 0.64}), ("rewards.cycle_time", 0.8))


# ---- what a graph would refuse, in rewards -------------------------------------------------------------------------------


def count(task: LeggedRobot) -> Tensor:
    task.calls = getattr(task, "calls", 0) + 1
    return task.rew_buf * 0.0


def rebind(task: LeggedRobot) -> Tensor:
    change = task.contact_forces[:, 0, 2] - task.last_contact_force
    task.last_contact_force = task.contact_forces[:, 0, 2].clone()
    return change


def write_by_list(task: LeggedRobot) -> Tensor:
    ids = task.reset_buf.nonzero(as_tuple=False).flatten()
    task.rew_buf[ids] = 0.0
    return task.rew_buf


REFUSED = {
    "numpy": (lambda task: torch.from_numpy(task.dof_pos.cpu().numpy()).sum(dim=1), "copies to the host"),
    "a tensor without device": (lambda task: task.dof_pos @ torch.tensor([1.0] * JOINTS), "device=self.device"),
    "numpy's random numbers": (lambda task: task.dof_pos[:, 0] * __import__("numpy").random.rand(), "np.random"),
    "a branch": (lambda task: task.rew_buf if task.reset_buf.any() else -task.rew_buf, "reads a value on the host"),
    "a mask": (lambda task: task.rew_buf * task.dof_pos[task.reset_buf].sum(), "indexes by a mask"),
    "ids": (write_by_list, "unknown size"),
    "a counter": (count, r"self\.calls changed"),
    "a tensor bound anew": (rebind, "self.last_contact_force"),
    "a fifth column of commands": (lambda task: task.commands[:, 4], "has vx, vy, yaw rate, heading; keep others"),
    "a slice of columns of commands": (lambda task: task.commands[:, 10:12][:, 1], "keep others in your own tensor"),
    "heights at points": (lambda task: task.terrain.terrain_heights(task.base_pos), r"self.height_scan.ground_at\(points\)"),
    "quaternions with w last": (lambda task: get_euler_xyz(task.root_states[:, 3:7])[2], "pass self.base_quat"),
    "Isaac Gym": (lambda task: task.gym.refresh_rigid_body_state_tensor(task.sim), "there is no Isaac Gym"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", REFUSED)
def test_the_guard_names_the_reward_and_says_why(name):
    function, words = REFUSED[name]

    class Mine(LeggedRobot):
        def _init_buffers(self):
            super()._init_buffers()
            self.last_contact_force = torch.zeros(self.num_envs, device=self.device)

        def _reward_lin_vel_z(self):
            return function(self)

    with pytest.raises(TermError, match=rf"_reward_lin_vel_z: .*{words}"):
        Mine(small_config())
