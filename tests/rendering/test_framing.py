"""Where a camera stands, and where in its picture a point is."""

import mujoco
import numpy as np
import pytest

from legged.rendering.camera import Camera, direction, frame

WIDTH, HEIGHT, FIELD_OF_VIEW = 400, 300, 30.0
TANGENT = float(np.tan(np.radians(15.0)))


def camera_on(place) -> Camera:
    """A camera over a small red ball; the test is skipped where nothing can be rendered."""
    spec = mujoco.MjSpec()
    spec.visual.global_.fovy = FIELD_OF_VIEW
    spec.visual.global_.offwidth, spec.visual.global_.offheight = WIDTH, HEIGHT
    spec.worldbody.add_geom(size=[0.1, 0, 0], pos=place, rgba=[1, 0, 0, 1])
    spec.worldbody.add_light(pos=[0, 0, 9])
    try:
        return Camera(spec.compile(), WIDTH, HEIGHT)
    except Exception as error:  # each GL back-end fails in its own way
        pytest.skip(f"nothing can be rendered here: {error}")


def aim(camera: Camera, points, azimuth: float, elevation: float) -> None:
    reach = (TANGENT * WIDTH / HEIGHT, TANGENT)
    camera.view.azimuth, camera.view.elevation = azimuth, elevation
    camera.view.lookat[:], camera.view.distance, _ = frame(np.array(points), reach, azimuth, elevation)
    camera.update()


def test_pixels_are_where_mujoco_draws():
    """A ball at a place that the camera says to be off its middle."""
    place = np.array([1.0, -2.0, 0.5])
    camera = camera_on(place)
    aim(camera, [[-4.0, -4.0, 0.0], [4.0, 4.0, 0.0], [4.0, -4.0, 1.0], [-4.0, 4.0, 1.0]], 14.0, -35.0)
    row, column = np.argwhere(camera.render()[:, :, 0] > 20).mean(axis=0)
    expected = camera.pixels(place[None])[0]
    camera.close()
    assert np.abs(expected - [WIDTH / 2, HEIGHT / 2]).max() > 30
    np.testing.assert_allclose([column + 0.5, row + 0.5], expected, atol=1.5)


@pytest.mark.parametrize(("azimuth", "elevation"), [(14.0, -35.0), (-120.0, -10.0), (90.0, -80.0)])
@pytest.mark.parametrize("sides", [(20.0, 6.0, 1.0), (1.0, 15.0, 0.3), (1.0, 1.0, 9.0)])
def test_a_frame_holds_all_points_and_touches_two_edges(azimuth, elevation, sides):
    points = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (0.0, 1.0)]) * sides + [3.0, -1.0, 0.2]
    camera = camera_on([0.0, 0.0, 0.0])
    aim(camera, points, azimuth, elevation)
    at = camera.pixels(points)
    camera.close()
    low, high = at.min(axis=0), at.max(axis=0)
    assert (low > -0.5).all()
    assert (high < np.array([WIDTH, HEIGHT]) + 0.5).all()
    touches = (np.abs(low) < 0.5) & (np.abs(high - [WIDTH, HEIGHT]) < 0.5)
    assert touches.any()  # left and right, or above and below


def test_a_square_seen_from_above_by_hand():
    """Half a side of 1 m is to fill a tangent of 0.25: 4 m away. A plate of 2 m x 1 m fills as much of it upward as half."""
    square = np.array([[x, y, 0.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    lookat, distance, seen = frame(square, (0.25, 0.25), 90.0, -90.0)
    np.testing.assert_allclose(lookat, [0.0, 0.0, 0.0], atol=1e-12)
    assert distance == pytest.approx(4.0)
    np.testing.assert_allclose(seen, [0.5, 0.5])
    _, _, seen = frame(square * [1.0, 0.5, 1.0] + 7.0, (0.25, 0.25), 90.0, -90.0)
    np.testing.assert_allclose(seen, [0.5, 0.25])


def test_directions():
    np.testing.assert_allclose(direction(0.0, 0.0), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(direction(90.0, 0.0), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(direction(37.0, -90.0), [0, 0, -1], atol=1e-12)
