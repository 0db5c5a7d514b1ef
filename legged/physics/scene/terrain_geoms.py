"""The terrain as static geoms, for the C engine's collisions and for rendering."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from legged.terrain.height_map import CORNERS, HeightMap
from legged.terrain.terrain import Terrain

DEPTH = 20.0
"""Distance from the lowest point of the map to the bottom of all geoms [m]. Geoms are so deep that nothing slips between two
of them. Points of a height field that no slope uses lie at the bottom. The flanks that lead down to these points deviate from
the vertical by less than 1 mm for each 0.2 m of height."""
SKIN = 0.05
"""Distance of a colliding height field below the ground, along the ground's normal [m]. The geom has a margin of this size,
so that shapes collide with it at the height of the ground.

MuJoCo treats a height field as adjacent prisms, each of which is solid down to its base. A small foot that sinks below their
tops at an impact is pushed out of one prism sideways into the next, and gets stuck. The margin keeps the foot above the
prisms.
"""
SAME = 1e-6
"""Heights that differ by less than this are treated as equal [m]."""


def add_terrain(
    spec: mujoco.MjSpec,
    terrain: Terrain,
    rows: Sequence[int] | None = None,
    cols: Sequence[int] | None = None,
    material: str | None = None,
    collide: bool = True,
    depth: float = DEPTH,
) -> list[mujoco.MjsGeom]:
    """Add a terrain to the world body: boxes where it consists of steps, and one height field per tile where it is smooth.
    Return the geoms, which are named terrain_<number>.

    The surface is that of the height map, except that a twisted cell becomes two triangles instead of a bilinear patch.
    Shapes collide with a height field at the distance `SKIN` above its geom, so its edges are rounded with this radius.

    Args:
        spec: model that the geoms are added to.
        terrain: the terrain.
        rows: adjacent rows of tiles; all by default. The terrain's first and last row include the adjoining border.
        cols: columns of tiles, in the same way.
        material: name of a material in `spec`.
        collide: False for geoms that are only rendered.
        depth: distance from the lowest point of the map to the bottom of all geoms [m].
    """
    ground = terrain.height_map
    skin = SKIN if collide else 0.0
    add = _Geoms(spec, ground, float(ground.corners.min()) - depth, _attributes(material, collide), skin, collide)
    length, width, border = (round(x / ground.cell) for x in (*terrain.tile_size, terrain.border))
    count = terrain.origins.shape[:2]
    # Where a slope meets the border, the border's first cells slope too. The outer tiles include these cells.
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


def add_height_field(spec: mujoco.MjSpec, ground: HeightMap) -> mujoco.MjsGeom:
    """Add the whole map to the world body as one height field, `terrain_0`. Vertical faces become slopes at least one cell
    wide.

    Where corners of neighbouring cells differ in height, the height field's point lies at their mean.
    """
    add = _Geoms(spec, ground, float(ground.corners.min()) - DEPTH, _attributes(None, collide=True))
    add.surface(0, 0, lattice_heights(ground))
    return add.added[0]


def lattice_heights(ground: HeightMap) -> np.ndarray:
    """Return the heights (X + 1, Y + 1) of the cells' corners [m]. Where cells differ at a common corner, take their mean."""
    return _lattice(ground.corners)[0]


@dataclass
class _Geoms:
    """Adds geoms whose positions are given in cells of the map."""

    spec: mujoco.MjSpec
    ground: HeightMap
    floor: float
    """Height of the bottom of all geoms [m]."""
    attributes: dict[str, Any]
    skin: float = 0.0
    """Distance above a height field's geom at which shapes collide with it [m]."""
    overlap: bool = False
    """True if boxes of equal height overlap, so that level ground has few seams."""
    added: list[mujoco.MjsGeom] = field(default_factory=list)

    def box(self, x: slice, y: slice, top: float) -> None:
        """Add a box with height `top` [m] over the cells `x`, `y`."""
        half = [0.5 * (s.stop - s.start) * self.ground.cell for s in (x, y)] + [0.5 * (top - self.floor)]
        self._add(x.start, y.start, half, top - half[2], type=mujoco.mjtGeom.mjGEOM_BOX, size=half)

    def surface(self, x: int, y: int, heights: np.ndarray, skin: float = 0.0) -> None:
        """Add a height field with the points `heights` (X + 1, Y + 1) [m]. Shapes collide with it at the distance `skin` [m]
        above its geom. The first point lies at the corner of cell (x, y) with the lowest x and y.
        """
        half = [0.5 * (n - 1) * self.ground.cell for n in heights.shape]
        low, high = float(heights.min()), float(heights.max())
        name = self._name()
        self.spec.add_hfield(
            name=name,
            nrow=heights.shape[1],  # the row index counts along y
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
    """Return the attributes of a terrain's geoms. With `collide`, the geoms collide with the robot only."""
    bits = {"contype": 2, "conaffinity": 1} if collide else {"contype": 0, "conaffinity": 0}
    return {**bits, "group": 0} | ({"material": material} if material else {})


def _edges(count: int, side: int, border: int) -> list[int]:
    """Return each tile's first cell, and the end of the last tile. The outer tiles reach one cell into the border."""
    edges = [border + i * side for i in range(count + 1)]
    edges[0] -= min(border, 1)
    edges[-1] += min(border, 1)
    return edges


def _add_patch(add: _Geoms, x: slice, y: slice) -> None:
    """Add the cells x, y as boxes, as a height field, or as both."""
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
        # Height fields among boxes have no `skin`, because a skin would stick out of vertical faces. Points that belong to no
        # sloped cell are lowered to the floor: the field then falls steeply inside the neighbouring boxes.
        i, j = (slice(int(at.min()), int(at.max()) + 1) for at in np.nonzero(sloped))
        points = _lattice(corners[i, j], sloped[i, j])[0]
        add.surface(x.start + i.start, y.start + j.start, np.where(np.isnan(points), add.floor, points))


def _layers(corners: np.ndarray, sloped: np.ndarray) -> Iterator[np.ndarray]:
    """Yield sets of cells (X, Y) that together are the `sloped` cells. Each set fits one height field: the cells of a set
    agree in the points that they share, and the field does not stick out above any other cell.

    The first set leaves out all cells around two kinds of points. At points of the first kind, sloped cells differ in
    height. Points of the second kind lie above a corner of a cell that is not sloped, but of which the field would use at
    least three corners, for example because slopes surround the cell. The cells that are left out are distributed
    over further sets. Between two cells of such a set lie at least two other cells.
    """
    points, bad = _lattice(corners, sloped)
    used = [~np.isnan(own) for own in _at_corners(points)]
    covers = ~sloped & ((used[0] & used[3]) | (used[1] & used[2]))  # three corners of a cell include two opposite ones
    for k, (top, is_bad) in enumerate(zip(_at_corners(points), _at_corners(bad), strict=True)):
        is_bad |= covers & (top > corners[:, :, k] + SAME)
    alone = sloped & np.any(_at_corners(bad), axis=0)
    i, j = np.indices(alone.shape) % 3
    for layer in (sloped & ~alone, *(alone & (i == a) & (j == b) for a in range(3) for b in range(3))):
        if layer.any():
            yield layer


def _at_corners(points: np.ndarray) -> list[np.ndarray]:
    """Return four views (X, Y) of lattice points (X + 1, Y + 1): one for each corner of the cells, as ordered in CORNERS."""
    x, y = (n - 1 for n in points.shape)
    return [points[right : right + x, up : up + y] for right, up in CORNERS]


def _lattice(corners: np.ndarray, used: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean height [m] of the cells' corners at each lattice point, (X + 1, Y + 1), and a mask of the points at
    which the corners differ. `corners` is (X, Y, 4).

    With `used` (X, Y), only used cells count. The mean is NaN at points without used cells.
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
    """Return the ratio of each cell's surface area to its horizontal area, (X, Y): 1 if level. `corners` is (X, Y, 4)."""
    signs = 2.0 * np.array(CORNERS) - 1.0
    slopes = corners.astype(np.float64) @ signs / (2.0 * cell)
    return np.sqrt(1.0 + (slopes**2).sum(axis=2))


def _rectangles(low: np.ndarray, flat: np.ndarray, overlap: bool) -> Iterator[tuple[slice, slice, float]]:
    """Yield rectangles of cells, and their heights [m]. They cover all `flat` cells (X, Y), whose heights are `low` [m].

    Boxes are solid, so a box may extend below higher cells: a pyramid becomes a stack of plates. Boxes that are only rendered
    do not overlap. Boxes that collide overlap those of equal height (`overlap`), so that level ground has few seams. At a
    seam, a foot that sinks in would be pushed sideways into the next box. The method is greedy: the lowest cell that is still
    uncovered takes the larger of two rectangles. One of them is extended along x first, the other along y first.
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
    """Return the longest run around `start` in which all of `allowed` (N,) are true."""
    ends = np.flatnonzero(~allowed)
    after = int(np.searchsorted(ends, start))
    return slice(int(ends[after - 1]) + 1 if after else 0, int(ends[after]) if after < len(ends) else len(allowed))
