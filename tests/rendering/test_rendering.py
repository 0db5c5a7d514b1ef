"""Pictures: the robots are in them, move in them, and carry their arrows and captions."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from legged.config import override
from legged.play.playground import SETTING, Playground
from legged.registry import make_task, task_config
from legged.rendering.camera import BEHIND, CUT, FLATTEST, FRONT, Follower, RobotsCamera, size_of
from legged.rendering.scene import LOW, MIDDLE, display_model
from legged.terrain import HeightMap

WIDTH, HEIGHT = 320, 180


@pytest.fixture(scope="module")
def task():
    changes = {"env.num_envs": 3, "sim.physics": "mujoco", "env.seed": 5}
    return make_task(task_config("anymal_c_flat", changes.items(), on_cpu=True))


@pytest.fixture
def camera(task):
    """Two of the three robots, standing where their episode began, without commands."""
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # each GL back-end fails in its own way
        pytest.skip(f"nothing can be rendered here: {error}")
    task.reset()
    task.commands.zero_()
    task.base_lin_vel.zero_()
    camera = RobotsCamera(task, count=2, width=WIDTH, height=HEIGHT)
    yield camera
    camera.close()


def red(picture: np.ndarray) -> np.ndarray:
    """(h, w) pixels of the robots' shells; floor, sky and arrows are grey, blue and green."""
    r, g, b = (picture[:, :, i].astype(int) for i in range(3))
    return (r > 60) & (r > 2 * g) & (r > 2 * b)


def differ(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(h, w) pixels that differ by more than the renderer's rounding."""
    return (np.abs(one.astype(int) - other) > 4).any(axis=2)


@pytest.mark.slow
def test_picture_shows_the_robots(camera):
    picture = camera.picture()
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert picture.dtype == np.uint8
    assert 0.005 < red(picture).mean() < 0.3
    columns = np.flatnonzero(red(picture).any(axis=0))
    assert columns.max() - columns.min() > WIDTH / 4  # side by side


@pytest.mark.slow
def test_each_robot_is_drawn(task, camera):
    """One robot from the same distance shows half of the red, and for one the camera comes nearer."""
    both = red(camera.picture()).sum()
    single = RobotsCamera(task, count=1, width=WIDTH, height=HEIGHT)
    assert single.view.distance < camera.view.distance
    single.view.distance = camera.view.distance
    one = red(single.picture()).sum()
    single.close()
    assert 0.3 * both < one < 0.7 * both


@pytest.mark.slow
def test_picture_is_the_same_until_the_robots_move(task, camera):
    first = camera.picture()
    assert not differ(camera.picture(), first).any()
    for _ in range(10):
        task.step(torch.full((3, 12), 2.0))
    task.commands.zero_()
    task.base_lin_vel.zero_()
    assert differ(camera.picture(), first).mean() > 0.01


@pytest.mark.slow
def test_commanded_velocity_is_a_green_arrow(task, camera):
    def green(picture: np.ndarray) -> int:
        r, g, b = (picture[:, :, i].astype(int) for i in range(3))
        return int(((g > 1.5 * r) & (g > 1.5 * b) & (g > 60)).sum())

    assert green(camera.picture()) == 0
    task.commands[0, 0] = 1.0
    one = green(camera.picture())
    assert one > 20
    task.commands[1, 0] = 1.0
    assert green(camera.picture()) > 1.5 * one
    task.commands[2, 0] = 1.0  # is not in the picture


@pytest.mark.slow
def test_caption_is_drawn_in_the_upper_left_corner_only(camera):
    plain = camera.picture()
    captioned = camera.picture(["commanded 1.0 m/s", "actual 0.9 m/s"])
    assert captioned.shape == plain.shape
    assert captioned.dtype == np.uint8
    changed = differ(captioned, plain)
    rows, columns = np.nonzero(changed)
    assert changed.sum() > 500
    assert rows.max() < HEIGHT / 4
    assert columns.max() < WIDTH / 2
    text = captioned[: HEIGHT // 4, : WIDTH // 2].astype(int)
    assert (text.max(axis=2) - text.min(axis=2) > 60).any()  # letters in the colours of the arrows
    assert not differ(camera.picture(), plain).any()  # nothing stays


# ---- on terrain ------------------------------------------------------------------------------------------------------


def on_terrain(name: str, num_envs: int = 2):
    """Robots in the middle of tiles with steps of 0.19 m."""
    changes = {"env.num_envs": num_envs, "sim.physics": "mujoco", "sim.threads": 1, "env.seed": 5}
    cfg = task_config("anymal_c", changes.items(), on_cpu=True)
    ground = Playground.of(cfg, name, 0.8)
    cfg = override(cfg, [*SETTING, *ground.changes(cfg)])
    task = make_task(cfg, terrain=ground.build(cfg))
    ground.place(task)
    task.reset()
    task.commands.zero_()
    task.base_lin_vel.zero_()
    return task


@pytest.fixture(scope="module")
def pit():
    return on_terrain("stairs_up")


@pytest.fixture
def camera_in_pit(camera, pit):
    found = RobotsCamera(pit, count=2, width=WIDTH, height=HEIGHT)
    yield found
    found.close()


def cold(picture: np.ndarray) -> float:
    """Share of pixels of deep ground, which is bluish but darker than the sky."""
    r, b = picture[:, :, 0].astype(int), picture[:, :, 2].astype(int)
    return float(((b > r + 8) & (b < 190)).mean())


def warm(picture: np.ndarray) -> float:
    """Share of pixels of high ground, which is orange but not as red as the robots."""
    r, g, b = (picture[:, :, i].astype(int) for i in range(3))
    return float(((r > b + 45) & (r < 2 * g)).mean())


@pytest.mark.slow
def test_the_ground_is_in_the_picture(camera_in_pit):
    """At the foot of stairs it is cold, on top of a pyramid it is warm; either way there are the robots and risers."""
    deep = camera_in_pit.picture()
    top = RobotsCamera(on_terrain("stairs_down"), count=2, width=WIDTH, height=HEIGHT)
    high = top.picture()
    top.close()
    assert cold(deep) > 0.1 > 0.01 > cold(high)
    assert warm(high) > 0.1 > 0.01 > warm(deep)
    for picture in (deep, high):
        assert 0.005 < red(picture).mean() < 0.3


@pytest.mark.slow
def test_colours_span_the_heights_there_are_and_level_ground_is_checkered(pit):
    model = display_model(pit.robot, 0, WIDTH, HEIGHT, pit.terrain)
    tops = model.geom_pos[:, 2] + model.geom_size[:, 2]
    lowest = float(pit.terrain.height_map.corners.min())
    assert lowest < -1.5
    np.testing.assert_allclose(model.geom_rgba[tops.argmin(), :3], LOW, atol=1e-6)
    half = int(np.abs(tops - 0.5 * lowest).argmin())
    expected = MIDDLE + tops[half] / lowest * (LOW - MIDDLE)
    np.testing.assert_allclose(model.geom_rgba[half, :3], expected, atol=1e-5)
    assert ((model.geom_matid >= 0) == (np.abs(tops) < 1e-6)).all()


@pytest.mark.slow
def test_steps_show_as_edges_without_shadows(camera_in_pit):
    """Along a column of pixels that sees the stairs brightness changes often and clearly: treads and risers."""
    picture = camera_in_pit.picture().astype(float).mean(axis=2)
    edges = (np.abs(np.diff(picture, axis=0)) > 15).sum(axis=0)
    assert np.median(edges) >= 6


@pytest.mark.slow
def test_on_terrain_robots_are_where_they_are(camera_in_pit, pit):
    camera_in_pit.picture()
    bases = camera_in_pit.data.qpos.reshape(2, -1)[:, :3]
    np.testing.assert_allclose(bases, pit.base_pos.numpy(), atol=1e-5)
    assert np.linalg.norm(bases[0] - bases[1]) > 7.0


@pytest.mark.slow
def test_the_camera_follows_the_chosen_robot(camera_in_pit, pit):
    for robot in (1, 0):
        camera_in_pit.followed = robot
        picture = camera_in_pit.picture()
        np.testing.assert_allclose(camera_in_pit.view.lookat, pit.base_pos[robot].numpy(), atol=1e-5)
        middle = red(picture)[HEIGHT // 3 : 2 * HEIGHT // 3, WIDTH // 3 : 2 * WIDTH // 3]
        assert middle.sum() > 0.5 * red(picture).sum()


@pytest.mark.slow
def test_feet_have_dark_spots_below_them(camera_in_pit, pit):
    camera_in_pit.picture()
    scene = camera_in_pit.renderer.scene
    drawn = [scene.geoms[i] for i in range(scene.ngeom) if scene.geoms[i].rgba[3] < 0.5]
    assert len(drawn) == 8
    feet = pit.feet_pos.reshape(-1, 3).numpy()
    np.testing.assert_allclose([geom.pos[:2] for geom in drawn], feet[:, :2], atol=1e-4)
    ground = pit.terrain.height_map.height_at(feet[:, 0], feet[:, 1])
    np.testing.assert_allclose([geom.pos[2] for geom in drawn], ground, atol=1e-4)


def level(height: float = 0.0) -> HeightMap:
    return HeightMap.of(np.full((200, 200), height), 0.1, (-10.0, -10.0), np.full((200, 200), np.inf))


def follower_over(ground: HeightMap) -> Follower:
    return Follower(mujoco.MjvCamera(), 3.6, ground)


def test_a_follower_converges_without_jumps():
    follower = follower_over(level())
    view = follower.view
    follower.update(np.array([0.0, 0.0, 0.5]))
    np.testing.assert_allclose(view.lookat, [0.0, 0.0, 0.5])
    target = np.array([0.6, -0.4, 0.8])
    before = np.array(view.lookat)
    for _ in range(150):
        follower.update(target)
        assert np.linalg.norm(view.lookat - before) < 0.2 * np.linalg.norm(target - [0.0, 0.0, 0.5])
        before = np.array(view.lookat)
    np.testing.assert_allclose(view.lookat, target, atol=1e-3)
    assert view.elevation == FLATTEST


def test_a_follower_cuts_to_a_robot_that_was_put_elsewhere():
    follower = follower_over(level())
    follower.update(np.zeros(3))
    follower.update(np.array([CUT + 0.1, 0.0, 0.0]))
    np.testing.assert_allclose(follower.view.lookat, [CUT + 0.1, 0.0, 0.0])


def test_a_follower_looks_over_the_rim_of_a_pit():
    """2 m wide and 1.5 m deep: from the flattest elevation the camera would stand inside the ground."""
    heights = np.zeros((200, 200))
    heights[90:110, 90:110] = -1.5
    ground = HeightMap.of(heights, 0.1, (-10.0, -10.0), np.full((200, 200), 0.2))
    follower = follower_over(ground)
    view = follower.view
    follower.update(np.array([0.0, 0.0, -1.0]))
    steep = view.elevation
    assert steep < FLATTEST - 10.0
    follower.update(np.array([0.3, 0.0, -1.0]))
    assert abs(view.elevation - steep) < 3.0
    e, a = np.radians([view.elevation, view.azimuth])
    eye = view.lookat - view.distance * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    along = np.linspace(0.3, 1.0, 50)[:, None]
    sight = (1.0 - along) * view.lookat + along * eye
    assert (sight[:, 2] > ground.height_at(sight[:, 0], sight[:, 1])).all()


def test_a_follower_sees_the_faces_of_steps():
    """A step up at x = 1, and one down at x = -5: they are seen from the side on which they are."""
    heights = np.zeros((200, 200))
    heights[110:] = 0.3
    heights[:50] = 0.3
    follower = follower_over(HeightMap.of(heights, 0.1, (-10.0, -10.0), np.full((200, 200), 0.2)))
    for x, azimuth in ((0.0, BEHIND), (-6.0, FRONT), (-3.0, BEHIND), (4.0, BEHIND)):
        follower.update(np.array([x, 0.0, 0.5]))
        assert follower.view.azimuth == azimuth


# ---- robots of other sizes -------------------------------------------------------------------------------------------


def scaled_robot(robot, tmp_path, factor: float, angle: float = 0.0):
    """A robot of one box with legs of boxes at an angle, `factor` times as large as 1 m x 0.4 m x 0.5 m."""
    xml = f"""<mujoco><worldbody><body name="base" pos="0 0 {factor}"><freejoint/>
      <geom name="shell" type="box" size="{0.5 * factor} {0.2 * factor} {0.1 * factor}" mass="1"/>
      <body pos="0 0 {-0.1 * factor}"><joint name="hip" axis="0 1 0"/>
        <geom name="leg" type="box" pos="0 0 {-0.15 * factor}" size="0.01 0.01 {0.15 * factor}" mass="1"/></body>
      </body></worldbody></mujoco>"""
    (tmp_path / "small.xml").write_text(xml)
    file = replace(robot.file, model="small.xml", base="base")
    return replace(robot, folder=tmp_path, file=file, default_qpos=np.array([0, 0, 0, 1, 0, 0, 0, angle]))


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_a_robot_is_as_large_as_the_box_around_it(robot, tmp_path, factor):
    size = size_of(scaled_robot(robot, tmp_path, factor))
    assert size.max() == pytest.approx(factor)
    assert size[2] == pytest.approx(0.5 * factor)  # 0.2 of the shell, 0.3 of the leg
    turned = scaled_robot(robot, tmp_path, factor, np.pi / 2)
    assert size_of(turned)[2] == pytest.approx(factor * 0.2 + 0.01, abs=0.011)  # the leg points along x


def test_the_camera_comes_nearer_to_smaller_robots(task, camera, monkeypatch):
    assert camera.view.distance == pytest.approx(2.0 + 1.1 * 2**0.5, rel=0.01)  # ANYmal C's
    assert camera.offsets[1, 1] - camera.offsets[0, 1] == pytest.approx(1.9, rel=0.01)
    size = size_of(task.robot)
    monkeypatch.setattr("legged.rendering.camera.size_of", lambda _: 0.5 * size)
    near = RobotsCamera(task, count=2, width=WIDTH, height=HEIGHT)
    near.close()
    assert near.view.distance == pytest.approx(0.5 * camera.view.distance)
    assert np.ptp(near.offsets[:, 1]) == pytest.approx(0.5 * np.ptp(camera.offsets[:, 1]))


def test_feet_have_spots_on_a_plane(task, camera, monkeypatch):
    with_spots = camera.picture().astype(int)
    monkeypatch.setattr(camera, "_shade_feet", lambda: None)
    changed = differ(with_spots.astype(np.uint8), without := camera.picture())
    assert 0.0005 < changed.mean() < 0.05
    assert with_spots[changed].mean() < without[changed].mean() - 20  # they are darker than the floor
