"""Tiles of terrain that policies are measured on, in place of those of their training."""

from collections.abc import Sequence
from math import ceil
from typing import Any

import numpy as np

from legged.config import LeggedConfig
from legged.config.schema import TerrainConfig
from legged.evaluation.velocity_grid import Grid
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec

BORDER = 3.0
"""Level ground around the outer tiles [m]."""
ROUGH_SPAWN = 2.0
"""On rough ground robots start at most this far from the middle, in x and in y, so that they meet different bumps [m]."""
ROUGH_ROOM = 1.5
"""Rough ground beyond the farthest place that a command leads to [m]."""
VARIANTS = 16
"""Different tiles of each size, among which its robots are shared out, of types that are drawn at random: some tiles have
an easy way out, and the interval of a share knows of robots only."""


def on_terrain(cfg: LeggedConfig, side: float, spawn_range: float) -> list[tuple[str, Any]]:
    """Return overrides for a task on tiles of our own, with sides of `side` [m]; what the policy sees stays as trained.

    The tiles are built by the caller; of those of the training one stays, level, so that their number times our side does
    not count as ground that is asked for.
    """
    return [
        ("terrain.mesh_type", "height_map"),
        ("terrain.curriculum", False),
        ("terrain.num_rows", 1),
        ("terrain.num_cols", 1),
        ("terrain.max_init_terrain_level", 0),
        ("terrain.proportions", {**dict.fromkeys(cfg.terrain.proportions, 0.0), "flat": 1.0}),
        ("terrain.terrain_length", side),
        ("terrain.terrain_width", side),
        ("terrain.border_size", BORDER),
        ("terrain.spawn_range", spawn_range),
    ]


def dividing_cell(length: float, cell: float) -> float:
    """Return the edge of the largest cells, not larger than `cell`, of which a whole number is `length` [m]."""
    return length / ceil(length / cell - 1e-6)


def cell_for(name: str, cfg: TerrainConfig) -> float:
    """Return the edge of the cells in which a type is measured [m]: that of the training, or a smaller one that divides what
    the type is made of.
    """
    kind = TERRAIN_TYPES[name]
    if not kind.exact or kind.finest is None:
        return cfg.horizontal_scale
    return dividing_cell(kind.finest[0] * cfg.scale, cfg.horizontal_scale)


def rough_ground(cfg: TerrainConfig, seed: int) -> Terrain:
    """Build one level tile with bumps, on which all robots of a grid start; the configuration says how large it is (see
    `rough_side`).
    """
    return Terrain.of_tiles([[TileSpec("rough_slope_up", 0.0)]], cfg, np.random.default_rng(seed))


def rough_side(grid: Grid) -> float:
    """Return the side of a tile that nobody leaves while it holds its command [m]: 20 m for 1.4 m/s and 4 s."""
    fastest = float(np.linalg.norm(grid.cells[:, :2], axis=1).max())
    return 2.0 * ceil(ROUGH_SPAWN + fastest * grid.hold_s + ROUGH_ROOM)


def tiles_of_sizes(name: str, sizes: Sequence[float], cfg: TerrainConfig, seed: int) -> Terrain:
    """Build the tiles of every size of a type: see `tiles_apart`."""
    return tiles_apart([TileSpec(name, size) for size in sizes], cfg, seed)


def tiles_apart(specs: Sequence[TileSpec], cfg: TerrainConfig, seed: int) -> Terrain:
    """Build tiles of every kind: kind i in row 2 i, variant k in column 2 k. Between them is level ground, so that nobody
    steps onto another kind before it has left its own.
    """
    variants = 1 if all(TERRAIN_TYPES[spec.type].regular for spec in specs) else VARIANTS
    rows = [[TileSpec("flat", 0.0)] * (2 * variants - 1) for _ in range(2 * len(specs) - 1)]
    for i, spec in enumerate(specs):
        rows[2 * i][::2] = [spec] * variants
    return Terrain.of_tiles(rows, cfg, np.random.default_rng(seed))
