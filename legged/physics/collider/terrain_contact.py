"""Contacts of simple shapes with a height map. One Warp kernel finds them, after mujoco-warp's own collision detection.

mujoco-warp itself tests shapes against the triangular prisms of a height field with a general convex solver (GJK). That takes
ten times as long, and vertical faces become ramps one cell wide. Here a contact needs only a few look-ups (ground.py).

Conventions: the normal points from the terrain (first geom) to the robot's shape; `dist` is negative in penetration; the
contact point lies halfway between the two surfaces, as in MuJoCo. The directions of friction depend on the normal alone. For
a capsule on a plane, MuJoCo instead aligns one direction with the capsule's axis; the friction cone is the same.
"""

from collections.abc import Iterable
from typing import Any

import mujoco
import warp as wp
from mujoco_warp._src.collision_core import contact_margin_gap, contact_material_params, write_contact
from mujoco_warp._src.math import make_frame
from mujoco_warp._src.types import vec5

from legged.physics.collider.contact_features import contact_features, find_hits
from legged.physics.collider.ground import Ground, Hits, ground_of, room_for_hits
from legged.terrain import HeightMap

MODEL_FIELDS = (
    "geom_condim",
    "geom_priority",
    "geom_solmix",
    "geom_solref",
    "geom_solimp",
    "geom_friction",
    "geom_margin",
    "geom_gap",
    "geom_adhesion",
    "pair_dim",
    "pair_solref",
    "pair_solreffriction",
    "pair_solimp",
    "pair_margin",
    "pair_gap",
    "pair_adhesion",
    "pair_friction",
)
"""Arrays of mujoco-warp's model, in the order of the kernel's arguments."""
CONTACT_FIELDS = (
    "dist",
    "pos",
    "frame",
    "includemargin",
    "friction",
    "solref",
    "solreffriction",
    "solimp",
    "dim",
    "geom",
    "efc_address",
    "worldid",
    "type",
    "geomcollisionid",
    "adhesion",
)
"""Arrays of mujoco-warp's contacts, in the order of the kernel's arguments."""


@wp.kernel
def touch_ground(
    ground: Ground,
    hits: Hits,
    terrain: int,
    feature_geom: wp.array[int],
    feature_kind: wp.array[int],
    feature_start: wp.array[wp.vec3],
    feature_end: wp.array[wp.vec3],
    feature_radius: wp.array[float],
    geom_condim: wp.array[int],
    geom_priority: wp.array[int],
    geom_solmix: wp.array2d[float],
    geom_solref: wp.array2d[wp.vec2],
    geom_solimp: wp.array2d[vec5],
    geom_friction: wp.array2d[wp.vec3],
    geom_margin: wp.array2d[float],
    geom_gap: wp.array2d[float],
    geom_adhesion: wp.array2d[float],
    pair_dim: wp.array[int],
    pair_solref: wp.array2d[wp.vec2],
    pair_solreffriction: wp.array2d[wp.vec2],
    pair_solimp: wp.array2d[vec5],
    pair_margin: wp.array2d[float],
    pair_gap: wp.array2d[float],
    pair_adhesion: wp.array2d[float],
    pair_friction: wp.array2d[vec5],
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
    naconmax: int,
    contact_dist: wp.array[float],
    contact_pos: wp.array[wp.vec3],
    contact_frame: wp.array[wp.mat33],
    contact_includemargin: wp.array[float],
    contact_friction: wp.array[vec5],
    contact_solref: wp.array[wp.vec2],
    contact_solreffriction: wp.array[wp.vec2],
    contact_solimp: wp.array[vec5],
    contact_dim: wp.array[int],
    contact_geom: wp.array[wp.vec2i],
    contact_efc_address: wp.array2d[int],
    contact_worldid: wp.array[int],
    contact_type: wp.array[int],
    contact_geomcollisionid: wp.array[int],
    contact_adhesion: wp.array[float],
    nacon: wp.array[int],
):
    """Find up to MOST contacts of a feature, and append them to mujoco-warp's contacts. One thread per world and feature."""
    world, feature = wp.tid()
    geom = feature_geom[feature]
    radius = feature_radius[feature]
    geoms = wp.vec2i(terrain, geom)
    margin, gap = contact_margin_gap(geom_margin, geom_gap, pair_margin, pair_gap, geoms, -1, world)
    near = radius + margin + gap
    position, turn = geom_xpos[world, geom], geom_xmat[world, geom]
    row = world * feature_geom.shape[0] + feature
    count = find_hits(
        ground, feature_kind[feature], position, turn, feature_start[feature], feature_end[feature], near, hits, row
    )
    if count == 0:
        return
    condim, friction, solref, solreffriction, solimp, adhesion = contact_material_params(
        geom_condim,
        geom_priority,
        geom_solmix,
        geom_solref,
        geom_solimp,
        geom_friction,
        geom_adhesion,
        pair_dim,
        pair_solref,
        pair_solreffriction,
        pair_solimp,
        pair_adhesion,
        pair_friction,
        geoms,
        -1,
        world,
    )
    for k in range(count):
        normal = hits.normal[row, k]
        point = hits.point[row, k]
        dist = hits.dist[row, k] - radius
        write_contact(
            naconmax,
            k,
            dist,
            point - normal * (radius + 0.5 * dist),
            make_frame(normal),
            margin,
            gap,
            condim,
            friction,
            solref,
            solreffriction,
            solimp,
            adhesion,
            geoms,
            wp.vec2i(-1, -1),
            world,
            contact_dist,
            contact_pos,
            contact_frame,
            contact_includemargin,
            contact_friction,
            contact_solref,
            contact_solreffriction,
            contact_solimp,
            contact_dim,
            contact_geom,
            contact_efc_address,
            contact_worldid,
            contact_type,
            contact_geomcollisionid,
            contact_adhesion,
            nacon,
        )


class TerrainContact:
    """Appends the contacts with a height map to mujoco-warp's contacts, at the end of its collision stage."""

    def __init__(
        self, m: Any, d: Any, model: mujoco.MjModel, terrain: int, height_map: HeightMap, shapes: Iterable[int]
    ) -> None:
        """Register the collider with mujoco-warp's model `m` and data `d`. `terrain` is the static geom that represents the
        map; `shapes` are the geoms that collide with it. Warp's current device must be that of `m` and `d`.

        Raises:
            ConfigError: a shape in `shapes` is of a type without contact features.
        """
        self.terrain = terrain
        self.features = features = list(contact_features(model, shapes))
        largest = max(feature.reach for feature in features) + float((model.geom_margin + model.geom_gap).max())
        longest = max(feature.length for feature in features)
        self.ground = ground_of(height_map, largest, longest)
        self.hits = room_for_hits(d.nworld * len(features))
        self._inputs = [
            self.ground,
            self.hits,
            terrain,
            wp.array([feature.geom for feature in features], dtype=int),
            wp.array([feature.kind for feature in features], dtype=int),
            wp.array([feature.start for feature in features], dtype=wp.vec3),
            wp.array([feature.end for feature in features], dtype=wp.vec3),
            wp.array([feature.radius for feature in features], dtype=float),
            *(getattr(m, name) for name in MODEL_FIELDS),
            d.geom_xpos,
            d.geom_xmat,
            d.naconmax,
        ]
        self._outputs = [*(getattr(d.contact, name) for name in CONTACT_FIELDS), d.nacon]
        self._dim = (d.nworld, len(features))
        m.callback.contactfilter = self._append

    def _append(self, m: Any, d: Any) -> None:
        wp.launch(touch_ground, dim=self._dim, inputs=self._inputs, outputs=self._outputs)
