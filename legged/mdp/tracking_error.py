"""Squared errors between commanded and actual velocities."""

from torch import Tensor

from legged.math import squared_difference


def velocity_error(commands: Tensor, base_lin_vel: Tensor) -> Tensor:
    """Return the squared error of the horizontal velocity, (N,) [m^2/s^2].

    `commands` (N, 3 or more) are vx, vy [m/s] and yaw rate [rad/s], `base_lin_vel` (N, 3) is the base's velocity [m/s], both
    in the base frame.
    """
    return squared_difference(commands[:, :2], base_lin_vel[:, :2]).sum(dim=1)


def yaw_rate_error(commands: Tensor, base_ang_vel: Tensor) -> Tensor:
    """Return the squared error of the yaw rate, (N,) [rad^2/s^2].

    `commands` (N, 3 or more) are as for `velocity_error`, `base_ang_vel` (N, 3) is the base's angular velocity in the base
    frame [rad/s].
    """
    return squared_difference(commands[:, 2], base_ang_vel[:, 2])
