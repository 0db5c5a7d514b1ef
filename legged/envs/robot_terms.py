"""Observations, rewards and terminations of a robot, whatever its task, and the tensors that they read.

Formulas and names are those of legged_gym (Rudin et al., arXiv 2109.11978). If a term differs, its docstring says so.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from legged.config.robot import RobotConfig
from legged.envs.marks import concurrent, unit
from legged.envs.privileged_terms import MIRROR_KINDS
from legged.math import squared_difference
from legged.mdp.contacts import FeetContacts
from legged.mdp.control import Control
from legged.mdp.mirror_images import MirrorKind
from legged.mdp.sensors import ContactForces, HeightScan, Sensor
from legged.physics import Physics
from legged.robots.patterns import match_names
from legged.robots.robot import Robot
from legged.terrain import Terrain

TERMINATION_FORCE = 1.0
"""The episode ends if the contact force on a terminating shape exceeds this multiple of the feet's contact threshold. The
threshold is 1 N, or 1 % of the weight of a robot that weighs less than 100 N.
"""
PENALISED_FORCE = 0.1
"""A contact of a penalised shape is a collision if its force exceeds this multiple of the feet's contact threshold."""

SELF_COLLISION_FORCE = 10.0
"""A contact of the robot with itself is a collision if its force exceeds this multiple of the feet's contact threshold."""


class RobotTerms:
    """Terms of a robot: the methods `_obs_<name>`, `_reward_<name>` and `_terminate_<name>` that a configuration can name.
    N robots, D joints, F feet, B tracked collision shapes. The task allocates the tensors that are declared here.
    """

    MIRRORED: dict[str, MirrorKind] = {
        "base_lin_vel": "vector",
        "base_ang_vel": "rotation",
        "projected_gravity": "vector",
        "dof_pos": "angles",
        "dof_vel": "speeds",
        "actions": "actions",
        "held_targets": "held",
        "heights": "heights",
        "passive_pos": "passive",
        "passive_vel": "passive",
        **MIRROR_KINDS,
    }
    """Observation term -> kind of its mirror image (left and right exchanged). A subclass adds its own terms."""
    cfg: RobotConfig
    dt: float
    """Control step [s]."""
    device: torch.device
    robot: Robot
    physics: Physics
    base_pos: Tensor
    """(N, 3) position of the base in the world frame [m]. `base_quat` (N, 4) is its orientation (w, x, y, z)."""
    base_quat: Tensor
    base_lin_vel: Tensor
    """(N, 3) linear velocity of the base in the base frame [m/s]. `base_ang_vel` (N, 3) is the angular velocity [rad/s]."""
    base_ang_vel: Tensor
    projected_gravity: Tensor
    """(N, 3) unit vector along gravity in the base frame."""
    dof_pos: Tensor
    """(N, D) joint angles [rad]. `dof_vel` are joint velocities, `last_dof_vel` those of the previous step [rad/s]."""
    dof_vel: Tensor
    last_dof_vel: Tensor
    default_dof_pos: Tensor
    """(D,) joint angles at action 0 [rad]."""
    passive_default_pos: Tensor
    """(P,) positions of passive hinges [rad] and slides [m] in the default pose. `passive_qpos_columns` and
    `passive_qvel_columns` are their columns in qpos and qvel. Only robots with passive joints have these three tensors.
    """
    passive_qpos_columns: Tensor
    passive_qvel_columns: Tensor
    dof_pos_limits: Tensor
    """(D, 2) soft limits of the joint angles [rad]. `dof_vel_limits`, (D,) or (N, D), are limits of the speeds [rad/s]."""
    dof_vel_limits: Tensor
    torques: Tensor
    """(N, D) joint torques of the last physics step [N m]."""
    _joints: dict[tuple[str, ...], Tensor]
    """Patterns -> the tensor that `joints` returns for them."""
    actions: Tensor
    """(N, A) clipped actions of this step, one for each joint that is not held. `last_actions` are those of the previous
    step.
    """
    last_actions: Tensor
    feet_pos: Tensor
    """(N, F, 3) positions of the feet in the world frame [m]. `feet_vel` (N, F, 3) are their velocities [m/s]."""
    feet_vel: Tensor
    contact_forces: Tensor
    """(N, B, 3) contact forces on the tracked shapes in the world frame [N]. `feet_indices`, `penalised_indices` and
    `termination_indices` are indices of these shapes."""
    feet_indices: Tensor
    _feet_shapes: slice | Tensor
    """Indices of the feet among the tracked shapes. Evenly spaced indices are stored as a slice, because indexing by a slice
    launches no kernel. `_terminating_shapes`: the same for shapes whose contact ends an episode."""
    _terminating_shapes: slice | Tensor
    penalised_indices: Tensor
    posture_joints: Tensor
    """(D,) 1 for joints that neither swing a leg forward and back nor turn a wheel, 0 for the others."""
    _without_wheels: Tensor | None
    """Indices of the joints that are not wheels; None if the robot has no wheels."""
    _seen_angles: Tensor | None
    """Indices of the joints that `dof_pos` observes; None for all joints. `_seen_speeds`: the same for `dof_vel`."""
    _seen_speeds: Tensor | None
    contacts: FeetContacts
    """Contact and swing times of the feet."""
    control: Control
    height_scan: HeightScan
    """Ground heights in the world frame [m]: `measured_heights` (N, P) around each robot, `height_scan.ground` (N,) under
    each robot."""
    measured_heights: Tensor
    sensors: dict[str, Sensor]
    """Sensors by name."""
    terminated_buf: Tensor
    """(N,) True if the episode ends now in a failure."""
    termination_indices: Tensor
    """Indices of the shapes whose contact ends an episode."""
    terrain: Terrain | None
    """Ground; None on a plane."""

    # ---- observations: (N, width) each; docstrings and units go into policy.json -----------------------------------------

    @unit("m/s")
    def _obs_base_lin_vel(self) -> Tensor:
        """Linear velocity (x, y, z) of the base, in the base frame [m/s]."""
        return self.base_lin_vel

    @unit("rad/s")
    def _obs_base_ang_vel(self) -> Tensor:
        """Angular velocity (x, y, z) of the base, in the base frame [rad/s]."""
        return self.base_ang_vel

    @unit("1")
    def _obs_projected_gravity(self) -> Tensor:
        """Unit vector along gravity, in the base frame: (0, 0, -1) when the base is level [1]."""
        return self.projected_gravity

    @unit("rad")
    def _obs_dof_pos(self) -> Tensor:
        """Joint angle minus default_joint_angles, by joint, without wheels [rad]."""
        angles = self.dof_pos - self.control.zero_dof_pos
        return angles if self._seen_angles is None else angles.index_select(1, self._seen_angles)

    @unit("rad/s")
    def _obs_dof_vel(self) -> Tensor:
        """Joint velocity, by joint [rad/s]."""
        return self.dof_vel if self._seen_speeds is None else self.dof_vel.index_select(1, self._seen_speeds)

    @unit("rad")
    def _obs_held_targets(self) -> Tensor:
        """Target angle minus default_joint_angles in the next control step, by joint of control.held [rad]."""
        return self.control.held_offsets

    @unit("rad")
    def _obs_passive_pos(self) -> Tensor:
        """Angles of the passive joints minus those of the default pose; for a spring this is the deflection [rad]."""
        return self.physics.qpos[:, self.passive_qpos_columns] - self.passive_default_pos

    @unit("rad/s")
    def _obs_passive_vel(self) -> Tensor:
        """Velocities of the passive joints [rad/s]."""
        return self.physics.qvel[:, self.passive_qvel_columns]

    @unit("1")
    def _obs_actions(self) -> Tensor:
        """The policy's last output, clipped to plus or minus action_clip, by joint; 0 at the start of an episode [1]."""
        return self.actions

    @unit("m")
    def _obs_heights(self) -> Tensor:
        """Height of the base above the ground at each point, less an offset: clip(base_z - offset - ground_z, -limit,
        deepest). Points are in the yaw frame, base_z and ground_z in the world frame [m].
        """
        return self.heights_seen(self.measured_heights)

    def heights_seen(self, ground: Tensor) -> Tensor:
        """Return the term `heights` for ground heights (N, P) in the world frame [m]."""
        seen = self.cfg.observations
        return (self.base_pos[:, 2:3] - seen.heights_offset - ground).clamp(-seen.heights_limit, seen.deepest)

    def without_wheels(self, values: Tensor) -> Tensor:
        """Return `values` (N, D), one for each joint, without the columns of wheels."""
        return values if self._without_wheels is None else values.index_select(1, self._without_wheels)

    def joints(self, pattern: str, *others: str) -> Tensor:
        """Return the indices (K,) of the joints whose names contain any of the patterns, in the robot's order, such as
        `self.dof_pos[:, self.joints("hip", "knee")]`. Every call with the same patterns returns the same tensor.

        Raises:
            ConfigError: a pattern is empty or matches no joint.
        """
        patterns = (pattern, *others)
        if patterns not in self._joints:
            found = match_names(patterns, self.robot.joint_names, f"{type(self).__name__}.joints")
            self._joints[patterns] = torch.tensor(found, dtype=torch.long, device=self.device)
        return self._joints[patterns]

    def _force(self, units: float) -> float:
        """Return `units` times the contact threshold of this robot's feet [N]."""
        return units * self.contacts.force

    # ---- rewards: (N,) each, before the multiplication by scale and control step ---------------------------------------

    @concurrent
    @unit("m^2/s^2")
    def _reward_lin_vel_z(self) -> Tensor:
        """Bouncing: squared vertical velocity [m^2/s^2]."""
        return self.base_lin_vel[:, 2].square()

    @concurrent
    @unit("rad^2/s^2")
    def _reward_ang_vel_xy(self) -> Tensor:
        """Rolling and pitching: squared rates [rad^2/s^2]."""
        return self.base_ang_vel[:, :2].square().sum(dim=1)

    @concurrent
    @unit("1")
    def _reward_orientation(self) -> Tensor:
        """Leaning: sum of the squares of x and y of `projected_gravity`."""
        return self.projected_gravity[:, :2].square().sum(dim=1)

    @concurrent
    @unit("m^2")
    def _reward_base_height(self) -> Tensor:
        """Squared difference between the base's height above the mean of the scanned ground and base_height_target [m^2]."""
        height = self.base_pos[:, 2] - self.measured_heights.mean(dim=1)
        return (height - self.cfg.rewards.base_height_target).square()

    @concurrent
    @unit("N^2 m^2")
    def _reward_torques(self) -> Tensor:
        """Sum of squared torques [N^2 m^2]."""
        return self.torques.square().sum(dim=1)

    @concurrent
    @unit("rad^2/s^2")
    def _reward_dof_vel(self) -> Tensor:
        """Sum of squared joint velocities, without wheels [rad^2/s^2]."""
        return self.without_wheels(self.dof_vel).square().sum(dim=1)

    @concurrent
    @unit("rad^2/s^4")
    def _reward_dof_acc(self) -> Tensor:
        """Sum of squared joint accelerations over a control step, without wheels [rad^2/s^4]."""
        return self.without_wheels(squared_difference(self.last_dof_vel, self.dof_vel)).sum(dim=1) / self.dt**2

    @concurrent
    @unit("1")
    def _reward_action_rate(self) -> Tensor:
        """Sum of squared changes of the actions in a control step."""
        return squared_difference(self.last_actions, self.actions).sum(dim=1)

    @concurrent
    @unit("1")
    def _reward_collision(self) -> Tensor:
        """Number of penalised shapes in contact."""
        return (self.contact_forces[:, self.penalised_indices].norm(dim=2) > self._force(PENALISED_FORCE)).sum(
            dim=1, dtype=torch.float32
        )

    @concurrent
    @unit("1")
    def _reward_self_collision(self) -> Tensor:
        """Number of physics steps in the control step in which a contact between two shapes of the robot had a large force:
        more than 10 N, or 10 % of the weight of a robot that weighs less than 100 N.
        """
        forces = self.sensors["self_collision"]
        assert isinstance(forces, ContactForces)
        return forces.steps_above(self._force(SELF_COLLISION_FORCE))

    @unit("1")
    def _reward_termination(self) -> Tensor:
        """Failure: 1 if the episode ends in a failure. It is added after the sum of all other rewards is clipped at zero."""
        return self.terminated_buf.float()

    @concurrent
    @unit("rad")
    def _reward_dof_pos_limits(self) -> Tensor:
        """Sum of the angles by which joints, without wheels, exceed their soft limits [rad]."""
        low, high = self.dof_pos_limits[:, 0], self.dof_pos_limits[:, 1]
        beyond = (low - self.dof_pos).clamp(min=0.0) + (self.dof_pos - high).clamp(min=0.0)
        return self.without_wheels(beyond).sum(dim=1)

    @concurrent
    @unit("rad/s")
    def _reward_dof_vel_limits(self) -> Tensor:
        """Sum of the speeds by which joints exceed their soft limits, at most 1 rad/s for each joint [rad/s]."""
        limit = self.dof_vel_limits * self.cfg.rewards.soft_dof_vel_limit
        return (self.dof_vel.abs() - limit).clamp(0.0, 1.0).sum(dim=1)

    @concurrent
    @unit("N m")
    def _reward_torque_limits(self) -> Tensor:
        """Sum of the torques by which joints exceed their soft limits [N m]."""
        limit = self.control.torque_limits * self.cfg.rewards.soft_torque_limit
        return (self.torques.abs() - limit).clamp(min=0.0).sum(dim=1)

    @concurrent
    @unit("1")
    def _reward_stumble(self) -> Tensor:
        """Stumbling: 1 if the horizontal force on a foot exceeds five times the vertical one."""
        force = self.contact_forces[:, self.feet_indices]
        return (force[:, :, :2].norm(dim=2) > 5.0 * force[:, :, 2].abs()).any(dim=1).float()

    @concurrent
    @unit("N")
    def _reward_feet_contact_forces(self) -> Tensor:
        """Sum of the forces by which contacts of feet exceed max_contact_force [N]."""
        force = self.contact_forces[:, self.feet_indices].norm(dim=2)
        return (force - self.cfg.rewards.max_contact_force).clamp(min=0.0).sum(dim=1)

    @concurrent
    @unit("m^2/s^2")
    def _reward_feet_slide(self) -> Tensor:
        """Sum of squared horizontal speeds of feet on the ground [m^2/s^2]."""
        return (self.feet_vel[:, :, :2].square().sum(dim=2) * self.contacts.in_contact).sum(dim=1)

    @concurrent
    @unit("m^3/s")
    def _reward_feet_clearance(self) -> Tensor:
        """Clearance of moving feet: squared difference between their height above the lowest foot and feet_clearance_target,
        times their horizontal speed [m^3/s].
        """
        height = self.feet_pos[:, :, 2] - self.feet_pos[:, :, 2].amin(dim=1, keepdim=True)
        apart = (height - self.cfg.rewards.feet_clearance_target).square() * self.feet_vel[:, :, :2].norm(dim=2)
        return (apart * ~self.contacts.in_contact).sum(dim=1)

    @concurrent
    @unit("rad^2")
    def _reward_posture(self) -> Tensor:
        """Sum of squared distances from the default angles, for all joints except wheels, joints that swing a leg forward
        and back, and held joints whose goals move. The waist, arms that do not move, and the abduction and yaw of the hips
        are counted [rad^2].
        """
        return ((self.dof_pos - self.default_dof_pos) * self.posture_joints).square().sum(dim=1)

    @concurrent
    @unit("1")
    def _reward_no_fly(self) -> Tensor:
        """Walk of a biped: 1 while exactly one foot is on the ground."""
        touching = self.contact_forces[:, self.feet_indices, 2] > self._force(PENALISED_FORCE)
        return (touching.sum(dim=1) == 1).float()

    # ---- terminations: (N,) bool each ----------------------------------------------------------------------------------

    @concurrent
    def _terminate_contact(self) -> Tensor:
        """Contact of a shape in the robot's `terminate_after_contacts_on`."""
        return (self.contact_forces[:, self._terminating_shapes].norm(dim=2) > self._force(TERMINATION_FORCE)).any(dim=1)

    @concurrent
    def _terminate_base_height(self) -> Tensor:
        """Base lower than min_base_height above the ground under it."""
        return self.base_pos[:, 2] - self.height_scan.ground < self.cfg.terminations.min_base_height

    @concurrent
    def _terminate_tilt(self) -> Tensor:
        """Base tilted by more than max_tilt."""
        return torch.acos((-self.projected_gravity[:, 2]).clamp(-1.0, 1.0)) > self.cfg.terminations.max_tilt

    @concurrent
    def _terminate_left_terrain(self) -> Tensor:
        """Base less than 1 m from the end of the map, or beyond it. The map includes the flat border around all tiles."""
        assert self.terrain is not None
        x, y = self.terrain.reach
        return (self.base_pos[:, 0].abs() > x) | (self.base_pos[:, 1].abs() > y)


def observed_joints(robot: Robot, patterns: tuple[str, ...], where: Callable[[str], str] = str) -> tuple[int, ...]:
    """Return the indices of the joints that `dof_vel` observes, and `dof_pos` too if they are no wheels. `where` turns a
    dotted path into the beginning of an error message.

    Raises:
        ConfigError: a pattern matches no joint.
    """
    if not patterns:
        return tuple(range(robot.num_dof))
    return match_names(patterns, robot.joint_names, where("observations.joints"))
