"""One height map for all worlds. Its square cells share no corners, so that faces between cells can be vertical."""

from dataclasses import dataclass

import numpy as np

CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))
"""Order of a cell's corners: (x, y) offsets in cells."""


@dataclass(frozen=True)
class HeightMap:
    """Terrain of X x Y cells. Within a cell the height is interpolated bilinearly from the four corners. Where corners of
    neighbouring cells differ, there is a vertical face. Outside the map the height is that of the nearest point on the map.
    """

    heights: np.ndarray
    """(X, Y) height of each cell's centre as generated, world frame [m]."""
    corners: np.ndarray
    """(X, Y, 4) heights of each cell's corners, in the order of CORNERS, float32 [m]."""
    cell: float
    """Edge of a cell [m]."""
    origin: tuple[float, float]
    """World x, y of the outer corner of cell (0, 0) [m]."""

    @classmethod
    def of(cls, heights: np.ndarray, cell: float, origin: tuple[float, float], steepest: np.ndarray) -> "HeightMap":
        """Return a height map with the `heights` (X, Y). Neighbouring cells are joined unless a face is between them.

        `steepest` (X, Y) is a limit of the slope (rise over run) for each cell. Two cells have a vertical face between them
        if the slope between their centres exceeds the smaller one of their limits. legged_gym makes such faces in a triangle
        mesh, with the same limit everywhere.
        """
        return cls(heights, join(heights, cell * steepest), cell, origin)

    @property
    def size(self) -> tuple[float, float]:
        """Extent along x and y [m]."""
        return self.heights.shape[0] * self.cell, self.heights.shape[1] * self.cell

    def index(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices of the cells that contain the world points, or that are nearest to points outside the map."""
        i = np.floor((np.asarray(x) - self.origin[0]) / self.cell).astype(int)
        j = np.floor((np.asarray(y) - self.origin[1]) / self.cell).astype(int)
        return np.clip(i, 0, self.heights.shape[0] - 1), np.clip(j, 0, self.heights.shape[1] - 1)

    def height_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the height of the surface at world points [m]. On a vertical face, the cell of larger index counts."""
        i, j = self.index(x, y)
        u = np.clip((np.asarray(x) - self.origin[0]) / self.cell - i, 0.0, 1.0)
        v = np.clip((np.asarray(y) - self.origin[1]) / self.cell - j, 0.0, 1.0)
        c = self.corners[i, j]
        low = c[..., 0] * (1.0 - u) + c[..., 1] * u
        high = c[..., 2] * (1.0 - u) + c[..., 3] * u
        return low * (1.0 - v) + high * v

    def ceiling(self, reach: int) -> np.ndarray:
        """Return for each cell the highest corner of all cells up to `reach` cells away in x and y, (X, Y) float32 [m]."""
        top = self.corners.max(axis=2)
        for axis in (0, 1):
            padded = np.pad(top, [(reach, reach) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
            windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=axis)
            top = windows.max(axis=-1)
        return top.astype(np.float32)

    def scan_map(self, scan: str) -> np.ndarray:
        """Return (X, Y) float32: the height that a height scan measures in each cell [m]. `scan` is the setting terrain.scan.
        "own" takes the height of the cell. "lowest" (as in legged_gym) or "highest" takes the lowest or highest height of the
        cell and its next neighbours along +x and +y.
        """
        if scan == "own":
            return self.heights.astype(np.float32)
        pick = {"lowest": np.minimum, "highest": np.maximum}[scan]
        heights = np.pad(self.heights, ((0, 1), (0, 1)), mode="edge")
        return pick(pick(heights[:-1, :-1], heights[1:, :-1]), heights[:-1, 1:]).astype(np.float32)


def join(heights: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Return the corner heights (X, Y, 4) [m]. Cells that are joined at a lattice point get the mean of their heights there.

    Two neighbours are joined if their heights differ by at most the smaller of their `rise` [m]. Cells that are joined
    through a common neighbour around the point count as joined too.
    """
    h = np.pad(heights, 1, mode="edge")
    r = np.pad(rise, 1, mode="edge")
    corners = np.empty((*heights.shape, 4), dtype=np.float32)
    inner = slice(1, -1)
    for k, (right, up) in enumerate(CORNERS):
        side, above = (slice(2, None) if right else slice(0, -2)), (slice(2, None) if up else slice(0, -2))
        own, x, y, xy = (inner, inner), (side, inner), (inner, above), (side, above)

        def joined(a: tuple[slice, slice], b: tuple[slice, slice]) -> np.ndarray:
            return np.abs(h[a] - h[b]) <= np.minimum(r[a], r[b]) + 1e-9

        to_x, to_y, x_xy, y_xy = joined(own, x), joined(own, y), joined(x, xy), joined(y, xy)
        has_x = to_x | (to_y & y_xy & x_xy)
        has_y = to_y | (to_x & x_xy & y_xy)
        has_xy = (to_x & x_xy) | (to_y & y_xy)
        total = h[own] + has_x * h[x] + has_y * h[y] + has_xy * h[xy]
        corners[:, :, k] = total / (1.0 + has_x + has_y + has_xy)
    return corners
