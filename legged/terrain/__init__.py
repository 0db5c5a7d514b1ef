"""Rough ground: tile generators, one height map, and sampling of its heights."""

from legged.terrain.generators import BUMPS, METRES, TERRAIN_TYPES, terrain_type, terrain_types
from legged.terrain.height_map import HeightMap
from legged.terrain.terrain import Terrain, TileSpec, check_terrain, hardest_difficulty, tile_size

__all__ = [
    "BUMPS",
    "METRES",
    "TERRAIN_TYPES",
    "HeightMap",
    "Terrain",
    "TileSpec",
    "check_terrain",
    "hardest_difficulty",
    "terrain_type",
    "terrain_types",
    "tile_size",
]
