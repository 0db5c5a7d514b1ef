"""A robot's collision shapes: which of them are a foot, and which contact force each adds to."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco

from legged.robots.patterns import match_names


@dataclass(frozen=True)
class Shapes:
    """S collision shapes in the order of the model, and B contacts that their forces are added to: a foot's shapes have one
    together, every other shape has its own. Contacts are in the order of their first shapes.
    """

    names: tuple[str, ...]
    """(S,)"""
    bodies: tuple[str, ...]
    """(S,) the body of each."""
    contact: tuple[int, ...]
    """(S,) the contact of each."""
    contact_names: tuple[str, ...]
    """(B,)"""
    feet_shapes: tuple[tuple[str, ...], ...]
    """(F,) the shapes of each foot."""
    feet: tuple[int, ...]
    """(F,) the contact of each foot."""

    @classmethod
    def of(cls, model: mujoco.MjModel, feet: Sequence[str], where: str) -> "Shapes":
        """Return those of a model whose feet are named by the patterns `feet`; shapes of one body are one foot.

        Raises:
            ConfigError: a pattern matches neither shape nor body; `where` says whose it is.
        """
        geoms = [model.geom(i) for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]]
        names = tuple(geom.name for geom in geoms)
        bodies = tuple(model.body(geom.bodyid[0]).name for geom in geoms)
        of_foot = set(match_shapes(feet, names, bodies, where))
        members: dict[tuple[str, int], list[int]] = {}  # a foot by its body, any other shape by itself
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
        """Return the contacts that the shapes of those patterns belong to, each once. Raises as `of`."""
        return tuple(sorted({self.contact[i] for i in match_shapes(patterns, self.names, self.bodies, where)}))


def match_shapes(patterns: Sequence[str], names: Sequence[str], bodies: Sequence[str], where: str) -> tuple[int, ...]:
    """Return the indices of the shapes that any of the patterns names, in their order: those whose names contain it, or where
    no shape's does, all shapes of the bodies whose names contain it.

    Raises:
        ConfigError: a pattern is in no name; `where` says whose it is.
    """
    found: set[int] = set()
    for pattern in patterns:
        by_body = bool(pattern) and not any(pattern in name for name in names) and any(pattern in body for body in bodies)
        found.update(match_names([pattern], bodies if by_body else names, where))
    return tuple(sorted(found))


def _common_name(names: Sequence[str], body: str) -> str:
    """Return what several shapes of a body are called: how all their names begin, without separators; else as the body."""
    if len(names) == 1:
        return names[0]
    together = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in together).rstrip("_-. ") or body
