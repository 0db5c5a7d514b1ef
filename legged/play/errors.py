"""How well robots on show follow their commands: velocities, errors and falls, in words."""

import torch
from torch import Tensor

from legged.envs import LeggedRobot
from legged.mdp.tracking_error import velocity_error, yaw_rate_error


class TrackingErrors:
    """Squared errors and falls of N robots, summed up."""

    COLUMNS = ("velocity RMSE", "yaw rate RMSE", "falls")
    """What a row says."""

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self.steps, self.lin, self.ang, self.falls = (torch.zeros(num_envs, device=device) for _ in range(4))
        """(N,) control steps measured, sums of squared errors of vx and vy [m^2/s^2] and yaw rate [rad^2/s^2], falls."""

    def add(self, task: LeggedRobot, measured: Tensor) -> None:
        """Take in the falls of the step that was just made, and the errors of the robots of `measured` (N,)."""
        self.falls += task.terminated_buf
        self.steps += measured
        self.lin += torch.where(measured, velocity_error(task.commands, task.base_lin_vel), 0.0)
        self.ang += torch.where(measured, yaw_rate_error(task.commands, task.base_ang_vel), 0.0)

    def row(self, robots: Tensor | slice = slice(None)) -> tuple[str, str, str]:
        """Return root mean squares of velocity and yaw rate and number of falls of the robots in `robots` (N,), as text."""
        steps, lin, ang, falls = (float(sums[robots].sum()) for sums in (self.steps, self.lin, self.ang, self.falls))
        if steps == 0.0:  # they fell at once, every time, or what was asked was over before anything was measured
            return "-", "-", f"{falls:.0f}"
        return f"{(lin / steps) ** 0.5:.3f} m/s", f"{(ang / steps) ** 0.5:.3f} rad/s", f"{falls:.0f}"


def velocities(task: LeggedRobot, robots: slice) -> list[str]:
    """Return in words the commanded velocity of the first of `robots`, and the mean of their actual ones."""
    wanted = task.commands[robots][0, :3].tolist()
    actual = [*task.base_lin_vel[robots, :2].mean(dim=0).tolist(), float(task.base_ang_vel[robots, 2].mean())]
    return [
        f"{name}  {v[0]:+.2f}  {v[1]:+.2f} m/s  {v[2]:+.2f} rad/s" for name, v in (("commanded", wanted), ("actual", actual))
    ]
