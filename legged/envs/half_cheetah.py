"""HalfCheetah: a planar cheetah with two legs runs as fast as it can. The terms are those of Gymnasium's HalfCheetah-v5.

The task goes back to Wawrzynski, "A cat-like robot real-time learning to run", 2009. The model is Gymnasium's
half_cheetah.xml.
"""

import torch
from torch import Tensor

from legged.envs.base_task import BaseTask
from legged.envs.gymnasium_models import gymnasium_model
from legged.envs.marks import concurrent, unit
from legged.physics import ModelScene, Scene


class HalfCheetah(BaseTask):
    """Planar cheetah with nine generalised positions: x [m], z [m] and pitch [rad] of the torso, then six joints [rad] with a
    motor each. Episodes end by time only.
    """

    GYMNASIUM_ID = "HalfCheetah-v5"
    """Gymnasium's id of the same task, with the same observations, actions and rewards."""
    POSITION_NOISE, VELOCITY_NOISE = 0.1, 0.1
    """Noise of initial states: half width of the uniform noise on the positions of the reference pose [m, rad], and standard
    deviation of the Gaussian noise on the velocities [m/s, rad/s]."""

    def make_scene(self) -> Scene:
        """Return Gymnasium's cheetah on its floor."""
        return ModelScene(gymnasium_model("half_cheetah.xml"))

    def _init_buffers(self) -> None:
        super()._init_buffers()
        self.last_x = torch.zeros(self.num_envs, device=self.device)
        """(N,) x of the torso at the end of the last control step [m]."""

    def draw_reset(self) -> None:
        self.reset_qpos.uniform_(-self.POSITION_NOISE, self.POSITION_NOISE).add_(self.qpos0)
        self.reset_qvel.normal_(0.0, self.VELOCITY_NOISE)

    def remember(self) -> None:
        super().remember()
        self.last_x.copy_(self.physics.qpos[:, 0])

    def x_velocity(self) -> Tensor:
        """Return the mean forward velocity over the control step, (N,) [m/s]."""
        return (self.physics.qpos[:, 0] - self.last_x) / self.dt

    @unit("m, rad")
    def _obs_position(self) -> Tensor:
        """Generalised positions without x: z and pitch of the torso, then six joint angles, back leg first [m, rad]."""
        return self.physics.qpos[:, 1:]

    @unit("m/s, rad/s")
    def _obs_velocity(self) -> Tensor:
        """Generalised velocities: x, z and pitch of the torso, then six joints [m/s, rad/s]."""
        return self.physics.qvel

    @concurrent
    @unit("m/s")
    def _reward_forward(self) -> Tensor:
        """Forward velocity [m/s]."""
        return self.x_velocity()

    @concurrent
    @unit("1")
    def _reward_control(self) -> Tensor:
        """Sum of squared actions."""
        return self.actions.square().sum(dim=1)

    @concurrent
    @unit("m/s")
    def _metric_x_velocity(self) -> Tensor:
        """Forward velocity [m/s]."""
        return self.x_velocity()
