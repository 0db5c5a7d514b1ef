"""Poses and velocities of named bodies."""

from collections.abc import Sequence
from dataclasses import fields

import torch
from torch import Tensor
from torch.nn.functional import normalize

from legged.math import quat_multiply, quat_rotate
from legged.mdp.kernels import Kernels
from legged.mdp.sensors.sensor import Sensor
from legged.physics import Physics
from legged.physics.body_chains import BALL, FREE, HINGE, SLIDE, BodyChains


class BodyStates(Sensor):
    """Poses and velocities of B named bodies of N robots in the world frame: those of the bodies' frames in the MJCF file,
    not of their centres of mass. They follow from `physics.qpos` and `physics.qvel`, so they are the same for all engines.
    """

    def __init__(
        self, physics: Physics, names: Sequence[str], kernels: Kernels | None = None, where: str = "BodyStates"
    ) -> None:
        """Prepare to measure the bodies `names` of `physics.model`.

        Raises:
            ConfigError: the model has no such body; `where` is the beginning of the message.
        """
        self.names, self._physics, self._kernels = tuple(names), physics, kernels
        """Names of the B bodies."""
        shape, device = (physics.num_envs, len(self.names)), physics.device
        self.pos = torch.zeros(*shape, 3, device=device)
        """(N, B, 3) positions [m]."""
        self.quat = torch.zeros(*shape, 4, device=device)
        """(N, B, 4) orientations, (w, x, y, z). They are continuous in time, so w may be negative."""
        self.lin_vel = torch.zeros(*shape, 3, device=device)
        """(N, B, 3) velocities of the origins of the bodies' frames [m/s]."""
        self.ang_vel = torch.zeros(*shape, 3, device=device)
        """(N, B, 3) angular velocities [rad/s]."""
        chains = BodyChains.of(physics.model, self.names, where)
        self._chains = {
            field.name: torch.as_tensor(
                values := getattr(chains, field.name),
                dtype=torch.float32 if values.dtype.kind == "f" else torch.int32,
                device=device,
            ).contiguous()
            for field in fields(chains)
        }
        self._levels = [{name: values[level] for name, values in self._chains.items()} for level in range(len(chains.kind))]
        self._kinds = [set(kinds.tolist()) for kinds in chains.kind]

    def update(self) -> None:
        qpos, qvel, of = self._physics.qpos, self._physics.qvel, self._chains
        if self._kernels is not None:
            links = (of["body_pos"], of["axis"], of["anchor"])
            rest = (of["body_quat"], of["kind"], of["position"], of["speed"], of["reference"], qpos, qvel)
            written = (self.pos, self.lin_vel, self.ang_vel)
            self._kernels.launch("read_bodies", tuple(self.pos.shape[:2]), *written, *links, self.quat, *rest)
            return
        pos, lin_vel, ang_vel = (torch.zeros_like(self.pos) for _ in range(3))
        quat = torch.zeros_like(self.quat)
        quat[..., 0] = 1.0
        for kinds, level in zip(self._kinds, self._levels, strict=True):
            arm = quat_rotate(quat, level["body_pos"].expand_as(pos))
            pos, lin_vel = pos + arm, lin_vel + torch.linalg.cross(ang_vel, arm)
            quat = quat_multiply(quat, level["body_quat"].expand_as(quat))
            at, rate = level["position"], level["speed"]
            has = {kind: (level["kind"] == kind).unsqueeze(1) for kind in kinds}
            along = quat_rotate(quat, level["axis"].expand_as(pos))
            moved, speed = (qpos[:, at] - level["reference"]).unsqueeze(2), qvel[:, rate].unsqueeze(2)
            if SLIDE in kinds:
                path = has[SLIDE] * moved * along
                pos = pos + path
                lin_vel = lin_vel + torch.linalg.cross(ang_vel, path) + has[SLIDE] * speed * along
            arm = quat_rotate(quat, level["anchor"].expand_as(pos))
            pos, lin_vel = pos + arm, lin_vel + torch.linalg.cross(ang_vel, arm)
            if HINGE in kinds:
                half = 0.5 * has[HINGE] * moved
                turn = torch.cat([torch.cos(half), torch.sin(half) * level["axis"]], dim=2)
                quat, ang_vel = quat_multiply(quat, turn), ang_vel + has[HINGE] * speed * along
            if BALL in kinds:
                turned = quat_multiply(quat, normalize(_columns(qpos, at, 4), dim=2))
                quat = torch.where(has[BALL], turned, quat)
                ang_vel = ang_vel + has[BALL] * quat_rotate(quat, _columns(qvel, rate, 3))
            arm = quat_rotate(quat, level["anchor"].expand_as(pos))
            pos, lin_vel = pos - arm, lin_vel - torch.linalg.cross(ang_vel, arm)
            if FREE in kinds:
                quat = torch.where(has[FREE], normalize(_columns(qpos, at + 3, 4), dim=2), quat)
                pos = torch.where(has[FREE], _columns(qpos, at, 3), pos)
                lin_vel = torch.where(has[FREE], _columns(qvel, rate, 3), lin_vel)
                ang_vel = torch.where(has[FREE], quat_rotate(quat, _columns(qvel, rate + 3, 3)), ang_vel)
        self.pos.copy_(pos)
        self.quat.copy_(quat)
        self.lin_vel.copy_(lin_vel)
        self.ang_vel.copy_(ang_vel)


def _columns(coordinates: Tensor, first: Tensor, count: int) -> Tensor:
    """Return `count` columns of `coordinates` (N, K) from each of `first` (B,) on, (N, B, count). Columns beyond the last one
    repeat it.
    """
    places = first.unsqueeze(1) + torch.arange(count, device=first.device)
    return coordinates[:, places.clamp(max=coordinates.shape[1] - 1)]
