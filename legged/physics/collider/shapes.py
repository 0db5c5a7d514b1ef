"""Warp functions that compute the geometry of contacts of simple shapes with a plane and with each other.

The results are those of C MuJoCo. mujoco-warp differs in two ways: it also keeps the corners of a box that lie above its
centre, and it aligns friction with a capsule's axis only while the capsule is closer to horizontal than to vertical.
"""

import warp as wp
from mujoco_warp._src.collision_primitive_core import capsule_capsule, mat23f
from mujoco_warp._src.math import make_frame

from legged.physics.collider import contact_pairs

POINT, END, CORNER = wp.constant(contact_pairs.POINT), wp.constant(contact_pairs.END), wp.constant(contact_pairs.CORNER)
RIM = wp.constant(contact_pairs.RIM)
FAR = wp.constant(1e6)
"""Distance that is returned for shapes that do not touch [m]."""


@wp.struct
class PlaneHit:
    """Contact of a shape's point with a plane."""

    dist: float
    """Distance [m], negative in penetration."""
    pos: wp.vec3
    """Contact point, halfway between shape and plane [m]."""
    frame: wp.mat33
    """Rows: the plane's normal and two tangents."""


@wp.func
def rim_point(normal: wp.vec3, turn: wp.mat33, radius: float, half_length: float, k: int) -> wp.vec3:
    """Return the k-th point on which a cylinder rests on a plane, relative to the cylinder's centre. Points 0 and 1 are the
    lowest points of the lower and of the upper rim. Points 2 and 3 lie on the lower rim and form a triangle with point 0.
    """
    axis = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
    if wp.dot(normal, axis) > 0.0:
        axis = -axis
    down = axis * wp.dot(normal, axis) - normal
    length = wp.length(down)
    if length < 1e-6:  # the cylinder stands upright, and all points of a rim are equally low
        down = wp.vec3(turn[0, 0], turn[1, 0], turn[2, 0])
        length = 1.0
    down = down * (radius / length)
    axis = axis * half_length
    if k == 0:
        return down + axis
    if k == 1:
        return down - axis
    sideways = wp.normalize(wp.cross(down, axis)) * (radius * 0.5 * wp.sqrt(3.0))
    return wp.where(k == 2, sideways, -sideways) + axis - 0.5 * down


@wp.func
def on_plane(
    plane: wp.vec3, normal: wp.vec3, position: wp.vec3, turn: wp.mat33, kind: int, place: wp.vec3, radius: float
) -> PlaneHit:
    """Return the contact of a shape's point (`contact_pairs.PlanePoint`) with a plane; `plane` is a point of the plane."""
    hit = PlaneHit()
    around = radius
    offset = turn * place
    if kind == RIM:
        offset = rim_point(normal, turn, place[0], place[1], wp.int32(radius))
        around = 0.0
    elif kind > RIM:
        stretched = wp.normalize(wp.cw_mul(wp.transpose(turn) * normal, place))
        offset = -(turn * wp.cw_mul(stretched, place))
    point = position + offset
    hit.dist = wp.dot(point - plane, normal) - around
    if kind == CORNER and wp.dot(normal, offset) > 0.0:
        hit.dist = FAR
    hit.pos = point - normal * (around + 0.5 * hit.dist)
    hit.frame = make_frame(normal)
    if kind == END:
        axis = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
        tangent = axis - normal * wp.dot(normal, axis)
        length = wp.length(tangent)
        if length > 1e-6:  # an upright shape has no preferred tangent
            tangent = tangent * (1.0 / length)
            hit.frame = wp.matrix_from_rows(normal, tangent, wp.cross(normal, tangent))
    return hit


@wp.func
def round_shapes(
    first: wp.vec3, first_turn: wp.mat33, first_size: wp.vec2, second: wp.vec3, second_turn: wp.mat33, second_size: wp.vec2
) -> tuple[wp.vec2, mat23f, mat23f]:
    """Return distances, positions and normals of the contacts between two capsules. A size is (radius, half length); a sphere
    is a capsule of half length 0. There are two contacts if the capsules are parallel, and one otherwise. The distance of a
    missing contact is infinite.
    """
    first_axis = wp.vec3(first_turn[0, 2], first_turn[1, 2], first_turn[2, 2])
    second_axis = wp.vec3(second_turn[0, 2], second_turn[1, 2], second_turn[2, 2])
    return capsule_capsule(
        first, first_axis, first_size[0], first_size[1], second, second_axis, second_size[0], second_size[1]
    )
