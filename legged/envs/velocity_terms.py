"""Observations, rewards and metrics of robots that follow velocity commands, and the tensors that they read.

Formulas and names are those of legged_gym (Rudin et al., arXiv 2109.11978). If a term differs, its docstring says so.
"""

import torch
from torch import Tensor

from legged.config.legged import LeggedConfig
from legged.envs.marks import concurrent, unit
from legged.envs.robot_terms import RobotTerms
from legged.math import quat_rotate_inverse
from legged.mdp.mirror_images import MirrorKind
from legged.mdp.sensors import BodyStates
from legged.mdp.tracking_error import velocity_error, yaw_rate_error


class VelocityTerms(RobotTerms):
    """Terms of a velocity task, in addition to those of a robot: the methods `_obs_<name>` and `_reward_<name>` that a
    configuration can name, and metrics `_metric_<name>`. N robots.
    """

    MIRRORED: dict[str, MirrorKind] = {**RobotTerms.MIRRORED, "commands": "command", "base_commands": "same"}
    cfg: LeggedConfig
    commands: Tensor
    """(N, 4) commanded vx, vy [m/s], yaw rate [rad/s] and heading [rad]. `is_moving` (N,) is True if any motion is
    commanded.
    """
    is_moving: Tensor
    base_commands: Tensor
    """(N, 2) commanded height of the base above the ground [m] and pitch [rad], positive if it leans forward."""

    @property
    def pitch_gravity(self) -> Tensor:
        """(N, 3) direction of gravity in the frame of the body whose pitch is commanded, the base or commands.pitch_body."""
        body = self.sensors.get("pitch_body")
        if not isinstance(body, BodyStates):
            return self.projected_gravity
        down = torch.zeros_like(body.pos[:, 0])
        down[:, 2] = -1.0
        return quat_rotate_inverse(body.quat[:, 0], down)

    # ---- observations: (N, width) each; docstrings and units go into policy.json -----------------------------------------

    @unit("m/s, m/s, rad/s")
    def _obs_commands(self) -> Tensor:
        """Commanded vx (forward), vy (leftward) and yaw rate (left positive), in the base frame [m/s, m/s, rad/s]."""
        return self.commands[:, :3]

    @unit("m, rad")
    def _obs_base_commands(self) -> Tensor:
        """Commanded height of the base above the ground, and pitch of the base or of commands.pitch_body, positive if that
        body leans forward [m, rad].
        """
        return self.base_commands

    # ---- rewards: (N,) each, before the multiplication by scale and control step ---------------------------------------

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
    @unit("m^2")
    def _reward_height_error(self) -> Tensor:
        """Squared difference between the base's height above the mean of the scanned ground and its command [m^2]. It takes
        the place of `base_height` under commands of the height.
        """
        height = self.base_pos[:, 2] - self.measured_heights.mean(dim=1)
        return (height - self.base_commands[:, 0]).square()

    @concurrent
    @unit("1")
    def _reward_tilt_error(self) -> Tensor:
        """Leaning otherwise than commanded: sum of the squared differences between x and y of `pitch_gravity` and those of a
        body with the commanded pitch and no roll. It takes the place of `orientation` under commands of the pitch.
        """
        gravity = self.pitch_gravity
        return (gravity[:, 0] - self.base_commands[:, 1].sin()).square() + gravity[:, 1].square()

    @concurrent
    @unit("s")
    def _reward_feet_air_time(self) -> Tensor:
        """Long swings: air time minus its target, paid at touch-down while any motion is commanded [s].

        legged_gym rewards swings only under a horizontal command. Steps for turning on the spot are then never rewarded, and
        not learned.
        """
        swing = self.contacts.last_air_time - self.cfg.rewards.air_time_target_s
        return (swing * self.contacts.first_contact).sum(dim=1) * self.is_moving

    @concurrent
    @unit("rad")
    def _reward_stand_still(self) -> Tensor:
        """Sum of the joints' distances from their default angles, without wheels, while no motion is commanded [rad]."""
        return self.without_wheels((self.dof_pos - self.default_dof_pos).abs()).sum(dim=1) * ~self.is_moving

    @concurrent
    @unit("s")
    def _reward_single_stance(self) -> Tensor:
        """Steps of a biped: half of air_time_target_s plus the air time of the swinging foot, while exactly one foot stands
        and any motion is commanded [s].

        Beyond the target, a longer air time earns less, and from twice the target on the reward is 0. If every long swing
        were rewarded, robots would take one step a second and could not turn in between. If the fixed half were missing,
        short steps would earn almost nothing, and robots that began to hop on both feet would go on hopping.
        """
        alone = (self.contacts.in_contact.sum(dim=1) == 1) & self.is_moving
        target = self.cfg.rewards.air_time_target_s
        swing = target - (self.contacts.air_time.amax(dim=1) - target).abs()
        return torch.where(alone & (swing > 0.0), 0.5 * target + swing, 0.0)

    @concurrent
    @unit("s")
    def _reward_uneven_steps(self) -> Tensor:
        """Limping: difference between the longest and the shortest of the feet's last swings, while any motion is commanded
        [s].
        """
        swings = self.contacts.last_air_time
        return (swings.amax(dim=1) - swings.amin(dim=1)) * self.is_moving

    # ---- metrics: (N,) each, averaged over robots and steps; for names that end in `_rmse` the root is logged ------------

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
