"""Contacts and all constraint rows in one launch. One warp of threads computes each world.

mujoco-warp needs about ten launches, and keeps the contacts of all worlds in one pool, in the order in which threads append
them. Here each world has its own slots in mujoco-warp's contact arrays. Slots are filled in the order of the shapes. Indices
from rows to contacts and from contacts to rows stay valid, so code that reads these arrays works unchanged.

The lanes first test points of shapes against planes, pairs of spheres and capsules, and contact features against the height
map. Then they make the rows of dry friction, joint limits and contacts (contact_stage.h). mujoco-warp makes the rows of
equality constraints.
"""

from collections.abc import Collection
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from legged.physics.collider import contact_pairs
from legged.physics.collider.ground import Ground, Hits
from legged.physics.collider.terrain_contact import TerrainContact
from legged.physics.fused.active_set import ActiveSet
from legged.physics.fused.contact_kernel import (
    NAMES,
    Candidates,
    StageArrays,
    Vector5,
    shared_bytes,
    stage_constants,
    stage_kernel,
)
from legged.physics.fused.native import SHARED_BYTES, lanes_of

FIXED = (
    *("geom_size", "geom_margin", "geom_priority", "geom_solmix", "geom_solimp", "jnt_solref", "jnt_solimp"),
    *("dof_solref", "dof_solimp", "pair_margin", "pair_friction", "pair_solref", "pair_solimp"),
)
"""Model arrays that are read once at construction, so they must not differ between worlds."""
OWN_ARRAYS = ("jnt_limited", "contact_touch", "contact_mark", "row_key", "impratio_invsqrt", "dof_spring", "joint_spring")
"""Arrays of the kernel, apart from `touch_*`, that are not taken by name from mujoco-warp's model or data."""
FLAGS = mujoco.mjtDisableBit


class ContactStage:
    """Finds contacts and makes constraint rows in all worlds, from poses and velocities in mujoco-warp's data."""

    def __init__(
        self,
        model: mujoco.MjModel,
        m: Any,
        d: Any,
        randomized: Collection[str] = (),
        on_cells: TerrainContact | None = None,
    ) -> None:
        """Prepare the launch for a `model` that `why_not` accepts; `m` and `d` are mujoco-warp's model and data for it.
        `randomized` names the arrays in which worlds differ. `on_cells` is the height-map collider, if there is a height map.
        Warp's current device must be that of `m` and `d`.
        """
        self._m, self._d = m, d
        flags = model.opt.disableflags
        rubs = "dof_frictionloss" in randomized or bool(np.any(model.dof_frictionloss))
        frictions = rubs and not flags & FLAGS.mjDSBL_FRICTIONLOSS
        limited = np.array(model.jnt_limited, dtype=int) * (not flags & FLAGS.mjDSBL_LIMIT)
        contacts = not flags & FLAGS.mjDSBL_CONTACT
        self.equalities = model.neq > 0 and not flags & FLAGS.mjDSBL_EQUALITY
        all_pairs = contact_pairs.pairs_of(m) if contacts else []
        pairs = [contact_pairs.contact_pair(model, *pair) for pair in all_pairs]
        features = on_cells.features if on_cells is not None and contacts else []
        met = {feature.geom: len(pairs) + k for k, feature in enumerate({p.geom: p for p in features}.values())}
        assert on_cells is not None or not met
        ground = -1 if on_cells is None else on_cells.terrain
        self.contact_pairs = [*pairs, *(contact_pairs.contact_pair(model, ground, geom) for geom in met)]
        """Pairs of shapes that may touch."""
        on_planes = [model.geom_type[touch.geoms[0]] == contact_pairs.KINDS.mjGEOM_PLANE for touch in pairs]
        points = [
            point
            for k, touch in enumerate(pairs)
            if on_planes[k]
            for point in contact_pairs.plane_points(model, k, touch.geoms[1])
        ]
        round_pairs = [k for k in range(len(pairs)) if not on_planes[k]]

        self.active_set = ActiveSet.of(d)
        """Keys of the rows, and the states of the last step's rows. The solver finds a row's last state by the row's key."""
        self._arrays = self._stage_arrays(model, m, d)
        self._arrays.jnt_limited = wp.array(limited, dtype=int)
        items = self._candidates(model, d, points, round_pairs, [(met[p.geom], p) for p in features])
        ground_of = (Ground(), Hits()) if on_cells is None else (on_cells.ground, on_cells.hits)
        self.inputs = [self._arrays, items, *ground_of]
        """Arguments of the launch after the number of lanes."""
        dim, slots = max((touch.dim for touch in self.contact_pairs), default=1), d.naconmax // d.nworld
        bounces, dense_friction = "geom_solref" in randomized, d.qacc.device.is_cpu or model.ntendon > 0
        self.constants = stage_constants(model, d.njmax, slots, dim, frictions, bool(limited.any()), bounces, dense_friction)
        """Constants of contact_stage.h."""
        self.kinds = bool(points), bool(round_pairs), bool(features)
        """Flags for the kinds of candidates that the model has, as `stage_kernel` takes them."""
        self._kernel = stage_kernel(self.constants, *self.kinds)
        self._lanes = lanes_of(d.qacc.device)

    @staticmethod
    def why_not(model: mujoco.MjModel, m: Any, d: Any, randomized: Collection[str] = ()) -> str:
        """Return the reason why a `model` that `ConstraintSolver` supports is not supported here, or an empty text. `m` and
        `d` are mujoco-warp's model and data for it; `randomized` names the arrays in which worlds differ.
        """
        if drawn := [name for name in FIXED if name in randomized]:
            return f"{drawn[0]} differs between worlds"
        if "geom_solref" in randomized and not contact_pairs.alike_springs(model, contact_pairs.pairs_of(m)):
            return "restitution differs between worlds, and shapes that may touch have different solref"
        if model.nflex or np.any(model.tendon_limited) or np.any(model.tendon_frictionloss):
            return "the model has flexes, or tendons with limits or friction"
        if np.any(model.geom_surfacevel) or np.any(model.geom_adhesion) or np.any(model.pair_adhesion):
            return "the model has surface velocities or adhesion"
        if model.opt.disableflags & FLAGS.mjDSBL_CONSTRAINT:
            return "the model disables constraints"
        if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE:
            return "the model overrides contact parameters"
        slots = d.naconmax // d.nworld
        if shared_bytes(stage_constants(model, d.njmax, slots, dim=6, frictions=True, limits=True)) > SHARED_BYTES:
            return f"{slots} contacts per world (sim.nconmax) exceed a GPU's shared memory"
        return contact_pairs.why_not(model, contact_pairs.pairs_of(m))

    def launch(self) -> None:
        """Find the contacts and make the constraint rows, for the current poses and velocities."""
        if self.equalities:
            self.launch_equalities()
        inputs = [self._lanes, *self.inputs]
        wp.launch(self._kernel, dim=(self._d.nworld, self._lanes), inputs=inputs, block_dim=self._lanes)

    def launch_equalities(self) -> None:
        """Make the rows of equality constraints, which precede all others."""
        opt = self._m.opt
        flags = opt.disableflags
        opt.disableflags |= FLAGS.mjDSBL_FRICTIONLOSS | FLAGS.mjDSBL_LIMIT | FLAGS.mjDSBL_CONTACT
        mjw.make_constraint(self._m, self._d)
        opt.disableflags = flags

    def _stage_arrays(self, model: mujoco.MjModel, m: Any, d: Any) -> Any:
        arrays, every = StageArrays(), self.contact_pairs
        timestep, safe = float(model.opt.timestep), contact_pairs.is_safe(model)

        def spring(solref: np.ndarray, solimp: np.ndarray) -> np.ndarray:
            return contact_pairs.spring_of(solref, solimp, timestep, safe)

        def springs(solrefs: Any, solimps: Any) -> wp.array:
            made = [spring(*pair) for pair in zip(solrefs, solimps, strict=True)]
            return wp.array(np.reshape(made, (-1, contact_pairs.SPRING)), dtype=float)

        own = [t.solreffriction.any() and not contact_pairs.is_mixed(t.solreffriction) for t in every]
        sliding = [spring(t.solreffriction if has else t.solref, t.solimp)[1] for t, has in zip(every, own, strict=True)]
        arrays.touch_geom = wp.array([t.geoms for t in every], dtype=wp.vec2i)
        arrays.touch_margin = wp.array([t.margin for t in every], dtype=float)
        arrays.touch_dim = wp.array([t.dim for t in every], dtype=int)
        arrays.touch_rough = wp.array([t.rough for t in every], dtype=wp.vec2i)
        arrays.touch_friction = wp.array([t.friction for t in every], dtype=Vector5)
        arrays.touch_spring = springs([t.solref for t in every], [t.solimp for t in every])
        arrays.touch_sliding = wp.array(sliding, dtype=float)
        bounces = [
            (2.0 * timestep * safe, float(np.clip(t.solimp[1], contact_pairs.LEAST, contact_pairs.GREATEST))) for t in every
        ]
        arrays.touch_bounce = wp.array(bounces, dtype=wp.vec2)
        arrays.dof_spring = springs(model.dof_solref, model.dof_solimp)
        arrays.joint_spring = springs(model.jnt_solref, model.jnt_solimp)
        arrays.contact_touch, arrays.contact_mark = wp.zeros(d.naconmax, dtype=int), wp.zeros(d.naconmax, dtype=int)
        arrays.row_key = self.active_set.key
        arrays.impratio_invsqrt = m.opt.impratio_invsqrt
        for name in StageArrays.vars:  # type: ignore[attr-defined]
            if name in OWN_ARRAYS or name.startswith("touch_"):
                continue
            path = NAMES.get(name, name.replace("contact_", "contact.", 1))
            owner, _, field = path.rpartition(".")
            source = getattr(d, owner) if owner else m if hasattr(m, field) else d
            setattr(arrays, name, getattr(source, field))
        return arrays

    def _candidates(self, model: mujoco.MjModel, d: Any, points: list, round_pairs: list[int], features: list) -> Any:
        items = Candidates()
        items.point_touch = wp.array([p.touch for p in points], dtype=int)
        items.point_kind = wp.array([p.kind for p in points], dtype=int)
        items.point_place = wp.array([p.place for p in points], dtype=wp.vec3)
        items.point_radius = wp.array([p.radius for p in points], dtype=float)
        items.pair_touch = wp.array(round_pairs, dtype=int)
        items.feature_touch = wp.array([touch for touch, _ in features], dtype=int)
        items.feature_kind = wp.array([p.kind for _, p in features], dtype=int)
        items.feature_start = wp.array([p.start for _, p in features], dtype=wp.vec3)
        items.feature_end = wp.array([p.end for _, p in features], dtype=wp.vec3)
        items.feature_radius = wp.array([p.radius for _, p in features], dtype=float)
        items.geom_size = wp.array(model.geom_size, dtype=wp.vec3)
        items.geom_xpos, items.geom_xmat = d.geom_xpos, d.geom_xmat
        return items
