"""Contact features: the parts of shapes that are tested against a height map. Features are points with a radius, segments of
capsules, and rim points and end discs of cylinders.

A sphere has one point. A capsule has its two ends and the segment between them. A box has its corners. A cylinder touches a
surface with four points of its rims: those on which it would rest on a plane with the slope of the ground under the
cylinder's centre. The cylinder touches vertical faces and their rims with the discs at its ends and, like a capsule, with the
segment between the ends.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np
import warp as wp

from legged.errors import ConfigError
from legged.physics.collider.contact_pairs import kind_of
from legged.physics.collider.ground import NOTHING, Ground, Hits, around_point, between_ends, cell_of, surface
from legged.physics.collider.shapes import rim_point

AT, BETWEEN, RIM, DISC = (wp.constant(k) for k in range(4))
"""Kinds of features. AT: a sphere at `start`. BETWEEN: the segment between `start` and `end`, without its ends. RIM: the
`end[0]`-th rim point of a cylinder of radius `start[0]` and half length `start[1]`. DISC: a disc at `start` of radius
`end[0]`, perpendicular to the shape's z axis."""

LENGTHWISE = wp.constant(0.1)
"""A rim of the terrain can touch the end discs of a cylinder only if the cosine of the angle between the rim and the
cylinder's axis is larger than this."""


@dataclass(frozen=True)
class ContactFeature:
    """Contact feature of a geom. `start` and `end` are given in the geom's frame [m]; their meaning depends on `kind`."""

    geom: int
    kind: int
    start: np.ndarray
    end: np.ndarray
    radius: float
    """Radius around the feature [m]; 0 for corners, rim points and discs."""

    @property
    def reach(self) -> float:
        """Largest distance from the feature's point, segment or disc centre to ground that the feature can touch [m]."""
        return float(self.end[0]) if self.kind == DISC else self.radius

    @property
    def length(self) -> float:
        """Distance between the ends [m]; 0 for points and discs."""
        return float(np.linalg.norm(self.end - self.start)) if self.kind == BETWEEN else 0.0


def contact_features(model: mujoco.MjModel, shapes: Iterable[int]) -> Iterator[ContactFeature]:
    """Yield the contact features of the geoms `shapes`.

    Raises:
        ConfigError: a shape is of a type without contact features.
    """
    kinds = mujoco.mjtGeom
    for i in shapes:
        kind, size = model.geom_type[i], model.geom_size[i]
        centre, end = np.zeros(3), np.array([0.0, 0.0, size[1]])
        if kind == kinds.mjGEOM_SPHERE:
            yield ContactFeature(i, AT, centre, centre, size[0])
        elif kind == kinds.mjGEOM_CAPSULE:
            yield ContactFeature(i, AT, -end, -end, size[0])
            yield ContactFeature(i, AT, end, end, size[0])
            yield ContactFeature(i, BETWEEN, -end, end, size[0])
        elif kind == kinds.mjGEOM_BOX:
            for signs in product((-1.0, 1.0), repeat=3):
                yield ContactFeature(i, AT, size * signs, size * signs, 0.0)
        elif kind == kinds.mjGEOM_CYLINDER:
            for k in range(4):
                yield ContactFeature(i, RIM, np.array([size[0], size[1], 0.0]), np.array([float(k), 0.0, 0.0]), 0.0)
            for centre in (-end, end):
                yield ContactFeature(i, DISC, centre, np.array([size[0], 0.0, 0.0]), 0.0)
            yield ContactFeature(i, BETWEEN, -end, end, size[0])
        else:
            raise ConfigError(
                f"terrain: shape '{model.geom(i).name}' is of type {kind_of(model, i)}; sim.terrain_collider=cells"
                " supports only spheres, capsules, cylinders and boxes; use one of these types, or set"
                " sim.terrain_collider=convex or sim.physics=mujoco"
            )


@wp.func
def around_disc(ground: Ground, centre: wp.vec3, axis: wp.vec3, radius: float, margin: float, hits: Hits, row: int) -> int:
    """Find a thin disc's possible contacts with vertical faces and rims. Write them to row `row`, and return their number."""
    found = around_point(ground, centre, radius + margin, True, hits, row)
    count = wp.int32(0)
    for k in range(found):
        normal = hits.normal[row, k]
        across = normal - axis * wp.dot(normal, axis)
        wide = wp.length(across)
        point = centre
        if wide > 1e-6:
            point = centre - across * (radius / wide)
        dist = hits.dist[row, k] - radius * wide
        if normal[2] > 0.0 and (normal[0] == 0.0 or normal[1] == 0.0):
            # The contact is with a rim along x or y. Find the point in which the rim passes through the disc's plane.
            along = wp.where(normal[0] == 0.0, axis[0], axis[1])
            to = -normal * hits.dist[row, k]
            shift = -wp.dot(to, axis) / along
            if normal[0] == 0.0:
                to[0] = to[0] + shift
            else:
                to[1] = to[1] + shift
            away = wp.length(to)
            dist = NOTHING
            # A rim that is nearly perpendicular to the cylinder's axis cannot touch the disc, only the part between the ends.
            if wp.abs(along) > LENGTHWISE and away > 1e-6:
                normal = -to / away
                point = centre - normal * radius
                dist = away - radius
        if dist < margin:
            hits.dist[row, count] = dist
            hits.normal[row, count] = normal
            hits.point[row, count] = point
            count += 1
    return count


@wp.func
def find_hits(
    ground: Ground,
    kind: int,
    position: wp.vec3,
    turn: wp.mat33,
    start: wp.vec3,
    end: wp.vec3,
    near: float,
    hits: Hits,
    row: int,
) -> int:
    """Find the possible contacts of a geom's feature with ground within `near` [m] of it (feature radius + contact margin).
    Write the contacts to row `row` of `hits`, and return their number. The radius is not subtracted from distances.
    """
    if kind == BETWEEN:
        return between_ends(ground, position + turn * start, position + turn * end, near, hits, row)
    if kind == RIM:
        cell = cell_of(ground, position[0], position[1])
        slope = surface(ground, cell[0], cell[1], position[0], position[1])
        up = wp.normalize(wp.vec3(-slope[1], -slope[2], 1.0))
        offset = rim_point(up, turn, start[0], start[1], wp.int32(end[0]))
        return around_point(ground, position + offset, near, False, hits, row)
    if kind == DISC:
        axis = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
        return around_disc(ground, position + turn * start, axis, end[0], near, hits, row)
    return around_point(ground, position + turn * start, near, False, hits, row)
