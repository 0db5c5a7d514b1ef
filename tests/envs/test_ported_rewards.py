"""Reward sets of two other frameworks as tasks: Isaac Lab's rough velocity task of the G1 and mjlab's velocity task of the
Go2. Each term is compared with arithmetic on states and contacts of C MuJoCo, which makes the same steps beside the task.
"""

import mujoco
import numpy as np
import pytest
import torch
from helpers import CALM, ENGINE

from legged import LeggedRobot, registry
from legged.errors import ConfigError
from legged.math import quat_rotate, yaw_of
from legged.registry import make_task, register, task_config
from legged.robots.robot import load_robot

ROBOTS, STEPS = 4, 70
LEGS, ANKLES, ARMS = ("hip", "knee"), ("ankle_pitch", "ankle_roll"), ("shoulder", "elbow")


class Lab(LeggedRobot):
    """Rewards of Isaac-Velocity-Rough-G1-v0. This G1 has wrists and three joints of the waist, but no fingers."""

    def _init_buffers(self):
        super()._init_buffers()
        self.dof_vel_before = torch.zeros_like(self.dof_vel)

    def apply_control(self):
        super().apply_control()
        self.dof_vel_before.copy_(self.dof_vel)  # in the end, that before the last physics step

    def _reward_track_lin_vel_xy_yaw_frame_exp(self):
        velocity, yaw = self.physics.qvel[:, :3], yaw_of(self.base_quat)
        forward = torch.cos(yaw) * velocity[:, 0] + torch.sin(yaw) * velocity[:, 1]
        left = torch.cos(yaw) * velocity[:, 1] - torch.sin(yaw) * velocity[:, 0]
        error = (self.commands[:, 0] - forward).square() + (self.commands[:, 1] - left).square()
        return torch.exp(-error / 0.5**2)

    def _reward_track_ang_vel_z_world_exp(self):
        rate = quat_rotate(self.base_quat, self.base_ang_vel)[:, 2]
        return torch.exp(-(self.commands[:, 2] - rate).square() / 0.5**2)

    def _reward_feet_air_time_positive_biped(self):
        feet = self.contacts
        in_mode = torch.where(feet.in_contact, feet.contact_time, feet.air_time).amin(dim=1).clamp(max=0.4)
        return in_mode * (feet.in_contact.sum(dim=1) == 1) * (self.commands[:, :2].norm(dim=1) > 0.1)

    def _reward_feet_slide(self):
        return (self.feet_vel[:, :, :2].norm(dim=2) * self.contacts.in_contact).sum(dim=1)

    def _reward_dof_pos_limits(self):
        angle, limits = self.dof_pos[:, self.joints(*ANKLES)], self.dof_pos_limits[self.joints(*ANKLES)]
        return ((limits[:, 0] - angle).clamp(min=0.0) + (angle - limits[:, 1]).clamp(min=0.0)).sum(dim=1)

    def deviation(self, *patterns):
        return (self.dof_pos - self.default_dof_pos)[:, self.joints(*patterns)].abs().sum(dim=1)

    def _reward_joint_deviation_hip(self):
        return self.deviation("hip_yaw", "hip_roll")

    def _reward_joint_deviation_arms(self):
        return self.deviation(*ARMS)

    def _reward_joint_deviation_fingers(self):
        return self.deviation("wrist")

    def _reward_joint_deviation_torso(self):
        return self.deviation("waist")

    def _reward_dof_torques_l2(self):
        return self.torques[:, self.joints(*LEGS, "ankle")].square().sum(dim=1)

    def _reward_dof_acc_l2(self):
        change = (self.dof_vel - self.dof_vel_before)[:, self.joints(*LEGS)]
        return (change / self.cfg.sim.dt).square().sum(dim=1)


class Mjlab(LeggedRobot):
    """Rewards of Mjlab-Velocity-Flat-Unitree-Go2."""

    QUANTITIES = ("cinert", "cvel")

    def _init_buffers(self):
        super()._init_buffers()
        self.peak = torch.zeros_like(self.contacts.air_time)
        tables = ({"hip": 0.05, "thigh": 0.05, "calf": 0.1}, {"hip": 0.3, "thigh": 0.3, "calf": 0.6})
        self.spread = [torch.tensor(self.robot.each(t, "pose"), dtype=torch.float32, device=self.device) for t in tables]

    def advance(self):
        super().advance()
        torch.maximum(self.peak, self.feet_pos[:, :, 2] * ~self.contacts.in_contact, out=self.peak)

    def remember(self):
        super().remember()
        self.peak.mul_(self.contacts.air_time > 0.0)

    def asked(self):
        """Return the horizontal and angular speed of the command together (N,)."""
        return self.commands[:, :2].norm(dim=1) + self.commands[:, 2].abs()

    def _reward_track_linear_velocity(self):
        error = (self.commands[:, :2] - self.base_lin_vel[:, :2]).square().sum(dim=1) + self.base_lin_vel[:, 2].square()
        return torch.exp(-error / 0.25)

    def _reward_track_angular_velocity(self):
        error = (self.commands[:, 2] - self.base_ang_vel[:, 2]).square() + self.base_ang_vel[:, :2].square().sum(dim=1)
        return torch.exp(-error / 0.5)

    def _reward_upright(self):
        return torch.exp(-self.projected_gravity[:, :2].square().sum(dim=1) / 0.2)

    def _reward_pose(self):
        spread = torch.where(self.asked()[:, None] < 0.05, self.spread[0], self.spread[1])
        return torch.exp(-((self.dof_pos - self.default_dof_pos) / spread).square().mean(dim=1))

    def _reward_body_ang_vel(self):
        return quat_rotate(self.base_quat, self.base_ang_vel)[:, :2].square().sum(dim=1)

    def _reward_angular_momentum(self):
        inertia, velocity = self.physics.quantity("cinert"), self.physics.quantity("cvel")
        tensor = inertia[:, :, [0, 3, 4, 3, 1, 5, 4, 5, 2]].unflatten(2, (3, 3))
        own = (tensor @ velocity[:, :, :3, None]).squeeze(3)
        return (own + torch.linalg.cross(inertia[:, :, 6:9], velocity[:, :, 3:])).sum(dim=1).square().sum(dim=1)

    def _reward_air_time(self):
        swinging = (self.contacts.air_time > 0.05) & (self.contacts.air_time < 0.5)
        return swinging.sum(dim=1) * (self.asked() > 0.5)

    def _reward_foot_clearance(self):
        apart = (self.feet_pos[:, :, 2] - 0.1).abs() * self.feet_vel[:, :, :2].norm(dim=2)
        return apart.sum(dim=1) * (self.asked() > 0.05)

    def _reward_foot_swing_height(self):
        error = (self.peak / 0.1 - 1.0).square() * self.contacts.first_contact
        return error.sum(dim=1) * (self.asked() > 0.05)

    def _reward_foot_slip(self):
        slip = self.feet_vel[:, :, :2].square().sum(dim=2) * self.contacts.in_contact
        return slip.sum(dim=1) * (self.asked() > 0.05)

    def _reward_soft_landing(self):
        force = self.contact_forces[:, self.feet_indices].norm(dim=2) * self.contacts.first_contact
        return force.sum(dim=1) * (self.asked() > 0.05)


# Terms whose weight is 0 in those tasks have their weight in a related task, so that they run.
LAB_SCALES = {
    "termination": -200.0,
    "track_lin_vel_xy_yaw_frame_exp": 1.0,
    "track_ang_vel_z_world_exp": 2.0,
    "feet_air_time_positive_biped": 0.25,
    "feet_slide": -0.1,
    "dof_pos_limits": -1.0,
    "joint_deviation_hip": -0.1,
    "joint_deviation_arms": -0.1,
    "joint_deviation_fingers": -0.05,
    "joint_deviation_torso": -0.1,
    "lin_vel_z": -2.0,
    "ang_vel_xy": -0.05,
    "orientation": -1.0,
    "dof_torques_l2": -1.5e-7,
    "dof_acc_l2": -1.25e-7,
    "action_rate": -0.005,
}
MJLAB_SCALES = {
    "track_linear_velocity": 2.0,
    "track_angular_velocity": 2.0,
    "upright": 1.0,
    "pose": 1.0,
    "body_ang_vel": -0.05,
    "angular_momentum": -0.02,
    "dof_pos_limits": -1.0,
    "action_rate": -0.1,
    "air_time": 1.0,
    "foot_clearance": -2.0,
    "foot_swing_height": -0.25,
    "foot_slip": -0.1,
    "soft_landing": -1e-5,
}
TASKS = {"g1": (Lab, LAB_SCALES), "go2": (Mjlab, MJLAB_SCALES)}


class World:
    """One robot in C MuJoCo: the numbers of its last control step, and the times of its feet."""

    def __init__(self, task, name):
        self.model, self.data = task.physics.model, mujoco.MjData(task.physics.model)
        self.robot, self.base = load_robot(name), self.model.body(load_robot(name).file.base).id
        self.joints = self.robot.joint_names
        self.default, self.scale, self.dt = np.array(self.robot.default_dof_pos), task.cfg.control.action_scale, task.dt
        low, high = np.array(self.robot.dof_pos_limits).T
        middle, half = (low + high) / 2, (high - low) / 2 * task.cfg.rewards.soft_dof_pos_limit
        self.low, self.high = middle - half, middle + half
        self.feet = [[self.model.geom(shape).id for shape in shapes] for shapes in self.robot.feet_shapes]
        self.ending = [
            i for i in range(self.model.ngeom) if any(p in self.model.geom(i).name for p in ("pelvis", "torso", "head"))
        ]
        self.begin()

    def begin(self):
        """Begin an episode."""
        feet = len(self.feet)
        self.touched, self.air, self.stance, self.peak = np.zeros(feet, bool), np.zeros(feet), np.zeros(feet), np.zeros(feet)
        self.last_action = np.zeros(len(self.joints))

    def force_on(self, shapes):
        """Return the contact force on some shapes, in the world frame [N]."""
        total, wrench = np.zeros(3), np.zeros(6)
        for i, contact in enumerate(self.data.contact):
            mujoco.mj_contactForce(self.model, self.data, i, wrench)
            force = contact.frame.reshape(3, 3).T @ wrench[:3]
            total += force * (int(contact.geom2 in shapes) - int(contact.geom1 in shapes))
        return total

    def step(self, state, command, action):
        """Make a control step of four physics steps from a `state`: positions, velocities and a warm start."""
        data, model = self.data, self.model
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = state
        self.command, self.action, limit = command, action, model.actuator_forcerange[:, 1]
        for _ in range(4):
            target = self.default + self.scale * action
            torque = self.robot.stiffness * (target - data.qpos[7:]) - self.robot.damping * data.qvel[6:]
            self.torque = data.ctrl[:] = np.clip(torque, -limit, limit)
            self.before = data.qvel[6:].copy()
            mujoco.mj_step(model, data)
        self.forces = np.array([self.force_on(shapes) for shapes in self.feet])
        self.hit = any(np.linalg.norm(self.force_on([shape])) > 1.0 for shape in self.ending)
        for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel, mujoco.mj_subtreeVel):
            update(model, data)
        self.q, self.v, self.turn = data.qpos[7:], data.qvel[6:], data.xmat[self.base].reshape(3, 3)
        self.velocity, self.rate, self.down = self.turn.T @ data.qvel[:3], data.qvel[3:6], -self.turn[2]
        self.height = np.array([np.mean([data.geom_xpos[i][2] for i in shapes]) for shapes in self.feet])
        self.speed = np.array([np.linalg.norm(np.mean([self.speed_of(i) for i in shapes], axis=0)) for shapes in self.feet])
        touching = self.forces[:, 2] > 1.0
        self.contact = touching | self.touched
        self.landed = self.contact & (self.air > 0)
        self.touched = touching
        self.peak = np.where(self.contact, self.peak, np.maximum(self.peak, self.height))
        self.air, self.stance = (
            np.where(self.contact, 0, self.air + self.dt),
            np.where(self.contact, self.stance + self.dt, 0),
        )

    def speed_of(self, shape):
        """Return the horizontal velocity of a shape's centre [m/s]."""
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_GEOM, shape, velocity, 0)
        return velocity[3:5]

    def end(self):
        """End the control step."""
        self.last_action, self.peak = self.action, np.where(self.contact, 0, self.peak)

    def of(self, values, *patterns):
        """Return the `values` of joints by parts of their names."""
        return np.array([value for value, name in zip(values, self.joints, strict=True) if any(p in name for p in patterns)])

    def away(self, *patterns):
        return np.abs(self.of(self.q - self.default, *patterns)).sum()

    def beyond(self, *patterns):
        over = np.maximum(self.low - self.q, 0) + np.maximum(self.q - self.high, 0)
        return self.of(over, *patterns).sum()

    @property
    def asked(self):
        return np.hypot(*self.command[:2]) + abs(self.command[2])

    def yaw_frame(self):
        yaw = np.arctan2(self.turn[1, 0], self.turn[0, 0])
        return np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]) @ self.data.qvel[:2]

    def mode_time(self):
        alone = self.contact.sum() == 1 and np.hypot(*self.command[:2]) > 0.1
        return min(0.4, *(self.stance + self.air)) if alone else 0.0

    def pose(self):
        spread = np.array([0.1 if "calf" in name else 0.05 for name in self.joints]) * (1 if self.asked < 0.05 else 6)
        return np.exp(-np.mean(((self.q - self.default) / spread) ** 2))


def squares(values):
    return (np.asarray(values) ** 2).sum()


BY_HAND = {
    "termination": lambda w: w.hit or w.data.qpos[2] < 0.45 or np.arccos(-w.down[2]) > 0.9,
    "track_lin_vel_xy_yaw_frame_exp": lambda w: np.exp(-squares(w.command[:2] - w.yaw_frame()) / 0.25),
    "track_ang_vel_z_world_exp": lambda w: np.exp(-squares(w.command[2] - (w.turn @ w.rate)[2]) / 0.25),
    "feet_air_time_positive_biped": World.mode_time,
    "feet_slide": lambda w: (w.speed * w.contact).sum(),
    "joint_deviation_hip": lambda w: w.away("hip_yaw", "hip_roll"),
    "joint_deviation_arms": lambda w: w.away("shoulder", "elbow"),
    "joint_deviation_fingers": lambda w: w.away("wrist"),
    "joint_deviation_torso": lambda w: w.away("waist"),
    "lin_vel_z": lambda w: w.velocity[2] ** 2,
    "ang_vel_xy": lambda w: squares(w.rate[:2]),
    "orientation": lambda w: squares(w.down[:2]),
    "dof_torques_l2": lambda w: squares(w.of(w.torque, "hip", "knee", "ankle")),
    "dof_acc_l2": lambda w: squares(w.of(w.v - w.before, "hip", "knee") / 0.005),
    "action_rate": lambda w: squares(w.action - w.last_action),
    "track_linear_velocity": lambda w: np.exp(-squares([*(w.command[:2] - w.velocity[:2]), w.velocity[2]]) / 0.25),
    "track_angular_velocity": lambda w: np.exp(-squares([w.command[2] - w.rate[2], *w.rate[:2]]) / 0.5),
    "upright": lambda w: np.exp(-squares(w.down[:2]) / 0.2),
    "pose": World.pose,
    "body_ang_vel": lambda w: squares((w.turn @ w.rate)[:2]),
    "angular_momentum": lambda w: squares(w.data.subtree_angmom[w.base]),
    "air_time": lambda w: ((w.air > 0.05) & (w.air < 0.5)).sum() * (w.asked > 0.5),
    "foot_clearance": lambda w: (np.abs(w.height - 0.1) * w.speed).sum() * (w.asked > 0.05),
    "foot_swing_height": lambda w: squares((w.peak / 0.1 - 1) * w.landed) * (w.asked > 0.05),
    "foot_slip": lambda w: squares(w.speed * w.contact) * (w.asked > 0.05),
    "soft_landing": lambda w: (np.linalg.norm(w.forces, axis=1) * w.landed).sum() * (w.asked > 0.05),
    "dof_pos_limits": lambda w: w.beyond(*(ANKLES if w.robot.name == "g1" else ("",))),
}
"""Term -> function that computes it from a `World`."""


@pytest.fixture(scope="module")
def walks():
    """Return for each robot the values of its terms, term -> (STEPS, ROBOTS), and the same from C MuJoCo."""
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_REGISTERED", {})
        return {name: walk(name, *TASKS[name]) for name in TASKS}


def walk(name, task_class, scales):
    rewards = {"scales": scales, "soft_dof_pos_limit": 0.9}
    register(f"{name}_ported", {"extends": f"{name}_flat", "own_rewards": True, "rewards": rewards}, task_class)
    often = [("commands.resampling_time_s", 0.3), ("commands.standing_share", 0.3)]
    settings = [("env.num_envs", ROBOTS), *ENGINE, *CALM, *often]
    task = make_task(task_config(f"{name}_ported", settings, on_cpu=True))
    assert task.rewards.scales == {name: pytest.approx(task.dt * scale) for name, scale in scales.items()}
    worlds = [World(task, name) for _ in range(ROBOTS)]
    found, wanted = np.zeros((2, len(scales), STEPS, ROBOTS))
    generator = torch.Generator().manual_seed(1)
    for step in range(STEPS):
        state = {key: value.numpy().copy() for key, value in task.physics.state_tensors().items()}
        commands, actions = task.commands.numpy().copy(), torch.randn(ROBOTS, task.num_actions, generator=generator)
        dones = task.step(actions)[2]
        for i, world in enumerate(worlds):
            world.step((state["qpos"][i], state["qvel"][i], state["warmstart"][i]), commands[i], actions[i].numpy())
            wanted[:, step, i] = [BY_HAND[term](world) for term in task.rewards.names]
            world.end()
            if dones[i]:
                world.begin()
        found[:, step] = task.rewards.last.numpy() / np.array([[scales[term] * task.dt] for term in task.rewards.names])
    return {term: (found[i], wanted[i]) for i, term in enumerate(task.rewards.names)}


@pytest.mark.parametrize(("name", "term"), [(name, term) for name, (_, scales) in TASKS.items() for term in scales])
def test_a_ported_term_has_the_value_that_c_mujoco_s_state_gives(walks, name, term):
    found, wanted = walks[name][term]
    assert len(np.unique(wanted.round(6))) > 1
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-4 * np.abs(wanted).max())


def test_joints_are_found_by_parts_of_their_names():
    task = make_task(task_config("g1_flat", [("env.num_envs", 1), *ENGINE, *CALM], on_cpu=True))
    found = task.joints("hip_yaw", "ankle")
    names = [task.robot.joint_names[i] for i in found]
    kinds = ("hip_yaw", "ankle_pitch", "ankle_roll")
    assert names == [f"{side}_{kind}_joint" for side in ("left", "right") for kind in kinds]
    assert task.joints("hip_yaw", "ankle") is found
    says = r"LeggedRobot\.joints: pattern 'left_hip_yw' matches nothing; did you mean 'left_hip_yaw_joint'\?"
    with pytest.raises(ConfigError, match=says):
        task.joints("ankle", "left_hip_yw")
