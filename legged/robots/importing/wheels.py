"""Detection of wheels. A wheel is the last link of a chain, on a hinge without limits, with shapes that are round about the
hinge's axis. Round meshes of wheels become cylinders.
"""

import re
from dataclasses import replace

import mujoco
import numpy as np

from legged.robots.importing.tree import Hinge, Shape, Tree, Vector, matrix

ROUND = 1.09
"""An outline is round if its greatest width is at most this multiple of its least width. An octagon has 1.082."""
DIRECTIONS = 32
"""Number of directions in which the width of an outline is measured."""
OFF_CENTRE = 0.05
"""Largest distance of a wheel's centre from its hinge's axis, as a share of the wheel's radius."""
TURNS = 4
"""A hinge with a range of at least this number of full turns counts as one without limits."""
WHEEL = re.compile("wheel|tyre|tire", re.IGNORECASE)
"""Pattern in the names of wheels. Balls, and cylinders across their hinge's axis, are wheels only with such a name."""


def find_wheels(tree: Tree) -> None:
    """Mark the hinges of wheels, and replace round meshes of wheels by cylinders. Welded links have to be merged before."""
    for i, link in enumerate(tree.links):
        if len(link.hinges) != 1 or tree.children(i):
            continue
        (hinge,) = link.hinges
        if hinge.range is not None and hinge.range[1] - hinge.range[0] < TURNS * 2.0 * np.pi:
            continue
        rounds = [_about(shape, hinge) if shape.collides else None for shape in link.shapes]
        radius = max((shape.size[0] for shape in rounds if shape is not None), default=0.0)
        others = [s for s, turned in zip(link.shapes, rounds, strict=True) if s.collides and turned is None]
        if radius == 0.0 or any(np.linalg.norm(_across(shape.pos, hinge)) > radius for shape in others):
            continue
        hinge.rolls, hinge.range = True, None
        for shape, turned in zip(link.shapes, rounds, strict=True):
            if turned is not None and turned.kind != shape.kind:
                tree.say("round meshes of wheels become cylinders", shape.link)
            elif turned is not None and turned is not shape:
                tree.say("guess: wheels whose cylinders lie across the hinge's axis are turned along it", shape.link)
        link.shapes = [turned or shape for shape, turned in zip(link.shapes, rounds, strict=True)]


def _across(point: Vector, hinge: Hinge) -> Vector:
    """Return the shortest vectors (..., 3) from the axis of a hinge to points (..., 3)."""
    away = point - hinge.anchor
    return away - np.multiply.outer(away @ hinge.axis, hinge.axis)


def _about(shape: Shape, hinge: Hinge) -> Shape | None:
    """Return `shape` as a round shape about the hinge's axis; None if `shape` is not round about this axis."""
    if shape.points is not None:
        return _cylinder(shape, shape.points, hinge)
    if shape.kind not in ("sphere", "cylinder", "capsule"):
        return None
    if np.linalg.norm(_across(shape.pos, hinge)) > OFF_CENTRE * shape.size[0]:
        return None
    along = abs(matrix(shape.quat)[:, 2] @ hinge.axis)
    if shape.kind != "sphere" and along > 0.999:
        return shape
    called = bool(WHEEL.search(f"{shape.link} {shape.name} {hinge.name}"))
    if shape.kind == "cylinder" and along < 0.001 and called:  # the author may have forgotten that cylinders lie along z
        return replace(shape, quat=_along(hinge))
    return shape if shape.kind == "sphere" and called else None


def _along(hinge: Hinge) -> Vector:
    """Return the orientation (4,) whose z axis is that of a hinge."""
    quat = np.zeros(4)
    mujoco.mju_quatZ2Vec(quat, hinge.axis)
    return quat


def _cylinder(shape: Shape, points: Vector, hinge: Hinge) -> Shape | None:
    """Return the cylinder about a hinge's axis that encloses points (V, 3); None if their outline is not round."""
    quat = _along(hinge)
    x, y, _ = matrix(quat).T
    angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    reach = (points - hinge.anchor) @ (np.outer(np.cos(angles), x) + np.outer(np.sin(angles), y)).T
    high, low = reach.max(axis=0), reach.min(axis=0)
    widths = high - low
    radius = widths.max() / 2.0
    if widths.max() > ROUND * widths.min() or np.abs(high + low).max() / 2.0 > OFF_CENTRE * radius:
        return None
    along = (points - hinge.anchor) @ hinge.axis
    first, last = along.min(), along.max()
    size = np.array([radius, max((last - first) / 2.0, 1e-3 * radius), 0.0])
    centre = hinge.anchor + hinge.axis * (first + last) / 2.0
    return replace(shape, kind="cylinder", size=size, pos=centre, quat=quat, fits={})
