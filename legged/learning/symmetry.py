"""Samples seen in a mirror: left legs for right ones, leftward for rightward (Mittal et al., arXiv 2403.04359)."""

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.envs import LeggedRobot
from legged.errors import ConfigError

SIGNS = {"vector": (1.0, -1.0, 1.0), "rotation": (-1.0, 1.0, -1.0), "command": (1.0, -1.0, -1.0)}
"""Kind of term -> signs of its three numbers. A rotation is a pseudo-vector: it keeps its y."""


class MirrorImages:
    """Columns and signs under which observations and actions of a task turn into those of its mirrored robot."""

    def __init__(self, task: LeggedRobot) -> None:
        """The configuration is checked already: the robot has a mirror, and so has every term, of a known kind.

        Raises:
            ConfigError: a term is not as wide as its kind in `MIRRORED` says.
        """
        assert task.robot.mirror is not None
        self._task, self._robot = task, task.robot.mirror
        self.groups = {name: self._group(name) for name in task.observation_groups}
        """Group -> (columns, signs), each (width,)."""
        self.actions = self._term("actions", task.num_actions, 0)
        """(columns, signs) of the actions, each (D,)."""

    def _group(self, name: str) -> tuple[Tensor, Tensor]:
        """Of a group, with its history."""
        group = self._task.observation_groups[name]
        parts = [self._term(term.name, term.columns.stop - term.columns.start, term.columns.start) for term in group.terms]
        columns, signs = (torch.cat(part) for part in zip(*parts, strict=True))
        steps = torch.arange(group.history, device=columns.device).unsqueeze(1) * len(columns)
        return (columns + steps).flatten(), signs.repeat(group.history)

    def _term(self, name: str, width: int, start: int) -> tuple[Tensor, Tensor]:
        """Of a term that lies at the columns from `start` on."""
        device = self._task.device
        kind = self._task.MIRRORED[name]
        columns, signs = self._images_of(kind, width)
        if len(columns) != width:
            task = type(self._task).__name__
            raise ConfigError(
                f"{task}.MIRRORED: observation '{name}' has {width} numbers, but its kind '{kind}' is for {len(columns)}"
            )
        return (columns + start).to(device), signs.to(device)

    def _images_of(self, kind: str, width: int) -> tuple[Tensor, Tensor]:
        """Columns and signs of a kind of term, of as many numbers as the kind has; `same` takes any `width`."""
        if kind in SIGNS:
            return torch.arange(len(SIGNS[kind])), torch.tensor(SIGNS[kind])
        if kind == "joints":
            return torch.tensor(self._robot.joints), torch.tensor(self._robot.signs)
        if kind == "same":
            columns = torch.arange(width)
        elif kind == "feet":
            columns = torch.tensor(self._robot.feet)
        elif kind == "heights":
            points = self._task.height_scan.points.cpu()
            columns = torch.cdist(points, points * torch.tensor([1.0, -1.0])).argmin(dim=1)
        else:
            raise ValueError(f"there is no way to mirror '{kind}'")
        return columns, torch.ones(len(columns))


def augment(env: LeggedRobot, obs: TensorDict | None, actions: Tensor | None) -> tuple[TensorDict | None, Tensor | None]:
    """A batch and, after it, its mirror image: (n, ...) -> (2 n, ...), as rsl-rl's symmetry extension asks for."""
    images: MirrorImages = env.mirror_images  # type: ignore[attr-defined]
    seen = done = None
    if obs is not None:
        both = {name: torch.cat([obs[name], obs[name][:, c] * s]) for name, (c, s) in images.groups.items()}
        seen = TensorDict(both, batch_size=[2 * obs.batch_size[0]], device=obs.device)
    if actions is not None:
        columns, signs = images.actions
        done = torch.cat([actions, actions[:, columns] * signs])
    return seen, done
