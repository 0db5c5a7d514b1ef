"""Which shapes are a foot, what patterns name, and that the force on a foot of several shapes is the sum over them."""

import mujoco
import numpy as np
import pytest
import torch
from reference import CWorlds, random_states

from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.physics import RobotScene, make_physics
from legged.robots.robot import load_robot
from legged.robots.shapes import Shapes

MODEL = """
<mujoco>
  <worldbody>
    <body name="trunk"><freejoint/>
      <geom name="trunk" size="0.1"/>
      <body name="left_ankle"><joint name="a"/>
        <geom name="left_shank" size="0.1"/><geom name="left_heel" size="0.1"/><geom name="left_toe" size="0.1"/>
        <geom size="0.1" contype="0" conaffinity="0"/>
      </body>
      <body name="right_ankle"><joint name="b"/>
        <geom name="right_shank" size="0.1"/><geom name="heel of right" size="0.1"/><geom name="toe of right" size="0.1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def shapes():
    return Shapes.of(mujoco.MjModel.from_xml_string(MODEL), ["heel", "toe"], "feet")


def test_shapes_of_one_body_are_one_foot(shapes):
    assert shapes.feet_shapes == (("left_heel", "left_toe"), ("heel of right", "toe of right"))
    # What their names begin with, or where that is nothing, the body's name.
    assert shapes.contact_names == ("trunk", "left_shank", "left", "right_shank", "right_ankle")
    assert shapes.feet == (2, 4)
    assert shapes.contact == (0, 1, 2, 2, 3, 4, 4)


@pytest.mark.parametrize(
    ("patterns", "contacts"),
    [
        (["shank"], (1, 3)),
        (["left"], (1, 2)),  # names of shapes: the shank, and the foot, once
        (["ankle"], (1, 2, 3, 4)),  # in no shape's name, so bodies': all that they have
        (["right_ankle", "trunk"], (0, 3, 4)),
        ([], ()),
    ],
)
def test_patterns_name_shapes_or_else_bodies(shapes, patterns, contacts):
    assert shapes.contacts(patterns, "where") == contacts


@pytest.mark.parametrize("pattern", ["knee", ""])
def test_pattern_that_names_nothing_is_an_error(shapes, pattern):
    with pytest.raises(ConfigError, match=r"^where: "):
        shapes.contacts([pattern], "where")


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
def test_forces_and_places_of_feet_of_several_shapes(engine):
    """H1 thrown on the ground, 10 steps, beside C MuJoCo, whose contacts are added up by hand."""
    robot, sim = load_robot("h1"), SimConfig(physics=engine, nconmax=48, njmax=200, iterations=100, ls_iterations=50)
    assert robot.feet_names == ("left_foot", "right_foot")
    start = random_states(robot, 6, seed=0)
    start.base_pos[:, 2] += 0.42
    physics, worlds = make_physics(RobotScene(robot), sim, 6, torch.device("cpu")), CWorlds(robot, sim, start)
    start.write(physics)
    for _ in range(10):
        physics.ctrl.zero_()
        physics.step()
        worlds.step(torch.zeros(6, robot.num_dof))
    physics.refresh()
    expected = worlds.observe()
    feet = list(robot.feet_indices)
    assert (expected["contact_forces"][:, feet, 2] > 50.0).any()
    for name, limit in (("feet_pos", 2e-4), ("feet_vel", 2e-2)):
        np.testing.assert_allclose(getattr(physics.robot_state, name).cpu(), expected[name], atol=limit)
    forces = physics.robot_state.contact_forces.cpu().numpy()
    np.testing.assert_allclose(forces, expected["contact_forces"], atol=1e-2 * np.abs(expected["contact_forces"]).max())


BIPED = """
<mujoco><compiler angle="radian"/><worldbody>
<body name="trunk"><freejoint/><geom name="trunk" size="0.1"/>{legs}</body>
</worldbody><actuator>{motors}</actuator></mujoco>
"""
LIMB = """
<body name="{n}_mount" pos="0.02 {y} -0.1" quat="0.9 0.1 -0.2 0.3">
  <body name="{n}_leg" pos="0 0 -0.05" quat="0.8 0 0.3 0.1">
    <joint name="{n}_a" axis="1 0 0.2" pos="0.01 0 0.02"/><joint name="{n}_b" axis="0 1 0" pos="0 0.03 0" ref="0.4"/>
    <geom name="{n}_leg" size="0.02" mass="1"/>
    <body name="{n}_ankle" pos="0.05 0 -0.2"><body name="{n}_sole" pos="0 0.01 -0.03" quat="0.7 0.1 0 0.2">
      <geom name="{n}_toe" size="0.02" pos="0.05 0 0" mass="0.1"/>
      <geom name="{n}_heel" size="0.02" pos="-0.03 0.01 0" mass="0.1"/>
    </body></body>
  </body>
</body>
"""


def test_feet_on_welded_bodies_and_behind_two_hinges_of_one_body(tmp_path):
    """A hinge with a reference angle among them; places and velocities as MuJoCo has them."""
    legs = "".join(LIMB.format(n=n, y=y) for n, y in (("l", 0.1), ("r", -0.1)))
    motors = "".join(f'<motor joint="{n}_{joint}" forcerange="-9 9"/>' for n in "lr" for joint in "ab")
    (tmp_path / "biped.xml").write_text(BIPED.format(legs=legs, motors=motors))
    tables = "".join(
        f"{name}: {{_a: 0.1, _b: 0.2}}\n" for name in ("default_joint_angles", "stiffness", "damping", "velocity_limit")
    )
    (tmp_path / "robot.yaml").write_text(f"model: biped.xml\nbase: trunk\nspawn_height: 0.5\n{tables}feet: [_sole]\n")
    robot = load_robot(str(tmp_path))
    assert robot.feet_shapes == (("l_toe", "l_heel"), ("r_toe", "r_heel"))
    sim = SimConfig(physics="mujoco")
    start = random_states(robot, 4, seed=3)
    start.base_pos[:, 2] += 1.0
    physics, worlds = make_physics(RobotScene(robot), sim, 4, torch.device("cpu")), CWorlds(robot, sim, start)
    start.write(physics)
    expected = worlds.observe()
    np.testing.assert_allclose(physics.robot_state.feet_pos, expected["feet_pos"], atol=1e-5)
    np.testing.assert_allclose(physics.robot_state.feet_vel, expected["feet_vel"], atol=1e-4)
