"""Simple shapes in place of meshes: which one, where, and that nothing else changes."""

import mujoco
import numpy as np
import pytest
import torch
from reference import TOUCHING, roll, standing

from legged.config.schema import SimConfig, TerrainConfig
from legged.physics import RobotScene, make_physics
from legged.physics.scene.mesh_shapes import fit_meshes
from legged.robots.robot import load_robot
from legged.terrain import Terrain, TileSpec

BOX = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.05, 0.05) for z in (-0.02, 0.02)])


def ball(radius: float) -> np.ndarray:
    """Return points all over a sphere."""
    angles = np.linspace(0.0, np.pi, 17)
    ring = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    rows = [[np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)] for a in angles for b in ring]
    return radius * np.unique(np.round(rows, 9), axis=0)


def tube(radius: float, half: float, round_ends: bool) -> np.ndarray:
    """Return points all over a cylinder or a capsule along z."""
    points = ball(radius)
    if round_ends:
        return np.concatenate([points + np.array([0.0, 0.0, half * side]) for side in (-1.0, 1.0)])
    ring = np.unique(np.round(points[np.abs(points[:, 2]) < 1e-9], 9), axis=0)
    return np.concatenate([ring * [1, 1, 0] + [0.0, 0.0, half * z] for z in np.linspace(-1.0, 1.0, 9)])


MESHES = {
    "box": (BOX, [0.02, 0.05, 0.1]),
    "sphere": (ball(0.03), [0.03, 0.0, 0.0]),
    "capsule": (tube(0.03, 0.1, True), [0.03, 0.1, 0.0]),
    "cylinder": (tube(0.03, 0.1, False), [0.03, 0.1, 0.0]),
}


def text(points: np.ndarray) -> str:
    return " ".join(f"{x:.9g}" for x in points.ravel())


def of_mesh(points: np.ndarray, body: str = "") -> mujoco.MjSpec:
    """Return a body with such a mesh, off its origin and turned, and without an inertia of its own."""
    return mujoco.MjSpec.from_string(
        f'<mujoco><asset><mesh name="mesh" vertex="{text(points)}"/></asset><worldbody>'
        '<geom type="plane" size="0 0 1"/><body name="body"><freejoint/>'
        f'<geom name="mesh" type="mesh" mesh="mesh" pos=".3 .1 -.2" euler="20 40 70"/>{body}</body></worldbody></mujoco>'
    )


@pytest.mark.parametrize("kind", MESHES)
def test_a_mesh_of_a_simple_shape_is_that_shape(kind):
    """With its size, touching a plane at the mesh's lowest point; masses and inertias stay the mesh's."""
    points, size = MESHES[kind]
    before = of_mesh(points).compile()
    spec = of_mesh(points)
    assert fit_meshes(spec) == f"mesh by a {kind} (0 mm)"
    after = spec.compile()
    assert mujoco.mjtGeom(after.geom_type[1]).name == f"mjGEOM_{kind.upper()}"
    np.testing.assert_allclose(after.geom_size[1], size, atol=1e-4)
    for name in ("body_mass", "body_inertia", "body_ipos"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), rtol=1e-9, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(np.abs(after.body_iquat), np.abs(before.body_iquat), atol=1e-9)
    lowest = []
    for model in (before, after):
        data = mujoco.MjData(model)
        data.qpos[2], data.qpos[3:] = 2.0, np.array([0.7, 0.1, -0.5, 0.5])
        mujoco.mj_forward(model, data)
        lowest.append(mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None))
    assert lowest[1] == pytest.approx(lowest[0], abs=1e-3)


def test_meshes_that_only_look_are_left_alone():
    spec = of_mesh(BOX)
    spec.geom("mesh").contype = spec.geom("mesh").conaffinity = 0
    assert fit_meshes(spec) == ""
    assert spec.geom("mesh").type == mujoco.mjtGeom.mjGEOM_MESH


def test_a_robot_with_a_foot_of_mesh_stands_on_a_terrain(robot, tmp_path):
    """As the robot whose feet are spheres does, for that is what the mesh is; and the engine says which shape was taken."""
    text_of_model = robot.model_path.read_text()
    old = '<geom name="LF_FOOT" class="collision" type="sphere" size="0.03"'
    assert old in text_of_model
    asset = f'<asset><mesh name="ball" vertex="{text(ball(0.03))}"/></asset>'
    new = text_of_model.replace(old, '<geom name="LF_FOOT" class="collision" type="mesh" mesh="ball"')
    (tmp_path / robot.model_path.name).write_text(new.replace("<worldbody>", asset + "<worldbody>"))
    (tmp_path / "robot.yaml").write_text((robot.folder / "robot.yaml").read_text())
    cfg = TerrainConfig(mesh_type="height_map", border_size=4.0)
    ground = Terrain.of_tiles([[TileSpec("flat", 0.0)]], cfg, np.random.default_rng(5))
    states = standing(robot, 1, height=TOUCHING - 0.002)
    states.base_pos[0] += torch.tensor(ground.origins[0, 0], dtype=torch.float32)
    forces, said = [], []
    for each in (robot, load_robot(str(tmp_path))):
        physics = make_physics(RobotScene(each, ground), SimConfig(physics="mujoco_warp"), 1, torch.device("cpu"))
        assert physics.why_library == ""
        assert physics.model.body_mass.sum() == pytest.approx(robot.mass, rel=1e-6)
        said.append(physics.fitted)
        states.write(physics)
        roll(physics, states.dof_pos, 20)
        forces.append(physics.robot_state.contact_forces)
    assert said == ["", "LF_FOOT by a sphere (0 mm)"]
    assert (forces[0][0, :, 2] > 50.0).sum() == 4
    torch.testing.assert_close(forces[1], forces[0], atol=1.0, rtol=0.01)
