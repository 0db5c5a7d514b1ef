"""URDF files as they are found: what MuJoCo's own reader loses or refuses, with masses and places worked by hand."""

import mujoco
import numpy as np
import pytest
from importing_fixtures import LEG_MASS, LEGS, TRUNK, urdf

from legged.errors import ConfigError
from legged.robots.gains import standing_torques
from legged.robots.importing.infer import make_ready, read_robot
from legged.robots.importing.legs import Poser
from legged.robots.importing.mjcf import read_mjcf
from legged.robots.importing.mjcf_writer import mjcf_of
from legged.robots.importing.repair import repair
from legged.robots.importing.shapes import count_fitted, fit_meshes, name_shapes
from legged.robots.importing.tree import Tree
from legged.robots.importing.urdf import read_urdf

SPHERE = '<geometry><sphere radius="0.05"/></geometry>'
UNIT = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'


@pytest.fixture
def read(tmp_path):
    """read(text): the tree of a URDF that is ready to be a model."""

    def read(text: str, **how) -> Tree:
        path = tmp_path / "toy" / "urdf" / "toy.urdf"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        tree = read_urdf(path, **how)
        fit_meshes(tree)
        repair(tree)
        count_fitted(tree)
        name_shapes(tree)
        return tree

    return read


def model_of(tree: Tree) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(mjcf_of(tree))


def said(tree: Tree, part: str) -> str:
    (line,) = [line for line in tree.said if part in line]
    return line


def arm(kind: str = "revolute", child: str = "", inside: str = "", name: str = "arm") -> str:
    """A joint of that kind at the front of the trunk, and what it carries."""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="trunk"/><child link="{name}_link"/><origin xyz="0.3 0 0"/>'
        f'<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="5" velocity="3"/>{inside}</joint>'
        f'<link name="{name}_link">{child}</link>'
    )


def test_the_base_floats_and_no_mass_is_lost(read, tmp_path):
    """MuJoCo's reader welds the root to the world, and 6 kg are gone."""
    tree = read(urdf())
    model = model_of(tree)
    assert tree.mass == pytest.approx(6.0 + 4 * LEG_MASS)
    assert model.body_mass.sum() == pytest.approx(13.0)
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "toy" / "urdf" / "toy.urdf")).body_mass.sum() == pytest.approx(7.0)
    assert (model.jnt_type[0], model.njnt, model.nbody) == (mujoco.mjtJoint.mjJNT_FREE, 13, 14)
    assert [model.joint(i).name for i in range(1, 4)] == ["fl_hip", "fl_thigh", "fl_calf"]
    np.testing.assert_array_equal(model.actuator_forcerange, [[-30.0, 30.0]] * 12)


def test_welded_links_are_lumped_by_the_parallel_axis_theorem(read):
    """Calf 0.2 kg at -0.1 and foot 0.05 kg at -0.2: the centre is at -0.12, and each is away from it by 0.02 and 0.08."""
    tree = read(urdf())
    calf = next(link for link in tree.links if link.name == "fl_calf")
    assert calf.mass == pytest.approx(0.25)
    np.testing.assert_allclose(calf.com, [0.0, 0.0, -0.12], atol=1e-12)
    across = 0.001 + 1e-5 + 0.2 * 0.02**2 + 0.05 * 0.08**2
    np.testing.assert_allclose(calf.inertia, np.diag([across, across, 0.0001 + 1e-5]), atol=1e-12)
    assert [shape.name for shape in calf.shapes] == ["fl_calf", "fl_foot"]
    np.testing.assert_allclose(calf.shapes[1].pos, [0, 0, -0.2], atol=1e-12)
    assert "dont_collapse" in said(tree, "dont_collapse")


def test_a_turned_inertia_is_that_of_the_model(read):
    """An inertial frame turned by a quarter about z swaps x and y; the fixed joint turns by a quarter about x."""
    link = (
        '<inertial><origin xyz="0.1 0 0" rpy="0 0 1.5707963267948966"/><mass value="2"/>'
        '<inertia ixx="0.01" iyy="0.02" izz="0.025" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    joint = (
        '<joint name="j" type="fixed"><parent link="trunk"/><child link="box"/><origin rpy="1.5707963267948966 0 0"/></joint>'
    )
    before, after = (read(urdf(extra)).links[0] for extra in ("", f'{joint}<link name="box">{link}</link>'))
    assert after.mass == pytest.approx(8.0)
    np.testing.assert_allclose(after.com, [0.2 / 8.0, 0, 0], atol=1e-12)
    turned = np.diag([0.02, 0.025, 0.01])  # about x, y and z of the trunk
    points = 6.0 * 0.025**2 + 2.0 * 0.075**2
    np.testing.assert_allclose(after.inertia, before.inertia + turned + np.diag([0, points, points]), atol=1e-12)


def test_cylinders_become_capsules_of_the_same_length(read):
    """Radius 0.02 and length 0.2: between the caps, 0.16 are left."""
    tree = read(urdf())
    thigh = next(shape for shape in tree.shapes if shape.name == "fl_thigh")
    assert thigh.kind == "capsule"
    np.testing.assert_allclose(thigh.size[:2], [0.02, 0.08])


def test_an_empty_base_link_takes_what_is_welded_to_it(read):
    """As A1's: `base` without inertial, and a trunk on a fixed joint."""
    joint = '<joint name="floating" type="fixed"><parent link="base"/><child link="trunk"/><origin xyz="0 0 0.1"/></joint>'
    tree = read(urdf(trunk=f'<link name="base"><visual>{SPHERE}</visual></link>{TRUNK}{joint}'))
    assert (tree.links[0].name, tree.links[0].mass) == ("base", 6.0)
    np.testing.assert_allclose(tree.links[0].com, [0, 0, 0.1])
    np.testing.assert_allclose(tree.links[1].pos, [0.2, 0.1, 0.1])


@pytest.mark.parametrize("kind", ["fixed", "floating"])
def test_a_world_link_is_not_the_base(read, kind):
    joint = f'<joint name="root" type="{kind}"><parent link="world"/><child link="trunk"/></joint>'
    assert read(urdf(f'<link name="world"/>{joint}')).links[0].name == "trunk"


def test_empty_links_above_the_base_are_passed_over_and_named(read):
    """As `base_footprint`, on the ground. A quarter turn to the left brings a hip at (0.2, 0.1) to (-0.1, 0.2)."""
    joints = (
        '<joint name="j1" type="fixed"><parent link="base_footprint"/><child link="base_link"/>'
        '<origin xyz="0 0 0.3"/></joint>'
        '<joint name="j2" type="fixed"><parent link="base_link"/><child link="trunk"/>'
        '<origin xyz="0 0 0.1" rpy="0 0 1.5707963267948966"/></joint>'
    )
    tree = read(urdf(f'<link name="base_footprint"/><link name="base_link"/>{joints}'))
    assert (tree.links[0].name, tree.links[0].mass) == ("trunk", 6.0)
    np.testing.assert_allclose(tree.links[0].com, [0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(tree.links[1].pos, [-0.1, 0.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.diag(tree.links[0].inertia), [0.08, 0.03, 0.1], atol=1e-12)
    assert said(tree, "guess: the base is link 'trunk'").endswith(": base_link, base_footprint")


def test_links_without_mass(read):
    """At the end of a hinge: it is held. In a chain: it moves, and is given a hundredth of the next link's mass."""
    tree = read(urdf(arm()))
    assert "arm" not in [hinge.name for hinge in tree.hinges]
    assert "arm" in said(tree, "move no mass")
    wrist = (
        '<joint name="wrist" type="continuous"><parent link="arm_link"/><child link="hand"/><origin xyz="0 0 0.1"/></joint>'
    )
    hand = f'<link name="hand"><inertial><mass value="1"/>{UNIT}</inertial></link>'
    tree = read(urdf(arm() + wrist + hand))
    masses = {link.name: link.mass for link in tree.links}
    assert (masses["arm_link"], masses["hand"]) == (pytest.approx(0.01), pytest.approx(0.99))
    assert model_of(tree).body_mass.sum() == pytest.approx(14.0)
    assert "arm_link 0.01 kg of hand" in said(tree, "have no mass")
    assert next(hinge for hinge in tree.hinges if hinge.name == "wrist").range is None  # continuous


@pytest.mark.parametrize(
    ("moments", "expected", "why"),
    [
        # C is 0.01 above A + B: each of these is raised by half of that.
        ((0.01, 0.02, 0.04), (0.015, 0.025, 0.04), "breaks A + B >= C by 25.0%"),
        ((-0.01, 0.03, 0.03), (3e-5, 0.03, 0.03), "has a moment that is not above 0"),
    ],
)
def test_impossible_inertias_are_mended_and_named(read, moments, expected, why):
    xx, yy, zz = moments
    child = f'<inertial><mass value="1"/><inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial>'
    tree = read(urdf(arm(child=child)))
    assert f"arm_link {why}" in said(tree, "impossible inertias")
    np.testing.assert_allclose(np.sort(model_of(tree).body("arm_link").inertia), expected, rtol=1e-3)


def test_a_mass_without_inertia_has_that_of_a_box(read):
    """As Laikago's. A ball of radius 0.05 is in a cube with an edge of 0.1: m / 12 (0.1^2 + 0.1^2)."""
    child = f'<inertial><mass value="3"/></inertial><collision>{SPHERE}</collision>'
    tree = read(urdf(arm(child=child)))
    np.testing.assert_allclose(model_of(tree).body("arm_link").inertia, [3.0 / 12.0 * 0.02] * 3, rtol=1e-6)
    assert "arm_link" in said(tree, "no inertia")


def test_joints_that_are_no_hinges_are_held(read):
    child = f'<inertial><mass value="1"/>{UNIT}</inertial>'
    tree = read(urdf(arm("prismatic", child) + arm("planar", child, name="sheet")))
    assert tree.links[0].mass == pytest.approx(8.0)
    assert "arm" in said(tree, "that slide are no hinges")
    assert "sheet" in said(tree, "slide in a plane")


def test_mimic_joints_are_held_at_their_offset(read):
    """At pi / 2 about y, a mass 0.1 above the joint is 0.1 in front of it: at 0.4 of the trunk."""
    child = f'<inertial><origin xyz="0 0 0.1"/><mass value="6"/>{UNIT}</inertial>'
    mimic = '<mimic joint="fl_hip" multiplier="2" offset="1.5707963267948966"/>'
    tree = read(urdf(arm(child=child, inside=mimic)))
    assert tree.links[0].mass == pytest.approx(12.0)
    np.testing.assert_allclose(tree.links[0].com, [0.2, 0, 0], atol=1e-12)
    assert "arm (1.5708 rad)" in said(tree, "mimic")


def test_the_first_of_two_axes_is_taken(read):
    child = f'<inertial><mass value="1"/>{UNIT}</inertial>'
    tree = read(urdf(arm(child=child, inside='<axis xyz="1 0 0"/>')))
    hinge = next(hinge for hinge in tree.hinges if hinge.name == "arm")
    assert hinge.axis.tolist() == [0, 1, 0]
    assert "arm" in said(tree, "several axes")


def test_limits_that_are_none(read):
    """ANYmal C's file has [0, 0] for every joint, others an effort of 0."""
    child = f'<inertial><mass value="1"/>{UNIT}</inertial>'
    text = urdf(arm(child=child)).replace('lower="-1" upper="1" effort="5"', 'lower="0" upper="0" effort="0"')
    tree = read(text)
    hinge = next(hinge for hinge in tree.hinges if hinge.name == "arm")
    assert (hinge.range, hinge.effort, hinge.velocity) == (None, None, 3.0)
    assert "arm" in said(tree, "are not a valid range")


OBJ = """v -1 -2 -3
v 1 -2 -3
v 1 2 -3
v -1 2 -3
v -1 -2 3
v 1 -2 3
v 1 2 3
v -1 2 3
f 1 3 2
f 1 4 3
f 5 6 7
f 5 7 8
f 1 2 6
f 1 6 5
f 2 3 7
f 2 7 6
f 3 4 8
f 3 8 7
f 4 1 5
f 4 5 8
"""
"""A box of 2 x 4 x 6."""
MESH = '<geometry><mesh filename="{}" scale="0.1 0.1 0.1"/></geometry>'


@pytest.mark.parametrize(
    ("where", "named"),
    [
        ("toy/meshes/box.obj", "package://toy/meshes/box.obj"),
        ("toy/meshes/box.obj", "../meshes/box.obj"),
        ("toy/meshes/box.obj", "package://toy_description/meshes/box.obj"),  # the folder has lost its package's name
        ("toy/meshes/box.obj", "/home/somebody/toy/meshes/box.obj"),
        ("elsewhere/toy/meshes/box.obj", "package://toy/meshes/box.obj"),
    ],
)
def test_meshes_are_found_where_packages_are(read, tmp_path, where, named):
    """And a collision mesh becomes the box that it is, of a tenth of its size."""
    (tmp_path / where).parent.mkdir(parents=True)
    (tmp_path / where).write_text(OBJ)
    child = f'<inertial><mass value="1"/>{UNIT}</inertial><collision>{MESH.format(named)}</collision>'
    tree = read(urdf(arm(child=child)), roots=[tmp_path / "elsewhere"])
    (box,) = [shape for shape in tree.shapes if shape.link == "arm_link"]
    assert box.kind == "box"
    np.testing.assert_allclose(np.sort(box.size), [0.1, 0.2, 0.3], atol=1e-6)
    assert "1 box" in said(tree, "1 collision meshes become")


def test_what_a_knee_holds_under_the_weight(tmp_path):
    """A foot carries 13 g / 4 = 31.87 N. It is under the hip, and the knee 0.2 sin(0.7) = 0.1288 m behind both: 4.106 N m,
    less what the shank's 0.2 kg at half of that and the foot's 0.05 kg weigh, 0.126 and 0.063 N m. Thighs and shanks have
    their masses 0.0644 m behind the hips, so the robot's is 4 * 1.2 * 0.0644 / 13 = 0.0238 m behind the middle of feet that
    are 0.2 m before and behind it: a hind foot carries 31.87 * 0.0238 / 0.2 = 3.79 N more, which is 0.488 N m.
    """
    path = tmp_path / "toy.urdf"
    path.write_text(urdf())
    tree = read_robot(path)
    make_ready(tree)
    poser = Poser(tree)
    angles = {f"{leg}_{joint}": angle for leg in LEGS for joint, angle in (("thigh", 0.7), ("calf", -1.4))}
    qpos = poser.pose(angles).qpos
    knees = [int(poser.model.joint(f"{leg}_calf").id) for leg in LEGS]
    feet = [int(poser.model.geom(f"{leg}_foot").id) for leg in LEGS]
    torques = standing_torques(poser.model, qpos, knees, feet)
    even = 4.106 - 0.126 - 0.063
    np.testing.assert_allclose(np.abs(torques), [even - 0.488, even - 0.488, even + 0.488, even + 0.488], atol=3e-3)


@pytest.mark.parametrize("place", ["assets", "assets/fine", "../assets"])
def test_a_mesh_that_lies_in_another_folder_than_the_file_says_is_found_by_its_name(read, tmp_path, place):
    """The toy is read in toy/urdf/. Of two that are called so nobody knows which is meant."""
    folder = tmp_path / "toy" / "urdf" / place
    folder.mkdir(parents=True)
    (folder / "box.obj").write_text(OBJ)
    child = f'<inertial><mass value="1"/>{UNIT}</inertial><collision>{MESH.format("meshes/box.obj")}</collision>'
    tree = read(urdf(arm(child=child)))
    (box,) = [shape for shape in tree.shapes if shape.link == "arm_link"]
    np.testing.assert_allclose(np.sort(box.size), [0.1, 0.2, 0.3], atol=1e-6)
    assert said(tree, "meshes are not where the file says") == f"meshes are not where the file says, but in: {place}/"
    other = tmp_path / "toy" / "urdf" / "other"
    other.mkdir()
    (other / "box.obj").write_text(OBJ)
    tree = read(urdf(arm(child=child)))
    assert not [shape for shape in tree.shapes if shape.link == "arm_link"]
    assert "left out: meshes/box.obj" in said(tree, "collision meshes that are not found")


def test_a_mesh_that_is_missing_or_of_a_kind_that_nobody_reads_is_left_out(read, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)  # as if it were not installed
    (tmp_path / "toy" / "urdf").mkdir(parents=True)
    (tmp_path / "toy" / "urdf" / "nice.dae").write_text("<COLLADA/>")
    visuals = "".join(f"<visual>{MESH.format(name)}</visual>" for name in ("nice.dae", "package://toy/nowhere.stl"))
    child = f'<inertial><mass value="1"/>{UNIT}</inertial>{visuals}'
    tree = read(urdf(arm(child=child)))
    line = said(tree, "visual meshes are left out")
    assert "nice.dae: MuJoCo does not read .dae; run `pip install trimesh pycollada`" in line
    missing = said(tree, "visual meshes that are not found")
    assert (
        missing == "visual meshes that are not found in the folders around the file are left out: package://toy/nowhere.stl"
    )
    assert "arm" in [hinge.name for hinge in tree.hinges]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</robot>", "", "is not well-formed XML: no element found: line"),
        ("<robot", "<mujoco", "mismatched tag"),
        ('<child link="fl_calf"/>', '<child link="fl_clf"/>', "there is no link 'fl_clf'; did you mean 'fl_calf'?"),
        ('type="revolute"', 'type="revolut"', "there is no type 'revolut'; did you mean 'revolute'?"),
        ('<parent link="fl_hip"/>', '<parent link="fl_foot"/>', "a closed loop; links not connected to 'trunk': fl_calf"),
        ('<parent link="trunk"/><child link="fl_hip"/>', '<parent link="trunk"/><child link="fr_hip"/>', "child of several"),
        ('<mass value="6"/>', '<mass value="six"/>', "<mass>: value: expected a number, got 'six'"),
        ('<mass value="6"/>', '<mass value="-6"/>', "link 'trunk': mass: must not be below 0, got -6"),
        ('<mass value="6"/>', "", "the base, link 'trunk', and the links that are welded to it have no mass"),
        ('xyz="0.2 0.1 0"', 'xyz="0.2 0.1"', "<origin>: xyz: expected 3 numbers, got '0.2 0.1'"),
        ('<axis xyz="1 0 0"/>', '<axis xyz="0 0 0"/>', "joint 'fl_hip': axis: must have a length"),
        ('upper="0.8"', 'upper="0.8."', "<limit>: upper: expected a number, got '0.8.'"),
        ("</robot>", '<link name="lost"/></robot>', "expected one link that is no joint's child, found 2: trunk, lost"),
    ],
)
def test_a_wrong_file_is_an_error_of_one_line(read, old, new, message):
    text = urdf()
    assert old in text
    with pytest.raises(ConfigError) as error:
        read(text.replace(old, new, 1))
    assert message in str(error.value)
    assert "toy.urdf: " in str(error.value)


def test_blanks_before_the_declaration_do_not_matter(read):
    assert read("\n  " + urdf()).mass == pytest.approx(13.0)


def test_what_is_written_is_what_was_read(read, tmp_path):
    """The MJCF of a tree, read again, has the same masses, places and limits."""
    tree = read(urdf())
    path = tmp_path / "again.xml"
    path.write_text(mjcf_of(tree))
    again = read_mjcf(path)
    repair(again)
    one, two = model_of(tree), model_of(again)
    for name in (
        "body_mass",
        "body_inertia",
        "body_pos",
        "jnt_range",
        "jnt_axis",
        "actuator_forcerange",
        "geom_pos",
        "geom_size",
    ):
        np.testing.assert_allclose(getattr(one, name), getattr(two, name), atol=1e-8, err_msg=name)
    assert {n for n in LEGS} == {name[:2] for name in (hinge.name for hinge in again.hinges)}


def test_a_heel_behind_a_toe_may_stand_on_the_ground(tmp_path):
    """Toes turn: they are the feet, and heels, which stand beside them, are no shanks whose contact is penalised."""
    fixed, toe = '_foot_fixed" type="fixed" dont_collapse="true">', '_toe" type="revolute"><axis xyz="0 1 0"/>'
    text = urdf().replace(fixed, f'{toe}<limit lower="-0.3" upper="0.3" effort="9"/>').replace("_calf", "_heel")
    (tmp_path / "toy.urdf").write_text(text)
    guesses = make_ready(read_robot(tmp_path / "toy.urdf"))
    assert guesses.feet == ["foot"]
    assert guesses.penalized == [f"{leg}_thigh" for leg in LEGS]
