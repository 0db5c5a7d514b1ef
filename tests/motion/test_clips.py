"""The clips that come with the package, and how they are made."""

import clips
import numpy as np
import pytest

from legged.motion.checks import quality_of
from legged.motion.kinematics import Skeleton
from legged.motion.readers import read_clip
from legged.process.paths import data_folder
from legged.robots.robot import load_robot

FOLDER = data_folder("resources") / "motions" / "g1"
SOLE = np.array([[-0.05, 0.12], [-0.03, 0.03]])
"""Extent of a sole around the ankle, along x and y [m]."""


@pytest.fixture(scope="module")
def skeleton() -> Skeleton:
    return Skeleton(load_robot("g1"))


@pytest.mark.parametrize("name", ["walk", "turn", "squat", "kick"])
def test_a_shipped_clip_has_no_findings(skeleton, name):
    clip = read_clip(FOLDER / f"{name}.npz", skeleton)
    assert clip.fps == 50.0
    assert quality_of(clip, skeleton).findings() == []


@pytest.mark.parametrize("name", ["squat", "kick"])
def test_the_centre_of_mass_stays_above_the_soles_that_stand(skeleton, name):
    """Slow motions balance if it does. Ankles of feet that stay on the ground turn by less than their soft limits."""
    clip = read_clip(FOLDER / f"{name}.npz", skeleton)
    quality, feet = quality_of(clip, skeleton), skeleton.indices(clips.FEET, "test")
    sides = [side for side, sole in zip(("left", "right"), quality.soles.T, strict=True) if sole.max() < 2e-3]
    robot = skeleton.robot
    ankles = [i for i, joint in enumerate(robot.joint_names) if "ankle" in joint and joint.split("_")[0] in sides]
    low, high = robot.dof_pos_limits[ankles].T
    beyond = np.abs(clip.joint_pos[:, ankles] - 0.5 * (low + high)) - 0.45 * (high - low)
    assert ankles
    assert beyond.max() < 0.0
    assert np.abs(quality.lower_sole).max() < 1e-3
    for data, soles in zip(skeleton.frames(clip), quality.soles, strict=True):
        stands = [foot for foot, sole in zip(feet, soles, strict=True) if sole < 2e-3]
        back, front = (pick(data.xpos[stands, :2] + SOLE[:, side], axis=0) for side, pick in ((0, np.min), (1, np.max)))
        assert (back < data.subtree_com[skeleton.base, :2]).all()
        assert (data.subtree_com[skeleton.base, :2] < front).all()


def test_the_kick_lifts_a_foot_and_swings_it(skeleton):
    soles = quality_of(read_clip(FOLDER / "kick.npz", skeleton), skeleton).soles
    assert soles[:, 0].max() > 0.3
    assert soles[:, 1].max() < 1e-3


def test_keyframes_are_reached(skeleton):
    """Feet, centre of mass and base have their targets to the micrometre."""
    feet, centre, height = clips.standing(skeleton)
    skeleton.data.qpos[:3] = 0.0, 0.0, height
    feet[0] += 0.02, 0.01, 0.03
    pose = clips.Pose(feet, centre + np.array([0.02, -0.03]), height - 0.1, pitch=0.2, toes=0.1)
    clips.reach(skeleton, pose)
    data, (left, right) = skeleton.data, skeleton.indices(clips.FEET, "test")
    np.testing.assert_allclose(data.xpos[[left, right]], pose.feet, atol=1e-6)
    np.testing.assert_allclose(data.subtree_com[skeleton.base, :2], pose.centre, atol=1e-6)
    assert data.xpos[skeleton.base, 2] == pytest.approx(pose.height, abs=1e-6)
    for body, pitch in ((left, 0.1), (right, 0.0), (skeleton.base, 0.2)):
        np.testing.assert_allclose(np.abs(data.xquat[body] @ clips.pitched(pitch)), 1.0, atol=1e-9)
    with pytest.raises(ValueError, match="the targets are missed by"):
        clips.reach(skeleton, pose._replace(height=2.0))


def test_a_squat_is_made_anew_as_it_is_shipped(skeleton):
    found, shipped = clips.squat(skeleton), read_clip(FOLDER / "squat.npz", skeleton)
    np.testing.assert_allclose(found.joint_pos, shipped.joint_pos, atol=1e-4)
    np.testing.assert_allclose(found.root_pos, shipped.root_pos, atol=1e-4)
