"""The size of a robot, and the gains that follow from its joints' inertia."""

import mujoco
import numpy as np
import pytest

from legged.robots.gains import FREQUENCY, LARGEST_TARGET, MARGIN, RATIO, SAG, TIME_STEP, gains, mass_matrix
from legged.robots.robot import load_robot
from legged.robots.similarity import Size, grown, growth, size_of
from legged.robots.stance import lowest_point, standing_height

PENDULUM = """
<mujoco>
  <worldbody>
    <body name="base">
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="1e4 1e4 1e4"/>
      <geom name="trunk" type="box" size="0.1 0.1 0.05"/>
      <body name="leg" pos="0.2 0 -0.1">
        <joint name="hip" axis="0 1 0"/>
        <inertial pos="0 0 -0.3" mass="2" diaginertia="0.02 0.02 0.02"/>
        <geom name="foot" type="sphere" size="0.02" pos="0 0 -0.4"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def pendulum():
    return mujoco.MjModel.from_xml_string(PENDULUM.format(mass=1e6))


def test_standing_height_is_down_to_the_lowest_shape(pendulum):
    """By hand: 0.1 + 0.4 + 0.02 m straight down; with the leg level, the trunk's underside is lowest but for the foot."""
    assert standing_height(pendulum, "base", [0, 0, 0, 1, 0, 0, 0, 0.0]) == pytest.approx(0.52, abs=1e-6)
    assert standing_height(pendulum, "base", [0, 0, 0, 1, 0, 0, 0, np.pi / 3]) == pytest.approx(0.1 + 0.2 + 0.02, abs=1e-6)
    assert standing_height(pendulum, "base", [0, 0, 0, 1, 0, 0, 0, np.pi]) == pytest.approx(0.05, abs=1e-6)


SHAPES = {
    "sphere": 'size="0.1"',
    "capsule": 'size="0.05 0.2"',
    "cylinder": 'size="0.1 0.2"',
    "ellipsoid": 'size="0.1 0.2 0.05"',
    "box": 'size="0.1 0.2 0.05"',
    "mesh": 'mesh="wedge"',
}


@pytest.mark.parametrize("kind", SHAPES)
def test_the_lowest_point_of_a_shape_is_where_c_mujoco_has_it(kind):
    """MuJoCo's own distance to a plane far below is what it should be."""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
      <asset><mesh name="wedge" vertex="0 0 0 0.3 0 0 0 0.2 0 0 0 0.1"/></asset>
      <worldbody>
        <geom name="below" type="plane" size="0 0 1" pos="0 0 -10"/>
        <body pos="0.1 0.2 0.3" quat="0.7 0.3 -0.4 0.2"><freejoint/><geom name="shape" type="{kind}" {SHAPES[kind]}/></body>
      </worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    apart = mujoco.mj_geomDistance(model, data, 0, 1, 100.0, None)
    assert lowest_point(model, data, 1) == pytest.approx(apart - 10.0, abs=2e-6)


def test_joints_that_swing_a_leg_forward():
    """Hip pitch, knee and ankle pitch; neither the hip's roll and yaw nor any joint of waist and arms."""
    for name, expected in (("anymal_c", ("HFE", "KFE")), ("g1", ("hip_pitch", "knee", "ankle_pitch"))):
        robot = load_robot(name)
        found = {joint for joint, swings in zip(robot.joint_names, robot.swings, strict=True) if swings}
        assert found == {joint for joint in robot.joint_names if any(part in joint for part in expected)}


def test_sizes_of_robots():
    size = size_of("anymal_c")
    assert (size.mass, size.height) == pytest.approx((52.13485, 0.54882), abs=1e-4)


def test_growth_keeps_gravity():
    small, large = Size(1.0, 0.25), Size(10.0, 1.0)
    assert growth(small, large) == {"kg": 10.0, "m": 4.0, "s": 2.0}
    assert grown("m/s^2", small, large) == 1.0
    assert grown("m/s", small, large) == 2.0
    assert grown("m/s", large, small) == 0.5


def test_gains_of_a_leg_on_a_heavy_base(pendulum):
    """On a base that does not give way the leg's inertia about its hip is 0.02 + 2 * 0.3^2 = 0.2 in the air; it can't move at
    all with its foot on the ground, so that only the sag, the effort and the stability bound what follows from that.
    """
    model = pendulum
    model.opt.gravity[:] = [0, 0, -1e-9]  # nothing to carry
    joint, foot = model.joint("hip").id, model.geom("foot").id
    height = 1e-9 / 9.81 * 0.52  # so that the frequency is that under 9.81
    stiffness, damping = gains(model, model.qpos0, [joint], [foot], np.array([1e6]), height)
    assert stiffness == pytest.approx(0.2 * FREQUENCY**2 * 9.81 / 0.52, rel=1e-3)
    assert damping == pytest.approx(MARGIN * 0.2 / TIME_STEP, rel=1e-2)
    stiffness, _ = gains(model, model.qpos0, [joint], [foot], np.array([1.5]), height)
    assert stiffness == pytest.approx(1.5 / LARGEST_TARGET)


def test_what_is_too_light_for_the_weight_is_held_as_softly_as_the_explicit_law_needs(pendulum):
    """A robot that would stand 1 km high wants m g h / 10 of a leg of 0.2 kg m^2. Semi-implicit steps with K dt^2 / I above 4
    diverge; it is kept to 1, at 8000 N m/rad. Toes of a biped were driven until its physics blew up.
    """
    joint, foot = pendulum.joint("hip").id, pendulum.geom("foot").id
    stiffness, _ = gains(pendulum, pendulum.qpos0, [joint], [foot], np.array([1e9]), 1000.0)
    assert stiffness == pytest.approx(MARGIN * 0.2 / TIME_STEP**2, rel=1e-2)
    assert stiffness == pytest.approx(8000.0, rel=1e-2)


def test_p_gains_of_known_robots_are_those_of_their_makers_within_a_factor_of_two_and_d_gains_nearly():
    """ANYmal C 90 N m/rad and 4 N m s/rad; Go2 20 and 0.5, whose D gain is known as small."""
    for name, most in (("anymal_c", 2.5), ("go2", 3.8)):
        robot = load_robot(name)
        model = mujoco.MjModel.from_xml_path(str(robot.model_path))
        joints = [model.joint(joint).id for joint in robot.joint_names]
        qpos = model.qpos0.copy()
        qpos[7:] = robot.default_dof_pos
        feet = [model.geom(foot).id for foot in robot.feet_names]
        p, d = gains(model, qpos, joints, feet, robot.torque_limits, size_of(name).height)
        own_p, own_d = (robot.each(table, name) for table in (robot.file.stiffness, robot.file.damping))
        assert (np.abs(np.log(p / own_p)) < np.log(2.0)).all()
        assert (np.abs(np.log(d / own_d)) < np.log(most)).all()


def test_the_explicit_law_is_stable_and_holds_the_weight():
    robot = load_robot("anymal_c")
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    joints = [model.joint(joint).id for joint in robot.joint_names]
    qpos = model.qpos0.copy()
    qpos[7:] = robot.default_dof_pos
    feet = [model.geom(foot).id for foot in robot.feet_names]
    p, d = gains(model, qpos, joints, feet, robot.torque_limits, 0.55)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    inverse = np.linalg.inv(mass_matrix(model, data))[6:, 6:]
    assert TIME_STEP * np.abs(np.linalg.eigvals(inverse * d)).max() <= MARGIN + 1e-9
    assert TIME_STEP**2 * np.abs(np.linalg.eigvals(inverse * p)).max() <= MARGIN + 1e-9
    knees = [i for i, name in enumerate(robot.joint_names) if "KFE" in name]
    assert (25.0 / p[knees] < SAG * 1.01).all()  # 25 N m each carries the robot, worked out from a quarter of its weight
    assert RATIO == 0.5
