"""Terrain: generators of tiles, a height map of all tiles, and look-ups in it."""

from legged.terrain.generators import BUMPS, METRES, TERRAIN_TYPES, TerrainType, terrain_type, terrain_types
from legged.terrain.height_map import HeightMap
from legged.terrain.terrain import Terrain, TileSpec, check_terrain, hardest_difficulty, tile_size

__all__ = [
    "BUMPS",
    "METRES",
    "TERRAIN_TYPES",
    "HeightMap",
    "Terrain",
    "TerrainType",
    "TileSpec",
    "check_terrain",
    "hardest_difficulty",
    "terrain_type",
    "terrain_types",
    "tile_size",
]
