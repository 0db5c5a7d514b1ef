"""What environment classes of legged_gym and its forks call by other names, and their rewards, run as they stand."""

import math

import pytest
import torch
from helpers import JOINTS, small_config, small_task, zero_actions
from torch import Tensor

from legged.envs import LeggedRobot
from legged.envs.legged_gym_names import ABSENT, COMPUTED, CONSTANT, KEPT, PLAIN, ReadOnly
from legged.errors import ConfigError, TermError
from legged.math import get_euler_xyz, quat_rotate, quat_rotate_inverse, wrap_to_pi

ROBOTS = 4


def quat_about(axis: int, angle: float) -> list[float]:
    """Quaternion, w first, of a turn about x, y or z."""
    quat = [math.cos(angle / 2), 0.0, 0.0, 0.0]
    quat[1 + axis] = math.sin(angle / 2)
    return quat


@pytest.fixture(scope="module")
def task() -> LeggedRobot:
    """A robot that has moved; tests read it."""
    task = small_task(("domain_rand.randomize_friction", True))
    torch.manual_seed(3)
    for _ in range(3):
        task.step(torch.randn(ROBOTS, JOINTS))
    return task


# ---- names ---------------------------------------------------------------------------------------------------------------


def test_root_states_are_laid_out_as_isaac_gyms(task):
    """Turned by 90 degrees about z, the robot's forward is the world's y; quaternions have w last."""
    qpos, qvel = task.reset_qpos.clone(), torch.zeros_like(task.reset_qvel)
    qpos[:, :3] = torch.tensor([1.0, 2.0, 0.6])
    qpos[:, 3:7] = torch.tensor(quat_about(2, math.pi / 2))
    qvel[:, :6] = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])  # linear in the world, angular in the base frame
    before = task.state_dict()
    task.physics.write(torch.ones(ROBOTS, dtype=torch.bool), qpos, qvel)
    task.sense()
    half = math.sqrt(0.5)
    # The base's x axis is the world's y, its y axis the world's -x.
    expected = [1.0, 2.0, 0.6, 0.0, 0.0, half, half, 0.1, 0.2, 0.3, -0.5, 0.4, 0.6]
    torch.testing.assert_close(task.root_states, torch.tensor(expected).expand(ROBOTS, 13), rtol=0.0, atol=1e-6)
    torch.testing.assert_close(task.rpy[:, 2], torch.full((ROBOTS,), math.pi / 2))
    task.load_state_dict(before)


def test_names_mean_what_they_mean_there(task):
    assert (task.num_dof, len(task.dof_names), task.num_obs, task.num_privileged_obs) == (JOINTS, JOINTS, 48, 48)
    assert task.dof_names[0] == task.robot.joint_names[0]
    assert task.max_episode_length_s == task.cfg.env.episode_length_s
    assert task.torque_limits.tolist() == pytest.approx(task.robot.torque_limits)
    assert task.p_gains is task.control.stiffness
    assert task.d_gains is task.control.damping
    assert task.penalised_contact_indices.tolist() == list(task.robot.penalised_indices)
    assert task.termination_contact_indices.tolist() == list(task.robot.termination_indices)
    assert task.reward_scales["tracking_lin_vel"] == pytest.approx(task.cfg.rewards.scales["tracking_lin_vel"] * task.dt)
    assert task.reward_names == list(task.reward_scales)
    assert task.obs_scales.lin_vel == task.cfg.observations.scales["base_lin_vel"]
    assert task.commands_scale.tolist() == [2.0, 2.0, 0.25]
    assert task.obs_buf.data_ptr() == task.observation_groups["actor"].buffer.data_ptr()
    assert task.base_init_state.tolist() == pytest.approx([0, 0, 0.6, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0])
    assert task.friction_coeffs.shape == (ROBOTS, 1, 1)
    assert task.dof_state.view(ROBOTS, JOINTS, 2)[..., 1].equal(task.dof_vel)
    assert task.height_points.shape == (ROBOTS, 187, 3)
    assert task.height_points[2, :, :2].equal(task.height_scan.points)
    torch.testing.assert_close(quat_rotate_inverse(task.base_quat, task.gravity_vec), task.projected_gravity)
    assert task.command_ranges["lin_vel_x"].tolist() == task.command_sampler.ranges[0].tolist()


def test_a_terrain_has_its_names():
    ground = [("terrain.mesh_type", "height_map"), ("terrain.proportions", {"flat": 1.0}), ("terrain.num_rows", 3)]
    rough = small_task(*ground, ("terrain.num_cols", 2), ("terrain.max_init_terrain_level", 1))
    assert rough.custom_origins
    assert rough.terrain_levels is rough.terrain_curriculum.levels
    assert rough.terrain_types.tolist() == [0, 0, 1, 1]
    assert (rough.max_terrain_level, tuple(rough.terrain_origins.shape)) == (3, (3, 2, 3))
    chosen = rough.terrain_origins[rough.terrain_levels, rough.terrain_types]
    assert chosen.equal(rough.env_origins)


def test_no_name_shadows_what_the_class_has():
    tables = (PLAIN, COMPUTED, CONSTANT, KEPT, ABSENT)
    names = [name for table in tables for name in table]
    assert len(set(names)) == len(names)
    assert [name for name in names if hasattr(LeggedRobot, name)] == []


@pytest.mark.parametrize("name", ABSENT)
def test_a_name_that_is_not_there_says_what_is(task, name):
    with pytest.raises(AttributeError, match=f"^self.{name}: is not there; ") as error:
        getattr(task, name)
    assert ABSENT[name] in str(error.value)


def test_a_slip_of_the_pen_has_its_nearest_name(task):
    with pytest.raises(
        AttributeError, match="'LeggedRobot' object has no attribute 'base_lin_velo'; did you mean 'base_lin_vel'"
    ):
        task.base_lin_velo  # noqa: B018
    with pytest.raises(AttributeError, match="the ground is a plane"):
        task.terrain_levels  # noqa: B018
    assert not hasattr(task, "nothing_like_it")


class Mistaken(LeggedRobot):
    @property
    def slip(self) -> Tensor:
        return self.feet_vell[:, :, 0].sum(dim=1)

    @property
    def rpy(self) -> Tensor:  # of a name that would be there
        return self.base_quad


def test_a_property_that_fails_says_what_is_missing_and_not_that_it_is():
    task = object.__new__(Mistaken)
    task.feet_vel = torch.zeros(1, 4, 3)
    with pytest.raises(AttributeError, match="has no attribute 'feet_vell'; did you mean 'feet_vel'"):
        task.slip  # noqa: B018
    with pytest.raises(AttributeError, match="has no attribute 'base_quad'"):
        task.rpy  # noqa: B018
    assert not hasattr(task, "slip")


WRITES = {
    "a part": lambda task: task.root_states.__setitem__((slice(None), slice(7, 9)), 1.0),
    "a slice in place": lambda task: task.root_states[:, 7:9].uniform_(-1.0, 1.0),
    "a slice of a slice": lambda task: task.root_states[:, 7:10][:, 0].mul_(2.0),
    "out": lambda task: torch.add(task.base_pos, 1.0, out=task.root_states[:, :3]),
    "counting air time": lambda task: task.feet_air_time.__iadd__(0.02),
    "joint angles": lambda task: task.dof_state.view(ROBOTS, JOINTS, 2)[..., 0].zero_(),
    "widening commands": lambda task: task.command_ranges["lin_vel_x"].__setitem__(1, 2.0),
}


@pytest.mark.parametrize("name", WRITES)
def test_writing_where_it_would_be_lost_is_an_error(task, name):
    with pytest.raises(AttributeError, match=r"^self\.(root_states|feet_air_time|dof_state|command_ranges)"):
        WRITES[name](task)


def test_what_is_computed_of_it_is_an_ordinary_tensor(task):
    assert isinstance(task.root_states[:, :3], ReadOnly)
    for tensor in (task.root_states * 2.0, task.root_states.clone(), torch.cat([task.root_states, task.dof_pos], dim=1)):
        assert type(tensor) is Tensor
    task.root_states.clone().zero_()


def test_what_a_class_sets_itself_takes_the_place():
    class Fork(LeggedRobot):
        def _init_buffers(self):
            super()._init_buffers()
            self.feet_air_time = torch.zeros(self.num_envs, 4, device=self.device)
            self.last_contacts = torch.zeros(self.num_envs, 4, dtype=torch.bool, device=self.device)
            self.hip_indices = torch.tensor([i for i, name in enumerate(self.dof_names) if "HAA" in name], device=self.device)

    fork = Fork(small_config())
    fork.feet_air_time += 1.0
    fork.step(zero_actions(fork))
    assert fork.feet_air_time.tolist() == [[1.0] * 4] * ROBOTS
    assert not fork.last_contacts.any()
    assert fork.hip_indices.tolist() == [0, 3, 6, 9]


def test_what_is_kept_is_that_of_the_step_before():
    class Fork(LeggedRobot):
        def _reward_lin_vel_z(self):
            self.seen.copy_(torch.cat([self.last_root_vel, self.last_torques, self.last_last_actions], dim=1))
            self.seen_contacts.copy_(self.last_contacts)
            return self.rew_buf * 0.0

        def _init_buffers(self):
            super()._init_buffers()
            self.seen = torch.zeros(self.num_envs, 6 + 2 * JOINTS, device=self.device)
            self.seen_contacts = torch.ones(self.num_envs, 4, dtype=torch.bool, device=self.device)

    fork = Fork(small_config())
    torch.manual_seed(0)
    history = []
    for _ in range(30):
        actions = 0.1 * torch.randn(ROBOTS, JOINTS)
        fork.step(actions)
        touching = fork.contact_forces[:, fork.feet_indices, 2] > 1.0
        history.append((fork.root_states[:, 7:].clone(), fork.torques.clone(), actions, touching))
        if len(history) > 2:
            (_, _, older, _), (velocity, torques, _, contacts) = history[-3:-1]
            torch.testing.assert_close(fork.seen, torch.cat([velocity, torques, older], dim=1))
            assert fork.seen_contacts.equal(contacts)
    assert touching.any()
    assert {"last_root_vel", "last_torques", "last_last_actions"} <= set(fork.state_dict()["task"])


def test_air_time_is_that_of_swings_which_go_on_or_end(task):
    contacts = task.contacts
    air = torch.where(contacts.first_contact, contacts.last_air_time, contacts.air_time)
    assert task.feet_air_time.tolist() == air.tolist()


@pytest.mark.parametrize(("axis", "angle"), [(0, 0.7), (1, -0.4), (2, 3.0), (2, -3.0)])
def test_euler_angles_of_turns_about_one_axis(axis, angle):
    found = [float(value) for value in get_euler_xyz(torch.tensor([quat_about(axis, angle)]))]
    assert found == pytest.approx([angle if i == axis else 0.0 for i in range(3)], abs=1e-6)


def test_euler_angles_turn_about_x_then_y_then_z():
    def about(axis: int, angle: float, vector: Tensor) -> Tensor:
        return quat_rotate(torch.tensor([quat_about(axis, angle)]), vector)

    torch.manual_seed(0)
    quat = torch.nn.functional.normalize(torch.randn(20, 4), dim=1)
    vector = torch.randn(20, 3)
    for q, v, *angles in zip(quat, vector, *get_euler_xyz(quat), strict=True):
        turned = v.unsqueeze(0)
        for axis, angle in enumerate(angles):
            turned = about(axis, float(angle), turned)
        torch.testing.assert_close(turned, quat_rotate(q.unsqueeze(0), v.unsqueeze(0)), rtol=1e-4, atol=1e-5)


# ---- rewards of forks ----------------------------------------------------------------------------------------------------


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
        landed = torch.logical_or(touching, self.last_contacts) * (self.feet_air_time > 0.0)
        swing = torch.sum((self.feet_air_time - 0.5) * landed, dim=1)
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
    with pytest.raises(AttributeError, match="only where a term reads it"):
        task.last_dof_pos  # noqa: B018


def test_there_are_many_rewards():
    assert len(REWARDS) >= 30


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


# ---- what a graph would refuse, in rewards -------------------------------------------------------------------------------


def count(task: LeggedRobot) -> Tensor:
    task.calls = getattr(task, "calls", 0) + 1
    return task.rew_buf * 0.0


def rebind(task: LeggedRobot) -> Tensor:
    change = task.contact_forces[:, 0, 2] - task.last_contact_force
    task.last_contact_force = task.contact_forces[:, 0, 2].clone()
    return change


def rebind_contacts(task: LeggedRobot) -> Tensor:
    touching = task.contact_forces[:, task.feet_indices, 2] > 1.0
    landed = torch.logical_or(touching, task.last_contacts)
    task.last_contacts = touching
    return landed.sum(dim=1).float()


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
    "contacts bound anew": (rebind_contacts, "self.last_contacts"),
    "air time counted": (lambda task: task.feet_air_time.__iadd__(task.dt).sum(dim=1), "self.contacts counts it"),
    "Isaac Gym": (lambda task: task.gym.refresh_rigid_body_state_tensor(task.sim), "there is no Isaac Gym"),
}


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


# ---- classes of forks ----------------------------------------------------------------------------------------------------


def test_a_constructor_with_isaac_gyms_arguments_is_refused():
    class Mine(LeggedRobot):
        def __init__(self, cfg, sim_params, physics_engine, sim_device, headless):
            super().__init__(cfg, sim_params, physics_engine)

    line = Mine.__init__.__code__.co_firstlineno
    words = rf"test_legged_gym_names\.py:{line}: Mine\.__init__ must take \(self, cfg, device, graph\)"
    with pytest.raises(ConfigError, match=words):
        Mine.check(small_config())


def test_a_constructor_that_passes_on_what_it_gets_is_allowed():
    class Mine(LeggedRobot):
        def __init__(self, cfg, *args, **kwargs):
            super().__init__(cfg, *args, **kwargs)

    Mine.check(small_config())


@pytest.mark.parametrize("name", ["step", "get_observations"])
def test_what_training_does_not_call_is_refused(name):
    mine = type("Mine", (LeggedRobot,), {name: lambda self, *args: None})
    with pytest.raises(ConfigError, match=rf"Mine\.{name} would not act: training "):
        mine.check(small_config())
    type("Mine", (LeggedRobot,), {name: lambda self, *args: None, "OWN_HELPERS": (name,)}).check(small_config())
