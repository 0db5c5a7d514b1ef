"""What environment classes of legged_gym and its forks call by other names, and what such a class must not do."""

import math
import re

import mujoco
import pytest
import torch
from helpers import CALM, ENGINE, JOINTS, small_config, small_task, zero_actions
from torch import Tensor

from legged.envs import LeggedRobot
from legged.envs.legged_gym_names import ABSENT, COMPUTED, CONSTANT, KEPT, PLAIN, SUBSTEPS, ReadOnly
from legged.errors import ConfigError
from legged.math import get_euler_xyz, quat_apply_yaw, quat_from_angle_axis, quat_rotate, quat_rotate_inverse
from legged.registry import make_task, task_config

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
    assert task.env is task
    assert task.base_position is task.base_pos
    assert task.penalized_contact_indices is task.penalised_indices
    assert task.raw_default_dof_pos is task.default_joint_pd_target is task.default_dof_pos
    assert task.num_actuated_dof == JOINTS
    assert task.base_euler_xyz.equal(task.rpy)
    assert task.base_height.equal(task.base_pos[:, 2])  # the ground is a plane


def test_heights_of_feet_are_those_of_their_soles():
    """The robot in its default pose, lifted by 0.1 m, on ground of 0.3 m height; ANYmal's feet are balls."""
    ground = [("terrain.mesh_type", "height_map"), ("terrain.proportions", {"flat": 1.0})]
    task = small_task(*ground, ("terrain.num_rows", 1), ("terrain.num_cols", 1), ("terrain.max_init_terrain_level", 0))
    task.height_scan._map.fill_(0.3)
    qpos = torch.tensor(task.robot.default_qpos, dtype=torch.float32).repeat(ROBOTS, 1)
    qpos[:, 2] = 0.3 + task.robot.height + 0.1
    task.physics.write(torch.ones(ROBOTS, dtype=torch.bool), qpos, torch.zeros_like(task.reset_qvel))
    task.sense()
    torch.testing.assert_close(task.foot_heights, torch.full((ROBOTS, 4), 0.1), rtol=0.0, atol=2e-3)
    (radius,) = {float(task.physics.model.geom(foot[0]).size[0]) for foot in task.robot.feet_shapes}
    torch.testing.assert_close(task.foot_heights, task.feet_pos[:, :, 2] - radius - 0.3)
    task.height_scan._map.fill_(0.5)  # feet below the ground, and 1.2 m above it
    assert task.foot_heights.unique().tolist() == [0.0]
    task.height_scan._map.fill_(-0.9)
    assert task.foot_heights.unique().tolist() == [1.0]


def test_soles_of_boxes_or_several_shapes_are_the_lowest_points():
    config = task_config("g1_flat", [("env.num_envs", 2), *ENGINE, *CALM], on_cpu=True)
    task = make_task(config)
    qpos = torch.tensor(task.robot.default_qpos, dtype=torch.float32).repeat(2, 1)
    qpos[:, 2] = task.robot.height + 0.25
    task.physics.write(torch.ones(2, dtype=torch.bool), qpos, torch.zeros_like(task.reset_qvel))
    task.sense()
    torch.testing.assert_close(task.foot_heights, torch.full((2, 2), 0.25), rtol=0.0, atol=2e-3)


def test_ground_under_a_point_is_that_of_the_height_scan():
    ground = [("terrain.mesh_type", "height_map"), ("terrain.proportions", {"random_grid": 1.0}), ("terrain.num_rows", 3)]
    rough = small_task(*ground, ("terrain.num_cols", 1), ("terrain.max_init_terrain_level", 2), ("init_state.yaw", [0, 0]))
    points = rough.base_pos[:, None, :2] + rough.height_scan.points
    torch.testing.assert_close(rough.height_scan.ground_at(points), rough.measured_heights)
    assert len(rough.measured_heights.unique()) > 5


def test_angles_of_feet_are_those_of_their_bodies():
    """Roll and yaw of the rotation matrices that C MuJoCo computes for the same positions."""
    turning = type("Turning", (LeggedRobot,), {"_reward_toes": lambda self: self.feet_yaw.sum(dim=1)})(small_config())
    torch.manual_seed(5)
    for _ in range(5):
        turning.step(torch.randn(ROBOTS, JOINTS))
    data = mujoco.MjData(turning.physics.model)
    for i in range(ROBOTS):
        data.qpos[:] = turning.physics.qpos[i].double().numpy()
        mujoco.mj_kinematics(turning.physics.model, data)
        for k, (shape, *_) in enumerate(turning.robot.feet_shapes):
            rotation = data.xmat[turning.physics.model.geom(shape).bodyid[0]].reshape(3, 3)
            assert float(turning.feet_roll[i, k]) == pytest.approx(math.atan2(rotation[2, 1], rotation[2, 2]), abs=1e-4)
            assert float(turning.feet_yaw[i, k]) == pytest.approx(math.atan2(rotation[1, 0], rotation[0, 0]), abs=1e-4)


def test_angles_of_feet_say_what_they_need(task):
    with pytest.raises(AttributeError, match=r"self\.feet_yaw: needs .*; write QUANTITIES = \('xquat',\) in the class"):
        task.feet_yaw  # noqa: B018


def test_accelerations_and_the_values_of_the_step_before():
    """Differences of what a step and the step before it left, while no episode ends."""
    names = ("dof_acc", "base_lin_acc", "last_feet_pos", "prev_foot_velocities", "last_contact_forces")
    targets = ("last_joint_pos_target", "last_last_joint_pos_target")

    class Fork(LeggedRobot):
        def _reward_lin_vel_z(self):
            self.seen = [getattr(self, name).clone() for name in (*names, *targets)]
            return self.rew_buf * 0.0

    fork = Fork(small_config(), graph=False)
    fork.reset()
    torch.manual_seed(0)
    history = []
    for _ in range(6):
        fork.step(0.1 * torch.randn(ROBOTS, JOINTS))
        assert not fork.reset_buf.any()
        velocity = fork.physics.qvel[:, :3]  # of the base, in the world frame
        now = (fork.dof_vel, velocity, fork.feet_pos, fork.feet_vel, fork.contact_forces, fork.joint_pos_target)
        history.append([tensor.clone() for tensor in now])
        if len(history) > 2:
            older, before, now = history[-3:]
            expected = [(now[0] - before[0]) / 0.02, (now[1] - before[1]) / 0.02, *before[2:], older[5]]
            for name, seen, right in zip((*names, *targets), fork.seen, expected, strict=True):
                torch.testing.assert_close(seen, right, rtol=1e-4, atol=1e-3, msg=name)
    assert fork.contact_forces.abs().max() > 1.0


def test_indices_of_one_axis_more_are_those_of_the_fork(task):
    """`last_actions` (N, D, 2) has the actions of the step before and of the one before it; `default_dof_pos` is (1, D)."""
    older = task.last_last_actions.uniform_(-1.0, 1.0)
    assert task.last_actions.shape == (ROBOTS, JOINTS)
    assert task.last_actions[:, :, 0].equal(task.last_actions)
    assert task.last_actions[:, 3:5, 1].equal(older[:, 3:5])
    assert task.last_actions[:, 3].equal(task.actions[:, 3])
    assert task.last_actions[:, None].shape == (ROBOTS, 1, JOINTS)
    hips = task.joints("HAA")
    assert task.default_dof_pos[:, hips].equal(task.default_dof_pos[hips].unsqueeze(0))
    assert task.default_dof_pos[None, :].shape == (1, JOINTS)
    with pytest.raises(IndexError, match="too many indices"):
        task.last_actions[:, :, 1] = 0.0
    for tensor in (task.last_actions[:, :, 0], task.dof_pos - task.default_dof_pos, task.last_actions.clone()):
        assert type(tensor) is Tensor


def test_values_of_each_physics_step_are_those_of_c_mujoco():
    class Fork(LeggedRobot):
        def _reward_lin_vel_z(self):
            return sum(getattr(self, name).sum(dim=(1, 2)) for name in SUBSTEPS)

    fork = Fork(small_config(("rewards.soft_dof_pos_limit", 0.05)), graph=False)
    fork.step(zero_actions(fork))  # the first step allocates what the term reads
    fork.reset()
    actions = torch.randn(ROBOTS, JOINTS, generator=torch.Generator().manual_seed(7))
    starts = (fork.physics.qpos.double().numpy().copy(), fork.physics.qvel.double().numpy().copy())
    fork.step(actions)
    assert not fork.reset_buf.any()
    low, high = fork.dof_pos_limits.unbind(dim=1)
    for i in range(ROBOTS):
        data = mujoco.MjData(fork.physics.model)
        data.qpos[:], data.qvel[:] = starts[0][i], starts[1][i]
        for k in range(4):
            angles, velocities = torch.tensor(data.qpos[7:]), torch.tensor(data.qvel[6:])
            target = fork.default_dof_pos + 0.5 * actions[i]
            torques = fork.p_gains * (target - angles) - fork.d_gains * velocities
            data.ctrl[:] = torques.clamp(-fork.torque_limits, fork.torque_limits).numpy()
            mujoco.mj_step(fork.physics.model, data)
            assert fork.substep_torques[i, k].tolist() == pytest.approx(data.ctrl.tolist(), abs=1e-2)
            assert fork.substep_dof_vel[i, k].tolist() == pytest.approx(data.qvel[6:].tolist(), abs=1e-2)
            angles = torch.tensor(data.qpos[7:], dtype=torch.float32)
            beyond = (low - angles).clamp(min=0.0) + (angles - high).clamp(min=0.0)
            torch.testing.assert_close(fork.substep_exceed_dof_pos_limit_abs[i, k], beyond, atol=1e-4, rtol=1e-4)
            assert fork.substep_exceed_dof_pos_limits[i, k].equal(beyond > 0.0)
            assert beyond.any()


def test_tracking_before_a_step_is_that_of_the_same_commands():
    class Fork(LeggedRobot):
        def _reward_lin_vel_z(self):
            self.seen = torch.stack([self.rwd_linVelTrackPrev, self.rwd_angVelTrackPrev])
            return self.rew_buf * 0.0

    fork = Fork(small_config(), graph=False)
    fork.step(zero_actions(fork))
    for _ in range(3):
        fork.commands[:, :3].uniform_(-0.5, 0.5)
        fork.remember()
        error = fork.commands[:, :3] - torch.cat([fork.base_lin_vel[:, :2], fork.base_ang_vel[:, 2:]], dim=1)
        square = error.square()
        before = torch.stack([torch.exp(-square[:, :2].sum(dim=1) / 0.25), torch.exp(-square[:, 2] / 0.25)])
        fork.step(torch.randn(ROBOTS, JOINTS))
        torch.testing.assert_close(fork.seen, before)


@pytest.mark.parametrize(("axis", "angle"), [(0, 0.7), (1, -0.4), (2, 3.0)])
def test_a_quaternion_of_an_angle_about_an_axis_has_w_first(axis, angle):
    direction = [0.0, 0.0, 0.0]
    direction[axis] = 2.5  # of any length
    found = quat_from_angle_axis(torch.tensor([angle, 0.0]), torch.tensor(direction))
    torch.testing.assert_close(found, torch.tensor([quat_about(axis, angle), [1.0, 0.0, 0.0, 0.0]]))


def test_a_turn_by_the_yaw_ignores_roll_and_pitch():
    """A quaternion that tilts about a horizontal axis and then turns by 0.7 about z turns a vector by 0.7 about z."""
    turn, tilt, vector = 0.7, 0.9, torch.tensor([[1.0, 2.0, 3.0]])
    (w, _, _, z), x = quat_about(2, turn), math.sin(tilt / 2)
    tilted = [w * math.cos(tilt / 2), w * x, z * x, z * math.cos(tilt / 2)]
    expected = [math.cos(turn) - 2 * math.sin(turn), math.sin(turn) + 2 * math.cos(turn), 3.0]
    torch.testing.assert_close(quat_apply_yaw(torch.tensor([tilted]), vector), torch.tensor([expected]))
    torch.testing.assert_close(quat_apply_yaw(torch.tensor([quat_about(0, 0.4)]), vector), vector)


def test_targets_of_joints_that_are_held_are_their_default_angles():
    task = small_task(("control.held", ["HAA"]), ("train.algorithm.symmetry", False))
    task.step(torch.ones(ROBOTS, 8))
    moved = torch.tensor([0.0, 0.5, 0.5]).repeat(4)  # action_scale times 1, but for the first joint of each leg
    torch.testing.assert_close(task.joint_pos_target - task.default_dof_pos, moved.expand(ROBOTS, JOINTS))


@pytest.mark.slow
def test_noise_is_that_of_the_actor_whoever_adds_it():
    """Sensors that are late add the noise of what they measure by themselves."""
    noisy = ("observations.add_noise", True)
    usual = small_task(noisy).noise_scale_vec
    assert usual[24:36].tolist() == pytest.approx([0.05 * 1.5] * JOINTS)  # of dof_vel: scale times half width
    late = small_task(noisy, ("observations.delay", {"dof_vel": [0, 2]}), ("observations.bias", {"dof_pos": 0.02}))
    assert late.noise_scale_vec.equal(usual)


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
    tables = (PLAIN, COMPUTED, CONSTANT, KEPT, SUBSTEPS, ABSENT)
    names = [name for table in tables for name in table]
    assert len(set(names)) == len(names)
    assert [name for name in names if hasattr(LeggedRobot, name)] == []


@pytest.mark.parametrize("name", ABSENT)
def test_a_name_that_is_not_there_says_what_is(task, name):
    with pytest.raises(AttributeError, match=f"^self.{name}: is not there; ") as error:
        getattr(task, name)
    assert ABSENT[name] in str(error.value)


def test_what_takes_the_place_of_a_name_is_there():
    """What is drawn lies under the names that the errors say, and two names of forks are not taken for others like them."""
    said = re.findall(r"self\.randomization\.fields\['(\w+)'\]", " ".join(ABSENT.values()))
    assert {"friction", "added_base_mass", "motor_strength", "p_gain"} <= set(said)
    ranges = {name: [0.9, 1.0] for name in said}
    varied = small_task(("domain_rand.randomize_friction", False), ("domain_rand.ranges", ranges))
    assert all(varied.randomization.fields[name].shape[0] == varied.num_envs for name in said)
    assert varied.contacts.first_contact.shape == (varied.num_envs, varied.feet_num)
    assert "root_states" not in ABSENT["rb_states"]
    assert varied.rpy.shape == (varied.num_envs, 3)


def test_a_slip_of_the_pen_has_its_nearest_name(task):
    with pytest.raises(
        AttributeError, match="'LeggedRobot' object has no attribute 'base_lin_velo'; did you mean 'base_lin_vel'"
    ):
        task.base_lin_velo  # noqa: B018
    with pytest.raises(AttributeError, match="the ground is a plane"):
        task.terrain_levels  # noqa: B018
    assert not hasattr(task, "nothing_like_it")


@pytest.mark.parametrize(
    ("slip", "near"),
    [
        ("feet_velo", "feet_vel"),
        ("torque", "torques"),
        ("terrain_level", None),  # there are no levels on a plane
        ("reset_yaw", None),  # _reset_yaw is private
        ("front_hip_index", None),  # hip_indices is not there
        ("hip_indice", None),
        ("last_foot_vel", None),  # last_dof_vel is something else
        ("ref_dof_pos", None),  # and so is dof_pos
        ("edge_reset_buf", None),
        ("_stance_of_feet", None),
    ],
)
def test_only_what_can_be_read_and_is_like_it_is_proposed(task, slip, near):
    with pytest.raises(AttributeError) as error:
        getattr(task, slip)
    proposed = re.search("did you mean '(.*)'", str(error.value))
    assert (proposed and proposed[1]) == near
    assert near or str(error.value).endswith(
        "; paste it too if it is a method; allocate your own tensors in _init_buffers(), and write them in place in advance()"
    )


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
    "joint angles": lambda task: task.dof_state.view(ROBOTS, JOINTS, 2)[..., 0].zero_(),
    "widening commands": lambda task: task.command_ranges["lin_vel_x"].__setitem__(1, 2.0),
}


@pytest.mark.parametrize("name", WRITES)
def test_writing_where_it_would_be_lost_is_an_error(task, name):
    with pytest.raises(AttributeError, match=r"^self\.(root_states|dof_state|command_ranges)"):
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


@pytest.mark.slow
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


def test_actions_of_the_last_episode_are_not_those_before_the_first_ones():
    class Fork(LeggedRobot):
        def _reward_lin_vel_z(self):
            self.seen.copy_(self.last_last_actions)
            return self.rew_buf * 0.0

        def _init_buffers(self):
            super()._init_buffers()
            self.seen = torch.ones(self.num_envs, JOINTS, device=self.device)

    fork = Fork(small_config())
    for begins in (True, False, False, True, False):
        if begins:
            fork.reset()
        fork.step(torch.full((ROBOTS, JOINTS), 0.3))
        if begins:
            assert not fork.seen.any()
    fork.episode_length_buf = torch.full((ROBOTS,), fork.max_episode_length - 1)
    for seen in (0.3, 0.0, 0.0, 0.3):  # of the step that ends the episode, then of three of the next one
        fork.step(torch.full((ROBOTS, JOINTS), 0.3))
        assert fork.seen.unique().tolist() == pytest.approx([seen])


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
    with pytest.raises(ConfigError, match=rf"Mine\.{name} would have no effect: training "):
        mine.check(small_config())
    type("Mine", (LeggedRobot,), {name: lambda self, *args: None, "OWN_HELPERS": (name,)}).check(small_config())
