"""Pairs of shapes that may touch, and their contact parameters. The host computes the parameters by MuJoCo's rules."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

KINDS = mujoco.mjtGeom
ROUND = (int(KINDS.mjGEOM_SPHERE), int(KINDS.mjGEOM_CAPSULE))
"""Types of shapes that are a point or a segment with a radius. Any two of them may collide."""
ON_PLANES = (*ROUND, int(KINDS.mjGEOM_ELLIPSOID), int(KINDS.mjGEOM_CYLINDER), int(KINDS.mjGEOM_BOX))
"""Types of shapes that touch a plane in a few points."""
POINT, END, CORNER, RIM, ELLIPSOID = range(5)
"""Kinds of a shape's points that may touch a plane (`PlanePoint`). POINT: at `place`, with a radius. END: an end of a
capsule, with the capsule's radius; one direction of friction lies along the capsule's axis. CORNER: a corner of a box; it
counts only if it is below the box's centre. RIM: one of the four points on which a cylinder rests; `radius` is the number of
the point. ELLIPSOID: the lowest point of an ellipsoid."""
SPRING = 7
"""Number of parameters of a constraint's spring: stiffness [1/s^2], damping [1/s], least and greatest impedance, depth at
which the impedance reaches its greatest value [m or rad], and midpoint and power of the impedance curve."""
DEFAULT_SOLREF = np.array([0.02, 1.0])
"""MuJoCo's default solref: time constant [s] and damping ratio."""
LEAST_FRICTION, LEAST, GREATEST, TINY = mujoco.mjMINMU, mujoco.mjMINIMP, mujoco.mjMAXIMP, mujoco.mjMINVAL


@dataclass(frozen=True)
class ContactPair:
    """Contact parameters of two shapes that may touch."""

    geoms: tuple[int, int]
    """Ids of the geoms, ordered by type as in MuJoCo; normals point from the first to the second."""
    margin: float
    """The contact exerts force if the shapes' distance is less than this [m]."""
    dim: int
    """Number of directions in which the contact exerts force: 1, 3, 4 or 6."""
    rough: tuple[int, int]
    """Ids of two geoms. The contact uses the larger friction of both, or `friction` if the ids are (-1, -1)."""
    friction: np.ndarray
    """(5,) coefficients: sliding along two tangents, torsion about the normal, rolling about two tangents."""
    solref: np.ndarray
    solreffriction: np.ndarray
    solimp: np.ndarray


def contact_pair(model: mujoco.MjModel, first: int, second: int, pair: int = -1) -> ContactPair:
    """Return the parameters of contacts between two geoms. If `pair` is not -1, the parameters are those of the
    model's explicit contact pair with this index. Otherwise, the parameters are combined from both geoms by MuJoCo's rules.

    Source: MuJoCo documentation, "Computation", contact parameters. mujoco-warp differs for shapes of different priority: if
    the solref of either shape starts with a stiffness, mujoco-warp takes the elementwise minimum of both solrefs.
    """
    if pair >= 0:
        friction = np.maximum(model.pair_friction[pair], LEAST_FRICTION)
        own = (model.pair_solref[pair], model.pair_solreffriction[pair], model.pair_solimp[pair])
        margin = float(model.pair_margin[pair])
        return ContactPair((first, second), margin, int(model.pair_dim[pair]), (-1, -1), friction, *own)
    both = [first, second]
    priority, mixes = model.geom_priority[both], model.geom_solmix[both]
    dim = int(model.geom_condim[both].max())
    rough, share = (first, second), 0.5
    if priority[0] != priority[1]:
        winner = int(priority[1] > priority[0])
        dim, rough, share = int(model.geom_condim[both[winner]]), (both[winner],) * 2, 1.0 - winner
    elif mixes.max() >= TINY:
        share = float(mixes[0] / mixes.sum()) if mixes.min() >= TINY else float(mixes[0] >= TINY)
    weights = np.array([share, 1.0 - share])
    solref = model.geom_solref[both]
    # If one shape has the higher priority, its solref has weight 1. Otherwise, the two solrefs are averaged only if both
    # start with a time constant.
    alike = priority[0] != priority[1] or (solref[:, 0] > 0.0).all()
    mixed = weights @ solref if alike else solref.min(axis=0)
    margin = float(model.geom_margin[both].sum())
    return ContactPair(
        (first, second), margin, dim, rough, np.zeros(5), mixed, np.zeros(2), weights @ model.geom_solimp[both]
    )


def spring_of(solref: np.ndarray, solimp: np.ndarray, timestep: float, safe: bool) -> np.ndarray:
    """Return the (SPRING,) parameters of a constraint's spring, from MuJoCo's `solref` and `solimp`. With `safe`, the
    constraint's time constant is at least two time steps.

    Source: MuJoCo documentation, "Modeling", solver parameters. mujoco-warp computes an infinite stiffness if
    `is_mixed(solref)`.
    """
    if is_mixed(solref):
        solref = DEFAULT_SOLREF
    least, greatest, middle = np.clip(solimp[[0, 1, 3]], LEAST, GREATEST)
    width, power = max(TINY, float(solimp[2])), max(1.0, float(solimp[4]))
    if least == greatest or solimp[2] <= TINY:
        least = greatest = 0.5 * (least + greatest)
        power = 1.0
    time, ratio = max(solref[0], 2.0 * timestep) if safe else solref[0], solref[1]
    steepest = np.clip(solimp[1], LEAST, GREATEST)
    stiffness = -solref[0] / steepest**2 if solref[0] <= 0.0 else 1.0 / max(TINY, (steepest * time * ratio) ** 2)
    damping = -solref[1] / steepest if solref[1] <= 0.0 else 2.0 / max(TINY, steepest * time)
    return np.array([stiffness, damping, least, greatest, width, middle, power])


def is_mixed(solref: np.ndarray) -> np.ndarray:
    """Return a mask (...) of the `solref` (..., 2) that mix a time constant with a damping, or a stiffness with a damping
    ratio. C MuJoCo uses its default solref instead of these.
    """
    return np.asarray((solref[..., 0] > 0.0) != (solref[..., 1] > 0.0))


def alike_springs(model: mujoco.MjModel, pairs: Sequence[tuple[int, int, int]]) -> bool:
    """Return True if no contact combines two different solrefs of the model. This holds for a pair of shapes if one shape
    has the higher priority, if both have the same solref, or if the pair is explicit.
    """
    for first, second, pair in pairs:
        solref, priority = model.geom_solref[[first, second]], model.geom_priority[[first, second]]
        if pair < 0 and priority[0] == priority[1] and (solref[0] != solref[1]).any():
            return False
    return True


def is_safe(model: mujoco.MjModel) -> bool:
    """Return True if MuJoCo limits the model's constraints to time constants of at least two time steps (flag `refsafe`)."""
    return not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE


def pairs_of(m: Any) -> list[tuple[int, int, int]]:
    """Return the pairs of shapes that mujoco-warp tests for collision: two geoms, and the index of an explicit pair or -1."""
    geoms, pairs = m.nxn_geom_pair_filtered.numpy(), m.nxn_pairid_filtered.numpy()
    kinds = m.geom_type.numpy()
    found = []
    for (first, second), (pair, _) in zip(geoms.tolist(), pairs.tolist(), strict=True):
        if pair > -2:  # -2 marks a pair that only a sensor uses
            found.append((first, second, pair) if kinds[first] <= kinds[second] else (second, first, pair))
    return found


def kind_of(model: mujoco.MjModel, geom: int) -> str:
    """Return the name of a geom's type."""
    return KINDS(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()


def why_not(model: mujoco.MjModel, pairs: Sequence[tuple[int, int, int]]) -> str:
    """Return the reason why the fused contact stage does not support one of the `pairs`, or an empty text."""
    for first, second, _ in pairs:
        kinds = [int(model.geom_type[g]) for g in (first, second)]
        on_plane = kinds[0] == KINDS.mjGEOM_PLANE and kinds[1] in ON_PLANES
        if not on_plane and not (kinds[0] in ROUND and kinds[1] in ROUND):
            names = [f"'{model.geom(g).name}' (a {kind_of(model, g)})" for g in (first, second)]
            return f"shapes {names[0]} and {names[1]} may touch"
    return ""


@dataclass(frozen=True)
class PlanePoint:
    """A shape's point that may touch a plane. `touch` is the index of the `ContactPair` of shape and plane."""

    touch: int
    kind: int
    place: np.ndarray
    """(3,) position in the shape's frame [m]. For RIM: the cylinder's radius and half length. For ELLIPSOID: half axes."""
    radius: float
    """Radius of the sphere around the point [m]; for RIM, the point's number."""


def plane_points(model: mujoco.MjModel, touch: int, geom: int) -> Iterable[PlanePoint]:
    """Yield a geom's points that may touch a plane, in MuJoCo's order. `touch` is the index of their `ContactPair`."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == KINDS.mjGEOM_SPHERE:
        yield PlanePoint(touch, POINT, np.zeros(3), size[0])
    elif kind == KINDS.mjGEOM_CAPSULE:
        for side in (1.0, -1.0):
            yield PlanePoint(touch, END, np.array([0.0, 0.0, side * size[1]]), size[0])
    elif kind == KINDS.mjGEOM_BOX:
        for k in range(8):
            yield PlanePoint(touch, CORNER, size * [2.0 * (k >> axis & 1) - 1.0 for axis in range(3)], 0.0)
    elif kind == KINDS.mjGEOM_CYLINDER:
        for k in range(4):
            yield PlanePoint(touch, RIM, np.array([size[0], size[1], 0.0]), float(k))
    else:
        yield PlanePoint(touch, ELLIPSOID, size.copy(), 0.0)
