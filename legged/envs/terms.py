"""Observations, rewards, terminations and metrics of a legged robot, and everything that they may read.

Formulas and names are legged_gym's (Rudin et al., arXiv 2109.11978); where a term differs, its docstring says so.
"""

import torch
from torch import Tensor

from legged.config.schema import LeggedConfig
from legged.envs.marks import concurrent, unit
from legged.envs.privileged_terms import MIRROR_KINDS
from legged.math import squared_difference
from legged.mdp.contacts import FeetContacts
from legged.mdp.control import Control
from legged.mdp.height_scan import HeightScan
from legged.mdp.mirror_images import MirrorKind
from legged.mdp.tracking_error import velocity_error, yaw_rate_error
from legged.physics import Physics
from legged.terrain import Terrain

TERMINATION_FORCE = 1.0
"""Contact force on a terminating shape that ends the episode, in units of what counts as a contact of a foot: 1 N, of light
robots 1 % of their weight."""
PENALISED_FORCE = 0.1
"""Contact force on a penalised shape that counts as a collision, in the same units."""


class Terms:
    """The methods `_obs_<name>`, `_reward_<name>` and `_terminate_<name>` that a configuration can name, and metrics.
    N robots, D joints, F feet, B tracked collision shapes; the task allocates what is declared here.
    """

    MIRRORED: dict[str, MirrorKind] = {
        "base_lin_vel": "vector",
        "base_ang_vel": "rotation",
        "projected_gravity": "vector",
        "commands": "command",
        "dof_pos": "joints",
        "dof_vel": "joints",
        "actions": "actions",
        "heights": "heights",
        "passive_pos": "passive",
        "passive_vel": "passive",
        **MIRROR_KINDS,
    }
    """Observation term -> how its numbers change when left and right are exchanged; a subclass adds its own terms'."""
    cfg: LeggedConfig
    dt: float
    """Control step [s]."""
    physics: Physics
    base_pos: Tensor
    """(N, 3) base in the world [m]; `base_quat` (N, 4) is its orientation (w, x, y, z)."""
    base_quat: Tensor
    base_lin_vel: Tensor
    """(N, 3) velocity in the base frame [m/s]; `base_ang_vel` (N, 3) [rad/s]."""
    base_ang_vel: Tensor
    projected_gravity: Tensor
    """(N, 3) direction of gravity in the base frame."""
    dof_pos: Tensor
    """(N, D) joint angles [rad]; `dof_vel`, and `last_dof_vel` a control step before [rad/s]."""
    dof_vel: Tensor
    last_dof_vel: Tensor
    default_dof_pos: Tensor
    """(D,) joint angles at action 0 [rad]."""
    passive_default_pos: Tensor
    """(P,) passive hinges [rad] and slides [m] at action 0; where they are among the generalised positions and velocities.
    Only robots with passive joints have these three."""
    passive_qpos_columns: Tensor
    passive_qvel_columns: Tensor
    dof_pos_limits: Tensor
    """(D, 2) soft limits [rad]; `dof_vel_limits` (D,) [rad/s]."""
    dof_vel_limits: Tensor
    torques: Tensor
    """(N, D) [N m]."""
    actions: Tensor
    """(N, A) of this step, one for each joint that is not held; `last_actions` of the step before."""
    last_actions: Tensor
    commands: Tensor
    """(N, 4) vx, vy [m/s], yaw rate [rad/s], heading [rad]; `is_moving` (N,) whether any velocity is commanded."""
    is_moving: Tensor
    feet_pos: Tensor
    """(N, F, 3) in the world [m]; `feet_vel` (N, F, 3) [m/s]."""
    feet_vel: Tensor
    contact_forces: Tensor
    """(N, B, 3) in the world [N]; `feet_indices` and `penalised_indices` pick among the shapes."""
    feet_indices: Tensor
    _feet_shapes: slice | Tensor
    """The feet among the shapes, and below the shapes that must not touch anything: a slice where they are evenly spaced,
    which costs no launch."""
    _terminating_shapes: slice | Tensor
    penalised_indices: Tensor
    posture_joints: Tensor
    """(D,) 1 for joints that do not swing a leg forward and back, else 0."""
    contacts: FeetContacts
    """Contact and swing times of the feet."""
    control: Control
    height_scan: HeightScan
    """Heights of the ground: `measured_heights` (N, P) around each robot, `.ground` (N,) under it, world frame [m]."""
    measured_heights: Tensor
    terminated_buf: Tensor
    """(N,) the episode ends now in a failure."""
    termination_indices: Tensor
    """Shapes that must not touch anything."""
    terrain: Terrain | None
    """The ground; None on a plane."""

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

    @unit("m/s, m/s, rad/s")
    def _obs_commands(self) -> Tensor:
        """Commanded vx (forward), vy (leftward) and yaw rate (left positive), in the base frame [m/s, m/s, rad/s]."""
        return self.commands[:, :3]

    @unit("rad")
    def _obs_dof_pos(self) -> Tensor:
        """Joint angle minus default_joint_angles, by joint [rad]."""
        return self.dof_pos - self.control.zero_dof_pos

    @unit("rad/s")
    def _obs_dof_vel(self) -> Tensor:
        """Joint velocity, by joint [rad/s]."""
        return self.dof_vel

    @unit("rad")
    def _obs_passive_pos(self) -> Tensor:
        """Angles of the passive joints, less those of the default pose: among them how far springs give way [rad]."""
        return self.physics.qpos[:, self.passive_qpos_columns] - self.passive_default_pos

    @unit("rad/s")
    def _obs_passive_vel(self) -> Tensor:
        """Velocities of the passive joints [rad/s]."""
        return self.physics.qvel[:, self.passive_qvel_columns]

    @unit("1")
    def _obs_actions(self) -> Tensor:
        """The policy's last output within plus and minus action_clip, by joint; 0 at the start of an episode [1]."""
        return self.actions

    @unit("m")
    def _obs_heights(self) -> Tensor:
        """Base above ground, less an offset: clip(base_z - offset - ground_z, -limit, deepest) at each of the points, which
        lie in the yaw frame; base_z and ground_z in the world frame [m].
        """
        return self.heights_seen(self.measured_heights)

    def heights_seen(self, ground: Tensor) -> Tensor:
        """Return what the term `heights` is for a ground at (N, P) in the world [m]."""
        seen = self.cfg.observations
        return (self.base_pos[:, 2:3] - seen.heights_offset - ground).clamp(-seen.heights_limit, seen.deepest)

    def _force(self, units: float) -> float:
        """Return a force in units of what counts as a contact of this robot's feet [N]."""
        return units * self.contacts.force

    # ---- rewards: (N,) each, times scale and control step ------------------------------------------------------------

    @concurrent
    @unit("1")
    def _reward_tracking_lin_vel(self) -> Tensor:
        """Following the commanded horizontal velocity: exp(-|error|^2 / sigma)."""
        error = velocity_error(self.commands, self.base_lin_vel)
        return torch.exp(error * (-1.0 / self.cfg.rewards.tracking_sigma))

    @concurrent
    @unit("1")
    def _reward_tracking_ang_vel(self) -> Tensor:
        """Following the commanded yaw rate: exp(-error^2 / sigma)."""
        error = yaw_rate_error(self.commands, self.base_ang_vel)
        return torch.exp(error * (-1.0 / self.cfg.rewards.tracking_sigma))

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
        """Leaning: squared horizontal part of gravity in the base frame."""
        return self.projected_gravity[:, :2].square().sum(dim=1)

    @concurrent
    @unit("m^2")
    def _reward_base_height(self) -> Tensor:
        """Squared distance from the wanted base height above the mean of the ground around [m^2]."""
        height = self.base_pos[:, 2] - self.measured_heights.mean(dim=1)
        return (height - self.cfg.rewards.base_height_target).square()

    @concurrent
    @unit("N^2 m^2")
    def _reward_torques(self) -> Tensor:
        """Squared torques [N^2 m^2]."""
        return self.torques.square().sum(dim=1)

    @concurrent
    @unit("rad^2/s^2")
    def _reward_dof_vel(self) -> Tensor:
        """Squared joint velocities [rad^2/s^2]."""
        return self.dof_vel.square().sum(dim=1)

    @concurrent
    @unit("rad^2/s^4")
    def _reward_dof_acc(self) -> Tensor:
        """Squared joint accelerations over a control step [rad^2/s^4]."""
        return squared_difference(self.last_dof_vel, self.dof_vel).sum(dim=1) / self.dt**2

    @concurrent
    @unit("1")
    def _reward_action_rate(self) -> Tensor:
        """Squared change of the actions."""
        return squared_difference(self.last_actions, self.actions).sum(dim=1)

    @concurrent
    @unit("1")
    def _reward_collision(self) -> Tensor:
        """Number of penalised shapes that touch something."""
        return (self.contact_forces[:, self.penalised_indices].norm(dim=2) > self._force(PENALISED_FORCE)).sum(
            dim=1, dtype=torch.float32
        )

    @unit("1")
    def _reward_termination(self) -> Tensor:
        """Failing; added after the clip at zero."""
        return self.terminated_buf.float()

    @concurrent
    @unit("rad")
    def _reward_dof_pos_limits(self) -> Tensor:
        """How far joints are outside their soft limits [rad]."""
        low, high = self.dof_pos_limits[:, 0], self.dof_pos_limits[:, 1]
        return ((low - self.dof_pos).clamp(min=0.0) + (self.dof_pos - high).clamp(min=0.0)).sum(dim=1)

    @concurrent
    @unit("rad/s")
    def _reward_dof_vel_limits(self) -> Tensor:
        """How far joint speeds exceed their soft limits, at most 1 rad/s a joint [rad/s]."""
        limit = self.dof_vel_limits * self.cfg.rewards.soft_dof_vel_limit
        return (self.dof_vel.abs() - limit).clamp(0.0, 1.0).sum(dim=1)

    @concurrent
    @unit("N m")
    def _reward_torque_limits(self) -> Tensor:
        """How far torques exceed their soft limits [N m]."""
        limit = self.control.torque_limits * self.cfg.rewards.soft_torque_limit
        return (self.torques.abs() - limit).clamp(min=0.0).sum(dim=1)

    @concurrent
    @unit("s")
    def _reward_feet_air_time(self) -> Tensor:
        """Long swings: air time beyond the target, paid at touch-down while any velocity is commanded [s].

        legged_gym asks for a horizontal command; turning on the spot is then never paid, and not learned.
        """
        swing = self.contacts.last_air_time - self.cfg.rewards.air_time_target_s
        return (swing * self.contacts.first_contact).sum(dim=1) * self.is_moving

    @concurrent
    @unit("1")
    def _reward_stumble(self) -> Tensor:
        """A foot hits something vertical: horizontal force above five times the vertical one."""
        force = self.contact_forces[:, self.feet_indices]
        return (force[:, :, :2].norm(dim=2) > 5.0 * force[:, :, 2].abs()).any(dim=1).float()

    @concurrent
    @unit("rad")
    def _reward_stand_still(self) -> Tensor:
        """Joint angles away from the default while no motion is commanded [rad]."""
        return (self.dof_pos - self.default_dof_pos).abs().sum(dim=1) * ~self.is_moving

    @concurrent
    @unit("N")
    def _reward_feet_contact_forces(self) -> Tensor:
        """Foot forces beyond the allowed [N]."""
        force = self.contact_forces[:, self.feet_indices].norm(dim=2)
        return (force - self.cfg.rewards.max_contact_force).clamp(min=0.0).sum(dim=1)

    @concurrent
    @unit("s")
    def _reward_single_stance(self) -> Tensor:
        """Steps of a biped, while exactly one foot stands and any velocity is commanded: half the target, and how long the
        other foot has been in the air, up to the target, then the less the longer; after twice the target nothing [s].

        Paid for any long swing, robots take one step a second, and can't turn or be steered in between. Paid for the swing
        alone, short steps are worth next to nothing, and robots that began to hop on both feet go on hopping.
        """
        alone = (self.contacts.in_contact.sum(dim=1) == 1) & self.is_moving
        target = self.cfg.rewards.air_time_target_s
        swing = target - (self.contacts.air_time.amax(dim=1) - target).abs()
        return torch.where(alone & (swing > 0.0), 0.5 * target + swing, 0.0)

    @concurrent
    @unit("s")
    def _reward_uneven_steps(self) -> Tensor:
        """Difference between the longest and the shortest of the feet's last swings, while any velocity is commanded: a limp
        [s].
        """
        swings = self.contacts.last_air_time
        return (swings.amax(dim=1) - swings.amin(dim=1)) * self.is_moving

    @concurrent
    @unit("m^2/s^2")
    def _reward_feet_slide(self) -> Tensor:
        """Squared horizontal speed of feet on the ground [m^2/s^2]."""
        return (self.feet_vel[:, :, :2].square().sum(dim=2) * self.contacts.in_contact).sum(dim=1)

    @concurrent
    @unit("m^3/s")
    def _reward_feet_clearance(self) -> Tensor:
        """Feet that move forward at another height above the lowest foot than the target: squared difference times horizontal
        speed [m^3/s].
        """
        height = self.feet_pos[:, :, 2] - self.feet_pos[:, :, 2].amin(dim=1, keepdim=True)
        apart = (height - self.cfg.rewards.feet_clearance_target).square() * self.feet_vel[:, :, :2].norm(dim=2)
        return (apart * ~self.contacts.in_contact).sum(dim=1)

    @concurrent
    @unit("rad^2")
    def _reward_posture(self) -> Tensor:
        """Squared angles away from the default, of joints that do not swing a leg forward: hips that spread or turn, waist,
        arms [rad^2].
        """
        return ((self.dof_pos - self.default_dof_pos) * self.posture_joints).square().sum(dim=1)

    @concurrent
    @unit("1")
    def _reward_no_fly(self) -> Tensor:
        """Exactly one foot on the ground, the walk of a biped."""
        touching = self.contact_forces[:, self.feet_indices, 2] > self._force(PENALISED_FORCE)
        return (touching.sum(dim=1) == 1).float()

    # ---- terminations: (N,) bool each ----------------------------------------------------------------------------------

    @concurrent
    def _terminate_contact(self) -> Tensor:
        """A shape of the robot's `terminate_after_contacts_on` feels a force."""
        return (self.contact_forces[:, self._terminating_shapes].norm(dim=2) > self._force(TERMINATION_FORCE)).any(dim=1)

    @concurrent
    def _terminate_base_height(self) -> Tensor:
        """The base is too close to the ground under it."""
        return self.base_pos[:, 2] - self.height_scan.ground < self.cfg.terminations.min_base_height

    @concurrent
    def _terminate_tilt(self) -> Tensor:
        """The base leans too far."""
        return torch.acos((-self.projected_gravity[:, 2]).clamp(-1.0, 1.0)) > self.cfg.terminations.max_tilt

    @concurrent
    def _terminate_left_terrain(self) -> Tensor:
        """The base is beyond the middle of the level ground around all tiles: it cannot be judged there."""
        assert self.terrain is not None
        x, y = self.terrain.reach
        return (self.base_pos[:, 0].abs() > x) | (self.base_pos[:, 1].abs() > y)

    # ---- metrics: (N,) each, averaged over robots and steps; of squared errors named `_rmse` the root is logged ----------

    @concurrent
    @unit("m^2/s^2")
    def _metric_lin_vel_rmse(self) -> Tensor:
        """Squared error of the horizontal velocity [m^2/s^2]."""
        return velocity_error(self.commands, self.base_lin_vel)

    @concurrent
    @unit("rad^2/s^2")
    def _metric_ang_vel_rmse(self) -> Tensor:
        """Squared error of the yaw rate [rad^2/s^2]."""
        return yaw_rate_error(self.commands, self.base_ang_vel)
