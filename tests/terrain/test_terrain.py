"""The height map, and how it is laid out: joins, samples, tiles and the errors of a wrong configuration."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from legged.config.loader import merge
from legged.config.origins import Origins
from legged.config.robot import TerrainConfig
from legged.errors import ConfigError
from legged.terrain import TERRAIN_TYPES, HeightMap, Terrain, TileSpec, check_terrain, tile_size
from legged.terrain.height_map import CORNERS, join
from legged.terrain.terrain import column_types

CFG = TerrainConfig(mesh_type="height_map", proportions={"stairs_up": 0.5, "obstacles": 0.5}, border_size=3.0)
EVERYWHERE = np.inf


def terrain_of(rows, seed=0, **settings) -> Terrain:
    """Tiles given as (type, size)."""
    specs = [[TileSpec(*tile) for tile in row] for row in rows]
    return Terrain.of_tiles(specs, replace(CFG, **settings), np.random.default_rng(seed))


def map_of(heights, steepest=EVERYWHERE, cell=1.0, origin=(0.0, 0.0)) -> HeightMap:
    heights = np.array(heights, dtype=float)
    return HeightMap.of(heights, cell, origin, np.full(heights.shape, steepest))


def corners_at(corners: np.ndarray, i: int, j: int) -> list[float]:
    """Heights at lattice point (i, j) of the four cells around it: (i-1, j-1), (i, j-1), (i-1, j), (i, j)."""
    around = ((i - 1, j - 1, 3), (i, j - 1, 2), (i - 1, j, 1), (i, j, 0))
    return [float(corners[cell]) for cell in around]


# ---- joining cells ---------------------------------------------------------------------------------------------------


def test_cells_join_by_their_difference():
    """Along x they differ by 0.2, along y by 0.1; only the latter is a slope, so a face runs along y."""
    corners = join(np.array([[0.0, 0.1], [0.2, 0.3]]), np.full((2, 2), 0.15))
    assert corners_at(corners, 1, 1) == pytest.approx([0.05, 0.25, 0.05, 0.25])
    # On the map's outer edge the cells go on: cell (0, 0) there meets cell (0, 1) only.
    assert corners[0, 0].tolist() == pytest.approx([0.0, 0.0, 0.05, 0.05])
    assert corners[1, 1].tolist() == pytest.approx([0.25, 0.25, 0.3, 0.3])


def test_being_joined_passes_on_around_a_point():
    """(0, 0) to (1, 0) to (1, 1) to (0, 1) are steps of 0.1 each; (0, 1) is 0.3 above (0, 0) and yet shares the point."""
    heights = np.array([[0.0, 0.3], [0.1, 0.2]])
    corners = join(heights, np.full((2, 2), 0.15))
    assert corners_at(corners, 1, 1) == pytest.approx([0.15] * 4)
    # Where the chain does not close, there is a face between the two: at the outer edge x = 0.
    assert corners[0, 0, 2] == pytest.approx(0.0)
    assert corners[0, 1, 0] == pytest.approx(0.3)
    # The other way around, with the face along y.
    assert corners_at(join(heights.T, np.full((2, 2), 0.15)), 1, 1) == pytest.approx([0.15] * 4)


def test_diagonal_neighbours_join_only_through_others():
    """Equal heights across a point, with a high cell on both sides: four corners on their own."""
    corners = join(np.array([[0.0, 1.0], [1.0, 0.0]]), np.full((2, 2), 0.1))
    assert corners_at(corners, 1, 1) == [0.0, 1.0, 1.0, 0.0]
    corners = join(np.array([[0.0, 1.0], [0.1, 0.2]]), np.full((2, 2), 0.1))  # (0, 0), (1, 0) and (1, 1)
    assert corners_at(corners, 1, 1) == pytest.approx([0.1, 0.1, 1.0, 0.1])


def test_a_pillar_stands_alone_and_a_bump_is_smoothed():
    heights = np.zeros((3, 3))
    heights[1, 1] = 1.0
    pillar = join(heights, np.full((3, 3), 0.2))
    assert pillar[1, 1].tolist() == [1.0] * 4
    pillar[1, 1] = 0.0
    assert not pillar.any()
    bump = join(0.1 * heights, np.full((3, 3), 0.2))
    for i, j in ((1, 1), (1, 2), (2, 1), (2, 2)):
        assert corners_at(bump, i, j) == pytest.approx([0.025] * 4)
    assert bump[0, 0].tolist() == pytest.approx([0, 0, 0, 0.025])


@pytest.mark.parametrize(("rise", "shared"), [((0.2, 0.2), True), ((0.2, 0.05), False), ((np.inf, 0.1), True)])
def test_the_smaller_rise_decides(rise, shared):
    """Up to and including that rise the cells are joined."""
    corners = join(np.array([[0.0], [0.1]]), np.array([[rise[0]], [rise[1]]]))
    assert corners[0, 0].tolist() == pytest.approx([0.0, 0.05, 0.0, 0.05] if shared else [0.0] * 4)
    assert corners[1, 0].tolist() == pytest.approx([0.05, 0.1, 0.05, 0.1] if shared else [0.1] * 4)


def test_steepest_is_a_slope_not_a_height():
    """0.1 m over cells of 0.5 m is a slope of 0.2."""
    assert map_of([[0.0], [0.1]], steepest=0.21, cell=0.5).corners[0, 0, 1] == pytest.approx(0.05)
    assert map_of([[0.0], [0.1]], steepest=0.19, cell=0.5).corners[0, 0, 1] == 0.0


# ---- sampling --------------------------------------------------------------------------------------------------------


def test_height_is_bilinear_within_a_cell():
    corners = np.array([[[0.0, 0.1, 0.2, 0.5]]], dtype=np.float32)  # a cell of 0.5 m from (1, 2) to (1.5, 2.5)
    ground = HeightMap(np.zeros((1, 1)), corners, 0.5, (1.0, 2.0))
    assert ground.height_at(1.25, 2.25) == pytest.approx(0.2)
    # At u = 0.2, v = 0.6: 0.02 on the near edge, 0.8 * 0.2 + 0.2 * 0.5 = 0.26 on the far one.
    assert ground.height_at(1.1, 2.3) == pytest.approx(0.4 * 0.02 + 0.6 * 0.26)
    x, y = np.array([1.0, 1.5, 1.0, 1.5]), np.array([2.0, 2.0, 2.5, 2.5])
    np.testing.assert_allclose(ground.height_at(x, y), corners[0, 0], atol=1e-7)
    # Outside, the border goes on.
    assert ground.height_at(0.0, 2.25) == pytest.approx(0.1)
    assert ground.height_at(9.0, 9.0) == pytest.approx(0.5)


def test_height_is_exact_on_a_plane():
    """Inside the outermost cells, whose outer corners have no neighbour to lean on."""
    x, y = -2.0 + 0.25 * (np.arange(16) + 0.5), 1.0 + 0.25 * (np.arange(12) + 0.5)
    ground = map_of(0.7 + 0.3 * x[:, None] - 0.2 * y, cell=0.25, origin=(-2.0, 1.0))
    px, py = np.random.default_rng(0).uniform([[-1.75], [1.25]], [[1.75], [3.75]], (2, 500))
    np.testing.assert_allclose(ground.height_at(px, py), 0.7 + 0.3 * px - 0.2 * py, atol=1e-6)


def test_a_face_belongs_to_the_cell_behind_it():
    ground = map_of([[0.0, 0.0], [1.0, 1.0]], steepest=0.1, cell=0.5)
    assert ground.height_at([0.4999, 0.5, 0.5001], [0.3] * 3).tolist() == [0.0, 1.0, 1.0]


def random_map(rows=9, columns=7) -> HeightMap:
    return map_of(np.random.default_rng(1).uniform(-1.0, 1.0, (rows, columns)), steepest=0.5)


@pytest.mark.parametrize("reach", [0, 1, 3])
def test_ceiling_is_the_highest_corner_around(reach):
    ground = random_map()
    found = ground.ceiling(reach)
    assert found.dtype == np.float32
    for i, j in product(*map(range, found.shape)):
        near = ground.corners[max(0, i - reach) : i + reach + 1, max(0, j - reach) : j + reach + 1]
        assert found[i, j] == near.max()


@pytest.mark.parametrize(("scan", "pick"), [("lowest", min), ("highest", max), ("own", lambda *three: three[0])])
def test_scan_map_reads_of_a_cell_and_its_next_neighbours_what_is_asked_for(scan, pick):
    ground = random_map()
    found = ground.scan_map(scan)
    assert found.dtype == np.float32
    h = ground.heights.astype(np.float32)
    rows, columns = h.shape
    for i, j in product(range(rows), range(columns)):
        assert found[i, j] == pick(h[i, j], h[min(i + 1, rows - 1), j], h[i, min(j + 1, columns - 1)])


def test_a_single_raised_cell_is_seen_not_at_all_as_it_is_or_by_three_cells():
    """Cell (1, 1) is 0.3 m high: it is the next one of (0, 1) in x and of (1, 0) in y."""
    heights = np.zeros((3, 3))
    heights[1, 1] = 0.3
    ground = map_of(heights, steepest=0.1)
    found = {scan: [tuple(cell) for cell in np.argwhere(ground.scan_map(scan))] for scan in ("lowest", "own", "highest")}
    assert found == {"lowest": [], "own": [(1, 1)], "highest": [(0, 1), (1, 0), (1, 1)]}


def test_the_edge_of_a_step_moves_by_at_most_one_cell():
    """Three cells low, three high, along x: `lowest` sees a step down one cell early, `highest` a step up."""
    up = map_of([[0.0]] * 3 + [[0.2]] * 3, steepest=0.1)
    down = map_of([[0.2]] * 3 + [[0.0]] * 3, steepest=0.1)
    high = {
        scan: ((up.scan_map(scan) > 0.1).sum(), (down.scan_map(scan) > 0.1).sum()) for scan in ("lowest", "own", "highest")
    }
    assert high == {"lowest": (3, 2), "own": (3, 3), "highest": (4, 3)}


# ---- layout ----------------------------------------------------------------------------------------------------------


def test_map_is_centred_and_origins_are_the_middles_of_tiles():
    """2 x 3 tiles of 8 x 6 m in 3 m of border."""
    terrain = terrain_of([[("pit", 0.1 * (1 + r)), ("flat", 0.0), ("stairs_down", 0.1)] for r in range(2)], terrain_width=6.0)
    ground = terrain.height_map
    assert ground.heights.shape == (2 * 80 + 60, 3 * 60 + 60)
    assert ground.size == pytest.approx((22.0, 24.0))
    assert ground.origin == pytest.approx((-11.0, -12.0))
    assert terrain.tile_size == pytest.approx((8.0, 6.0))
    assert terrain.border == pytest.approx(3.0)
    assert terrain.reach == pytest.approx((10.0, 11.0))  # 1 m before the end of the map
    np.testing.assert_allclose(terrain.origins[..., 0], [[-4.0] * 3, [4.0] * 3], atol=1e-9)
    np.testing.assert_allclose(terrain.origins[..., 1], [[-6.0, 0.0, 6.0]] * 2, atol=1e-9)
    # Stairs: treads of 3 cells on 60 until at most 30 are left, 5 steps up.
    np.testing.assert_allclose(terrain.origins[..., 2], [[-0.1, 0.0, 0.5], [-0.2, 0.0, 0.5]], atol=1e-9)
    assert terrain.types == ("pit", "flat", "stairs_down")
    # Rows lie along x, columns along y: the pit of the second row is at (4, -6).
    assert ground.height_at([-4.0, 4.0, 4.0, 10.9], [-6.0, -6.0, 6.0, 0.0]) == pytest.approx([-0.1, -0.2, 0.5, 0.0])


def test_robots_start_at_the_highest_point_of_the_middle_square():
    """2 x 2 m around the origin: the cells whose centres are less than 1 m away in x and in y."""
    terrain = terrain_of([[("rough_slope_up", 10.0), ("waves", 0.2)]], seed=4)
    ground = terrain.height_map
    x, y = (o + ground.cell * (np.arange(n) + 0.5) for o, n in zip(ground.origin, ground.heights.shape, strict=True))
    for origin in terrain.origins[0]:
        near = ground.heights[np.ix_(np.abs(x - origin[0]) < 1.0, np.abs(y - origin[1]) < 1.0)]
        assert near.size == 400
        assert origin[2] == near.max() > near.mean()


def test_slopes_are_joined_however_steep_and_steps_are_not_however_low():
    """A slope of 36 % and a step of 3 cm in cells of 10 cm, with a threshold of 20 %."""
    terrain = terrain_of([[("slope_down", np.degrees(np.arctan(0.36))), ("stairs_down", 0.03)]])
    corners = terrain.height_map.corners[31:109]  # without the cells next to the border
    slope, stairs = corners[:, 31:109], corners[:, 111:189]
    assert all(np.ptp(corners_at(slope, i, i)) < 1e-6 for i in range(1, 77))
    assert np.ptp(slope, axis=2).max() > 0.03
    assert np.ptp(stairs, axis=2).max() == 0.0
    # A higher threshold makes slopes of such steps, half of them on either side; at the corner of a ring its cell hangs
    # down by three quarters, as three of the four cells there are lower.
    joined = np.ptp(terrain_of([[("stairs_down", 0.03)]], slope_threshold=0.35).height_map.corners, axis=2)
    assert joined[70, 32:35] == pytest.approx([0.015, 0.015, 0.0], abs=1e-6)
    assert joined.max() == pytest.approx(0.0225, abs=1e-6)


def test_columns_follow_the_proportions():
    shares = {"slope_up": 0.05, "slope_down": 0.05, "stairs_up": 0.35, "gap": 0.0, "stairs_down": 0.3, "obstacles": 0.25}
    counts = {"slope_up": 1, "slope_down": 1, "stairs_up": 7, "stairs_down": 6, "obstacles": 5}
    found = column_types(shares, 20)
    assert found == [name for name, count in counts.items() for _ in range(count)]
    assert column_types({"gap": 0.4, "pit": 0.6}, 3) == ["gap", "pit", "pit"]
    assert column_types({"gap": 0.1, "pit": 0.2, "flat": 0.7}, 10) == ["gap"] + ["pit"] * 2 + ["flat"] * 7  # sum rounds


def test_rows_get_harder():
    """Row / num_rows is the difficulty, and the depth of a pit in metres."""
    cfg = replace(CFG, proportions={"pit": 1.0}, num_rows=5, num_cols=2)
    terrain = Terrain.build(cfg, 1)
    np.testing.assert_allclose(terrain.origins[..., 2], np.repeat(-0.2 * np.arange(5)[:, None], 2, axis=1))
    assert terrain.type_names == ("pit",)


def test_without_a_curriculum_every_row_is_hard():
    cfg = replace(CFG, proportions={"pit": 1.0}, num_rows=12, num_cols=1, curriculum=False)
    depths = -Terrain.build(cfg, 1).origins[:, 0, 2]
    assert set(depths.round(9)) == {0.5, 0.75, 0.9}


def test_a_seed_is_a_map():
    cfg = replace(CFG, num_rows=3, num_cols=2)
    one, same, other = (Terrain.build(cfg, seed) for seed in (1, 1, 2))
    assert (one.height_map.corners == same.height_map.corners).all()
    assert (one.height_map.corners != other.height_map.corners).any()
    assert one.types == ("stairs_up", "obstacles")
    # Tiles of one map differ too: rows 1 and 2 of the obstacles, where they have one.
    a, b = (one.height_map.heights[30 + 80 * r : 110 + 80 * r, 110:190] != 0.0 for r in (1, 2))
    assert (a != b).any()


def test_corners_are_listed_with_x_first():
    assert CORNERS == ((0, 0), (1, 0), (0, 1), (1, 1))
    heights = map_of([[0.0, 0.2], [0.4, 0.6]]).corners[0, 0]
    assert heights.tolist() == pytest.approx([0.0, 0.2, 0.1, 0.3])  # along x the ground rises faster


# ---- wrong configurations --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"proportions": {"stairs_up": 0.5, "obstacles": 0.4}}, ["proportions", "sum to 1, got 0.9", "obstacles 0.4"]),
        ({"proportions": {}}, ["proportions", "sum to 1"]),
        ({"proportions": {"stair_up": 1.0}}, ["proportions.stair_up", "did you mean 'stairs_up'?"]),
        ({"proportions": {"stairs_up": 1.5, "gap": -0.5}}, ["proportions.gap", "at least 0, got -0.5"]),
        ({"proportions": {"stairs_up": 0.98, "gap": 0.02}}, ["proportions.gap", "num_cols = 20", "less than one"]),
        ({"terrain_length": 3.0}, ["3 x 8 m", "platform", "'stairs_up', 3 m"]),
        ({"terrain_width": 4.0, "proportions": {"pit": 1.0}}, ["8 x 4 m", "'pit', 4 m"]),
        ({"spawn_range": 4.0}, ["spawn_range", "4 m", "outside"]),
        ({"max_init_terrain_level": 10}, ["max_init_terrain_level", "num_rows = 10", "got 10"]),
        ({"border_size": 1.9}, ["border_size", "at least 2", "1.9"]),
        (
            {"horizontal_scale": 0.02},
            ["horizontal_scale", "86 x 166 m in cells of 0.02 m are 35,690,000", "16,777,216"],
        ),
        ({"horizontal_scale": 0.32}, ["horizontal_scale: cells of 0.32 m", "tread of a step of 'stairs_up', 0.31 m"]),
        ({"horizontal_scale": 1.1, "proportions": {"obstacles": 1.0}}, ["cells of 1.1 m", "side of a block", "1 m"]),
        ({"horizontal_scale": 0.11, "proportions": {"stepping_stones": 1.0}}, ["cells of 0.11 m", "gap between two stones"]),
        ({"horizontal_scale": 0.6, "proportions": {"gap": 1.0}}, ["cells of 0.6 m", "width of a ditch"]),
        ({"horizontal_scale": 0.6, "proportions": {"waves": 1.0}}, ["cells of 0.6 m", "quarter of a wave"]),
        ({"horizontal_scale": 2.5, "proportions": {"flat": 1.0}}, ["cells of 2.5 m", "2 m square in which robots start"]),
        (
            {"horizontal_scale": 1.5, "terrain_width": 1.2, "spawn_range": 0.1, "proportions": {"flat": 1.0}},
            ["cells of 1.5 m are larger than a tile of 1.2 m"],
        ),
        ({"num_rows": 101, "num_cols": 100, "terrain_width": 3.5}, ["num_rows", "num_cols = 100", "10,100 tiles"]),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_wrong_terrain_is_named(changes, words):
    origins = Origins()
    merge({}, {"terrain": changes}, "my_task.yaml", origins)
    with pytest.raises(ConfigError) as error:
        check_terrain(replace(CFG, **changes), origins)
    for word in ["my_task.yaml: terrain.", *words]:
        assert word in str(error.value)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"mesh_type": "plane", "proportions": {"nonsense": 3.0}},  # a plane asks for nothing else
        {"terrain_length": 3.1, "spawn_range": 1.5, "max_init_terrain_level": 9, "border_size": 2.0},
        {"terrain_length": 3.1, "proportions": {"flat": 1.0, "pit": 0.0}},  # the pit's platform does not count
        {"proportions": {"stairs_up": 0.95, "gap": 0.05}},  # one column
        {"horizontal_scale": 0.31},  # a cell a step
        {"horizontal_scale": 2.0, "proportions": {"flat": 1.0}},
        {"proportions": dict.fromkeys(TERRAIN_TYPES, 1.0 / len(TERRAIN_TYPES)), "num_cols": len(TERRAIN_TYPES)},
    ],
)
def test_right_terrain_passes(changes):
    check_terrain(replace(CFG, **changes), Origins())


def test_a_size_of_ones_own_takes_the_place_of_those_that_grow():
    cfg = TerrainConfig(
        mesh_type="height_map", proportions={"step": 0.5, "pit": 0.5}, sizes={"step": 0.15}, num_rows=4, num_cols=2
    )
    assert [tile_size(cfg, "step", d) for d in (0.0, 0.5, 1.0)] == [0.15] * 3
    assert [tile_size(cfg, "pit", d) for d in (0.0, 0.5, 1.0)] == [0.0, 0.5, 1.0]
    terrain = Terrain.build(cfg, 1)
    assert terrain.height_map.heights.max() == pytest.approx(0.15)


def test_sizes_between_two_go_from_the_easier_to_the_harder():
    sizes = {"stairs_up": (0.1, 0.3), "stepping_stones": (0.4, 1.2)}
    cfg = TerrainConfig(mesh_type="height_map", proportions={"stairs_up": 1.0}, sizes=sizes, num_rows=4, num_cols=1)
    assert [tile_size(cfg, "stairs_up", d) for d in (0.0, 0.5, 1.0)] == pytest.approx([0.1, 0.2, 0.3])
    assert [tile_size(cfg, "stepping_stones", d) for d in (0.0, 0.5, 1.0)] == pytest.approx([1.2, 0.8, 0.4])
    heights = Terrain.build(replace(cfg, border_size=0.0), 1).height_map.heights
    steps = np.diff(heights[:, heights.shape[1] // 2])
    assert np.unique(np.abs(steps[steps != 0.0]).round(3)) == pytest.approx([0.1, 0.15, 0.2, 0.25])


@pytest.mark.parametrize("size", [90.0, (10.0, 120.0)])
def test_a_slope_as_steep_as_a_wall_is_refused(size):
    """At 90 degrees the ground would be 1e16 m high, and beyond it `slope_up` would go down."""
    cfg = TerrainConfig(mesh_type="height_map", proportions={"slope_up": 1.0}, sizes={"slope_up": size})
    with pytest.raises(ConfigError, match=r"terrain\.sizes\.slope_up: must be at most 80 degrees, got (90|120)$"):
        check_terrain(cfg, Origins())
    check_terrain(replace(cfg, sizes={"slope_up": 80.0}), Origins())


def test_a_size_of_a_type_that_there_is_not_is_refused():
    cfg = TerrainConfig(mesh_type="height_map", proportions={"step": 1.0}, sizes={"stpe": 0.15})
    with pytest.raises(ConfigError, match=r"terrain\.sizes\.stpe: there is no terrain type 'stpe'; did you mean 'step'"):
        check_terrain(cfg, Origins())
