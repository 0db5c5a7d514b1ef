"""MJCF that was written for something else: adapted when loaded, with places, limits and masses worked by hand."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from helpers import ENGINE
from importing_fixtures import LEGS, urdf

from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.physics import RobotScene
from legged.physics.scene.robot_scene import robot_source
from legged.registry import make_task, task_config
from legged.rendering.camera import size_of
from legged.rendering.scene import display_model
from legged.robots.importing.convert import is_plain_file, robot_spec_of
from legged.robots.importing.infer import make_ready, read_robot
from legged.robots.importing.mjcf import read_mjcf
from legged.robots.importing.mjcf_writer import mjcf_of
from legged.robots.importing.tree import Tree, rotate
from legged.robots.robot import Robot, load_robot

LEG = """
<body name="{n}_thigh" pos="{x} {y} 0">
  <inertial pos="0 0 -0.1" mass="1" diaginertia="0.005 0.005 0.001"/>
  <joint name="{n}_hip" axis="0 1 0" range="-2 2" damping="0.5"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2"/>
  <geom type="capsule" size="0.025" fromto="0 0 -0.05 0 0 -0.1"/>
  <body name="{n}_shank" pos="0 0 -0.2">
    <inertial pos="0 0 -0.1" mass="0.4" diaginertia="0.002 0.002 0.0005"/>
    <joint name="{n}_knee" axis="0 1 0" range="-2.5 2.5" damping="0.5"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2"/>
    <body name="{n}_foot" pos="0 0 -0.2">
      <geom name="{n}_tip" size="0.03" mass="0.1" friction="0.8 0.02 0.01"/>
    </body>
  </body>
</body>
"""
SCENE = """
<mujoco model="dog">
  <compiler angle="radian"/>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="1 1 1" rgb2="0 0 1" width="32" height="32"/>
  </asset>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="crate" pos="2 0 0.1"><freejoint/><geom type="box" size="0.1 0.1 0.1" mass="1"/></body>
    <body name="trunk" pos="0 0 0.4">
      {root}
      <geom type="box" size="0.25 0.08 0.05" mass="6"/>
      <geom type="box" size="0.05 0.05 0.05" pos="0.2 0 0.1" mass="0" contype="0" conaffinity="0"/>
      <camera name="eye" pos="0 0 1"/><site name="imu"/>
      {legs}
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
  <sensor><gyro site="imu"/><touch name="contact_x" site="imu"/></sensor>
  {extra}
</mujoco>
"""
"""A dog of 12 kg: 6 in the trunk, and 1.5 in each leg."""
ORDER = [f"{n}_{joint}" for n in LEGS for joint in ("hip", "knee")]
POSITIONS = "".join(f'<position joint="{name}" kp="40" forcerange="-20 20"/>' for name in reversed(ORDER))
YAML = """
model: {model}
base: trunk
spawn_height: 0.45
default_joint_angles: {{{angles}}}
feet: [tip]
penalize_contacts_on: [thigh]
terminate_after_contacts_on: [trunk]
"""


def scene(actuators: str = POSITIONS, root: str = "<freejoint/>", extra: str = "", legs: str = "") -> str:
    own = "".join(LEG.format(n=n, x=x, y=y) for n, (x, y) in LEGS.items())
    return SCENE.format(actuators=actuators, root=root, extra=extra, legs=legs or own)


@pytest.fixture
def dog(tmp_path):
    """dog(text, **yaml): a robot folder whose robot.yaml points to that file."""

    def dog(text: str, model: str = "scene.xml", angles: str = "hip: 0.3, knee: -0.6") -> Robot:
        (tmp_path / model).write_text(text)
        (tmp_path / "robot.yaml").write_text(YAML.format(model=model, angles=angles))
        return load_robot(str(tmp_path))

    return dog


@pytest.fixture
def read(tmp_path):
    def read(text: str) -> Tree:
        (tmp_path / "scene.xml").write_text(text)
        return read_mjcf(tmp_path / "scene.xml")

    return read


def test_a_scene_with_position_actuators_is_a_robot(dog, tmp_path):
    """Floor, crate, lights, cameras and sensors are gone; the actuators, of the opposite order, are motors with limits."""
    robot = dog(scene())
    assert not is_plain_file(robot.model_path)
    assert robot.joint_names == tuple(ORDER)
    assert robot.mass == pytest.approx(12.0)
    assert robot.torque_limits.tolist() == [20.0] * 8
    assert robot.shape_names[:4] == ("trunk", "fl_thigh", "fl_thigh_2", "fl_shank")
    model = RobotScene(robot).model(task_config("anymal_c_flat", on_cpu=True).sim)
    assert (model.nsensor, model.ncam, model.nkey) == (0, 0, 0)
    assert {model.geom(i).name for i in range(model.ngeom)} == {*robot.shape_names, "floor"}
    np.testing.assert_allclose(model.geom("fl_tip").friction, [0.8, 0.02, 0.01])  # it was merged into the shank
    assert model.body(model.geom("fl_tip").bodyid[0]).name == "fl_shank"
    assert model.body("fl_shank").mass == pytest.approx(0.5)
    np.testing.assert_allclose(model.body("fl_shank").ipos, [0, 0, -(0.4 * 0.1 + 0.1 * 0.2) / 0.5], atol=1e-9)


def test_it_steps_as_a_task_and_is_drawn(dog, tmp_path):
    robot = dog(scene())
    task = make_task(task_config("anymal_c_flat", [("robot", str(tmp_path)), ("env.num_envs", 2), *ENGINE], on_cpu=True))
    for _ in range(5):
        observations, _, _, _ = task.step(torch.zeros(2, 8))
    assert torch.isfinite(observations["actor"]).all()
    assert task.base_pos[:, 2].min() > 0.25
    drawn = display_model(robot, 2, 64, 64)
    assert drawn.nbody == 1 + 2 * 9  # the ground, and two robots without crates
    assert mujoco.MjModel.from_xml_string(robot_source(robot, False)).nu == 8  # for an engine that reads text


def test_the_file_of_a_plain_robot_is_used_as_it_is(robot):
    """ANYmal C's model must not change by a bit."""
    assert is_plain_file(robot.model_path)
    one, two = robot_spec_of(robot.model_path).compile(), mujoco.MjModel.from_xml_path(str(robot.model_path))
    for name in ("body_mass", "body_inertia", "body_ipos", "geom_pos", "geom_size", "jnt_range", "qpos0"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


@pytest.mark.parametrize(
    ("actuator", "effort", "stiffness", "damping"),
    [
        ('<motor joint="{j}" gear="6" ctrlrange="-5 5"/>', 30.0, None, None),
        ('<motor joint="{j}" ctrlrange="-5 5" forcerange="-8 8"/>', 5.0, None, None),
        ('<general joint="{j}" gainprm="2" ctrlrange="-5 5"/>', 10.0, None, None),
        ('<motor joint="{j}" forcerange="-80 90"/>', 80.0, None, None),
        ('<position joint="{j}" kp="30" kv="2" forcerange="-7 7"/>', 7.0, 30.0, 2.0),
        ('<position joint="{j}" kp="30" gear="2" forcerange="-7 7"/>', 14.0, 120.0, None),
        ('<velocity joint="{j}" kv="3"/>', None, None, 3.0),
        ('<position joint="{j}" kp="30"/><velocity joint="{j}" kv="3"/>', None, 30.0, 3.0),
    ],
)
def test_limits_and_gains_as_the_joint_feels_them(read, actuator, effort, stiffness, damping):
    tree = read(scene("".join(actuator.format(j=name) for name in ORDER)))
    for hinge in tree.hinges:
        assert hinge.driven
        assert (hinge.effort, hinge.stiffness, hinge.damping) == (
            None if effort is None else pytest.approx(effort),
            None if stiffness is None else pytest.approx(stiffness),
            None if damping is None else pytest.approx(damping),
        )


def test_critical_damping_is_a_number_once_compiled(read):
    """dampratio 1 is 2 sqrt(kp m), where MuJoCo takes m from the joint's inertia at the model's pose."""
    tree = read(scene("".join(f'<position joint="{name}" kp="30" dampratio="1" forcerange="-7 7"/>' for name in ORDER)))
    assert all(hinge.damping is not None and 0.1 < hinge.damping < 10.0 for hinge in tree.hinges)


def test_a_file_without_actuators_drives_every_hinge_by_its_force_range(read):
    text = (
        scene("").replace("<actuator></actuator>", "").replace('damping="0.5"/>', 'damping="0.5" actuatorfrcrange="-9 9"/>')
    )
    tree = read(text)
    assert [(hinge.driven, hinge.effort) for hinge in tree.hinges] == [(True, 9.0)] * 8
    assert any("no actuators" in line for line in tree.said)


def test_a_heavy_door_beside_the_robot_is_not_the_robot(read):
    """It hangs on a hinge, but nothing hangs on it."""
    door = '<body name="door" pos="3 0 1"><joint name="swing"/><geom type="box" size="0.1 0.5 1" mass="300"/></body>'
    tree = read(scene().replace("<worldbody>", f"<worldbody>{door}"))
    assert (tree.links[0].name, tree.mass) == ("trunk", pytest.approx(12.0))
    assert any("bodies door, crate" in line for line in tree.said)


@pytest.mark.parametrize("root", ["", '<joint name="x" type="slide" axis="1 0 0"/><joint name="turn" axis="0 1 0"/>'])
def test_a_base_that_does_not_float_does(dog, root):
    """It is fixed to the world, or hangs on joints of a plane, as the half cheetah."""
    robot = dog(scene(root=root))
    assert robot.mass == pytest.approx(12.0)
    assert robot.num_dof == 8


def test_angles_count_from_zero(read):
    """A hinge with a ref of 0.5 is drawn at 0.5: at 0 the leg is turned back by as much. A base that is drawn turned is
    upright: its inertia and its legs are turned with it.
    """
    inertial = '<inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/>'
    leg = f'<body name="leg">{inertial}<joint name="hip" axis="0 1 0" ref="0.5"/></body>'
    text = scene("", legs=leg).replace('pos="0 0 0.4"', 'pos="0 0 0.4" euler="0 0 1.5707963267948966"')
    tree = read(text.replace("<actuator></actuator>", ""))
    assert tree.links[0].inertia[0, 0] == pytest.approx(6.0 / 3.0 * (0.25**2 + 0.05**2))  # long along y now
    assert tree.links[0].inertia[1, 1] == pytest.approx(6.0 / 3.0 * (0.08**2 + 0.05**2))
    down = np.array([0.0, 0.0, -1.0])
    expected = [0.0, np.sin(0.5), -np.cos(0.5)]  # turned by -0.5 about y, then by a quarter about z
    np.testing.assert_allclose(rotate(tree.links[1].quat, down), expected, atol=1e-9)


def test_a_fragment_that_refers_to_a_scene_is_read(read):
    """A contact pair with a floor that another file has, and sensors on it; meshes that are not there."""
    extra = (
        '<contact><pair geom1="ground" geom2="fl_tip"/></contact><sensor><contact geom1="ground" geom2="fl_tip"/></sensor>'
    )
    text = scene(extra=extra).replace("</asset>", '<mesh name="shell" file="nowhere.stl"/></asset>')
    text = text.replace(
        '<site name="imu"/>', '<site name="imu"/><geom type="mesh" mesh="shell" contype="0" conaffinity="0"/>'
    )
    tree = read(text)
    assert tree.mass == pytest.approx(12.0)
    assert any("1 mesh files do not exist" in line for line in tree.said)


def test_shapes_that_only_pairs_let_touch_collide(read):
    """Apollo's feet have no collision bits, and explicit pairs."""
    text = scene(extra='<contact><pair geom1="floor" geom2="fl_tip"/></contact>').replace(
        'name="fl_tip" size="0.03"', 'name="fl_tip" size="0.03" contype="0" conaffinity="0"'
    )
    assert "fl_tip" in [shape.name for shape in read(text).shapes]


BOX = "-1 -2 -3  1 -2 -3  1 2 -3  -1 2 -3  -1 -2 3  1 -2 3  1 2 3  -1 2 3"


def test_collision_meshes_become_primitives_and_keep_their_place(dog, tmp_path):
    """A mesh of 0.2 x 0.4 x 0.6 at (1, 2, 3) of the trunk, turned by a quarter about z: a box of half of these."""
    mesh = f'<mesh name="block" vertex="{BOX}" scale="0.1 0.1 0.1"/></asset>'
    block = '<geom type="mesh" mesh="block" pos="1 2 3" euler="0 0 1.5707963267948966" mass="0"/>'
    text = scene().replace("</asset>", mesh).replace('<site name="imu"/>', f'<site name="imu"/>{block}')
    robot = dog(text)
    model = mujoco.MjModel.from_xml_string(robot_source(robot, False))
    box = model.geom("trunk_2")
    assert box.type[0] == mujoco.mjtGeom.mjGEOM_BOX
    np.testing.assert_allclose(box.pos, [1, 2, 3], atol=1e-6)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, box.quat)
    np.testing.assert_allclose(np.abs(turn.reshape(3, 3) @ box.size), [0.2, 0.1, 0.3], atol=1e-6)
    assert robot.mass == pytest.approx(12.0)


@pytest.mark.parametrize("plain", [True, False])
def test_a_camera_sees_what_is_only_drawn(dog, tmp_path, plain):
    """A flag of 1.5 m above the trunk, whose mesh is read for pictures alone: from the feet, 0.43 m below the trunk's origin
    less what bent legs take, to 1.5 m above it.
    """
    (tmp_path / "flag.obj").write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 1.5\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    asset, flag = '<mesh name="flag" file="flag.obj"/></asset>', '<geom type="mesh" mesh="flag" contype="0" conaffinity="0"/>'
    text = scene().replace("</asset>", asset).replace('<site name="imu"/>', f'<site name="imu"/>{flag}')
    text = text.replace(
        '<geom type="box" size="0.25', '<inertial pos="0 0 0" mass="6" diaginertia=".03 .08 .1"/><geom type="box" size="0.25'
    )
    robot = dog(text)
    if plain:
        spec = robot_spec_of(robot.model_path, drawn=True)
        robot = dog(spec.to_xml(), model="plain.xml")
    assert is_plain_file(robot.model_path) is plain
    assert 1.5 + 0.3 < size_of(robot)[2] < 1.5 + 0.43


@pytest.mark.parametrize("file", ["toy.urdf", "scene.xml"])
def test_what_is_drawn_collides_where_nothing_else_does(dog, file):
    """As named in the file, in the engines as in pictures."""
    if file == "toy.urdf":
        robot = dog(urdf().replace("collision>", "visual>").replace("_foot", "_tip"), file, "hip: 0, thigh: 0.7, calf: -1.4")
        assert len(robot.shape_names) == 13
    else:
        robot = dog(scene().replace("<asset>", '<default><geom contype="0" conaffinity="0"/></default><asset>'))
        assert len(robot.shape_names) == 18
    assert robot.feet_names == tuple(f"{n}_tip" for n in LEGS)
    drawn, touched = (robot_spec_of(robot.model_path, drawn).compile() for drawn in (True, False))
    assert touched.ngeom == len(robot.shape_names) == drawn.ngeom // 2
    np.testing.assert_allclose(drawn.body_inertia, touched.body_inertia, rtol=1e-6)


def test_a_mass_without_inertia_has_that_of_what_collides(dog):
    """6 kg in a box of 0.5 x 0.16 x 0.1, whatever is drawn around it: 6 / 12 (0.16^2 + 0.1^2) = 0.0178 about x."""
    bare = '<inertia ixx="0.03" iyy="0.08" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    cover = '<link name="trunk"><visual><geometry><box size="1 1 1"/></geometry></visual>'
    text = urdf().replace(bare, "").replace('<link name="trunk">', cover).replace("_foot", "_tip")
    robot = dog(text, "toy.urdf", "hip: 0, thigh: 0.7, calf: -1.4")
    for drawn in (True, False):
        assert robot_spec_of(robot.model_path, drawn).compile().body("trunk").inertia.min() == pytest.approx(0.0178)


def test_several_hinges_of_a_body_without_names_have_one_each(read):
    tree = read(scene(actuators="").replace('<joint name="fl_hip" ', '<joint axis="1 0 0"/><joint '))
    assert [hinge.name for hinge in tree.hinges][:3] == ["fl_thigh_joint", "fl_thigh_joint_2", "fl_knee"]
    assert "fl_thigh_joint_2" in mjcf_of(tree)


def test_links_that_are_kept_apart_stay_so(dog):
    """A shank and the other shank's foot, which was merged into it; and a crate, which is left out."""
    pairs = (("fl_shank", "fr_foot"), ("fl_shank", "fl_foot"), ("crate", "trunk"))
    excludes = "".join(f'<exclude body1="{one}" body2="{other}"/>' for one, other in pairs)
    robot = dog(scene(extra=f"<contact>{excludes}</contact>"))
    model = RobotScene(robot).model(SimConfig(self_collisions=True))
    shanks = [model.body(name).id for name in ("fl_shank", "fr_shank")]
    assert model.exclude_signature.tolist() == [(shanks[0] << 16) + shanks[1]]


def test_loops_and_springs_are_kept(read, tmp_path):
    """A rod that is tied to a shank, and one hinge that follows another; the foot, to which it is tied, was welded on."""
    connect = '<connect body1="fl_foot" body2="trunk" anchor="0 0 0.05"/>'
    extra = f'<equality>{connect}<joint joint1="fl_hip" joint2="fr_hip"/></equality>'
    text = scene(extra=extra).replace('range="-2 2"', 'range="-2 2" stiffness="7" springref="0.1"')
    (tmp_path / "scene.xml").write_text(text)
    model = robot_spec_of(tmp_path / "scene.xml").compile()
    assert model.neq == 2
    assert model.body(model.eq_obj1id[0]).name == "fl_shank"
    np.testing.assert_allclose(model.eq_data[0, :3], [0, 0, -0.15], atol=1e-9)  # the foot is 0.2 below the knee
    assert model.joint("fl_hip").stiffness[0] == 7.0
    assert model.qpos_spring[model.joint("fl_hip").qposadr[0]] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>",
            "holds no robot: no body that hangs on another body has a hinge",
        ),
        ("<mujoco><worldbody><body/></worldbody>", "MuJoCo refuses it"),
        ("<mujoco><compiler coordinate='global'/></mujoco>", "MuJoCo refuses it"),
    ],
)
def test_what_is_no_robot_is_refused_in_one_line(dog, text, message):
    with pytest.raises(ConfigError, match=message) as error:
        dog(text)
    assert "\n" not in str(error.value)


def test_a_motor_without_a_limit_is_still_refused(dog):
    """Only add_robot guesses one, and says so."""
    with pytest.raises(ConfigError, match="every motor needs a forcerange"):
        dog(scene("".join(f'<position joint="{name}" kp="40"/>' for name in ORDER)))


def test_a_urdf_is_a_model_too(dog):
    text = urdf().replace("_foot", "_tip")
    robot = dog(text, model="toy.urdf", angles="hip: 0, thigh: 0.7, calf: -1.4")
    assert robot.mass == pytest.approx(13.0)


KEY = '<keyframe><key name="{name}" qpos="2 0 0.1 1 0 0 0 0 0 0.4 1 0 0 0 {angles}"/></keyframe>'


@pytest.mark.parametrize(("name", "hip", "used"), [("home", 0.4, True), ("reach", 3.5, False)])
def test_a_keyframe_is_the_default_pose_if_one_can_stand_in_it(tmp_path, name, hip, used):
    """At 3.5 rad the hips are beyond their range of 2."""
    path = Path(tmp_path / "scene.xml")
    path.write_text(scene(extra=KEY.format(name=name, angles=f"{hip} -0.8 " * 4)))
    tree = read_robot(path)
    guesses = make_ready(tree)
    assert (guesses.angles["fl_hip"] == hip) is used
    assert any(f"keyframe '{name}'" in line for line in tree.said)


def test_gains_of_position_actuators_are_taken_where_they_hold(tmp_path):
    """40 N m/rad and the joints' own damping of 0.5, which leaves the model. 4000 would blow up at 5 ms: the shank turns at
    0.0003 to 0.02 kg m^2, so that its frequency of sqrt(4000 / 0.02) = 450 rad/s is above 2 / 5 ms.
    """
    path = Path(tmp_path / "scene.xml")
    path.write_text(scene())
    tree = read_robot(path)
    guesses = make_ready(tree)
    assert set(guesses.stiffness.values()) == {40.0}
    assert set(guesses.damping.values()) == {0.5}
    assert not any(hinge.passive for hinge in tree.hinges)
    path.write_text(scene(POSITIONS.replace('kp="40"', 'kp="4000"')))
    tree = read_robot(path)
    guesses = make_ready(tree)
    assert guesses.stiffness == {}
    assert any("gains of the file's position actuators are left out" in line for line in tree.said)
    assert all(hinge.passive["damping"] == 0.5 for hinge in tree.hinges)
    path.write_text(scene(POSITIONS.replace('kp="40"', 'kp="2"')))
    tree = read_robot(path)
    assert make_ready(tree).stiffness == {}
    assert any("left out: under the robot's weight" in line for line in tree.said)
    path.write_text(scene().replace('damping="0.5"', ""))  # deviations would go on for ever
    tree = read_robot(path)
    assert make_ready(tree).stiffness == {}
    assert any("left out: neither actuators nor joints have any damping" in line for line in tree.said)
