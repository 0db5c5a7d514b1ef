"""Waypoints: a controller on each robot's pose commands the velocities that lead from place to place."""

import torch
from torch import Tensor

from legged.config.legged import WaypointsConfig
from legged.math import masked_set_, wrap_to_pi, yaw_of
from legged.mdp.commands import MOVING, Commands
from legged.mdp.random_pool import RandomPool


class Waypoints:
    """Waypoints of N robots: positions and headings near the pose in which each episode began. A share of the robots, evenly
    spread, gets its velocity commands from a controller; the others keep the sampled commands.
    """

    STATE = ("start", "target", "resting")

    def __init__(self, cfg: WaypointsConfig, commands: Commands, numbers: RandomPool) -> None:
        """Steer by `commands`, whose sampling times are those of new waypoints. Random numbers come from the pool
        `numbers`.
        """
        self.cfg, self._commands = cfg, commands
        count, device = numbers.num_envs, numbers.device
        marks = (torch.arange(count + 1, device=device, dtype=torch.float64) * cfg.share).floor()
        self.steered = marks[1:] > marks[:-1]
        """(N,) True for robots that walk to waypoints."""
        self.start = torch.zeros(count, 3, device=device)
        """(N, 3) place (x, y) [m] and heading [rad] of the base at the beginning of the episode, world frame."""
        self.target = torch.zeros(count, 3, device=device)
        """(N, 3) place (x, y) [m] and heading [rad] of the waypoint, world frame."""
        self.resting = torch.zeros(count, 2, dtype=torch.bool, device=device)
        """(N, 2) True where the place, or the heading, is reached, so that no motion along these axes is commanded."""
        errors = torch.tensor([cfg.place_error, cfg.heading_error], device=device)
        self._near, self._far = errors.unbind(dim=1)
        self._drawn = numbers.between([0.0, -torch.pi, -torch.pi], [1.0, torch.pi, torch.pi], 3)

    def steer(self, reset: Tensor, base_pos: Tensor, base_quat: Tensor) -> None:
        """Command velocities by the robots' poses, after `Commands.update`. Robots of `reset` (N,) begin an episode.
        `base_pos` (N, 3) [m] and `base_quat` (N, 4) are the poses of the bases.
        """
        cfg, commands = self.cfg, self._commands
        yaw = yaw_of(base_quat)
        pose = torch.cat([base_pos[:, :2], yaw.unsqueeze(1)], dim=1)
        masked_set_(self.start, reset, pose)
        area, bearing, turn = self._drawn.values.unbind(dim=1)
        radius = cfg.radius * area.sqrt()
        ahead, aside = cfg.ahead + radius * bearing.cos(), radius * bearing.sin()
        place = self.start[:, :2] + _turned(ahead, aside, self.start[:, 2])
        masked_set_(self.target, commands.renewed, torch.cat([place, (self.start[:, 2] + turn).unsqueeze(1)], dim=1))
        asked, _ = approach(self.target, pose, self.resting, ~commands.renewed, self._near, self._far, cfg.gain)
        low, high = commands.ranges.unbind(dim=1)
        asked = torch.clamp(asked, low, high).masked_fill(commands.standing.unsqueeze(1), 0.0)
        masked_set_(commands.commands[:, :3], self.steered & ~commands.held, asked)
        torch.gt(commands.commands[:, :3].norm(dim=1), MOVING, out=commands.is_moving)


def approach(
    target: Tensor, pose: Tensor, resting: Tensor, kept: Tensor, near: Tensor, far: Tensor, gain: float
) -> tuple[Tensor, Tensor]:
    """Return the velocities in the yaw frame, (N, 3) [m/s, m/s, rad/s], that lead from `pose` to `target`, and the distances
    [m] and errors of the heading [rad], (N, 2). Poses (N, 3) are place [m] and heading [rad] in the world frame.

    Velocities are `gain` [1/s] times the errors. They are 0 where `resting` (N, 2) is True: it becomes True below the errors
    `near` (2,), and for robots of `kept` (N,) it stays True up to the errors `far` (2,).
    """
    apart = target - pose
    error = torch.cat([_turned(apart[:, 0], apart[:, 1], -pose[:, 2]), wrap_to_pi(apart[:, 2:])], dim=1)
    size = torch.stack([error[:, :2].norm(dim=1), error[:, 2].abs()], dim=1)
    torch.where(resting & kept.unsqueeze(1), size <= far, size < near, out=resting)
    idle = torch.cat([resting[:, :1], resting], dim=1)
    return (gain * error).masked_fill(idle, 0.0), size


def _turned(x: Tensor, y: Tensor, angle: Tensor) -> Tensor:
    """Return the vectors (x, y), (N,) each, turned by `angle` (N,) [rad], as (N, 2)."""
    sine, cosine = angle.sin(), angle.cos()
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y], dim=1)
