"""Kernel that finds contacts and makes constraint rows, with its arrays and constants."""

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp._src.math import make_frame
from mujoco_warp._src.types import ConstraintType, ContactType

from legged.physics.collider import shapes
from legged.physics.collider.contact_features import find_hits
from legged.physics.collider.ground import Ground, Hits
from legged.physics.fused.native import LANES, native_source

SOURCE = ("contact_stage.h",)
"""Source files of the native function."""
Vector5 = wp.types.vector(length=5, dtype=wp.float32)
FLAGS, CONES = mujoco.mjtDisableBit, mujoco.mjtCone


@wp.struct
class StageArrays:
    """Arrays of the kernel: its own tables, and arrays of mujoco-warp's model and data. The kernel writes `contact_touch`,
    `contact_mark`, `row_key` and all arrays after `equalities`. The kernel writes `equalities` only if there are no equality
    constraints. Arrays `touch_*` have one row for each `ContactPair`.
    """

    touch_geom: wp.array[wp.vec2i]
    touch_margin: wp.array[float]
    touch_dim: wp.array[int]
    touch_rough: wp.array[wp.vec2i]
    touch_friction: wp.array[Vector5]
    touch_spring: wp.array2d[float]
    touch_sliding: wp.array[float]
    touch_bounce: wp.array[wp.vec2]
    dof_spring: wp.array2d[float]
    joint_spring: wp.array2d[float]
    jnt_limited: wp.array[int]
    contact_touch: wp.array[int]
    contact_mark: wp.array[int]
    row_key: wp.array2d[int]
    impratio_invsqrt: wp.array[float]
    geom_bodyid: wp.array[int]
    geom_friction: wp.array2d[wp.vec3]
    geom_solref: wp.array2d[wp.vec2]
    body_rootid: wp.array[int]
    body_invweight0: wp.array2d[wp.vec2]
    body_isdofancestor: wp.array2d[int]
    jnt_type: wp.array[int]
    jnt_qposadr: wp.array[int]
    jnt_dofadr: wp.array[int]
    jnt_range: wp.array2d[wp.vec2]
    jnt_margin: wp.array2d[float]
    dof_invweight0: wp.array2d[float]
    dof_frictionloss: wp.array2d[float]
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    cdof: wp.array2d[wp.spatial_vector]
    subtree_com: wp.array2d[wp.vec3]
    equalities: wp.array[int]
    frictions: wp.array[int]
    limits: wp.array[int]
    nefc: wp.array[int]
    nacon: wp.array[int]
    overflow: wp.array[int]
    contact_dist: wp.array[float]
    contact_pos: wp.array[wp.vec3]
    contact_frame: wp.array[wp.mat33]
    contact_geom: wp.array[wp.vec2i]
    contact_dim: wp.array[int]
    contact_includemargin: wp.array[float]
    contact_friction: wp.array[Vector5]
    contact_worldid: wp.array[int]
    contact_type: wp.array[int]
    contact_adhesion: wp.array[float]
    contact_efc_address: wp.array2d[int]
    jacobian: wp.array3d[float]
    stiffness: wp.array2d[float]
    reference: wp.array2d[float]
    frictionloss: wp.array2d[float]
    row_type: wp.array2d[int]
    row_id: wp.array2d[int]


NAMES = {
    "equalities": "ne",
    "frictions": "nf",
    "limits": "nl",
    "jacobian": "efc.J",
    "stiffness": "efc.D",
    "reference": "efc.aref",
    "frictionloss": "efc.frictionloss",
    "row_type": "efc.type",
    "row_id": "efc.id",
}
"""Array -> name in mujoco-warp's data, for arrays that have another name there."""


@wp.struct
class Candidates:
    """Candidates for contacts: points of shapes above planes, pairs of spheres and capsules, and contact features above a
    height map. Arrays `*_touch` hold the index of the candidate's `ContactPair`.
    """

    point_touch: wp.array[int]
    point_kind: wp.array[int]
    point_place: wp.array[wp.vec3]
    point_radius: wp.array[float]
    pair_touch: wp.array[int]
    feature_touch: wp.array[int]
    feature_kind: wp.array[int]
    feature_start: wp.array[wp.vec3]
    feature_end: wp.array[wp.vec3]
    feature_radius: wp.array[float]
    geom_size: wp.array[wp.vec3]
    geom_xpos: wp.array2d[wp.vec3]
    geom_xmat: wp.array2d[wp.mat33]


@wp.func
def keep(
    arrays: StageArrays,
    slot: int,
    most: int,
    world: int,
    touch: int,
    mark: int,
    dist: float,
    pos: wp.vec3,
    frame: wp.mat33,
) -> None:
    """Write a contact into a slot of its world, if the slot exists. `mark` identifies the candidate that made the contact."""
    if slot < most:
        at = world * most + slot
        arrays.contact_touch[at] = touch
        arrays.contact_mark[at] = mark
        arrays.contact_dist[at] = dist
        arrays.contact_pos[at] = pos
        arrays.contact_frame[at] = frame


def stage_kernel(constants: dict[str, int | bool], planes: bool, pairs: bool, ground: bool) -> Any:
    """Return the kernel for a set of `stage_constants`; its launch dimension is (worlds, lanes). The flags tell which kinds
    of candidates a model has: points on `planes`, `pairs` of round shapes, contact features on the `ground`.
    """
    contacts_of_world = stage_function(constants, planes, pairs, ground)

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(LANES, 32))
    def contact_stage(lanes: int, arrays: StageArrays, items: Candidates, cells: Ground, hits: Hits) -> None:
        world, lane = wp.tid()  # type: ignore[misc]
        contacts_of_world(world, lane, lanes, arrays, items, cells, hits)

    return contact_stage


def stage_function(constants: dict[str, int | bool], planes: bool, pairs: bool, ground: bool) -> Any:
    """Return the kernel's device function, which all lanes of a world call."""
    most = int(constants["SLOTS"])

    @wp.func_native(native_source(("prefix_sum.h",), {}))
    def prefix_sum(count: int) -> int:  # type: ignore[empty-body]
        ...

    @wp.func_native(native_source(SOURCE, constants))
    def make_rows(world: int, found: int, arrays: StageArrays) -> None: ...

    @wp.func
    def contacts_of_world(
        world: int, lane: int, lanes: int, arrays: StageArrays, items: Candidates, cells: Ground, hits: Hits
    ) -> None:
        found = wp.int32(0)
        if wp.static(planes):
            for start in range(0, items.point_touch.shape[0], lanes):
                item = start + lane
                hit = shapes.PlaneHit()
                hit.dist = shapes.FAR
                touch = wp.int32(0)
                count = wp.int32(0)
                if item < items.point_touch.shape[0]:
                    touch = items.point_touch[item]
                    plane, geom = arrays.touch_geom[touch][0], arrays.touch_geom[touch][1]
                    facing = items.geom_xmat[world, plane]
                    hit = shapes.on_plane(
                        items.geom_xpos[world, plane],
                        wp.vec3(facing[0, 2], facing[1, 2], facing[2, 2]),
                        items.geom_xpos[world, geom],
                        items.geom_xmat[world, geom],
                        items.point_kind[item],
                        items.point_place[item],
                        items.point_radius[item],
                    )
                    if hit.dist < arrays.touch_margin[touch]:
                        count = 1
                packed = prefix_sum(count)
                if count > 0:
                    keep(arrays, found + (packed & 0xFFFF), most, world, touch, item, hit.dist, hit.pos, hit.frame)
                found += packed >> 16
        if wp.static(pairs):
            for start in range(0, items.pair_touch.shape[0], lanes):
                item = start + lane
                touch = wp.int32(0)
                count = wp.int32(0)
                dist, pos, normal = wp.vec2(shapes.FAR), shapes.mat23f(), shapes.mat23f()
                margin = wp.float32(0.0)
                if item < items.pair_touch.shape[0]:
                    touch = items.pair_touch[item]
                    first, second = arrays.touch_geom[touch][0], arrays.touch_geom[touch][1]
                    margin = arrays.touch_margin[touch]
                    one, other = items.geom_size[first], items.geom_size[second]
                    reach = one[0] + one[1] + other[0] + other[1] + margin
                    apart = items.geom_xpos[world, second] - items.geom_xpos[world, first]
                    if wp.length_sq(apart) < reach * reach:
                        dist, pos, normal = shapes.round_shapes(
                            items.geom_xpos[world, first],
                            items.geom_xmat[world, first],
                            wp.vec2(one[0], one[1]),
                            items.geom_xpos[world, second],
                            items.geom_xmat[world, second],
                            wp.vec2(other[0], other[1]),
                        )
                        for k in range(2):
                            if dist[k] < margin:
                                count += 1
                packed = prefix_sum(count)
                slot = found + (packed & 0xFFFF)
                if count > 0:
                    for k in range(2):
                        if dist[k] < margin:
                            mark = items.point_touch.shape[0] + 2 * item + k
                            keep(arrays, slot, most, world, touch, mark, dist[k], pos[k], make_frame(normal[k]))
                            slot += 1
                found += packed >> 16
        if wp.static(ground):
            for start in range(0, items.feature_touch.shape[0], lanes):
                item = start + lane
                touch = wp.int32(0)
                radius = wp.float32(0.0)
                row = world * items.feature_touch.shape[0] + item
                count = wp.int32(0)
                if item < items.feature_touch.shape[0]:
                    touch = items.feature_touch[item]
                    geom = arrays.touch_geom[touch][1]
                    radius = items.feature_radius[item]
                    near = radius + arrays.touch_margin[touch]
                    position, turn = items.geom_xpos[world, geom], items.geom_xmat[world, geom]
                    count = find_hits(
                        cells,
                        items.feature_kind[item],
                        position,
                        turn,
                        items.feature_start[item],
                        items.feature_end[item],
                        near,
                        hits,
                        row,
                    )
                packed = prefix_sum(count)
                for k in range(count):
                    up = hits.normal[row, k]
                    depth = hits.dist[row, k] - radius
                    middle = hits.point[row, k] - up * (radius + 0.5 * depth)
                    mark = items.point_touch.shape[0] + 2 * items.pair_touch.shape[0] + hits.dist.shape[1] * item + k
                    keep(arrays, found + (packed & 0xFFFF) + k, most, world, touch, mark, depth, middle, make_frame(up))
                found += packed >> 16
        make_rows(world, found, arrays)

    return contacts_of_world


def shared_bytes(constants: dict[str, int | bool]) -> int:
    """Return the size of the shared memory that contact_stage.h uses in each block [bytes]."""
    return 112 * constants["SLOTS"] + 16 * constants["PLAIN"]


def stage_constants(
    model: mujoco.MjModel,
    rows: int,
    slots: int,
    dim: int,
    frictions: bool,
    limits: bool,
    bounces: bool = False,
    dense_friction: bool = True,
) -> dict[str, int | bool]:
    """Return the constants of contact_stage.h.

    Args:
        model: MuJoCo's model.
        rows: largest number of constraint rows per world.
        slots: largest number of contacts per world.
        dim: largest number of directions in which a contact exerts force.
        frictions: True if there are rows of dry friction.
        limits: True if there are rows of joint limits.
        bounces: True if the springs of contacts differ between worlds.
        dense_friction: False if the rows of dry friction need no entries in the Jacobian.
    """
    return {
        **{"NV": model.nv, "NJ": model.njnt, "ROWS": rows, "SLOTS": slots, "DIMS": dim},
        "PLAIN": max(1, frictions * model.nv + limits * model.njnt),
        **{"FRICTIONS": frictions, "LIMITS": limits, "BOUNCES": bounces, "DENSE_FRICTION": dense_friction},
        "BALLS": bool(np.any(model.jnt_type == mujoco.mjtJoint.mjJNT_BALL)),
        "EQUALITIES": model.neq > 0 and not model.opt.disableflags & FLAGS.mjDSBL_EQUALITY,
        "ELLIPTIC": model.opt.cone == CONES.mjCONE_ELLIPTIC,
        **{"BALL": int(mujoco.mjtJoint.mjJNT_BALL), "CONSTRAINT": int(ContactType.CONSTRAINT)},
        "FRICTIONLESS": int(ConstraintType.CONTACT_FRICTIONLESS),
        "FRICTIONAL": int(ConstraintType.CONTACT_ELLIPTIC),
        "NARROWPHASE": int(mjw.OverflowType.NARROWPHASE),
    }
