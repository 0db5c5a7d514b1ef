"""Which shapes of a model may touch, and what their contacts are made of, as MuJoCo mixes it: tables on the host."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

KINDS = mujoco.mjtGeom
ROUND = (int(KINDS.mjGEOM_SPHERE), int(KINDS.mjGEOM_CAPSULE))
"""Shapes that meet each other as a segment, or a point, with a radius."""
ON_PLANES = (*ROUND, int(KINDS.mjGEOM_ELLIPSOID), int(KINDS.mjGEOM_CYLINDER), int(KINDS.mjGEOM_BOX))
"""Shapes that meet a plane in a few points."""
POINT, END, CORNER, RIM, ELLIPSOID = range(5)
"""How a point of a shape that may touch a plane is found: where it is said, with a radius; the same at an end of a capsule,
along whose axis friction is; a corner of a box, if it is below the box's centre; the `radius`-th point of a cylinder; the
lowest point of an ellipsoid."""
SPRING = 7
"""Numbers that say how a constraint holds: stiffness [1/s^2], damping [1/s], least and greatest impedance, the depth at which
it is greatest [m or rad], and middle and power of the way there."""
DEFAULT_SOLREF = np.array([0.02, 1.0])
"""MuJoCo's: time constant [s] and damping ratio."""
LEAST_FRICTION, LEAST, GREATEST, TINY = mujoco.mjMINMU, mujoco.mjMINIMP, mujoco.mjMAXIMP, mujoco.mjMINVAL


@dataclass(frozen=True)
class Touch:
    """Two shapes that may touch."""

    geoms: tuple[int, int]
    """The first is of the lower type, as in MuJoCo: normals point from it to the second."""
    margin: float
    """Distance from which on the contact pushes [m]."""
    dim: int
    """Directions in which it pushes: 1, 3, 4 or 6."""
    rough: tuple[int, int]
    """Shapes of which the larger friction counts; (-1, -1) where `friction` does."""
    friction: np.ndarray
    """(5,) along two tangents, about the normal, and about two tangents."""
    solref: np.ndarray
    solreffriction: np.ndarray
    solimp: np.ndarray


def touch_of(model: mujoco.MjModel, first: int, second: int, pair: int = -1) -> Touch:
    """Return how two geoms touch, as MuJoCo mixes their contacts, or as one of its explicit `pair`s says.

    Source: MuJoCo documentation, "Computation", contact parameters. (mujoco-warp takes the smaller solref of two shapes of
    different priority too, if one is a stiffness.)
    """
    if pair >= 0:
        friction = np.maximum(model.pair_friction[pair], LEAST_FRICTION)
        own = (model.pair_solref[pair], model.pair_solreffriction[pair], model.pair_solimp[pair])
        margin = float(model.pair_margin[pair])
        return Touch((first, second), margin, int(model.pair_dim[pair]), (-1, -1), friction, *own)
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
    alike = priority[0] != priority[1] or (solref[:, 0] > 0.0).all()  # one alone counts, or both are time constants
    mixed = weights @ solref if alike else solref.min(axis=0)
    margin = float(model.geom_margin[both].sum())
    return Touch((first, second), margin, dim, rough, np.zeros(5), mixed, np.zeros(2), weights @ model.geom_solimp[both])


def spring_of(solref: np.ndarray, solimp: np.ndarray, timestep: float, safe: bool) -> np.ndarray:
    """Return the SPRING numbers of a constraint with MuJoCo's parameters; `safe` keeps its time constant above two steps.

    Source: MuJoCo documentation, "Modeling", solver parameters. (mujoco-warp makes a stiffness without end of a solref
    that `is_mixed`.)
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
    """Return of solrefs (..., 2) which are half a time constant and half a stiffness: C MuJoCo takes its default instead."""
    return np.asarray((solref[..., 0] > 0.0) != (solref[..., 1] > 0.0))


def alike_springs(model: mujoco.MjModel, pairs: Sequence[tuple[int, int, int]]) -> bool:
    """Whether the contacts of each of the pairs have the spring of one shape, even if worlds differ in it: of the one with
    priority, or of two that have the same.
    """
    for first, second, pair in pairs:
        solref, priority = model.geom_solref[[first, second]], model.geom_priority[[first, second]]
        if pair < 0 and priority[0] == priority[1] and (solref[0] != solref[1]).any():
            return False
    return True


def is_safe(model: mujoco.MjModel) -> bool:
    """Whether the time constants of the model's constraints are kept above two steps."""
    return not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE


def pairs_of(m: Any) -> list[tuple[int, int, int]]:
    """Return the pairs of shapes that mujoco-warp would test, of its model: two geoms, and the explicit pair or -1."""
    geoms, pairs = m.nxn_geom_pair_filtered.numpy(), m.nxn_pairid_filtered.numpy()
    kinds = m.geom_type.numpy()
    found = []
    for (first, second), (pair, _) in zip(geoms.tolist(), pairs.tolist(), strict=True):
        if pair > -2:  # else a sensor alone asks
            found.append((first, second, pair) if kinds[first] <= kinds[second] else (second, first, pair))
    return found


def kind_of(model: mujoco.MjModel, geom: int) -> str:
    """Return what a geom is, in a word."""
    return KINDS(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()


def why_not(model: mujoco.MjModel, pairs: Sequence[tuple[int, int, int]]) -> str:
    """Return which of the pairs is of shapes whose contacts are not computed here; empty if none."""
    for first, second, _ in pairs:
        kinds = [int(model.geom_type[g]) for g in (first, second)]
        on_plane = kinds[0] == KINDS.mjGEOM_PLANE and kinds[1] in ON_PLANES
        if not on_plane and not (kinds[0] in ROUND and kinds[1] in ROUND):
            names = [f"'{model.geom(g).name}' (a {kind_of(model, g)})" for g in (first, second)]
            return f"shapes {names[0]} and {names[1]} may touch"
    return ""


@dataclass(frozen=True)
class PlanePoint:
    """A point of a shape that may touch a plane."""

    touch: int
    kind: int
    place: np.ndarray
    """(3,) in the shape's frame; for RIM radius and half length, for ELLIPSOID the half axes [m]."""
    radius: float
    """Of the sphere around it [m]; for RIM the point's number."""


def plane_points(model: mujoco.MjModel, touch: int, geom: int) -> Iterable[PlanePoint]:
    """Yield the points of a geom that may touch the plane of the `touch`-th pair, in the order in which MuJoCo has them."""
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
