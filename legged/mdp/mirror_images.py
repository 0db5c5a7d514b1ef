"""Mirror images of observations and actions: left and right legs are exchanged, and so are left and right directions."""

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from torch import Tensor

from legged.errors import ConfigError
from legged.mdp.observations import ObservationGroup
from legged.robots.mirror import Mirror
from legged.robots.robot import Robot

MirrorKind = Literal[
    "same",
    "vector",
    "rotation",
    "command",
    "joints",
    "angles",
    "speeds",
    "actions",
    "held",
    "passive",
    "feet",
    "heights",
    "scalar",
    "sideways",
    "vectors",
    "of_joints",
]
"""Kind of an observation, which determines its mirror image. `vector`: (x, y, z) of a velocity or direction; `rotation`: (x,
y, z) of an angular velocity; `command`: (vx, vy, yaw rate); `joints`: one number for each joint; `angles`: one for each
joint of observations.joints that is not a wheel; `speeds`: one for each joint of observations.joints; `actions`: one for each
action; `held`: one for each held joint; `passive`: one for each passive joint; `feet`: one for each foot; `heights`: the
height scan; `same`: numbers that mirroring does not change; `scalar`: one number that mirroring does not change; `sideways`:
one number that is positive to the left; `vectors`: several vectors, (x, y, z) each; `of_joints`: one number for each joint,
which mirroring moves to the other side but does not negate, or one number for all joints."""
SIGNS = {"vector": (1.0, -1.0, 1.0), "rotation": (-1.0, 1.0, -1.0), "command": (1.0, -1.0, -1.0)}
"""Kind of term -> signs of its three numbers. A rotation is a pseudo-vector, so its y component keeps its sign."""

Image = tuple[Tensor, Tensor]
"""Mirror image as (columns, signs), each (width,). The image of `x` (n, width) is x[:, columns] * signs."""


class MirrorImages:
    """Mirror images of all observation groups of a task, and of its actions."""

    def __init__(
        self,
        owner: str,
        kinds: Mapping[str, str],
        groups: Mapping[str, ObservationGroup],
        robot: Robot,
        joints: Mapping[str, Sequence[int]],
        points: Tensor,
    ) -> None:
        """Compute the image of every observation group. Actions are mirrored like the term `actions`.

        `kinds` has the `MirrorKind` of each term. `owner` is the name of the task's class, for errors. `robot` is symmetric.
        `joints` has the joints of the kinds `actions`, `angles`, `speeds` and `held`. `points` (P, 2) are the points of the
        height scan in the yaw frame [m].

        Raises:
            ConfigError: a term has no kind, has an unknown kind, or has a width that does not fit its kind.
        """
        assert robot.mirror is not None
        self._owner, self._kinds, self._mirror, self._points = owner, kinds, robot.mirror, points.cpu()
        self._joints = joints
        device = next(iter(groups.values())).buffer.device
        self.groups = {name: self._group(group) for name, group in groups.items()}
        """Group -> its image, for all steps of its history."""
        columns, signs = self._term("actions", len(joints["actions"]))
        self.actions: Image = (columns.to(device), signs.to(device))
        """Image of the actions."""

    def _group(self, group: ObservationGroup) -> Image:
        """Return the image of a group, including its history."""
        parts = []
        for term in group.terms:
            columns, signs = self._term(term.name, term.columns.stop - term.columns.start)
            parts.append((columns + term.columns.start, signs))
        columns, signs = (torch.cat(part) for part in zip(*parts, strict=True))
        steps = torch.arange(group.history).unsqueeze(1) * len(columns)
        device = group.buffer.device
        return (columns + steps).flatten().to(device), signs.repeat(group.history).to(device)

    def _term(self, name: str, width: int) -> Image:
        """Return the image of a term. Its columns are counted from the term's first column.

        Raises:
            ConfigError: the term has no kind, or its width does not fit its kind.
        """
        if name not in self._kinds:
            raise ConfigError(f"{self._owner}.MIRRORED does not say how observation '{name}' is mirrored")
        kind = self._kinds[name]
        columns, signs = self._image_of(kind, width)
        if len(columns) != width:
            wrong = f"observation '{name}' has {width} numbers, but its kind '{kind}' is for {len(columns)}"
            raise ConfigError(f"{self._owner}.MIRRORED: {wrong}")
        return columns, signs

    def _image_of(self, kind: str, width: int) -> Image:
        """Return the image of a term of this kind. Only `same`, `vectors` and `of_joints` read `width`, the term's number of
        columns; the other kinds determine this number.
        """
        if kind in SIGNS:
            return torch.arange(len(SIGNS[kind])), torch.tensor(SIGNS[kind])
        if kind == "joints":
            return torch.tensor(self._mirror.joints), torch.tensor(self._mirror.signs)
        if kind == "passive":
            return torch.tensor(self._mirror.passive, dtype=torch.long), torch.tensor(self._mirror.passive_signs)
        if kind in self._joints:
            image = mirror_of_actions(self._mirror, self._joints[kind])
            if image is None:
                setting = "control.held" if kind in ("actions", "held") else "observations.joints"
                raise ConfigError(f"{self._owner}: {setting} names joints on one side only, so {kind} have no mirror image")
            return torch.tensor(image[0]), torch.tensor(image[1])
        if kind == "sideways":
            return torch.zeros(1, dtype=torch.long), torch.tensor([-1.0])
        if kind == "vectors":
            return torch.arange(width - width % 3), torch.tensor(SIGNS["vector"]).repeat(width // 3)
        if kind == "same" or (kind == "of_joints" and width == 1):
            columns = torch.arange(width)
        elif kind == "scalar":
            columns = torch.zeros(1, dtype=torch.long)
        elif kind == "of_joints":
            columns = torch.tensor(self._mirror.joints)
        elif kind == "feet":
            columns = torch.tensor(self._mirror.feet)
        elif kind == "heights":
            columns = torch.cdist(self._points, self._points * torch.tensor([1.0, -1.0])).argmin(dim=1)
        else:
            raise ConfigError(f"{self._owner}.MIRRORED: there is no way to mirror '{kind}'")
        return columns, torch.ones(len(columns))


def mirror_of_actions(mirror: Mirror, acted: Sequence[int]) -> tuple[list[int], list[float]] | None:
    """Return for each action of the joints `acted` the index of its mirror image, and the sign of the image, as two lists.

    Return None if a joint has an action but its partner on the other side has none.
    """
    number = {joint: i for i, joint in enumerate(acted)}
    if any(mirror.joints[joint] not in number for joint in acted):
        return None
    return [number[mirror.joints[joint]] for joint in acted], [mirror.signs[joint] for joint in acted]
