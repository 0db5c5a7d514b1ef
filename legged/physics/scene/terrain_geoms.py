"""The terrain as static geoms: what the C engine collides with and what pictures show."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from legged.terrain.height_map import CORNERS, HeightMap
from legged.terrain.terrain import Terrain

DEPTH = 20.0
"""How far all geoms reach below the lowest point of the map [m]: nothing slips between two of them, and the flanks of a
height field sunk to there lean by less than 1 mm for each 0.2 m of a face."""
SKIN = 0.05
"""Height fields that collide lie so much below the ground, measured along its normal, and are felt so much above themselves
(MuJoCo's margin) [m].

MuJoCo sees a height field as prisms side by side, each solid down to its foot. A foot that sinks below their tops at an
impact, as small ones do, is pushed out of a prism sideways, into the next: it is wedged in. So it must not get there.
"""
SAME = 1e-6
"""Heights closer than this are the same [m]."""


def add_terrain(
    spec: mujoco.MjSpec,
    terrain: Terrain,
    rows: Sequence[int] | None = None,
    cols: Sequence[int] | None = None,
    material: str | None = None,
    collide: bool = True,
    depth: float = DEPTH,
) -> list[mujoco.MjsGeom]:
    """Add a terrain to the world body: boxes where it is made of steps, one height field a tile where it is smooth.

    The surface is that of the height map, but for two triangles in place of a bilinear patch in cells that are twisted; to
    those that collide with a height field it appears `SKIN` above the geom, with edges as round as that.
    `rows` and `cols`, all by default, must be without gaps; the border comes along on those sides that they reach.
    Geoms are named terrain_<number>. `material` is the name of one in `spec`. Without `collide`, they are for the eye
    only. `depth` [m] is how far they reach below the lowest point.
    """
    ground = terrain.height_map
    skin = SKIN if collide else 0.0
    add = _Geoms(spec, ground, float(ground.corners.min()) - depth, _attributes(material, collide), skin, collide)
    length, width, border = (round(x / ground.cell) for x in (*terrain.tile_size, terrain.border))
    count = terrain.origins.shape[:2]
    # A slope may be joined to the border, whose next cells then slope too: the outer tiles take these along.
    x_edges, y_edges = (_edges(n, side, border) for n, side in zip(count, (length, width), strict=True))
    chosen = [range(n) if picked is None else picked for n, picked in zip(count, (rows, cols), strict=True)]
    for r in chosen[0]:
        for c in chosen[1]:
            _add_patch(add, slice(x_edges[r], x_edges[r + 1]), slice(y_edges[c], y_edges[c + 1]))
    x = x_edges[min(chosen[0])], x_edges[max(chosen[0]) + 1]
    y = y_edges[min(chosen[1])], y_edges[max(chosen[1]) + 1]
    cells = ground.heights.shape
    outer_x = 0 if min(chosen[0]) == 0 else x[0], cells[0] if max(chosen[0]) == count[0] - 1 else x[1]
    outer_y = 0 if min(chosen[1]) == 0 else y[0], cells[1] if max(chosen[1]) == count[1] - 1 else y[1]
    for x_span, y_span in (
        ((outer_x[0], x[0]), outer_y),
        ((x[1], outer_x[1]), outer_y),
        (x, (outer_y[0], y[0])),
        (x, (y[1], outer_y[1])),
    ):
        if x_span[0] < x_span[1] and y_span[0] < y_span[1]:
            add.box(slice(*x_span), slice(*y_span), 0.0)
    return add.added


def add_height_field(
    spec: mujoco.MjSpec, ground: HeightMap, material: str | None = None, collide: bool = True, depth: float = DEPTH
) -> mujoco.MjsGeom:
    """Add the whole map to the world body as one height field, `terrain_0`: faces become slopes one cell wide or more.

    Where corners of neighbouring cells disagree, its point lies at their mean.
    """
    add = _Geoms(spec, ground, float(ground.corners.min()) - depth, _attributes(material, collide))
    add.surface(0, 0, lattice_heights(ground))
    return add.added[0]


def lattice_heights(ground: HeightMap) -> np.ndarray:
    """(X + 1, Y + 1) heights at the corners of all cells [m]; where neighbours disagree, their mean."""
    return _lattice(ground.corners)[0]


@dataclass
class _Geoms:
    """Adds geoms that are given in cells of the map."""

    spec: mujoco.MjSpec
    ground: HeightMap
    floor: float
    """Height down to which all of them reach [m]."""
    attributes: dict[str, Any]
    skin: float = 0.0
    """How far smooth ground is felt above its geom [m]."""
    overlap: bool = False
    """Whether boxes of one height overlap, so that level ground has few seams."""
    added: list[mujoco.MjsGeom] = field(default_factory=list)

    def box(self, x: slice, y: slice, top: float) -> None:
        """A box over those cells."""
        half = [0.5 * (s.stop - s.start) * self.ground.cell for s in (x, y)] + [0.5 * (top - self.floor)]
        self._add(x.start, y.start, half, top - half[2], type=mujoco.mjtGeom.mjGEOM_BOX, size=half)

    def surface(self, x: int, y: int, heights: np.ndarray, skin: float = 0.0) -> None:
        """A height field with points `heights` (X + 1, Y + 1) [m], the first of them at the outer corner of cell x, y, that
        is felt at a distance of `skin` [m].
        """
        half = [0.5 * (n - 1) * self.ground.cell for n in heights.shape]
        low, high = float(heights.min()), float(heights.max())
        name = self._name()
        self.spec.add_hfield(
            name=name,
            nrow=heights.shape[1],  # rows lie along y
            ncol=heights.shape[0],
            size=[*half, max(high - low, SAME), max(low - self.floor, 0.1)],
            userdata=(heights.T.ravel() - low) / max(high - low, SAME),
        )
        self._add(x, y, half, low, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=name, margin=skin)

    def _name(self) -> str:
        return f"terrain_{len(self.added)}"

    def _add(self, x: int, y: int, half: Sequence[float], z: float, **geom: Any) -> None:
        pos = [
            self.ground.origin[0] + x * self.ground.cell + half[0],
            self.ground.origin[1] + y * self.ground.cell + half[1],
            z,
        ]
        self.added.append(self.spec.worldbody.add_geom(name=self._name(), pos=pos, **geom, **self.attributes))


def _attributes(material: str | None, collide: bool) -> dict[str, Any]:
    """What all geoms of a terrain have in common: bits that meet the robot's shapes but not each other."""
    bits = {"contype": 2, "conaffinity": 1} if collide else {"contype": 0, "conaffinity": 0}
    return {**bits, "group": 0} | ({"material": material} if material else {})


def _edges(count: int, side: int, border: int) -> list[int]:
    """First cells of `count` tiles and the end of the last, where the outer ones reach one cell into the border."""
    edges = [border + i * side for i in range(count + 1)]
    edges[0] -= min(border, 1)
    edges[-1] += min(border, 1)
    return edges


def _add_patch(add: _Geoms, x: slice, y: slice) -> None:
    """Cells x, y as boxes, as a height field, or as both."""
    corners = add.ground.corners[x, y]
    low, high = corners.min(axis=2), corners.max(axis=2)
    flat = high - low < SAME
    points, apart = _lattice(corners)
    if not apart.any() and not flat.all():
        if add.skin > 0.0:
            points = _lattice(corners - add.skin * _steepness(corners, add.ground.cell)[:, :, None])[0]
        add.surface(x.start, y.start, points, add.skin)
        return
    for i, j, top in _rectangles(low, flat, add.overlap):
        add.box(slice(x.start + i.start, x.start + i.stop), slice(y.start + j.start, y.start + j.stop), top)
    for sloped in _layers(corners, ~flat):
        # Slopes among the steps, without a skin, which would stand out beside their faces. Points that no slope uses are
        # sunk: what hangs down to them is inside the boxes.
        i, j = (slice(int(at.min()), int(at.max()) + 1) for at in np.nonzero(sloped))
        points = _lattice(corners[i, j], sloped[i, j])[0]
        add.surface(x.start + i.start, y.start + j.start, np.where(np.isnan(points), add.floor, points))


def _layers(corners: np.ndarray, sloped: np.ndarray) -> Iterator[np.ndarray]:
    """Yield sets of cells (X, Y), together those that are `sloped`, each of which one height field can hold: its cells agree
    where they share a point, and between them it stands out over no other cell.

    The first set leaves out all cells around some points: those at which slopes disagree, and those above a lower cell of
    which the field would hold three corners or more, as of one that slopes go around. Those cells are dealt out to further
    sets in which two cells lie between any two.
    """
    points, bad = _lattice(corners, sloped)
    used = [~np.isnan(own) for own in _at_corners(points)]
    covers = ~sloped & ((used[0] & used[3]) | (used[1] & used[2]))  # three corners, or two on a diagonal
    for k, (top, is_bad) in enumerate(zip(_at_corners(points), _at_corners(bad), strict=True)):
        is_bad |= covers & (top > corners[:, :, k] + SAME)
    alone = sloped & np.any(_at_corners(bad), axis=0)
    i, j = np.indices(alone.shape) % 3
    for layer in (sloped & ~alone, *(alone & (i == a) & (j == b) for a in range(3) for b in range(3))):
        if layer.any():
            yield layer


def _at_corners(points: np.ndarray) -> list[np.ndarray]:
    """Lattice points (X + 1, Y + 1) -> views of those at each corner of the cells, (X, Y) each, in the order of CORNERS."""
    x, y = (n - 1 for n in points.shape)
    return [points[right : right + x, up : up + y] for right, up in CORNERS]


def _lattice(corners: np.ndarray, used: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Corners (X, Y, 4) of cells -> mean (X + 1, Y + 1) at each lattice point [m], and whether they disagree there.

    With `used` (X, Y), of those cells only; where there are none the mean is NaN.
    """
    shape = (corners.shape[0] + 1, corners.shape[1] + 1)
    total, number = np.zeros(shape), np.zeros(shape)
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    weight = np.ones(corners.shape[:2], dtype=bool) if used is None else used
    for k, (right, up) in enumerate(CORNERS):
        at = slice(right, shape[0] - 1 + right), slice(up, shape[1] - 1 + up)
        own = corners[:, :, k].astype(np.float64)
        total[at] += own * weight
        number[at] += weight
        low[at] = np.where(weight, np.minimum(low[at], own), low[at])
        high[at] = np.where(weight, np.maximum(high[at], own), high[at])
    mean = np.divide(total, number, out=np.full(shape, np.nan), where=number > 0)
    return mean, high - low > SAME


def _steepness(corners: np.ndarray, cell: float) -> np.ndarray:
    """Corners (X, Y, 4) of cells -> (X, Y) their surface over the area below it: 1 where it is level."""
    signs = 2.0 * np.array(CORNERS) - 1.0
    slopes = corners.astype(np.float64) @ signs / (2.0 * cell)
    return np.sqrt(1.0 + (slopes**2).sum(axis=2))


def _rectangles(low: np.ndarray, flat: np.ndarray, overlap: bool) -> Iterator[tuple[slice, slice, float]]:
    """Rectangles, and their heights, that together make up all flat cells of heights `low` (X, Y) [m].

    Boxes are solid, so one may run below cells that are higher than itself: a pyramid is a pile of plates. Where they
    are seen they do not overlap; where they are touched, those of one height do (`overlap`), for at a seam a foot that
    sinks in would be pushed out sideways, into the next box. Greedy: the lowest cell that is still open takes the better
    of two rectangles, grown along x or along y first.
    """
    open_cells = flat.copy()
    while open_cells.any():
        i, j = divmod(int(np.where(open_cells, low, np.inf).argmin()), flat.shape[1])
        top = float(low[i, j])
        wanted = open_cells & (low < top + SAME)
        allowed = low > top - SAME if overlap else wanted | (low > top + SAME)
        across = _run(allowed[i, :], j)
        along = _run(allowed[:, j], i)
        one = _run(np.asarray(allowed[:, across].all(axis=1)), i), across
        other = along, _run(np.asarray(allowed[along].all(axis=0)), j)
        best = max(one, other, key=lambda spans: int(wanted[spans].sum()))
        open_cells[best] &= ~wanted[best]
        yield *best, top


def _run(allowed: np.ndarray, start: int) -> slice:
    """The longest stretch around `start` in which all of `allowed` (N,) holds."""
    ends = np.flatnonzero(~allowed)
    after = int(np.searchsorted(ends, start))
    return slice(int(ends[after - 1]) + 1 if after else 0, int(ends[after]) if after < len(ends) else len(allowed))
