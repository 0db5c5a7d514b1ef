"""Ghosts: the poses of references, beside the robots that track them."""

import mujoco
import numpy as np
import pytest
import torch
from helpers import ENGINE

from legged.motion.kinematics import Skeleton
from legged.motion.readers import motion_files, read_clip
from legged.registry import make_task, task_config
from legged.rendering.camera import RobotsCamera
from legged.rendering.ghost import GHOST, Ghost
from legged.rendering.scene import display_model

FIRST, SHOWN = 1, 2


@pytest.fixture(scope="module")
def task():
    """Three robots that have gone a few steps from frames of the first motion."""
    found = make_task(task_config("g1_tracking", [*ENGINE, ("env.num_envs", 3)], on_cpu=True))
    found.start_at(torch.tensor([0, 10, 20]))
    for _ in range(4):
        found.step(torch.zeros(3, found.num_actions))
    return found


def test_a_ghost_has_the_pose_of_its_reference(task):
    clip = read_clip(motion_files(task.cfg.motion.files, "")[0], Skeleton(task.robot)).resampled(round(1.0 / task.dt))
    ghost = Ghost(task, display_model(task.robot, SHOWN, 64, 48))
    scene, offsets = mujoco.MjvScene(ghost.model, 1000), np.array([[0.0, 0.0, 0.0], [3.0, -2.0, 0.0]])
    ghost.draw(scene, mujoco.MjvOption(), FIRST, offsets)
    for i, (pose, offset) in enumerate(zip(ghost.data.qpos.reshape(SHOWN, -1), offsets, strict=True)):
        frame = int(task.motion.frame[FIRST + i])
        assert frame == 10 * (FIRST + i) + 5  # reset and four steps
        reference = [*(clip.root_pos[frame] + offset), *clip.root_quat[frame], *clip.joint_pos[frame]]
        np.testing.assert_allclose(pose, reference, atol=1e-6)
        bodies = [ghost.data.body(f"{i}/{name}").xpos - offset for name in task.cfg.motion.bodies]
        np.testing.assert_allclose(bodies, task.motion.now.pos[FIRST + i], atol=1e-5)


@pytest.fixture
def camera(task):
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # each GL library fails in its own way
        pytest.skip(f"nothing can be rendered here: {error}")
    found = RobotsCamera(task, SHOWN, 160, 90)
    yield found
    found.close()


def geoms_of(scene: mujoco.MjvScene) -> list[mujoco.MjvGeom]:
    return [geom for geom in scene.geoms[: scene.ngeom] if geom.category == mujoco.mjtCatBit.mjCAT_DYNAMIC]


def test_pictures_show_each_robot_twice_once_translucent(task, camera):
    before = task.physics.qpos.clone()
    with_ghosts = camera.picture()
    geoms = geoms_of(camera.renderer.scene)
    ghosts = [geom for geom in geoms if geom.rgba[3] < 1.0]
    assert [geom.rgba.tolist() for geom in ghosts] == [pytest.approx(GHOST)] * len(ghosts)
    assert len(geoms) == 2 * len(ghosts) > 0
    camera.ghost = None
    assert not np.array_equal(camera.picture(), with_ghosts)
    assert len(geoms_of(camera.renderer.scene)) == len(ghosts)
    assert torch.equal(task.physics.qpos, before)
