"""The pictures of a terrain: both are written and show what was asked for; wrong input is named."""

import mujoco
import numpy as np
import pytest
from helpers import TASK, call
from PIL import Image

from legged.cli.terrain import terrain as command
from legged.config.robot import TerrainConfig
from legged.rendering.scene import HIGH, LOW, MIDDLE, add_painted_terrain, color
from legged.terrain import Terrain, TileSpec


@pytest.fixture(scope="module")
def can_render():
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # each GL back-end fails in its own way
        pytest.skip(f"nothing can be rendered here: {error}")


def shown(folder, *arguments) -> tuple[np.ndarray, np.ndarray]:
    """The map and the picture of a call."""
    assert call(command.main, [TASK, "--out", str(folder), *arguments]) == 0
    assert {path.name for path in folder.iterdir()} == {"terrain.png", "terrain_map.png"}  # and nothing half written
    return tuple(np.asarray(Image.open(folder / name).convert("RGB")) for name in ("terrain_map.png", "terrain.png"))


def red(picture: np.ndarray) -> np.ndarray:
    """(h, w) pixels of the robots' shells."""
    r, g, b = (picture[:, :, i].astype(int) for i in range(3))
    return (r > 90) & (r > 3 * g) & (r > 3 * b)


@pytest.mark.slow
def test_chosen_types_side_by_side(tmp_path, can_render):
    """A pit on the left, a pyramid on the right: in the map blue and red, in the picture a robot on either."""
    chart, picture = shown(tmp_path / "new" / "folder", "--types", "stairs_up,stairs_down", "--difficulty", "0.9")
    r, b = chart[:, :, 0].astype(int), chart[:, :, 2].astype(int)
    blue, warm = (np.flatnonzero((difference > 60).sum(axis=0) > 20) for difference in (b - r, r - b))
    assert np.median(blue) < np.median(warm)
    assert picture.shape[1] == 1600
    columns = np.flatnonzero(red(picture).any(axis=0))
    assert columns.min() < 800 < columns.max()
    assert 500 < red(picture).sum() < 0.1 * picture[:, :, 0].size
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 500


@pytest.mark.slow
def test_the_grid_of_a_task(tmp_path, can_render):
    grid = ["terrain.mesh_type=height_map", "terrain.num_cols=2", "terrain.num_rows=3", "terrain.max_init_terrain_level=1"]
    chart, picture = shown(tmp_path, *grid, "terrain.proportions={rough_slope_up: 0.5, obstacles: 0.5}")
    assert chart.std() > 20
    assert red(picture).sum() > 500


def test_colours_by_height():
    """Level ground in the middle, ends at 0.9 m up and down and beyond."""
    np.testing.assert_allclose(color(np.array([-3.0, 0.0, 0.45, 0.9])), [LOW, MIDDLE, 0.5 * (MIDDLE + HIGH), HIGH])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["anymal_c_flat", "plane", "--types"]),
        (["--types", "gap", "--difficulty", "1.5"], ["--difficulty", "between 0 and 1", "1.5"]),
        (["--types", "gap", "--difficulty", "nan"], ["--difficulty", "between 0 and 1"]),
        (["--types", "gap,stair_up"], ["--types", "'stair_up'", "did you mean 'stairs_up'?"]),
        (["--types", "gap,gap"], ["--types", "twice"]),
        (["--types", ""], ["--types", "''"]),
        (["--types", "pit", "terrain.terrain_length=3"], ["3 x 8 m", "platform of 'pit'"]),
        (["terrain.mesh_type=height_map", "terrain.proportions={gap: 0.5}"], ["terrain.proportions", "sum to 1"]),
    ],
)
def test_wrong_input_is_named_and_writes_nothing(tmp_path, capsys, arguments, words):
    assert call(command.main, [TASK, "--out", str(tmp_path / "out"), *arguments]) == 2
    message = capsys.readouterr().err
    for word in words:
        assert word in message
    assert not (tmp_path / "out").exists()


def test_slopes_among_steps_have_the_colours_of_their_heights():
    """Nothing of rubble is below the level ground, so nothing has the colours of deep ground; points of height fields that
    are sunk where they hold no slope had, and textures blur them into the slopes beside.
    """
    cfg = TerrainConfig(border_size=2.0, slope_threshold=0.75)
    terrain = Terrain.of_tiles([[TileSpec("rubble", 0.19)]], cfg, np.random.default_rng(1))
    scene = mujoco.MjSpec()
    add_painted_terrain(scene, terrain)
    model = scene.compile()
    assert model.ntex > 1
    level, highest = color(np.array(0.0)), color(np.array(0.19))
    found = model.tex_data.reshape(-1, 3) / 255.0
    assert (found >= np.minimum(level, highest) - 0.01).all()
    assert (found <= np.maximum(level, highest) + 0.01).all()
