"""Rough ground: tile generators, one height map, and how it is sampled."""

from legged.terrain.generators import TERRAIN_TYPES
from legged.terrain.height_map import HeightMap
from legged.terrain.terrain import Terrain, TileSpec, check_terrain

__all__ = ["TERRAIN_TYPES", "HeightMap", "Terrain", "TileSpec", "check_terrain"]
