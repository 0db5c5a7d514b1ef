"""Velocity commands: sampling, fixed commands, heading mode."""

import torch
from torch import Tensor

from legged.config.legged import CommandsConfig
from legged.math import masked_set_, wrap_to_pi, yaw_of
from legged.mdp.kernels import Kernels
from legged.mdp.random_pool import RandomPool

MOVING = 0.1
"""Norm of (vx, vy, yaw rate) above which a command counts as motion."""
STANDING = 4
"""Index of the kind of command for which a robot stands still."""
HEADING_GAIN = 0.5
"""Yaw rate per heading error in heading mode [1/s]."""


class Commands:
    """Commands of N robots: (vx, vy) [m/s] and yaw rate [rad/s] in the base frame, and a heading in the world [rad]."""

    STATE = ("commands", "is_moving", "ranges", "time_left", "held", "steered", "standing")

    def __init__(
        self,
        cfg: CommandsConfig,
        num_envs: int,
        dt: float,
        device: torch.device,
        kernels: Kernels | None = None,
        numbers: RandomPool | None = None,
    ) -> None:
        """Set all commands to zero. The first `update` replaces them. `dt` is the control step [s]. Random numbers come from
        the pool `numbers`.
        """
        self.cfg, self.dt, self._kernels = cfg, dt, kernels
        ranges = (cfg.ranges.lin_vel_x, cfg.ranges.lin_vel_y, cfg.ranges.ang_vel_yaw)
        self.full_ranges = torch.tensor(ranges, device=device)
        self.ranges = self.full_ranges.clone()
        """(3, 2) current lowest and highest vx, vy, yaw rate. A curriculum writes them in place."""
        self.commands = torch.zeros(num_envs, 4, device=device)
        """(N, 4) vx, vy [m/s], yaw rate [rad/s], heading [rad]."""
        self.is_moving = torch.zeros(num_envs, dtype=torch.bool, device=device)
        """(N,) True if any motion is commanded, turning on the spot included."""
        self.time_left = torch.zeros(num_envs, device=device)
        """(N,) time until the next command is sampled [s]."""
        self.held = torch.zeros(num_envs, dtype=torch.bool, device=device)
        """(N,) True for robots whose command was set by `hold`. Such a command is not sampled any more."""
        self.steered = torch.ones(num_envs, dtype=torch.bool, device=device)
        """(N,) True for robots whose yaw rate steers towards their heading, in heading mode."""
        self.standing = torch.zeros(num_envs, dtype=torch.bool, device=device)
        """(N,) True for robots whose command is to stand still. They do not turn, even in heading mode."""
        self.renewed = torch.zeros_like(self.standing)
        """(N,) True for robots that got a new command in the last `update`."""
        self._sample = torch.zeros(num_envs, 4, device=device)
        self._sample_standing = torch.zeros_like(self.standing)
        self.numbers = numbers or RandomPool(num_envs, device)
        self._velocity = self.numbers.between(0.0, 1.0, 3)
        self._heading = self.numbers.between(*cfg.ranges.heading, 1)
        self._chance = self.numbers.between(0.0, 1.0, 1)
        # The kinds of commands are: only vx, only vy, only yaw rate, all axes, none. Some are along one axis on purpose,
        # because independent sampling of three axes hardly ever gives such a command.
        single, standing = cfg.single_axis_share * (1.0 - cfg.standing_share) / 3.0, cfg.standing_share
        self._up_to = torch.tensor([single, 2.0 * single, 3.0 * single, 1.0 - standing], device=device)
        kept = torch.cat([torch.eye(3), torch.ones(1, 3), torch.zeros(1, 3)])
        self._kept = torch.cat([kept, torch.ones(5, 1)], dim=1).to(device)  # all kinds keep the heading

    def draw(self) -> None:
        """Sample a new command for every robot from the pool's numbers. `update` gives it to robots that need a new one."""
        low, high = self.ranges[:, 0], self.ranges[:, 1]
        torch.addcmul(low, high - low, self._velocity.values, out=self._sample[:, :3])
        self._sample[:, 3:].copy_(self._heading.values)
        kind = (self._chance.values >= self._up_to).sum(dim=1)
        self._sample.mul_(self._kept.index_select(0, kind))
        horizontal = self._sample[:, :2]
        horizontal.masked_fill_(horizontal.norm(dim=1, keepdim=True) < self.cfg.small_command, 0.0)
        torch.eq(kind, STANDING, out=self._sample_standing)

    def update(self, reset: Tensor, base_quat: Tensor) -> None:
        """Update commands by a control step: give the sampled command to robots whose episode begins (`reset` (N,)) or whose
        time is up, then steer towards the headings. `base_quat` (N, 4) are the orientations of the bases.
        """
        if self._kernels is not None:
            masks = (reset, self.held, self.steered)
            drawn = (self._sample, self._sample_standing)
            times = (self.dt, 0.5 * self.dt, self.cfg.resampling_time_s)
            steering = (HEADING_GAIN if self.cfg.heading_command else 0.0, self.ranges)
            written = (self.commands, self.standing, self.time_left, self.is_moving, self.renewed)
            self._kernels.launch("renew_commands", len(reset), *masks, *drawn, base_quat, *times, *steering, MOVING, *written)
            return
        self.time_left.sub_(self.dt)
        torch.gt(reset | (self.time_left <= 0.5 * self.dt), self.held, out=self.renewed)  # for masks: a and not b
        masked_set_(self.commands, self.renewed, self._sample)
        masked_set_(self.standing, self.renewed, self._sample_standing)
        masked_set_(self.time_left, self.renewed, self.cfg.resampling_time_s)
        if self.cfg.heading_command:
            low, high = self.ranges[2]
            error = wrap_to_pi(self.commands[:, 3] - yaw_of(base_quat))
            steered = self.steered & ~self.standing
            self.commands[:, 2].copy_(torch.where(steered, (HEADING_GAIN * error).clamp(low, high), self.commands[:, 2]))
        torch.gt(self.commands[:, :3].norm(dim=1), MOVING, out=self.is_moving)

    def hold(self, commands: Tensor, heading: Tensor | None = None) -> None:
        """Set fixed commands, (N, 3) or one (3,) for all robots. They are not sampled any more. With `heading` (N,) [rad] and
        in heading mode, the yaw rate keeps steering towards that heading.
        """
        self.commands[:, :3].copy_(commands)
        self.held.fill_(True)
        self.standing.fill_(False)
        self.steered.fill_(heading is not None)
        if heading is not None:
            self.commands[:, 3].copy_(heading)
        torch.gt(self.commands[:, :3].norm(dim=1), MOVING, out=self.is_moving)
