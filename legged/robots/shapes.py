"""Collision shapes of a robot: the shapes of each foot, and the contact that each shape belongs to."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged.robots.patterns import match_names


@dataclass(frozen=True)
class Shapes:
    """S collision shapes in the order of the model, and B contacts. One force is computed for each contact. All shapes of a
    foot share a contact, and every other shape has its own. Contacts are in the order of their first shapes.
    """

    names: tuple[str, ...]
    """(S,) names of the shapes."""
    bodies: tuple[str, ...]
    """(S,) name of each shape's body."""
    contact: tuple[int, ...]
    """(S,) index of the contact of each shape."""
    contact_names: tuple[str, ...]
    """(B,) names of the contacts."""
    feet_shapes: tuple[tuple[str, ...], ...]
    """(F,) names of the shapes of each foot."""
    feet: tuple[int, ...]
    """(F,) index of the contact of each foot."""

    @classmethod
    def of(cls, model: mujoco.MjModel, feet: Sequence[str], where: str) -> "Shapes":
        """Return the shapes of a model. The patterns `feet` match shapes of feet. All such shapes on one body form one foot.

        Raises:
            ConfigError: a pattern matches neither shape nor body; `where` is the place of the patterns.
        """
        geoms = [model.geom(i) for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]]
        names = tuple(geom.name for geom in geoms)
        bodies = tuple(model.body(geom.bodyid[0]).name for geom in geoms)
        of_foot = set(match_shapes(feet, names, bodies, where))
        members: dict[tuple[str, int], list[int]] = {}  # the key of a foot is its body; the key of another shape is its index
        for i, body in enumerate(bodies):
            members.setdefault((body, -1) if i in of_foot else ("", i), []).append(i)
        contact = [0] * len(names)
        for row, shapes in enumerate(members.values()):
            for i in shapes:
                contact[i] = row
        return cls(
            names=names,
            bodies=bodies,
            contact=tuple(contact),
            contact_names=tuple(_common_name([names[i] for i in shapes], body) for (body, _), shapes in members.items()),
            feet_shapes=tuple(tuple(names[i] for i in shapes) for (_, i), shapes in members.items() if i < 0),
            feet=tuple(row for row, (_, i) in enumerate(members) if i < 0),
        )

    def contacts(self, patterns: Sequence[str], where: str) -> tuple[int, ...]:
        """Return the sorted indices of the contacts of all shapes that `patterns` match. Raises the error of `Shapes.of`."""
        return tuple(sorted({self.contact[i] for i in match_shapes(patterns, self.names, self.bodies, where)}))


def match_shapes(patterns: Sequence[str], names: Sequence[str], bodies: Sequence[str], where: str) -> tuple[int, ...]:
    """Return the indices, in ascending order, of the shapes that the patterns match. A pattern matches all shapes whose
    names contain it. If there is no such shape, the pattern matches all shapes of the bodies whose names contain it.

    Raises:
        ConfigError: a pattern matches no shape; `where` is the place of the patterns.
    """
    found: set[int] = set()
    for pattern in patterns:
        by_body = bool(pattern) and not any(pattern in name for name in names) and any(pattern in body for body in bodies)
        found.update(match_names([pattern], bodies if by_body else names, where))
    return tuple(sorted(found))


def self_collision_shapes(model: mujoco.MjModel, patterns: Sequence[str], where: str) -> dict[str, str]:
    """Return name -> body of the named shapes that don't collide in the model's file and that `patterns` match. Raises the
    error of `match_shapes`.
    """
    still = np.flatnonzero((model.geom_contype == 0) & (model.geom_conaffinity == 0))
    geoms = [model.geom(int(i)) for i in still if model.geom(int(i)).name]
    names, bodies = tuple(g.name for g in geoms), tuple(model.body(g.bodyid[0]).name for g in geoms)
    return {names[i]: bodies[i] for i in match_shapes(patterns, names, bodies, where)}


def _common_name(names: Sequence[str], body: str) -> str:
    """Return the name of a contact: the common beginning of its shapes' `names`, without separators at the end. If the names
    have no common beginning, the contact has the name of the `body`.
    """
    if len(names) == 1:
        return names[0]
    together = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in together).rstrip("_-. ") or body
