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


@wp.struct
class CollisionArrays:
    """Arrays of mujoco-warp's model and data, which have the same names there. Those that begin with `contact_` are arrays of
    its contacts, which have the rest of the name there.
    """

    geom_condim: wp.array[int]
    geom_priority: wp.array[int]
    geom_solmix: wp.array2d[float]
    geom_solref: wp.array2d[wp.vec2]
    geom_solimp: wp.array2d[vec5]
    geom_friction: wp.array2d[wp.vec3]
    geom_margin: wp.array2d[float]
    geom_gap: wp.array2d[float]
    geom_adhesion: wp.array2d[float]
    pair_dim: wp.array[int]
    pair_solref: wp.array2d[wp.vec2]
    pair_solreffriction: wp.array2d[wp.vec2]
    pair_solimp: wp.array2d[vec5]
    pair_margin: wp.array2d[float]
    pair_gap: wp.array2d[float]
    pair_adhesion: wp.array2d[float]
    pair_friction: wp.array2d[vec5]
    geom_xpos: wp.array2d[wp.vec3]
    geom_xmat: wp.array2d[wp.mat33]
    contact_dist: wp.array[float]
    contact_pos: wp.array[wp.vec3]
    contact_frame: wp.array[wp.mat33]
    contact_includemargin: wp.array[float]
    contact_friction: wp.array[vec5]
    contact_solref: wp.array[wp.vec2]
    contact_solreffriction: wp.array[wp.vec2]
    contact_solimp: wp.array[vec5]
    contact_dim: wp.array[int]
    contact_geom: wp.array[wp.vec2i]
    contact_efc_address: wp.array2d[int]
    contact_worldid: wp.array[int]
    contact_type: wp.array[int]
    contact_geomcollisionid: wp.array[int]
    contact_adhesion: wp.array[float]
    nacon: wp.array[int]


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
    of: CollisionArrays,
    naconmax: int,
):
    """Find up to MOST contacts of a feature, and append them to mujoco-warp's contacts. One thread per world and feature."""
    world, feature = wp.tid()
    geom = feature_geom[feature]
    radius = feature_radius[feature]
    geoms = wp.vec2i(terrain, geom)
    margin, gap = contact_margin_gap(of.geom_margin, of.geom_gap, of.pair_margin, of.pair_gap, geoms, -1, world)
    near = radius + margin + gap
    position, turn = of.geom_xpos[world, geom], of.geom_xmat[world, geom]
    row = world * feature_geom.shape[0] + feature
    count = find_hits(
        ground, feature_kind[feature], position, turn, feature_start[feature], feature_end[feature], near, hits, row
    )
    if count == 0:
        return
    condim, friction, solref, solreffriction, solimp, adhesion = contact_material_params(
        of.geom_condim,
        of.geom_priority,
        of.geom_solmix,
        of.geom_solref,
        of.geom_solimp,
        of.geom_friction,
        of.geom_adhesion,
        of.pair_dim,
        of.pair_solref,
        of.pair_solreffriction,
        of.pair_solimp,
        of.pair_adhesion,
        of.pair_friction,
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
            of.contact_dist,
            of.contact_pos,
            of.contact_frame,
            of.contact_includemargin,
            of.contact_friction,
            of.contact_solref,
            of.contact_solreffriction,
            of.contact_solimp,
            of.contact_dim,
            of.contact_geom,
            of.contact_efc_address,
            of.contact_worldid,
            of.contact_type,
            of.contact_geomcollisionid,
            of.contact_adhesion,
            of.nacon,
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
        arrays = CollisionArrays()
        for name in CollisionArrays.vars:  # type: ignore[attr-defined]
            owner = d.contact if name.startswith("contact_") else m if hasattr(m, name) else d
            setattr(arrays, name, getattr(owner, name.removeprefix("contact_")))
        self._inputs = [
            self.ground,
            self.hits,
            terrain,
            wp.array([feature.geom for feature in features], dtype=int),
            wp.array([feature.kind for feature in features], dtype=int),
            wp.array([feature.start for feature in features], dtype=wp.vec3),
            wp.array([feature.end for feature in features], dtype=wp.vec3),
            wp.array([feature.radius for feature in features], dtype=float),
            arrays,
            d.naconmax,
        ]
        self._dim = (d.nworld, len(features))
        m.callback.contactfilter = self._append

    def _append(self, m: Any, d: Any) -> None:
        wp.launch(touch_ground, dim=self._dim, inputs=self._inputs)
