"""Meshes for the browser: closed bodies seen from outside, and a terrain that is the height map."""

import json
import struct

import mujoco
import numpy as np
import pytest

from legged.config.robot import TerrainConfig
from legged.play.live.drawing import HALF_PLANE, PERIOD, body_meshes, plane_mesh, terrain_mesh
from legged.terrain import Terrain, TileSpec

MODEL = """
<mujoco>
  <asset>
    <mesh name="block" vertex="0 0 0  2 0 0  0 1 0  2 1 0  0 0 3  2 0 3  0 1 3  2 1 3"/>
    <material name="paint" rgba="0 0 0.5 1"/>
  </asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="a" pos="0 0 1">
      <freejoint/>
      <geom type="box" size="1 2 3" pos="5 0 0" quat="0.7071068 0 0 0.7071068" rgba="1 0 0 1"/>
      <geom type="sphere" size="0.5" material="paint"/>
      <geom type="sphere" size="9" group="3"/>
      <geom type="sphere" size="9" rgba="1 1 1 0"/>
      <body name="b"><joint/><geom type="mesh" mesh="block" mass="1"/></body>
    </body>
  </worldbody>
</mujoco>
"""


def attributes_of(mesh) -> dict[str, dict]:
    """Accessors of the vertex attributes in the file that the browser gets, by name."""
    data = mesh.export(file_type="glb")
    scene = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    return {name: scene["accessors"][i] for name, i in scene["meshes"][0]["primitives"][0]["attributes"].items()}


def test_files_have_normals_and_colours():
    model = mujoco.MjModel.from_xml_string(MODEL)
    for mesh in (*body_meshes(model).values(), plane_mesh()):
        found = attributes_of(mesh)
        assert {"POSITION", "NORMAL"} < set(found)
        assert found["NORMAL"]["count"] == found["POSITION"]["count"] == len(mesh.vertices)
    assert attributes_of(body_meshes(model)[1])["COLOR_0"]["max"] == [255, 0, 55, 255]


def colors_of(mesh) -> np.ndarray:
    """Colours (V, 3) that the file holds: linear intensities, 0 to 255."""
    return mesh.visual.vertex_attributes["color"][:, :3]


def test_bodies_look_as_their_model_says():
    model = mujoco.MjModel.from_xml_string(MODEL)
    looks = body_meshes(model)
    assert sorted(looks) == [1, 2]  # not the world
    a, b = looks[1], looks[2]
    assert a.bounds[0] == pytest.approx([-0.5, -1.0, -3.0], abs=0.02)
    assert a.bounds[1] == pytest.approx([7.0, 1.0, 3.0], abs=0.02)  # the box lies along y, turned to x
    is_box = np.abs(a.vertices[:, 0]) > 1.0
    assert (colors_of(a)[is_box] == [255, 0, 0]).all()
    assert (colors_of(a)[~is_box] == [0, 0, 55]).all()  # sRGB 0.5 is an intensity of 0.214
    # MuJoCo moves a mesh to its centre of mass, and the geom the other way.
    assert b.bounds[0] == pytest.approx([0, 0, 0], abs=1e-5)
    assert b.bounds[1] == pytest.approx([2, 1, 3], abs=1e-5)
    assert b.volume == pytest.approx(6.0, rel=1e-4)
    assert np.abs(b.vertex_normals).max(axis=1) == pytest.approx(np.ones(len(b.vertices)))  # edges of a block are sharp


@pytest.mark.parametrize(
    ("geom", "volume", "reach"),
    [
        ('type="box" size="0.1 0.2 0.3"', 8 * 0.1 * 0.2 * 0.3, [0.1, 0.2, 0.3]),
        ('type="cylinder" size="0.2 0.5"', np.pi * 0.04, [0.2, 0.2, 0.5]),
        ('type="capsule" size="0.2 0.5"', np.pi * 0.04 * (1.0 + 4.0 / 3.0 * 0.2), [0.2, 0.2, 0.7]),
        ('type="sphere" size="0.3"', 4.0 / 3.0 * np.pi * 0.027, [0.3, 0.3, 0.3]),
        ('type="ellipsoid" size="0.1 0.2 0.3"', 4.0 / 3.0 * np.pi * 0.006, [0.1, 0.2, 0.3]),
    ],
)
def test_shapes_are_closed_and_of_the_right_size(geom, volume, reach):
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><body><geom {geom}/></body></worldbody></mujoco>")
    mesh = body_meshes(model)[1]
    assert mesh.volume == pytest.approx(volume, rel=0.1)  # positive: faces are counterclockwise as seen from outside
    assert -mesh.bounds[0] == pytest.approx(reach, rel=0.05)
    assert mesh.bounds[1] == pytest.approx(reach, rel=0.05)
    assert (mesh.vertex_normals * mesh.vertices).sum(axis=1).min() > 0.0
    assert np.linalg.norm(mesh.vertex_normals, axis=1) == pytest.approx(np.ones(len(mesh.vertices)))


def test_the_rim_of_a_cylinder_is_sharp_and_its_side_smooth():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><geom type="cylinder" size="0.2 0.5"/></body></worldbody></mujoco>'
    )
    mesh = body_meshes(model)[1]
    upward = np.abs(mesh.vertex_normals[:, 2])
    assert ((upward < 1e-6) | (upward > 1.0 - 1e-6)).all()
    side = mesh.vertices[upward < 1e-6]
    assert len(np.unique(side.round(6), axis=0)) == len(side)  # faces of the side share their vertices


def top_of(shape, x: float, y: float) -> float:
    """Height of the uppermost triangle at a point."""
    a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    seen = area > 1e-9  # neither vertical nor from below
    p = np.array([x, y]) - a[seen, :2]
    s = (p[:, 0] * v[seen, 1] - p[:, 1] * v[seen, 0]) / area[seen]
    t = (u[seen, 0] * p[:, 1] - u[seen, 1] * p[:, 0]) / area[seen]
    inside = (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
    return float((a[seen, 2] + s * u[seen, 2] + t * v[seen, 2])[inside].max())


@pytest.mark.slow
def test_a_terrain_is_drawn_as_it_is_simulated():
    specs = [[TileSpec("stairs_up", 0.15), TileSpec("slope_down", 15.0), TileSpec("obstacles", 0.1)]]
    terrain = Terrain.of_tiles(specs, TerrainConfig(border_size=3.0), np.random.default_rng(0))
    shape = terrain_mesh(terrain)
    rng = np.random.default_rng(1)
    half = 0.5 * np.array(terrain.height_map.size)
    points = rng.uniform(-half, half, (300, 2))
    assert [top_of(shape, x, y) for x, y in points] == pytest.approx(terrain.height_map.height_at(*points.T), abs=2e-3)
    assert top_of(shape, half[0] + 5.0, 0.0) == 0.0
    # The stairs, along their middle line, have faces and not slopes: a hair to either side of an edge there is a riser.
    along = np.arange(0.0, 4.0, 0.1)
    rises = np.array([top_of(shape, x + 1e-3, -8.0) - top_of(shape, x - 1e-3, -8.0) for x in along])
    assert rises[np.abs(rises) > 1e-3] == pytest.approx(0.15, abs=1e-6)
    assert (rises > 0.1).sum() >= 4
    colors = colors_of(shape)
    assert len(colors) == len(shape.vertices)
    tread, riser = (np.abs(shape.vertex_normals[:, 2]) > 0.99), (np.abs(shape.vertex_normals[:, 2]) < 0.01)
    assert colors[tread].mean() > colors[riser].mean()


def test_the_squares_of_a_plane_repeat():
    mesh = plane_mesh()
    assert HALF_PLANE % PERIOD == 0.0  # the texture is whole at the origin
    assert mesh.bounds.tolist() == [[-HALF_PLANE, -HALF_PLANE, 0.0], [HALF_PLANE, HALF_PLANE, 0.0]]
    assert mesh.vertex_normals == pytest.approx(np.tile([0.0, 0.0, 1.0], (4, 1)))
    assert mesh.visual.uv * PERIOD == pytest.approx(mesh.vertices[:, :2])
    picture = np.asarray(mesh.visual.material.baseColorTexture)
    half = len(picture) // 2
    assert (picture == picture[::-1, ::-1]).all()
    assert (picture[:half, :half] > picture[:half, half:]).all()
