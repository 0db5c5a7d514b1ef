"""Every robot under resources/robots in the engines that read its model by themselves: loaded, nothing compiled."""

import mujoco_warp as mjw
import newton
import numpy as np
import pytest
import warp as wp

from legged.config.world import SimConfig
from legged.physics import RobotScene
from legged.physics.newton.model import build_newton_model
from legged.physics.newton.solvers import SOLVERS
from legged.process.paths import data_folder
from legged.robots.robot import Robot, load_robot

ROBOTS = sorted(path.parent.name for path in (data_folder("resources") / "robots").glob("*/robot.yaml"))


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request) -> Robot:
    return load_robot(request.param)


def test_robots_are_found():
    assert {"anymal_c", "go2", "spot", "g1", "cassie"} <= set(ROBOTS)


@pytest.mark.slow
def test_mujoco_warp_takes_it(robot):
    model = RobotScene(robot).model(SimConfig(), "none")
    with wp.ScopedDevice("cpu"):
        taken = mjw.put_model(model)
        mjw.make_data(model, nworld=2, nconmax=24, njmax=96)
    assert (taken.nq, taken.nv, taken.nu) == (model.nq, model.nv, robot.num_dof)


@pytest.mark.slow
def test_newton_takes_it(robot):
    """Joints, shapes and masses are where the layout says; robots with passive joints are refused elsewhere."""
    if robot.passive is not None:
        pytest.skip("newton does not simulate passive joints")
    sim = SimConfig(physics="newton")
    setup = SOLVERS[sim.solver]
    with wp.ScopedDevice("cpu"):
        model, layout = build_newton_model(robot, setup, sim, 1, None, wp.get_device("cpu"))
    assert isinstance(model, newton.Model)
    assert len(layout.dof_q) == len(set(layout.dof_q)) == robot.num_dof
    assert len(layout.shapes) == len(set(layout.shapes)) == len(robot.shape_names)
    assert model.body_mass.numpy()[: layout.bodies].sum() == pytest.approx(robot.mass, rel=1e-5)
    limits = np.stack([array.numpy()[layout.dof_qd] for array in (model.joint_limit_lower, model.joint_limit_upper)], axis=1)
    own = np.clip(robot.dof_pos_limits, -newton.MAXVAL, newton.MAXVAL)  # a wheel has no limits
    np.testing.assert_allclose(limits, own, atol=1e-5)
