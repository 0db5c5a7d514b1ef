"""A robot with a mesh that collides: what stands for it on a terrain, and that this is said."""

import numpy as np
import pytest
import torch
from reference import TOUCHING, roll, standing

from legged.config.robot import TerrainConfig
from legged.config.world import SimConfig
from legged.physics import RobotScene, make_physics
from legged.robots.robot import load_robot
from legged.terrain import Terrain, TileSpec


def ball(radius: float) -> np.ndarray:
    """Return points all over a sphere."""
    angles = np.linspace(0.0, np.pi, 17)
    ring = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    rows = [[np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)] for a in angles for b in ring]
    return radius * np.unique(np.round(rows, 9), axis=0)


def text(points: np.ndarray) -> str:
    return " ".join(f"{x:.9g}" for x in points.ravel())


@pytest.mark.slow
def test_a_robot_with_a_foot_of_mesh_stands_on_a_terrain(robot, tmp_path):
    """As the robot whose feet are spheres does, for that is what the mesh is; and it is said which shape was taken."""
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
        said.append(each.adaptations)
        states.write(physics)
        roll(physics, states.dof_pos, 20)
        forces.append(physics.robot_state.contact_forces)
    assert said[0] == ()
    assert "1 collision meshes become primitives around them: 1 sphere" in said[1]
    assert (forces[0][0, :, 2] > 50.0).sum() == 4
    torch.testing.assert_close(forces[1], forces[0], atol=1.0, rtol=0.01)
