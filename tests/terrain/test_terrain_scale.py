"""Ground of another scale: the same tiles, larger or smaller, and who has to know."""

import numpy as np
import pytest

from legged.config.origins import Origins
from legged.config.robot import TerrainConfig
from legged.errors import ConfigError
from legged.evaluation.success import sizes_of
from legged.registry import task_config
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec, check_terrain, tile_size
from legged.terrain.generators import Tile

LENGTHS = ("scale", "terrain_length", "terrain_width", "border_size", "horizontal_scale")


def ground(name, scale):
    """One tile of difficulty 0.5 of a robot of that scale, all its lengths in proportion."""
    base = TerrainConfig(mesh_type="height_map", proportions={name: 1.0}, border_size=4.0)
    cfg = TerrainConfig(
        mesh_type="height_map", proportions={name: 1.0}, **{field: getattr(base, field) * scale for field in LENGTHS}
    )
    size = tile_size(cfg, name, 0.5)
    return Terrain.of_tiles([[TileSpec(name, size)]], cfg, np.random.default_rng(3))


@pytest.mark.parametrize("name", TERRAIN_TYPES)
def test_a_tile_of_half_the_scale_is_the_same_tile_half_as_large(name):
    """Cell by cell, bumps and blocks drawn at random included."""
    whole, half = ground(name, 1.0), ground(name, 0.5)
    np.testing.assert_allclose(half.height_map.heights, 0.5 * whole.height_map.heights, atol=1e-6)
    np.testing.assert_allclose(half.origins, 0.5 * whole.origins, atol=1e-6)
    assert half.tile_size == pytest.approx(tuple(0.5 * side for side in whole.tile_size))


def test_lengths_grow_with_the_scale_and_angles_do_not():
    """By hand: the middle row of ten has risers of 0.05 + 0.18 * 0.5 = 0.14 m and a slope of atan(0.2) = 11.31 degrees."""
    cfg = TerrainConfig(scale=0.5)
    assert tile_size(cfg, "stairs_up", 0.5) == pytest.approx(0.07)
    assert tile_size(cfg, "slope_up", 0.5) == pytest.approx(11.3099, abs=1e-4)
    assert tile_size(TerrainConfig(scale=0.5, sizes={"step": 0.15}), "step", 0.5) == 0.15  # asked for in metres


def test_what_is_measured_grows_too():
    assert sizes_of("stairs_up", False) == (0.05, 0.1, 0.15, 0.2, 0.25, 0.3)
    assert sizes_of("stairs_up", False, 0.5) == (0.025, 0.05, 0.075, 0.1, 0.125, 0.15)
    assert sizes_of("slope_up", False, 0.5) == sizes_of("slope_up", False)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gap", "stepping_stones"])
@pytest.mark.parametrize("task", ["a1", "anymal_b", "go2", "go2_flat"])
def test_what_is_measured_is_as_many_cells_wide_as_on_ground_of_scale_1(name, task):
    """Gaps and stones are cut to whole cells: where half a millimetre of their size is missing, so is a cell."""
    cfg = task_config(task).terrain
    for whole, carried in zip(sizes_of(name, True), sizes_of(name, True, cfg.scale), strict=True):
        expected = Terrain.of_tiles([[TileSpec(name, whole)]], TerrainConfig(), np.random.default_rng(3))
        found = Terrain.of_tiles([[TileSpec(name, carried)]], cfg, np.random.default_rng(3))
        border = [round(tile_cfg.border_size / tile_cfg.horizontal_scale) for tile_cfg in (TerrainConfig(), cfg)]
        rows = [
            tile.height_map.heights[n : n + 80, n : n + 80] < -0.1 for tile, n in zip((expected, found), border, strict=True)
        ]
        assert (rows[0] == rows[1]).all(), (whole, carried)


@pytest.mark.parametrize("cell", [0.136623, 0.05893, 0.0905214])
def test_cells_are_counted_though_their_edge_is_rounded(cell):
    """A scale that is 15 cells, each rounded to six digits, makes a platform of 3 m 45 cells wide."""
    tile = Tile(np.zeros((100, 100)), cell, np.random.default_rng(1), float(f"{15 * cell:.6g}"))
    assert tile.cells(3.0) == 45


def test_cells_and_tiles_are_held_against_the_scaled_parts():
    """Treads are 0.31 m, platforms 3 m at scale 1."""
    stairs = {"mesh_type": "height_map", "proportions": {"stairs_up": 1.0}}
    check_terrain(TerrainConfig(**stairs, scale=2.0, horizontal_scale=0.5), Origins())
    with pytest.raises(ConfigError, match=r"larger than the tread of a step of 'stairs_up', 0\.155 m"):
        check_terrain(TerrainConfig(**stairs, scale=0.5, horizontal_scale=0.2), Origins())
    with pytest.raises(ConfigError, match="not larger than the platform of 'stairs_up', 9 m"):
        check_terrain(TerrainConfig(**stairs, scale=3.0), Origins())
