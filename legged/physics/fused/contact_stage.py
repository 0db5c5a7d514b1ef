"""Contacts and all rows of constraints in one launch: a warp of threads for each world.

mujoco-warp takes some ten launches for it, and keeps the contacts of all worlds in one pool, in the order in which threads
find room there. Here each world has slots of its own in mujoco-warp's arrays of contacts, filled in the order of the shapes;
what reads them by a row's contact, or a contact's rows, finds what it knows.

First, lanes look at points of shapes on planes, at pairs of spheres and capsules, and at what the ground of cells offers;
then (contact_stage.h) they make rows of dry friction, joint limits and those contacts. Rows of equalities are
mujoco-warp's own.
"""

from collections.abc import Collection
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp._src.math import make_frame
from mujoco_warp._src.types import ConstraintType, ContactType

from legged.physics.collider import shapes, touches
from legged.physics.collider.ground import Ground, Hits
from legged.physics.collider.probes import look
from legged.physics.collider.terrain_contact import TerrainContact
from legged.physics.fused.native import LANES, native_source

SOURCE = ("contact_stage.h",)
"""Of what the native function is put together."""
Vector5 = wp.types.vector(length=5, dtype=wp.float32)
FIXED = (
    *("geom_size", "geom_margin", "geom_priority", "geom_solmix", "geom_solref", "geom_solimp", "jnt_solref", "jnt_solimp"),
    *("dof_solref", "dof_solimp", "pair_margin", "pair_friction", "pair_solref", "pair_solimp"),
)
"""Arrays of the model that are read once, in which worlds may not differ."""
FLAGS, CONES = mujoco.mjtDisableBit, mujoco.mjtCone
LIMITED = (mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)


@wp.struct
class StageArrays:
    """Tables of our own, and what the launch reads of mujoco-warp's model and data; from `equalities` on what it writes."""

    touch_geom: wp.array[wp.vec2i]
    touch_margin: wp.array[float]
    touch_dim: wp.array[int]
    touch_rough: wp.array[wp.vec2i]
    touch_friction: wp.array[Vector5]
    touch_spring: wp.array2d[float]
    touch_sliding: wp.array[float]
    dof_spring: wp.array2d[float]
    joint_spring: wp.array2d[float]
    jnt_limited: wp.array[int]
    contact_touch: wp.array[int]
    impratio_invsqrt: wp.array[float]
    geom_bodyid: wp.array[int]
    geom_friction: wp.array2d[wp.vec3]
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
"""What mujoco-warp's data calls them, where it is something else."""


@wp.struct
class Candidates:
    """What may touch, item by item: points of shapes on planes, pairs of spheres and capsules, probes of the ground."""

    point_touch: wp.array[int]
    point_kind: wp.array[int]
    point_place: wp.array[wp.vec3]
    point_radius: wp.array[float]
    pair_touch: wp.array[int]
    probe_touch: wp.array[int]
    probe_kind: wp.array[int]
    probe_start: wp.array[wp.vec3]
    probe_end: wp.array[wp.vec3]
    probe_radius: wp.array[float]
    geom_size: wp.array[wp.vec3]
    geom_xpos: wp.array2d[wp.vec3]
    geom_xmat: wp.array2d[wp.mat33]


@wp.func
def keep(
    arrays: StageArrays, slot: int, most: int, world: int, touch: int, dist: float, pos: wp.vec3, frame: wp.mat33
) -> None:
    """Put a contact into a slot of its world, if there are so many."""
    if slot < most:
        at = world * most + slot
        arrays.contact_touch[at] = touch
        arrays.contact_dist[at] = dist
        arrays.contact_pos[at] = pos
        arrays.contact_frame[at] = frame


def stage_kernel(constants: dict[str, int | bool], planes: bool, pairs: bool, ground: bool) -> Any:
    """Return the kernel for some `stage_constants`, of models of which these may touch; launched for (worlds, lanes)."""
    most = int(constants["SLOTS"])

    @wp.func_native(native_source(("deal.h",), {}))
    def deal(count: int) -> int:  # type: ignore[empty-body]
        ...

    @wp.func_native(native_source(SOURCE, constants))
    def make_rows(world: int, found: int, arrays: StageArrays) -> None: ...

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(LANES, 32))
    def contact_stage(lanes: int, arrays: StageArrays, items: Candidates, cells: Ground, hits: Hits) -> None:
        world, lane = wp.tid()  # type: ignore[misc]
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
                dealt = deal(count)
                if count > 0:
                    keep(arrays, found + (dealt & 0xFFFF), most, world, touch, hit.dist, hit.pos, hit.frame)
                found += dealt >> 16
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
                dealt = deal(count)
                slot = found + (dealt & 0xFFFF)
                if count > 0:
                    for k in range(2):
                        if dist[k] < margin:
                            keep(arrays, slot, most, world, touch, dist[k], pos[k], make_frame(normal[k]))
                            slot += 1
                found += dealt >> 16
        if wp.static(ground):
            for start in range(0, items.probe_touch.shape[0], lanes):
                item = start + lane
                touch = wp.int32(0)
                radius = wp.float32(0.0)
                row = world * items.probe_touch.shape[0] + item
                count = wp.int32(0)
                if item < items.probe_touch.shape[0]:
                    touch = items.probe_touch[item]
                    geom = arrays.touch_geom[touch][1]
                    radius = items.probe_radius[item]
                    near = radius + arrays.touch_margin[touch]
                    position, turn = items.geom_xpos[world, geom], items.geom_xmat[world, geom]
                    count = look(
                        cells,
                        items.probe_kind[item],
                        position,
                        turn,
                        items.probe_start[item],
                        items.probe_end[item],
                        near,
                        hits,
                        row,
                    )
                dealt = deal(count)
                for k in range(count):
                    up = hits.normal[row, k]
                    depth = hits.dist[row, k] - radius
                    middle = hits.point[row, k] - up * (radius + 0.5 * depth)
                    keep(arrays, found + (dealt & 0xFFFF) + k, most, world, touch, depth, middle, make_frame(up))
                found += dealt >> 16
        make_rows(world, found, arrays)

    return contact_stage


class ContactStage:
    """The collision stage and the rows of constraints of all worlds, from poses and velocities in mujoco-warp's data."""

    def __init__(
        self,
        model: mujoco.MjModel,
        m: Any,
        d: Any,
        randomized: Collection[str] = (),
        on_cells: TerrainContact | None = None,
    ) -> None:
        """Prepare the launch for mujoco-warp's `m` and `d` of a `model` of which `why_not` says nothing, in whose arrays
        `randomized` worlds differ, with the ground of cells that it stands on, if any. Call with their device as Warp's
        current one.
        """
        self._m, self._d = m, d
        flags = model.opt.disableflags
        rubs = "dof_frictionloss" in randomized or bool(np.any(model.dof_frictionloss))
        frictions = rubs and not flags & FLAGS.mjDSBL_FRICTIONLOSS
        limited = np.array(model.jnt_limited, dtype=int) * (not flags & FLAGS.mjDSBL_LIMIT)
        contacts = not flags & FLAGS.mjDSBL_CONTACT
        self._equalities = model.neq > 0 and not flags & FLAGS.mjDSBL_EQUALITY
        all_pairs = touches.pairs_of(m) if contacts else []
        pairs = [touches.touch_of(model, *pair) for pair in all_pairs]
        probes = on_cells.probes if on_cells is not None and contacts else []
        met = {probe.geom: len(pairs) + k for k, probe in enumerate({p.geom: p for p in probes}.values())}
        assert on_cells is not None or not met
        ground = -1 if on_cells is None else on_cells.terrain
        self.touches = [*pairs, *(touches.touch_of(model, ground, geom) for geom in met)]
        """Pairs of shapes that may touch."""
        on_planes = [model.geom_type[touch.geoms[0]] == touches.KINDS.mjGEOM_PLANE for touch in pairs]
        points = [
            point for k, touch in enumerate(pairs) if on_planes[k] for point in touches.plane_points(model, k, touch.geoms[1])
        ]
        round_pairs = [k for k in range(len(pairs)) if not on_planes[k]]

        self._arrays = self._stage_arrays(model, m, d)
        self._arrays.jnt_limited = wp.array(limited, dtype=int)
        self._items = self._candidates(model, d, points, round_pairs, [(met[p.geom], p) for p in probes])
        self._ground = (Ground(), Hits()) if on_cells is None else (on_cells.ground, on_cells.hits)
        dim, slots = max((touch.dim for touch in self.touches), default=1), d.naconmax // d.nworld
        self.constants = stage_constants(model, d.njmax, slots, dim, frictions, bool(limited.any()))
        """What contact_stage.h was asked for."""
        self._kernel = stage_kernel(self.constants, bool(points), bool(round_pairs), bool(probes))
        self._lanes = 1 if d.qacc.device.is_cpu else LANES

    @staticmethod
    def why_not(model: mujoco.MjModel, m: Any, randomized: Collection[str] = ()) -> str:
        """Return what of a model, and of mujoco-warp's `m` of it, has no rows here, where worlds differ in the arrays
        `randomized`; empty if nothing.
        """
        if drawn := [name for name in FIXED if name in randomized]:
            return f"{drawn[0]} differs between worlds"
        if m.is_sparse:
            return "mujoco-warp keeps Jacobians sparse"
        if model.nflex or np.any(model.tendon_limited) or np.any(model.tendon_frictionloss):
            return "the model has flexes, or tendons with limits or friction"
        if np.any(model.geom_surfacevel) or np.any(model.geom_adhesion) or np.any(model.pair_adhesion):
            return "the model has surfaces that move or stick"
        if model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
            return "the model's integrator is not Euler"
        if model.opt.disableflags & FLAGS.mjDSBL_CONSTRAINT:
            return "the model disables constraints"
        if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE:
            return "the model overrides the parameters of contacts"
        return touches.why_not(model, touches.pairs_of(m))

    def launch(self) -> None:
        """Find the contacts and make the rows, of where shapes are and how they move."""
        if self._equalities:
            opt = self._m.opt
            flags = opt.disableflags
            opt.disableflags |= FLAGS.mjDSBL_FRICTIONLOSS | FLAGS.mjDSBL_LIMIT | FLAGS.mjDSBL_CONTACT
            mjw.make_constraint(self._m, self._d)
            opt.disableflags = flags
        inputs = [self._lanes, self._arrays, self._items, *self._ground]
        wp.launch(self._kernel, dim=(self._d.nworld, self._lanes), inputs=inputs, block_dim=self._lanes)

    def _stage_arrays(self, model: mujoco.MjModel, m: Any, d: Any) -> Any:
        """Return what contact_stage.h reads and writes."""
        arrays, every = StageArrays(), self.touches
        timestep, safe = float(model.opt.timestep), touches.is_safe(model)

        def spring(solref: np.ndarray, solimp: np.ndarray) -> np.ndarray:
            return touches.spring_of(solref, solimp, timestep, safe)

        def springs(solrefs: Any, solimps: Any) -> wp.array:
            made = [spring(*pair) for pair in zip(solrefs, solimps, strict=True)]
            return wp.array(np.reshape(made, (-1, touches.SPRING)), dtype=float)

        sliding = [spring(t.solreffriction if t.solreffriction.any() else t.solref, t.solimp)[1] for t in every]
        arrays.touch_geom = wp.array([t.geoms for t in every], dtype=wp.vec2i)
        arrays.touch_margin = wp.array([t.margin for t in every], dtype=float)
        arrays.touch_dim = wp.array([t.dim for t in every], dtype=int)
        arrays.touch_rough = wp.array([t.rough for t in every], dtype=wp.vec2i)
        arrays.touch_friction = wp.array([t.friction for t in every], dtype=Vector5)
        arrays.touch_spring = springs([t.solref for t in every], [t.solimp for t in every])
        arrays.touch_sliding = wp.array(sliding, dtype=float)
        arrays.dof_spring = springs(model.dof_solref, model.dof_solimp)
        arrays.joint_spring = springs(model.jnt_solref, model.jnt_solimp)
        arrays.contact_touch = wp.zeros(d.naconmax, dtype=int)
        arrays.impratio_invsqrt = m.opt.impratio_invsqrt
        for name in StageArrays.vars:  # type: ignore[attr-defined]
            if name in ("jnt_limited", "contact_touch", "impratio_invsqrt", "dof_spring", "joint_spring"):
                continue
            if name.startswith("touch_"):
                continue
            path = NAMES.get(name, name.replace("contact_", "contact.", 1))
            owner, _, field = path.rpartition(".")
            source = getattr(d, owner) if owner else m if hasattr(m, field) else d
            setattr(arrays, name, getattr(source, field))
        return arrays

    def _candidates(self, model: mujoco.MjModel, d: Any, points: list, round_pairs: list[int], probes: list) -> Any:
        """Return what the lanes look at."""
        items = Candidates()
        items.point_touch = wp.array([p.touch for p in points], dtype=int)
        items.point_kind = wp.array([p.kind for p in points], dtype=int)
        items.point_place = wp.array([p.place for p in points], dtype=wp.vec3)
        items.point_radius = wp.array([p.radius for p in points], dtype=float)
        items.pair_touch = wp.array(round_pairs, dtype=int)
        items.probe_touch = wp.array([touch for touch, _ in probes], dtype=int)
        items.probe_kind = wp.array([p.kind for _, p in probes], dtype=int)
        items.probe_start = wp.array([p.start for _, p in probes], dtype=wp.vec3)
        items.probe_end = wp.array([p.end for _, p in probes], dtype=wp.vec3)
        items.probe_radius = wp.array([p.radius for _, p in probes], dtype=float)
        items.geom_size = wp.array(model.geom_size, dtype=wp.vec3)
        items.geom_xpos, items.geom_xmat = d.geom_xpos, d.geom_xmat
        return items


def stage_constants(
    model: mujoco.MjModel, rows: int, slots: int, dim: int, frictions: bool, limits: bool
) -> dict[str, int | bool]:
    """Return what contact_stage.h asks for, of a model with room for so many rows and contacts in each world, of at most
    `dim` directions, with dry friction and limits or without.
    """
    return {
        **{"NV": model.nv, "NJ": model.njnt, "ROWS": rows, "SLOTS": slots, "DIMS": dim},
        "PLAIN": max(1, frictions * model.nv + limits * model.njnt),
        **{"FRICTIONS": frictions, "LIMITS": limits},
        "BALLS": bool(np.any(model.jnt_type == mujoco.mjtJoint.mjJNT_BALL)),
        "EQUALITIES": model.neq > 0 and not model.opt.disableflags & FLAGS.mjDSBL_EQUALITY,
        "ELLIPTIC": model.opt.cone == CONES.mjCONE_ELLIPTIC,
        **{"BALL": int(mujoco.mjtJoint.mjJNT_BALL), "CONSTRAINT": int(ContactType.CONSTRAINT)},
        "FRICTIONLESS": int(ConstraintType.CONTACT_FRICTIONLESS),
        "FRICTIONAL": int(ConstraintType.CONTACT_ELLIPTIC),
        "NARROWPHASE": int(mjw.OverflowType.NARROWPHASE),
    }
