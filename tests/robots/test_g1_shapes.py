"""The G1's hips, wrists and hands: they collide only with sim.self_collisions, and not in the default pose and the clips."""

import mujoco
import numpy as np
import pytest

from legged.config.world import SimConfig
from legged.motion.kinematics import Skeleton
from legged.motion.readers import read_clip
from legged.physics import RobotScene
from legged.process.paths import data_folder
from legged.robots.robot import load_robot

EXTRA = {f"{side}_{part}" for side in ("left", "right") for part in ("hip", "wrist", "hand")}
ALLOWED_MM = {"walk": 6.5}
"""Depth of a clip's deepest contact with itself [mm]. In four frames of the walk, the left forearm brushes the trunk."""


def colliding(model: mujoco.MjModel) -> set[str]:
    return {model.geom(k).name for k in range(model.ngeom) if model.geom_contype[k] or model.geom_conaffinity[k]}


def test_hips_wrists_and_hands_collide_only_if_asked():
    robot = load_robot("g1")
    assert set(robot.self_collision_shapes) == EXTRA
    assert not EXTRA & set(robot.shape_names)
    without, among = (RobotScene(robot).model(SimConfig(self_collisions=on)) for on in (False, True))
    assert colliding(without) == {*robot.shape_names, "floor"}
    assert without.ngeom == len(robot.shape_names) + 1
    assert colliding(among) == colliding(without) | EXTRA
    np.testing.assert_array_equal(among.body_mass, without.body_mass)
    np.testing.assert_array_equal(among.body_inertia, without.body_inertia)
    assert robot.contact_names == RobotScene(robot).robot.contact_names


def test_hands_meet_the_ground_too():
    model = RobotScene(load_robot("g1")).model(SimConfig(self_collisions=True))
    data = mujoco.MjData(model)
    data.qpos[2] = -1.0
    mujoco.mj_forward(model, data)
    met = {model.geom(g).name for c in data.contact if 0 in model.geom_bodyid[[c.geom1, c.geom2]] for g in (c.geom1, c.geom2)}
    assert met >= EXTRA


@pytest.mark.parametrize("name", ["default", "walk", "turn", "squat", "kick"])
def test_the_robot_does_not_touch_itself_in_its_default_pose_and_clips(name):
    robot = load_robot("g1")
    model = RobotScene(robot).model(SimConfig(self_collisions=True))
    data, deepest = mujoco.MjData(model), 0.0
    poses = [robot.default_qpos]
    if name != "default":
        clip = read_clip(data_folder("resources") / "motions" / "g1" / f"{name}.npz", Skeleton(robot))
        poses = np.hstack([clip.root_pos, clip.root_quat, clip.joint_pos])
    for pose in poses:
        data.qpos[:] = pose
        data.qpos[2] += 2.0
        mujoco.mj_forward(model, data)
        deepest = max([deepest, *(-1e3 * contact.dist for contact in data.contact)])
    assert deepest <= ALLOWED_MM.get(name, 0.0)
