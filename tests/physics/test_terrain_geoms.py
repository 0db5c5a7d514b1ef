"""Geoms of a terrain: C MuJoCo finds the surface of the height map with rays and with falling spheres."""

import time

import mujoco
import numpy as np
import pytest

from legged.config.robot import TerrainConfig
from legged.physics.scene.terrain_geoms import DEPTH, _rectangles, add_height_field, add_terrain
from legged.terrain import TERRAIN_TYPES, HeightMap, Terrain, TileSpec

DOWN = (0.0, 0.0, -1.0)
BOX, HFIELD = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_HFIELD
TRAINING = {
    "slope_up": 0.05,
    "slope_down": 0.05,
    "rough_slope_up": 0.05,
    "rough_slope_down": 0.05,
    "stairs_up": 0.35,
    "stairs_down": 0.25,
    "obstacles": 0.2,
}


def terrain_of(names, difficulties, seed=3, **settings) -> Terrain:
    """One row a difficulty, one column a type, and 3 m of border."""
    rows = [[TileSpec(name, TERRAIN_TYPES[name].size(d)) for name in names] for d in difficulties]
    return Terrain.of_tiles(rows, TerrainConfig(border_size=3.0, **settings), np.random.default_rng(seed))


def compiled(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def seen(terrain: Terrain) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The geoms for the eye: those that collide lie deeper where they have a skin."""
    return scene(terrain, collide=False)


def scene(terrain: Terrain, **arguments) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec()
    add_terrain(spec, terrain, **arguments)
    return compiled(spec)


def ray(model, data, start, direction=DOWN) -> float:
    """Distance to the first geom [m], -1 if there is none."""
    return mujoco.mj_ray(model, data, np.array(start, dtype=float), np.array(direction), None, 1, -1, None)


def heights_by_ray(model, data, x, y, above=5.0) -> np.ndarray:
    return np.array([above - ray(model, data, (a, b, above)) for a, b in zip(x, y, strict=True)])


def points_in_cells(ground: HeightMap, count=4000):
    """Cells i, j and points x, y in them that are more than 1 mm away from their edges."""
    rng = np.random.default_rng(0)
    i, j = (rng.integers(n, size=count) for n in ground.heights.shape)
    u, v = rng.uniform(0.011, 0.989, (2, count))
    return i, j, ground.origin[0] + (i + u) * ground.cell, ground.origin[1] + (j + v) * ground.cell


def twist(ground: HeightMap, i, j) -> np.ndarray:
    """How far two triangles may lie from the bilinear patch on the same corners [m]."""
    a, b, c, d = np.moveaxis(ground.corners[i, j].astype(float), -1, 0)
    return np.abs(a - b - c + d) / 4.0


def kinds(model) -> list[int]:
    return model.geom_type.tolist()


# ---- the surface -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_rays_find_the_height_map_on_every_type():
    terrain = terrain_of(list(TERRAIN_TYPES), (0.2, 0.9))
    ground = terrain.height_map
    model, data = seen(terrain)
    i, j, x, y = points_in_cells(ground)
    error = np.abs(heights_by_ray(model, data, x, y) - ground.height_at(x, y))
    bound = twist(ground, i, j)
    assert (error < bound + 1e-4).all()
    # Most of this map is made of boxes and planes, where there is nothing to allow for.
    assert (bound < 1e-6).mean() > 0.8
    assert (bound > 1e-3).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "difficulties", "threshold"),
    [
        pytest.param(["obstacles", "rough_slope_up", "obstacles", "stairs_up"], (0.2, 0.5, 0.9), 0.75, id="few slopes"),
        pytest.param(["rubble", "dense_blocks", "random_grid"], (0.2, 0.9), 0.75, id="many slopes"),
        pytest.param(["rubble", "dense_blocks", "random_grid"], (0.0, 0.1), 0.2, id="the easiest rows"),
    ],
)
def test_rays_find_slopes_among_steps(names, difficulties, threshold):
    """With slope_threshold 0.75 cells up to 7.5 cm apart are joined, with 0.2 those up to 2 cm: slopes lie beside faces,
    around lower cells, and beside other slopes. One height field of them all was up to 0.23 m too high.
    """
    terrain = terrain_of(names, difficulties, slope_threshold=threshold)
    ground = terrain.height_map
    model, data = seen(terrain)
    i, j, x, y = points_in_cells(ground)
    error = np.abs(heights_by_ray(model, data, x, y) - ground.height_at(x, y))
    assert (error < twist(ground, i, j) + 1e-4).all()
    sloped = np.ptp(ground.corners[i, j], axis=1) > 0.01
    stepped = np.array([TERRAIN_TYPES[name].stepped for name in names])
    column = ((y - ground.origin[1] - 3.0) // 8.0).astype(int)
    assert (sloped & stepped[np.clip(column, 0, len(names) - 1)]).sum() > 50


def test_border_beside_rough_ground_slopes_with_it():
    """The bumps of the outer tile are joined to the border: its first cells are no longer level, and rays see that."""
    terrain = terrain_of(["rough_slope_up"], (0.5,))
    ground = terrain.height_map
    i = np.full(80, 29)  # the last of the border's 30 cells before the tile
    j = np.arange(30, 110)
    x, y = ground.origin[0] + (i + 0.7) * 0.1, ground.origin[1] + (j + 0.5) * 0.1
    model, data = seen(terrain)
    found = heights_by_ray(model, data, x, y)
    assert np.abs(found).max() > 0.005
    np.testing.assert_array_less(np.abs(found - ground.height_at(x, y)), twist(ground, i, j) + 1e-4)


def test_riser_is_vertical_and_at_the_edge_of_its_cell():
    """From the platform at the bottom, rings rise 3 cells after each other: the platform has 80 - 2 * 27 = 26 cells."""
    terrain = terrain_of(["stairs_up"], (0.5,))  # risers of 0.14 m
    model, data = scene(terrain)
    bottom = terrain.origins[0, 0, 2]
    assert bottom == pytest.approx(-9 * 0.14)
    for direction in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)):
        for height, distance in ((0.001, 1.3), (0.07, 1.3), (0.139, 1.3), (0.141, 1.6), (0.279, 1.6), (0.281, 1.9)):
            for aside in (0.0, 1.2499, -1.2499):  # up to the corner of the ring
                start = np.array([0.0, 0.0, bottom + height]) + aside * np.array([direction[1], direction[0], 0])
                assert ray(model, data, start, np.array(direction, dtype=float)) == pytest.approx(distance, abs=1e-6)


def test_nothing_slips_between():
    """All boxes reach far below the lowest point, also below the ground of pits."""
    terrain = terrain_of(["stairs_up", "pit", "flat"], (0.9,))
    model, _ = scene(terrain)
    bottoms = model.geom_pos[:, 2] - model.geom_size[:, 2]
    np.testing.assert_allclose(bottoms, terrain.height_map.corners.min() - DEPTH, atol=1e-5)


# ---- contact ---------------------------------------------------------------------------------------------------------


def test_spheres_rest_on_treads_and_slopes():
    """A sphere in the middle of a tread (0.3 m wide), one on a level platform, one on the border."""
    terrain = terrain_of(["stairs_down", "slope_down"], (0.5,))
    spec = mujoco.MjSpec()
    add_terrain(spec, terrain)
    stairs, slope = terrain.origins[0]
    radius = 0.05
    places = np.array([stairs[:2], stairs[:2], slope[:2], [0.0, 10.0]])
    places[:2] += [[1.45, 0.0], [0.0, -1.75]]
    grounds = [8 * 0.14, 7 * 0.14, 0.2 * 2.5, 0.0]
    for place, ground in zip(places, grounds, strict=True):
        body = spec.worldbody.add_body(pos=[*place, ground + radius + 0.02])
        body.add_freejoint()
        body.add_geom(size=[radius, 0, 0], contype=1, conaffinity=2, priority=1)
    model, data = compiled(spec)
    mujoco.mj_step(model, data, 500)
    at = data.qpos.reshape(4, 7)
    np.testing.assert_allclose(at[:, 2], np.add(grounds, radius), atol=0.002)
    np.testing.assert_allclose(at[:, :2], places, atol=0.002)
    assert np.abs(data.qvel).max() < 0.01


def slope_contacts(depth: float, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A sphere 200 times in an even slope of 11 degrees: depths of its contacts below the surface [m], their normals,
    and the number of the sphere, (C,), (C, 3), (C,).
    """
    terrain = terrain_of(["slope_up"], (0.5,), terrain_length=6.0, terrain_width=6.0, horizontal_scale=0.06)
    spec = mujoco.MjSpec()
    add_terrain(spec, terrain)
    lean = np.arctan(0.2)
    rng = np.random.default_rng(1)
    for x, y in rng.uniform([-2.5, -0.5], [-1.7, 0.5], (200, 2)):
        ground = float(terrain.height_map.height_at(np.array(x), np.array(y)))
        body = spec.worldbody.add_body(
            pos=np.array([x, y, ground]) + (radius - depth) * np.array([np.sin(lean), 0, np.cos(lean)])
        )
        body.add_freejoint()
        body.add_geom(size=[radius, 0, 0], contype=1, conaffinity=2)
    _, data = compiled(spec)
    contact = data.contact
    return contact.includemargin - contact.dist, contact.frame[:, :3], contact.geom.max(axis=1)


def test_feet_are_felt_at_the_surface_though_a_height_field_lies_deeper():
    """The deepest contact of each is 2 mm deep, along the slope's normal."""
    depths, normals, spheres = slope_contacts(0.002, 0.022)
    for sphere in np.unique(spheres):
        own = np.flatnonzero(spheres == sphere)
        deepest = own[depths[own].argmax()]
        assert depths[deepest] == pytest.approx(0.002, abs=1e-6)
        np.testing.assert_allclose(normals[deepest], [np.sin(np.arctan(0.2)), 0.0, np.cos(np.arctan(0.2))], atol=1e-4)
    assert len(np.unique(spheres)) == 200


def test_a_small_foot_that_sinks_in_is_pushed_out_upward():
    """A Go2's foot of 22 mm, 25 mm deep after an impact: its middle is below the surface. A height field without its skin
    pushed it sideways from prism to prism, with thousands of newtons, and held it there: Go2 fell on any slope.
    """
    _, normals, spheres = slope_contacts(0.025, 0.022)
    assert len(np.unique(spheres)) == 200
    assert normals[:, 2].min() > 0.4


def test_geoms_touch_robots_not_each_other_and_can_be_for_the_eye_only():
    terrain = terrain_of(["stairs_up", "slope_up"], (0.5,))
    model, data = scene(terrain)
    assert set(model.geom_contype) == {2}
    assert set(model.geom_conaffinity) == {1}
    assert data.ncon == 0
    shown, _ = scene(terrain, collide=False)
    assert set(shown.geom_contype) == set(shown.geom_conaffinity) == {0}
    assert [model.geom(i).name for i in range(model.ngeom)] == [f"terrain_{i}" for i in range(model.ngeom)]


# ---- how it is made --------------------------------------------------------------------------------------------------


def test_smooth_tiles_are_height_fields_and_level_ones_boxes():
    """Each beside a tile of its own kind; 4 boxes more are the border."""
    assert kinds(scene(terrain_of(["flat"], (0.5,)))[0]) == [BOX] * 5
    assert kinds(scene(terrain_of(["waves", "slope_up"], (0.5,)))[0]) == [HFIELD] * 2 + [BOX] * 4


@pytest.mark.parametrize(("name", "boxes"), [("stairs_down", 10), ("stairs_up", 37), ("pit", 5), ("gap", 6)])
def test_steps_take_few_boxes(name, boxes):
    """Ten levels: plates on each other where they rise to the middle, else four a ring and one at the bottom.

    A pit is one plate and 4 boxes around; a gap is the same with a platform on the plate.
    """
    found = kinds(scene(terrain_of([name], (0.5,)))[0])
    assert HFIELD not in found
    assert len(found) == boxes + 4


def test_chosen_tiles_come_with_the_border_on_their_side():
    """Tile (0, 1) of 2 x 2: border towards -x and +y, nothing elsewhere."""
    terrain = terrain_of(["pit", "pit"], (0.3, 0.6))
    model, data = scene(terrain, rows=[0], cols=[1])
    assert heights_by_ray(model, data, [-4.0, -10.0, -10.0], [4.0, 4.0, 10.0]) == pytest.approx([-0.3, 0.0, 0.0])
    assert ray(model, data, (4.0, 4.0, 5.0)) == -1  # tile (1, 1)
    assert ray(model, data, (-4.0, -4.0, 5.0)) == -1  # tile (0, 0)
    assert ray(model, data, (-10.0, -4.0, 5.0)) == -1  # and the border beside it
    # And the opposite one.
    model, data = scene(terrain, rows=[1], cols=[0])
    assert heights_by_ray(model, data, [4.0, 10.0, 10.0], [-4.0, -4.0, -10.0]) == pytest.approx([-0.6, 0.0, 0.0])
    for x, y in ((-4.0, -4.0), (4.0, 4.0), (-10.0, -4.0), (4.0, 10.0)):
        assert ray(model, data, (x, y, 5.0)) == -1


@pytest.mark.slow
def test_training_grid_builds_in_bounded_time():
    """200 tiles of 80 x 80 cells, 0.5 s alone on one core."""
    terrain = Terrain.build(TerrainConfig(mesh_type="height_map", proportions=TRAINING), seed=1)
    start = time.process_time()  # of this process alone: others may have the core
    spec = mujoco.MjSpec()
    geoms = add_terrain(spec, terrain)
    model = spec.compile()
    assert time.process_time() - start < 8.0
    assert model.ngeom == len(geoms) < 7000
    model, data = seen(terrain)
    _, _, x, y = points_in_cells(terrain.height_map, 300)
    error = np.abs(heights_by_ray(model, data, x, y) - terrain.height_map.height_at(x, y))
    assert np.median(error) < 1e-6
    assert error.max() < 0.03


def test_one_height_field_of_the_whole_map():
    """Exact on slopes; at a face between levels 0 and -0.4 its point lies half way between them."""
    terrain = terrain_of(["slope_down", "pit"], (0.4,))
    ground = terrain.height_map
    spec = mujoco.MjSpec()
    geom = add_height_field(spec, ground)
    assert geom.name == "terrain_0"
    model, data = compiled(spec)
    i, j, x, y = points_in_cells(ground, 1000)
    slope = y < 0.0
    error = np.abs(heights_by_ray(model, data, x, y) - ground.height_at(x, y))
    assert (error < twist(ground, i, j) + 1e-4)[slope].all()
    assert error[~slope].max() > 0.05
    # The pit's edge is 2 m from its middle, at (0, 4): the surface falls over the cells on both sides of it.
    found = heights_by_ray(model, data, [1.85, 1.95, 2.0, 2.05, 2.15], [4.03] * 5)
    assert found == pytest.approx([-0.4, -0.3, -0.2, -0.1, 0.0], abs=1e-5)


@pytest.mark.parametrize(("overlap", "seams"), [(False, 2), (True, 0)])
def test_level_ground_has_no_seam_where_boxes_overlap(overlap, seams):
    """An L of 0.1 m, 2 cells wide, with a block of 0.2 m beside it that its boxes run below: of the pairs of neighbouring
    cells of the L, 2 are in no common box if it is cut in two.
    """
    heights = np.zeros((6, 6))
    heights[1:5, 1:3] = 0.1
    heights[3:5, 1:5] = 0.1
    heights[2, 3] = 0.2
    boxes = list(_rectangles(heights, np.full((6, 6), True), overlap))
    found = np.full((6, 6), -1.0)
    covers = []
    for x, y, top in boxes:
        found[x, y] = np.maximum(found[x, y], top)
        cover = np.zeros((6, 6), dtype=bool)
        cover[x, y] = abs(top - 0.1) < 1e-9
        covers.append(cover)
    assert np.array_equal(found, heights), "they are the ground, and nothing stands out of it"
    level = heights == 0.1
    missing = 0
    for along in (0, 1):
        first, second = ((slice(0, 5), slice(None)), (slice(1, 6), slice(None)))
        pair = [level if along == 0 else level.T for _ in (0, 1)]
        both = pair[0][first] & pair[1][second]
        together = np.zeros_like(both)
        for cover in covers:
            turned = cover if along == 0 else cover.T
            together |= turned[first] & turned[second]
        missing += int((both & ~together).sum())
    assert missing == seams
