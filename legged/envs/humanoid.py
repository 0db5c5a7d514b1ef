"""Humanoid: a humanoid runs as fast as it can. Observations and rewards are those of MuJoCo XLA's tutorial.

The task goes back to Tassa, Erez and Todorov, "Synthesis and stabilization of complex behaviors through online trajectory
optimization", 2012. The model is Gymnasium's humanoid.xml.
"""

from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from legged.config.bounds import between, quantity
from legged.config.randomization import Range
from legged.config.task import TaskConfig
from legged.envs.base_task import BaseTask
from legged.envs.gymnasium_models import gymnasium_model
from legged.envs.marks import concurrent, unit
from legged.physics import ModelScene, Scene

TORSO = 1
"""Index of the floating body."""


@dataclass(frozen=True)
class HumanoidConfig(TaskConfig):
    """Configuration of the humanoid's task: the sections that every task has, and two settings."""

    healthy_z: Range = field(default=(1.0, 1.5), metadata=quantity("m", between(0, 10)))
    """Lowest and highest torso height at which the humanoid counts as standing [m]."""
    reset_noise: float = field(default=0.01, metadata=quantity("m, rad, m/s, rad/s", between(0, 1)))
    """Half width of the uniform noise on the positions and velocities of initial states [m, rad, m/s, rad/s]."""


class Humanoid(BaseTask):
    """Humanoid with a floating torso and 17 motors on 17 joints; 13 bodies, 23 degrees of freedom."""

    Config: ClassVar[type[TaskConfig]] = HumanoidConfig
    cfg: HumanoidConfig
    QUANTITIES = ("subtree_com", "cinert", "cvel", "qfrc_actuator")

    def make_scene(self) -> Scene:
        """Return Gymnasium's humanoid on its floor."""
        return ModelScene(gymnasium_model("humanoid.xml"))

    def _init_buffers(self) -> None:
        super()._init_buffers()
        self.com = self.physics.quantity("subtree_com")[:, TORSO]
        """(N, 3) centre of mass, world frame [m]."""
        self.com_velocity = torch.zeros(self.num_envs, 3, device=self.device)
        """(N, 3) mean velocity of the centre of mass over the control step, world frame [m/s]."""
        self.last_com = torch.zeros_like(self.com_velocity)
        self.cinert, self.cvel, self.qfrc_actuator = (self.physics.quantity(name) for name in self.QUANTITIES[1:])

    def draw_reset(self) -> None:
        noise = self.cfg.reset_noise
        self.reset_qpos.uniform_(-noise, noise).add_(self.qpos0)
        self.reset_qvel.uniform_(-noise, noise)

    def advance(self) -> None:
        super().advance()
        torch.sub(self.com, self.last_com, out=self.com_velocity).div_(self.dt)

    def remember(self) -> None:
        super().remember()
        self.last_com.copy_(self.com)

    def healthy(self) -> Tensor:
        """Return a mask (N,) of the humanoids that stand."""
        low, high = self.cfg.healthy_z
        height = self.physics.qpos[:, 2]
        return (height >= low) & (height <= high)

    @unit("m, 1, rad")
    def _obs_position(self) -> Tensor:
        """Generalised positions without x and y: z and orientation (w, x, y, z) of the torso, then the joints [m, 1, rad]."""
        return self.physics.qpos[:, 2:]

    @unit("m/s, rad/s")
    def _obs_velocity(self) -> Tensor:
        """Torso's linear velocity (world axes) and angular velocity (torso's axes), then joint velocities [m/s, rad/s]."""
        return self.physics.qvel

    @unit("kg, m")
    def _obs_inertia(self) -> Tensor:
        """MuJoCo's cinert of each body, world axes: inertia about the robot's centre of mass, mass * offset, mass [kg, m]."""
        return self.cinert[:, TORSO:].flatten(1)

    @unit("rad/s, m/s")
    def _obs_body_velocity(self) -> Tensor:
        """MuJoCo's cvel of each body, world axes: angular and linear velocity at the robot's centre of mass [rad/s, m/s]."""
        return self.cvel[:, TORSO:].flatten(1)

    @unit("N, N m")
    def _obs_actuator_force(self) -> Tensor:
        """MuJoCo's qfrc_actuator: force of the motors on each degree of freedom, at the last physics step [N, N m]."""
        return self.qfrc_actuator

    @concurrent
    @unit("m/s")
    def _reward_linvel(self) -> Tensor:
        """Forward velocity of the centre of mass [m/s]."""
        return self.com_velocity[:, 0]

    @concurrent
    @unit("1")
    def _reward_alive(self) -> Tensor:
        """Standing: 1 while the torso is at a healthy height, else 0."""
        return self.healthy().float()

    @concurrent
    @unit("1")
    def _reward_quadctrl(self) -> Tensor:
        """Sum of squared actions."""
        return self.actions.square().sum(dim=1)

    @concurrent
    def _terminate_unhealthy(self) -> Tensor:
        """Torso too low or too high."""
        return ~self.healthy()

    @concurrent
    @unit("m")
    def _metric_x_position(self) -> Tensor:
        """Forward position of the centre of mass [m]."""
        return self.com[:, 0]

    @concurrent
    @unit("m")
    def _metric_y_position(self) -> Tensor:
        """Leftward position of the centre of mass [m]."""
        return self.com[:, 1]

    @concurrent
    @unit("m")
    def _metric_distance_from_origin(self) -> Tensor:
        """Distance of the centre of mass from the world's origin [m]."""
        return self.com.norm(dim=1)

    @concurrent
    @unit("m/s")
    def _metric_x_velocity(self) -> Tensor:
        """Forward velocity of the centre of mass [m/s]."""
        return self.com_velocity[:, 0]

    @concurrent
    @unit("m/s")
    def _metric_y_velocity(self) -> Tensor:
        """Velocity of the centre of mass to the left [m/s]."""
        return self.com_velocity[:, 1]
