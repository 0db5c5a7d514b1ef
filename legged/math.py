"""Quaternions (w, x, y, z) and in-place helpers, batched over the first dimension, without synchronisation with the host."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import mse_loss, normalize


def _w_first(quat: Tensor) -> Tensor:
    """Return `quat`, unless it is a part of Isaac Gym's `root_states`, whose quaternions have w last."""
    if getattr(quat, "w_last", False):
        raise TypeError("the quaternions of self.root_states have w last, those of legged.math first; pass self.base_quat")
    return quat


def quat_rotate(quat: Tensor, vec: Tensor) -> Tensor:
    """Rotate vectors `vec` (..., 3) from the body frame of `quat` (..., 4) to the world frame."""
    w, xyz = _w_first(quat).split([1, 3], dim=-1)
    t = 2.0 * torch.linalg.cross(xyz, vec)
    return vec + w * t + torch.linalg.cross(xyz, t)


def quat_rotate_inverse(quat: Tensor, vec: Tensor) -> Tensor:
    """Rotate vectors `vec` (..., 3) from the world frame to the body frame of `quat` (..., 4)."""
    w, xyz = _w_first(quat).split([1, 3], dim=-1)
    t = 2.0 * torch.linalg.cross(xyz, vec)
    return vec - w * t + torch.linalg.cross(xyz, t)


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Return the products (..., 4) of quaternions `a` and `b` (..., 4): the turn `b`, then the turn `a`."""
    (aw, a_xyz), (bw, b_xyz) = (_w_first(each).split([1, 3], dim=-1) for each in (a, b))
    w = aw * bw - (a_xyz * b_xyz).sum(dim=-1, keepdim=True)
    return torch.cat([w, aw * b_xyz + bw * a_xyz + torch.linalg.cross(a_xyz, b_xyz)], dim=-1)


def quat_to_matrix(quat: Tensor) -> Tensor:
    """Return the rotation matrices (N, 3, 3) from the body frame of `quat` (N, 4), w first, to the world frame."""
    w, x, y, z = _w_first(quat).t().contiguous()
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row) for row in rows]).permute(2, 0, 1)


def yaw_of(quat: Tensor) -> Tensor:
    """Return the heading angle of the body's x axis in the world frame, (N,) [rad]."""
    w, x, y, z = _w_first(quat).unbind(dim=1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def get_euler_xyz(quat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return roll, pitch and yaw [rad], (N,) each, of `quat` (N, 4), w first. The rotation consists of these turns about the
    world's x, y and z axes, in this order. Each angle lies in [-pi, pi]. Isaac Gym differs: its angles lie in [0, 2 pi), and
    its quaternions have w last.
    """
    w, x, y, z = _w_first(quat).unbind(dim=1)
    roll = torch.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
    return roll, pitch, yaw_of(quat)


def quat_apply_yaw(quat: Tensor, vec: Tensor) -> Tensor:
    """Rotate vectors `vec` (N, 3) about the world's z axis by the turn about z in `quat` (N, 4), w first: by the quaternion
    (w, 0, 0, z), normalised.
    """
    w, x, y, z = _w_first(quat).unbind(dim=1)
    turn = normalize(torch.stack([w, torch.zeros_like(x), torch.zeros_like(y), z], dim=1), dim=1)
    return quat_rotate(turn, vec)


def quat_from_angle_axis(angle: Tensor, axis: Tensor) -> Tensor:
    """Return the quaternions (N, 4), w first, of turns by `angle` (N,) [rad] about `axis`, (3,) or (N, 3), of any length."""
    half = 0.5 * angle.unsqueeze(-1)
    return torch.cat([torch.cos(half), torch.sin(half) * normalize(axis, dim=-1)], dim=-1)


def quat_from_rotation_vector(vector: Tensor) -> Tensor:
    """Return the quaternions (..., 4), w first, of turns by the length [rad] of `vector` (..., 3) about its direction."""
    half = 0.5 * vector.norm(dim=-1, keepdim=True)
    return torch.cat([torch.cos(half), 0.5 * torch.sinc(half / torch.pi) * vector], dim=-1)


def rotation_vector(quat: Tensor) -> Tensor:
    """Return the axis of `quat` (..., 4), w first, times its angle, (..., 3). The angle is from 0 to pi [rad]."""
    quat = _w_first(quat) * torch.where(quat[..., :1] < 0.0, -1.0, 1.0)
    sine = quat[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(sine, quat[..., :1])
    return quat[..., 1:] * torch.where(sine > 1e-12, angle / sine.clamp(min=1e-12), 2.0)


def quat_conjugate(quat: Tensor) -> Tensor:
    """Return the inverse rotations (..., 4) of unit quaternions `quat` (..., 4), w first."""
    return torch.cat([_w_first(quat)[..., :1], -quat[..., 1:]], dim=-1)


def wrap_to_pi(angle: Tensor) -> Tensor:
    """Return the same angle in [-pi, pi) [rad]."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi


def uniform(low: float, high: float, shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Return independent random numbers, uniform between `low` and `high`."""
    return low + (high - low) * torch.rand(shape, device=device)


def masked_set_(target: Tensor, mask: Tensor, value: Tensor | float) -> None:
    """Write `value` into the rows of `target` (N, ...) in which `mask` (N,) is True. Unlike indexing by a mask, this does not
    wait for the GPU.

    Other rows stay bit-identical, NaN included. `value` is a number or a tensor of the shape of `target`.
    """
    rows = mask.view(-1, *[1] * (target.dim() - 1))
    if isinstance(value, Tensor):
        torch.where(rows, value, target, out=target)
    else:
        target.masked_fill_(rows, value)


def squared_difference(a: Tensor, b: Tensor) -> Tensor:
    """Return (a - b)^2 of two tensors of the same shape, computed in one kernel launch."""
    return mse_loss(a, b, reduction="none")


def evenly_spaced(indices: Sequence[int]) -> slice | None:
    """Return the slice that selects `indices` if they rise in equal steps, else None. Indexing by a slice gives a view,
    without a kernel launch.
    """
    steps = {after - before for before, after in pairwise(indices)} or {1}
    step = min(steps)
    return slice(indices[0], indices[-1] + 1, step) if indices and len(steps) == 1 and step > 0 else None
