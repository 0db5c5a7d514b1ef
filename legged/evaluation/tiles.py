"""Terrain on which policies are measured, instead of the terrain of the training."""

from collections.abc import Sequence
from math import ceil
from typing import Any

import numpy as np

from legged.config import LeggedConfig
from legged.config.robot import TerrainConfig
from legged.evaluation.velocity_grid import Grid
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec

BORDER = 3.0
"""Width of the level ground around the outer tiles [m]."""
ROUGH_SPAWN = 2.0
"""Largest distance of a start from the middle of rough ground, in x and y [m]. It lets robots start on different bumps."""
ROUGH_ROOM = 1.5
"""Margin of rough ground beyond the farthest point that a command leads to [m]."""
VARIANTS = 16
"""Number of different tiles of each size, for terrain types with random shapes. Robots are distributed over these tiles,
because a single tile may have an easy way out.
"""


def on_terrain(cfg: LeggedConfig, side: float, spawn_range: float) -> list[tuple[str, Any]]:
    """Return overrides for a task on tiles with sides of `side` [m]. The caller builds the tiles. Observations do not change.

    The overrides describe only one level tile, so that they pass the check of the terrain's size.
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
    """Return the largest cell edge [m] that is at most `cell` [m] and divides `length` [m] into whole cells."""
    return length / ceil(length / cell - 1e-6)


def cell_for(name: str, cfg: TerrainConfig) -> float:
    """Return the edge of height-map cells for a terrain type [m]: the training's, or less to fit the type's features."""
    kind = TERRAIN_TYPES[name]
    if not kind.exact or kind.finest is None:
        return cfg.horizontal_scale
    return dividing_cell(kind.finest[0] * cfg.scale, cfg.horizontal_scale)


def rough_ground(cfg: TerrainConfig, seed: int) -> Terrain:
    """Build one level tile with bumps, on which all robots of a grid walk. `cfg` holds the tile's size (see `rough_side`)."""
    return Terrain.of_tiles([[TileSpec("rough_slope_up", 0.0)]], cfg, np.random.default_rng(seed))


def rough_side(grid: Grid) -> float:
    """Return the side [m] of a tile that robots do not leave while they follow the commands: 20 m for 4 s at 1.4 m/s."""
    fastest = float(np.linalg.norm(grid.cells[:, :2], axis=1).max())
    return 2.0 * ceil(ROUGH_SPAWN + fastest * grid.hold_s + ROUGH_ROOM)


def tiles_of_sizes(name: str, sizes: Sequence[float], cfg: TerrainConfig, seed: int) -> Terrain:
    """Build tiles of one terrain type in all `sizes`, arranged by `tiles_apart`."""
    return tiles_apart([TileSpec(name, size) for size in sizes], cfg, seed)


def tiles_apart(specs: Sequence[TileSpec], cfg: TerrainConfig, seed: int) -> Terrain:
    """Build tiles of all `specs`: variant k of spec i is in row 2 i and column 2 k. Level tiles lie between them, so that a
    robot leaves its own tile before it reaches the next.
    """
    variants = 1 if all(TERRAIN_TYPES[spec.type].regular for spec in specs) else VARIANTS
    rows = [[TileSpec("flat", 0.0)] * (2 * variants - 1) for _ in range(2 * len(specs) - 1)]
    for i, spec in enumerate(specs):
        rows[2 * i][::2] = [spec] * variants
    return Terrain.of_tiles(rows, cfg, np.random.default_rng(seed))
