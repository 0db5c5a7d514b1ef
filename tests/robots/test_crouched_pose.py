"""The pose from which a robot stands up."""

import numpy as np
import pytest

from legged.robots.crouched_pose import CROUCH, crouch
from legged.robots.robot import load_robot
from legged.robots.robot_model import read_model
from legged.robots.stance import standing_height


@pytest.mark.parametrize("name", ["anymal_c", "go2", "a1", "spot"])
def test_a_quadruped_crouches_at_the_height_that_is_wanted_within_its_limits(name):
    robot = load_robot(name)
    bent = crouch(robot)
    assert bent is not None
    qpos = robot.default_qpos.copy()
    qpos[list(robot.qpos_columns)] = bent
    height = standing_height(read_model(robot.folder, robot.file.model, "test"), robot.file.base, qpos)
    assert (CROUCH - 0.1) * robot.height < height <= CROUCH * robot.height
    assert (robot.dof_pos_limits[:, 0] <= bent).all()
    assert (bent <= robot.dof_pos_limits[:, 1]).all()
    # Hips stay where they are; of a leg, thigh and knee are bent by one factor, so that the foot stays below the hip.
    np.testing.assert_allclose(bent[~robot.swings], robot.default_dof_pos[~robot.swings])
    factors = bent[robot.swings] / robot.default_dof_pos[robot.swings]
    inside = np.abs(bent - robot.dof_pos_limits.T).min(axis=0)[robot.swings] > 1e-6
    assert np.ptp(factors[inside]) < 1e-9
    assert factors.min() > 1.1


@pytest.mark.parametrize("name", ["g1", "cassie"])
def test_a_biped_does_not(name):
    assert crouch(load_robot(name)) is None
