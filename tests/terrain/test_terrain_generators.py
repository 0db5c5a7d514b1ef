"""Tiles against numbers worked by hand: 8 x 8 m in cells of 0.1 m, so 80 x 80 cells, their centres at 0.05, 0.15, ..."""

from itertools import pairwise

import numpy as np
import pytest

from legged.config.robot import TerrainConfig
from legged.terrain import TERRAIN_TYPES, HeightMap, Terrain, TileSpec
from legged.terrain.generators import (
    Tile,
    bumps,
    dense_blocks,
    gap,
    kerbs,
    obstacles,
    pit,
    random_grid,
    rough_slope,
    rubble,
    slope,
    stairs,
    stepping_stones,
    waves,
)

CELLS = np.arange(80)
FROM_EDGE = np.minimum(CELLS, CELLS[::-1])
RING = np.minimum(FROM_EDGE[:, None], FROM_EDGE[None, :])
"""(80, 80) number of cells between each cell and the nearest edge of the tile."""


def tile(seed=0, shape=(80, 80)) -> Tile:
    return Tile(np.zeros(shape), 0.1, np.random.default_rng(seed))


def made(generate, *arguments, seed=0, **settings) -> np.ndarray:
    one = tile(seed)
    generate(one, *arguments, **settings)
    return one.heights


def runs(values: np.ndarray) -> list[tuple[float, int]]:
    """[0, 0, -1, 0] -> [(0, 2), (-1, 1), (0, 1)]."""
    ends = [0, *(np.flatnonzero(np.diff(values)) + 1), len(values)]
    return [(float(values[a]), int(b - a)) for a, b in pairwise(ends)]


def test_stairs_are_rings_with_treads_of_whole_cells():
    """0.31 m is 3 cells. Rings at 3, 6, ... 27 cells: after 24 there are 32 left, more than the platform's 30, so 9 rise."""
    heights = made(stairs, 0.12)
    np.testing.assert_allclose(heights, 0.12 * np.minimum(RING // 3, 9))
    assert heights[40, 40] == pytest.approx(9 * 0.12)
    assert (heights.max() - heights < 1e-9).sum() == 26 * 26
    np.testing.assert_allclose(made(stairs, -0.12), -heights)


def test_stairs_stop_at_a_larger_platform_and_on_wider_treads():
    """Treads of 5 cells to a platform of at most 4 m: at 5, 10, 15, 20, where 40 are left."""
    heights = made(stairs, 0.1, platform=4.0, tread=0.5)
    np.testing.assert_allclose(heights, 0.1 * np.minimum(RING // 5, 4))


def test_slope_rises_with_the_distance_from_the_edge_to_a_level_platform():
    """Rise over run 0.4: 0.02 m at the centre of the first cell, 0.4 * 2.5 m on the platform of 3 m."""
    heights = made(slope, np.degrees(np.arctan(0.4)))
    np.testing.assert_allclose(heights, 0.4 * np.minimum(0.1 * RING + 0.05, 2.5), atol=1e-12)
    assert heights[0, 40] == pytest.approx(0.02)
    assert heights[10, 40] == pytest.approx(0.42)
    np.testing.assert_allclose(heights[25:55, 25:55], 1.0)
    assert heights[24, 40] == pytest.approx(0.98)


def test_bumps_are_drawn_every_second_cell_and_joined_by_lines():
    heights = bumps(tile(seed=1), 0.05)
    drawn = heights[::2, ::2] / 0.005
    np.testing.assert_allclose(drawn, drawn.round(), atol=1e-6)
    assert set(drawn.round().astype(int).ravel()) == set(range(-10, 11))  # of 1600 draws from 21 levels none is left out
    assert np.abs(heights).max() == pytest.approx(0.05)
    np.testing.assert_allclose(heights[1:-1:2], 0.5 * (heights[:-2:2] + heights[2::2]), atol=1e-12)
    np.testing.assert_allclose(heights[:, 1:-1:2], 0.5 * (heights[:, :-2:2] + heights[:, 2::2]), atol=1e-12)


def test_rough_slope_is_a_slope_with_bumps():
    np.testing.assert_allclose(made(rough_slope, 8.0, seed=2), made(slope, 8.0) + bumps(tile(seed=2), 0.05))


def test_an_obstacle_is_a_rectangle_of_three_lengths_and_four_heights():
    """One at a time, without the free middle: sides of 1.0, 1.4 or 1.8 m, heights +-0.2 and +-0.1."""
    found, heights = set(), set()
    for seed in range(100):
        one = made(obstacles, 0.2, seed=seed, platform=0.0, count=1)
        at = np.argwhere(one != 0.0)
        low, high = at.min(axis=0), at.max(axis=0) + 1
        assert len(at) == np.prod(high - low)  # it fills its outline
        found |= set((high - low).tolist())
        heights |= set(one[one != 0.0].tolist())
    assert found == {10, 14, 18}
    assert sorted(heights) == pytest.approx([-0.2, -0.1, 0.1, 0.2])


def test_obstacles_leave_the_middle_free():
    heights = made(obstacles, 0.2, seed=3)
    assert not heights[25:55, 25:55].any()
    assert set(np.unique(heights).round(9)) == {-0.2, -0.1, 0.0, 0.1, 0.2}
    assert 0.1 < (heights != 0.0).mean() < 0.7


def test_stepping_stones_have_their_sides_and_gaps():
    """Stones of 0.5 m and gaps of 0.1 m: 5 cells and 1; rows of stones start every 6 cells, shifted as they like."""
    heights = made(stepping_stones, 0.5, seed=1)
    assert set(np.unique(heights)) == {-1.0, 0.0}
    assert not heights[20:60, 20:60].any()  # the platform of 4 m
    shifts = set()
    for x in range(20):
        if x % 6 == 5:
            assert (heights[x] == -1.0).all()
            continue
        first, *inner, _ = runs(heights[x])
        assert all(run in ((0.0, 5), (-1.0, 1)) for run in inner)
        assert first[1] <= 5
        shifts.add(first)
        np.testing.assert_array_equal(heights[x], heights[6 * (x // 6)])  # the same stones all along their side
    assert len(shifts) > 1


def test_small_stones_are_still_there():
    """0.075 m is less than a cell: a cell each."""
    heights = made(stepping_stones, 0.075)
    assert runs(heights[0]) == [(0.0, 1), (-1.0, 1)] * 40
    assert (heights[1] == -1.0).all()


def test_gap_is_a_ditch_of_its_width_around_the_platform():
    """0.57 m is 5 cells, around 3 m: from 4 m / 2 = 20 cells before the middle to 15; 1 m deep."""
    expected = np.zeros((80, 80))
    expected[20:60, 20:60] = -1.0
    expected[25:55, 25:55] = 0.0
    np.testing.assert_array_equal(made(gap, 0.57), expected)
    assert not made(gap, 0.0).any()


def test_gap_wider_than_its_tile_takes_all_of_it():
    """3 m and twice 0.9 m are more than 4 m."""
    small = tile(shape=(40, 40))
    gap(small, 0.9)
    assert (small.heights == -1.0).sum() == 40 * 40 - 30 * 30


def test_pit_is_as_deep_as_asked():
    expected = np.zeros((80, 80))
    expected[20:60, 20:60] = -0.35
    np.testing.assert_array_equal(made(pit, 0.35), expected)


def test_waves_have_their_amplitude_and_fade_at_the_edge():
    """sin(2 pi 4.55 / 2) = sin(0.55 pi) = 0.98769 along both axes is near the crest; the last metre fades in lines."""
    heights = made(waves, 0.2)
    assert heights[45, 45] == pytest.approx(0.2 * 0.98769, abs=1e-6)
    assert heights[40, 40] == pytest.approx(0.2 * np.sin(0.05 * np.pi))
    assert heights[35, 35] == pytest.approx(-0.2 * np.sin(0.45 * np.pi))
    assert np.abs(heights).max() <= 0.2
    # 0.05 m from the edge: a twentieth.
    assert heights[0, 45] == pytest.approx(0.05 * 0.1 * (np.sin(0.05 * np.pi) + 0.98769), abs=1e-6)
    assert np.abs(heights[RING == 0]).max() <= 0.05 * 0.2


def test_every_type_is_made_of_its_size():
    """Up means that robots, who start in the middle, have to climb."""
    middle = {}
    for name, kind in TERRAIN_TYPES.items():
        one = tile(seed=1)
        kind.generate(one, kind.size(0.5))
        middle[name] = float(one.heights[40, 40])
        assert np.isfinite(one.heights).all()
        assert one.heights.any() == (name != "flat")
    assert middle["stairs_up"] == pytest.approx(-9 * 0.14)
    assert middle["stairs_down"] == pytest.approx(9 * 0.14)
    assert middle["slope_up"] == pytest.approx(-0.2 * 2.5)
    assert middle["slope_down"] == pytest.approx(0.2 * 2.5)
    assert middle["rough_slope_up"] == pytest.approx(-0.5, abs=0.05)
    assert middle["rough_slope_down"] == pytest.approx(0.5, abs=0.05)
    assert middle["pit"] == pytest.approx(-0.5)
    assert middle["narrow_stairs_up"] == pytest.approx(-13 * 0.14)  # treads of 2 cells: after 24 there are 32 left, then 30
    assert middle["narrow_stairs_down"] == pytest.approx(13 * 0.14)
    assert middle["dense_blocks"] == middle["kerbs"] == middle["rubble"] == middle["random_grid"] == 0.0
    assert middle["gap"] == middle["obstacles"] == middle["stepping_stones"] == middle["flat"] == 0.0


@pytest.mark.parametrize(
    ("names", "sizes"),
    [
        (["slope_up", "slope_down", "rough_slope_up", "rough_slope_down"], (0.0, 0.2, 0.36)),  # rise over run
        (["stairs_up", "stairs_down"], (0.05, 0.14, 0.212)),
        (["narrow_stairs_up", "narrow_stairs_down", "kerbs"], (0.05, 0.14, 0.212)),
        (["obstacles", "random_grid", "dense_blocks", "rubble"], (0.05, 0.15, 0.23)),
        (["stepping_stones"], (1.575, 0.825, 0.225)),
        (["gap"], (0.0, 0.5, 0.9)),
        (["pit"], (0.0, 0.5, 0.9)),
        (["waves"], (0.0, 0.1, 0.18)),
        (["flat"], (0.0, 0.0, 0.0)),
    ],
)
def test_sizes_by_difficulty(names, sizes):
    """legged_gym's table at difficulties 0, 0.5 and 0.9."""
    for name in names:
        kind = TERRAIN_TYPES[name]
        found = [kind.size(d) for d in (0.0, 0.5, 0.9)]
        if kind.unit == "degrees":
            found = np.tan(np.radians(found)).tolist()
        assert found == pytest.approx(sizes)


@pytest.mark.slow
@pytest.mark.parametrize("name", TERRAIN_TYPES)
@pytest.mark.parametrize("cell", [0.32, 0.5, 1.5, 5.0])
def test_every_type_comes_to_an_end_on_coarse_cells(name, cell):
    """Whoever makes tiles without the check of a configuration gets a coarse tile, not an endless loop."""
    kind = TERRAIN_TYPES[name]
    one = Tile(np.zeros((6, 6)), cell, np.random.default_rng(0))
    kind.generate(one, kind.size(0.5))
    assert np.isfinite(one.heights).all()


@pytest.mark.parametrize("name", [name for name, kind in TERRAIN_TYPES.items() if kind.finest])
def test_the_largest_cells_that_are_admitted_make_the_type(name):
    """There is something on the tile, beside level ground, at every level of a training from the second to the hardest."""
    kind = TERRAIN_TYPES[name]
    count = round(8.0 / kind.finest[0])
    for difficulty in (0.6, 0.9):
        one = Tile(np.zeros((count, count)), kind.finest[0], np.random.default_rng(0))
        kind.generate(one, kind.size(difficulty))
        assert len(np.unique(one.heights.round(6))) > 1


@pytest.mark.parametrize("name", TERRAIN_TYPES)
def test_tiles_of_regular_types_are_the_same_and_others_are_not(name):
    kind, tiles = TERRAIN_TYPES[name], [Tile(np.zeros((80, 80)), 0.1, np.random.default_rng(seed)) for seed in (1, 2)]
    for tile in tiles:
        kind.generate(tile, kind.size(0.5))
    assert (tiles[0].heights == tiles[1].heights).all() == kind.regular


def test_sizes_in_words():
    assert TERRAIN_TYPES["stairs_up"].text(0.19400000000000003) == "0.194 m"
    assert TERRAIN_TYPES["gap"].text(0.125, 0.30000000000000004, 1.0) == "0.125 to 0.3 to 1 m"
    assert TERRAIN_TYPES["slope_up"].text(11.31, 17.74) == "11 to 18 degrees"


def test_a_single_step_goes_up_all_around_the_platform_and_down_again():
    """On a tile of 8 m: level to 1.5 m from the middle, 15 cm up to 2.5 m, level from there."""
    tile = Tile(np.zeros((80, 80)), 0.1, np.random.default_rng(0))
    TERRAIN_TYPES["step"].generate(tile, 0.15)
    distance = tile.from_centre()
    assert (tile.heights[(distance > 1.5) & (distance < 2.5)] == 0.15).all()
    assert (tile.heights[(distance < 1.5) | (distance > 2.5)] == 0.0).all()
    assert (tile.heights > 0.0).sum() == 50**2 - 30**2


# ---- ground that nobody trains on ------------------------------------------------------------------------------------


def test_narrow_stairs_have_their_tread_where_cells_divide_it():
    """0.28 m are 4 cells of 0.07 m: rings at 4, 8, ... of a tile of 114 cells, to a platform of at most 42: after 36."""
    one = Tile(np.zeros((114, 114)), 0.07, np.random.default_rng(0))
    TERRAIN_TYPES["narrow_stairs_down"].generate(one, 0.17)
    edge = np.minimum(np.arange(114), np.arange(114)[::-1])
    np.testing.assert_allclose(one.heights[57], 0.17 * np.minimum(edge // 4, 9))


def test_a_tile_may_have_a_tread_of_its_own_whatever_its_scale():
    """0.5 m on a tile of half the scale, in cells of 0.05 m: 10 cells, to a platform of 1.5 m: 30."""
    for name in ("stairs_down", "narrow_stairs_down"):
        one = Tile(np.zeros((80, 80)), 0.05, np.random.default_rng(0), scale=0.5, tread=0.5)
        TERRAIN_TYPES[name].generate(one, 0.1)
        np.testing.assert_allclose(one.heights[40], 0.1 * np.minimum(FROM_EDGE // 10, 3))
    terrain = Terrain.of_tiles([[TileSpec("stairs_down", 0.1, tread=0.4)]], TerrainConfig(border_size=2.0), None)
    assert runs(terrain.height_map.heights[60, 20:40])[:3] == [(pytest.approx(0.0), 4), (pytest.approx(0.1), 4), (0.2, 4)]


def test_dense_blocks_leave_no_room_but_the_middle():
    """Tops at quarters of the height; anywhere else level ground of the size of a robot (0.9 by 0.5 m) is rare."""
    heights = made(dense_blocks, 0.2, seed=3)
    assert set((heights / 0.05).round(6).ravel()) == {0.0, 1.0, 2.0, 3.0, 4.0}
    assert not heights[30:50, 30:50].any()
    outside = np.ones((80, 80), dtype=bool)
    outside[30:50, 30:50] = False
    assert (heights[outside] > 0.0).mean() > 0.5
    windows = np.lib.stride_tricks.sliding_window_view(np.where(outside, heights, np.nan), (9, 5))
    level = np.ptp(windows, axis=(2, 3)) == 0.0  # windows that reach into the middle are NaN: not level
    assert level.mean() < 0.05


def test_a_single_dense_block_has_sides_of_3_to_8_cells():
    sides = set()
    for seed in range(200):
        one = made(dense_blocks, 0.2, seed=seed, platform=0.0, cover=1e-6)
        at = np.argwhere(one > 0.0)
        if len(at):
            low, high = at.min(axis=0), at.max(axis=0) + 1
            assert len(at) == np.prod(high - low)
            if low.min() > 0 and high.max() < 80:  # the tile's edge cuts off no part
                sides |= set((high - low).tolist())
    assert sides == {3, 4, 5, 6, 7}  # 8 would be drawn as 0.8 m exactly


def test_squares_of_a_random_grid_have_heights_of_their_own():
    """0.45 m are 4 cells: 20 by 20 squares at quarters from -0.1 to 0.1 m, around a platform of 20 cells."""
    heights = made(random_grid, 0.2, seed=3)
    squares = heights.reshape(20, 4, 20, 4).swapaxes(1, 2).reshape(20, 20, 16)
    outside = np.ones((20, 20), dtype=bool)
    outside[7:13, 7:13] = False  # squares 7 and 12 are half in the platform, cells 30 to 49
    assert not heights[30:50, 30:50].any()
    assert (np.ptp(squares, axis=2) == 0.0)[outside].all()
    levels, counts = np.unique((squares[outside, 0] / 0.05).round(6), return_counts=True)
    assert levels.tolist() == [-2.0, -1.0, 0.0, 1.0, 2.0]
    assert counts.min() > 364 / 5 * 0.7
    same = squares[:, 1:, 0] == squares[:, :-1, 0]
    assert same.mean() == pytest.approx(0.2, abs=0.07)  # neighbours are independent, but for the 15 in the platform


def test_kerbs_stand_out_of_level_ground():
    """Around a platform of 2 m, from 1 m on: 2 cells up, 8 level, 2 up, ...: rings 28 and 29, 18 and 19, 8 and 9."""
    np.testing.assert_allclose(made(kerbs, 0.15), np.where(np.isin(RING, [8, 9, 18, 19, 28, 29]), 0.15, 0.0))


def test_rubble_is_made_of_turned_slabs():
    heights = made(rubble, 0.2, seed=2)
    assert not heights[30:50, 30:50].any()
    assert set((heights / 0.05).round(6).ravel()) == {0.0, 1.0, 2.0, 3.0, 4.0}
    assert 0.5 < (heights > 0.0).mean() < 0.95
    turned = 0
    for seed in range(40):
        stone = made(rubble, 0.2, seed=seed, platform=0.0, cover=1e-6) > 0.0  # a single one
        at = np.argwhere(stone)
        assert len(at) <= 30  # 0.5 x 0.5 m are 25 cells, as many centres more or less as the edge lies
        turned += len(at) > 0 and len(at) < np.prod(np.ptp(at, axis=0) + 1)  # it does not fill its outline
    assert turned > 20


@pytest.mark.parametrize("name", ["dense_blocks", "kerbs", "rubble", "narrow_stairs_up"])
def test_faces_of_new_ground_are_vertical(name):
    """In the height map, all cells of a corner that differ by more than 2 cm (a slope of 0.2) keep corners of their own."""
    terrain = Terrain.of_tiles([[TileSpec(name, 0.2)]], TerrainConfig(border_size=2.0), np.random.default_rng(5))
    ground: HeightMap = terrain.height_map
    jump = np.abs(np.diff(ground.heights, axis=0)) > 0.15
    assert jump.any()
    right, left = ground.corners[:-1, :, 1], ground.corners[1:, :, 0]  # two sides of one lattice point
    assert (np.abs(right - left)[jump] > 0.05).all()
