"""What a browser draws: closed bodies seen from outside, and a terrain that is the height map."""

import json
import struct

import mujoco
import numpy as np
import pytest

from legged.config.schema import TerrainConfig
from legged.play.live.glb import glb, linear, normals
from legged.play.live.shapes import bodies_of, box, capsule, cylinder, plane_shape, terrain_shape
from legged.terrain import Terrain, TileSpec


def volume(triangles) -> float:
    """Volume inside triangles that are counterclockwise as seen from outside [m^3]; negative if they are not."""
    a, b, c = (triangles[0][triangles[1][:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def test_solids_are_closed_and_of_the_right_size():
    assert volume(box(np.array([0.1, 0.2, 0.3]))) == pytest.approx(8 * 0.1 * 0.2 * 0.3)
    assert volume(cylinder(0.2, 0.5)) == pytest.approx(np.pi * 0.04 * 1.0, rel=0.03)
    assert volume(capsule(0.2, 0.5)) == pytest.approx(np.pi * 0.04 * (1.0 + 4.0 / 3.0 * 0.2), rel=0.06)
    assert volume(capsule(0.3, 0.0)) == pytest.approx(4.0 / 3.0 * np.pi * 0.027, rel=0.06)
    vertices, _ = capsule(0.2, 0.5)
    assert np.abs(vertices).max(axis=0) == pytest.approx([0.2, 0.2, 0.7], rel=0.02)


MODEL = """
<mujoco>
  <asset>
    <mesh name="block" vertex="0 0 0  2 0 0  0 1 0  2 1 0  0 0 3  2 0 3  0 1 3  2 1 3"/>
    <material name="paint" rgba="0 0 1 1"/>
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


def test_bodies_look_as_their_model_says():
    model = mujoco.MjModel.from_xml_string(MODEL)
    looks = bodies_of(model)
    assert sorted(looks) == [1, 2]  # not the world
    a, b = looks[1], looks[2]
    assert a.vertices.min(axis=0) == pytest.approx([-0.5, -1.0, -3.0], abs=0.01)
    assert a.vertices.max(axis=0) == pytest.approx([7.0, 1.0, 3.0], abs=0.01)  # the box lies along y, turned to x
    is_box = np.abs(a.vertices[:, 0]) > 1.0
    assert (a.colors[is_box] == [255, 0, 0]).all()
    assert (a.colors[~is_box] == [0, 0, 255]).all()
    # MuJoCo moves a mesh to its centre of mass, and the geom the other way.
    assert b.vertices.min(axis=0) == pytest.approx([0, 0, 0], abs=1e-5)
    assert b.vertices.max(axis=0) == pytest.approx([2, 1, 3], abs=1e-5)
    assert volume((b.vertices, b.faces)) == pytest.approx(6.0, rel=1e-4)
    outward = normals(b.vertices, b.faces)
    assert np.abs(outward).max(axis=1) == pytest.approx(np.ones(len(outward)))  # edges of a block are sharp


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


def test_a_terrain_is_drawn_as_it_is_simulated():
    specs = [[TileSpec("stairs_up", 0.15), TileSpec("slope_down", 15.0), TileSpec("obstacles", 0.1)]]
    terrain = Terrain.of_tiles(specs, TerrainConfig(border_size=3.0), np.random.default_rng(0))
    shape = terrain_shape(terrain)
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
    assert len(shape.colors) == len(shape.vertices)


def test_a_plane_looks_the_same_two_metres_on():
    shape = plane_shape()
    middles, painted = shape.vertices[shape.faces].mean(axis=1).round(3), shape.colors[shape.faces[:, 0]]
    colors = {tuple(middle): tuple(color) for middle, color in zip(middles.tolist(), painted.tolist(), strict=True)}
    for (x, y, z), color in list(colors.items())[::37]:
        assert colors.get((round(x + 2.0, 3), y, z), color) == color
        assert colors.get((round(x + 1.0, 3), y, z), (0,)) != color


def test_a_glb_file_holds_what_it_was_given():
    vertices = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    data = glb(vertices, np.array([[0, 1, 2]]), np.array([[255, 0, 0], [0, 128, 0], [0, 0, 0]]))
    magic, version, length, json_length, kind = struct.unpack_from("<4sIIII", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), 0x4E4F534A)
    assert json_length % 4 == 0
    scene = json.loads(data[20 : 20 + json_length])
    binary_length, kind = struct.unpack_from("<II", data, 20 + json_length)
    start = 28 + json_length
    assert (start + binary_length, kind) == (len(data), 0x004E4942)
    found = {}
    attributes = scene["meshes"][0]["primitives"][0]["attributes"]
    for name, index in attributes.items():
        view = scene["bufferViews"][scene["accessors"][index]["bufferView"]]
        count = scene["accessors"][index]["count"]
        found[name] = np.frombuffer(data, "<f4", 3 * count, start + view["byteOffset"]).reshape(-1, 3)
    assert (found["POSITION"] == vertices).all()
    assert found["NORMAL"] == pytest.approx(np.tile([0.0, 0.0, 1.0], (3, 1)))
    assert found["COLOR_0"][1, 1] == pytest.approx(0.2159, abs=1e-4)  # half as bright on a screen is a fifth of the light
    assert scene["accessors"][attributes["POSITION"]]["max"] == [2.0, 3.0, 0.0]


def test_screens_and_light():
    assert linear(np.array([0, 255])) == pytest.approx([0.0, 1.0])
    assert linear(np.array([10.0])) == pytest.approx([10.0 / 255.0 / 12.92], rel=0.02)
