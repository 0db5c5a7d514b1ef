"""Tiles against numbers worked by hand: 8 x 8 m in cells of 0.1 m, so 80 x 80 cells, their centres at 0.05, 0.15, ..."""

from itertools import pairwise

import numpy as np
import pytest

from legged.terrain import TERRAIN_TYPES
from legged.terrain.generators import Tile, bumps, gap, obstacles, pit, rough_slope, slope, stairs, stepping_stones, waves

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
    assert middle["gap"] == middle["obstacles"] == middle["stepping_stones"] == middle["flat"] == 0.0


@pytest.mark.parametrize(
    ("names", "sizes"),
    [
        (["slope_up", "slope_down", "rough_slope_up", "rough_slope_down"], (0.0, 0.2, 0.36)),  # rise over run
        (["stairs_up", "stairs_down"], (0.05, 0.14, 0.212)),
        (["obstacles"], (0.05, 0.15, 0.23)),
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
