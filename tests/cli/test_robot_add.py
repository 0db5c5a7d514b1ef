"""The command that brings a robot: what it writes trains at once, and it says what it guessed."""

import re
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import yaml
from helpers import ENGINE, call
from importing_fixtures import URDF_LEG, urdf

from legged.cli.robot import add
from legged.config.yaml_files import read_yaml
from legged.errors import ConfigError
from legged.registry import make_task, register_file, task_config
from legged.robots.importing.folder import Guesses, _compact, robot_yaml, task_yaml
from legged.robots.importing.tree import Tree
from legged.robots.robot import load_robot

pytestmark = pytest.mark.usefixtures("workplace")


@pytest.mark.slow
def test_a_urdf_becomes_a_robot_whose_task_steps(added):
    out = added(urdf(), "--name", "first_toy")
    assert "first_toy: a quadruped of 13 kg, 12 hinges, 12 motors, 13 shapes" in out
    assert "mass: 13 kg in the links of the file, 13 kg in the model" in out
    assert "guess: the default pose is a stance by inverse kinematics" in out
    assert "train it: legged train mine/first_toy_flat.yaml" in out
    robot = load_robot("mine/first_toy")
    assert robot.mass == pytest.approx(13.0)
    assert robot.feet_names == ("fl_foot", "fr_foot", "hl_foot", "hr_foot")
    names = np.array(robot.contact_names)
    assert set(names[list(robot.termination_indices)]) == {"trunk"}
    rods = {f"{leg}_{part}" for leg in ("fl", "fr", "hl", "hr") for part in ("thigh", "calf")}
    assert set(names[list(robot.penalised_indices)]) == rods
    task = register_file("mine/first_toy_flat.yaml")
    built = make_task(task_config(task, [("env.num_envs", 4), ("domain_rand.push_robots", False), *ENGINE], on_cpu=True))
    for _ in range(50):
        observations, _, _, _ = built.step(torch.zeros(4, 12))
    assert torch.isfinite(observations["actor"]).all()
    assert built.base_pos[:, 2].median() > 0.6 * robot.height
    assert "written by `legged robot add` from `toy.urdf`" in Path("mine/first_toy/PROVENANCE.md").read_text()


def test_a_file_of_which_no_model_can_be_made_is_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "toy.urdf").write_text(urdf().replace('joint name="fr_hip"', 'joint name="fl_hip"'))
    assert call(add.main, ["toy.urdf", "--out", "mine"]) == 2
    error = capsys.readouterr().err
    assert "toy.urdf: joint 'fl_hip' comes twice; each joint needs a name of its own" in error
    assert error.count("\n") == 1


def test_the_box_of_its_inertia_stands_for_a_trunk_without_a_shape(added):
    """A box of 6 kg and 0.6 x 0.4 x 0.2 m has moments of 6 (0.4^2 + 0.2^2) / 12 = 0.1, 0.2 and 0.26 kg m^2. Without it a
    robot would lie on its back, or in the ground, and its episode go on.
    """
    bare = """
    <link name="trunk"><inertial><origin xyz="0.02 0 0.01"/><mass value="6"/>
     <inertia ixx="0.1" iyy="0.2" izz="0.26" ixy="0" ixz="0" iyz="0"/></inertial>
     <collision><geometry><mesh filename="nowhere.stl"/></geometry></collision></link>
    """
    out = added(urdf(trunk=bare), "--name", "bare_toy")
    assert "guess: the trunk has no collision shapes, so a box with the base's inertia is added" in out
    assert "guess: contact that ends an episode: trunk\n" in out
    robot = load_robot("mine/bare_toy")
    assert [robot.contact_names[i] for i in robot.termination_indices] == ["trunk"]
    box = mujoco.MjModel.from_xml_path(str(robot.model_path)).geom("trunk")
    np.testing.assert_allclose(np.sort(box.size), [0.1, 0.2, 0.3], atol=1e-4)
    np.testing.assert_allclose(box.pos, [0.02, 0.0, 0.01], atol=1e-6)
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, box.quat)
    np.testing.assert_allclose(np.abs(turned.reshape(3, 3)) @ box.size, [0.3, 0.2, 0.1], atol=1e-4)


@pytest.mark.slow
def test_a_frame_on_the_ground_is_not_the_base(added):
    """0.3 m below it, the base would stand at a tenth of its height, and torque limits by its height be a tenth too."""
    weak = urdf().replace('effort="30"', 'effort="0"')
    joint = '<joint name="j" type="fixed"><parent link="foot_print"/><child link="trunk"/><origin xyz="0 0 0.3"/></joint>'
    out = added(weak.replace("</robot>", f'<link name="foot_print"/>{joint}</robot>'), "--name", "sixteenth_toy")
    assert "guess: the base is link 'trunk', and empty links above it on fixed joints are passed over: foot_print" in out
    added(weak, "--name", "seventeenth_toy")
    robot, plain = load_robot("mine/sixteenth_toy"), load_robot("mine/seventeenth_toy")
    assert (robot.file.base, robot.file.spawn_height) == ("trunk", plain.file.spawn_height)
    np.testing.assert_array_equal(robot.torque_limits, plain.torque_limits)


def test_what_a_file_does_not_say_is_guessed_and_named(added):
    """Torque limits: 0.4 m g h. A robot.yaml holds every guess as a comment."""
    out = added(urdf().replace('effort="30"', 'effort="0"'), "--name", "third_toy")
    robot = load_robot("mine/third_toy")
    np.testing.assert_allclose(robot.torque_limits, 0.4 * 13.0 * 9.81 * robot.height, atol=0.06)
    assert "guess: torque limits missing in the file are set to 0.4 m g h: fl_hip" in out
    text = Path("mine/third_toy/robot.yaml").read_text()
    for line in (line.strip() for line in out.splitlines() if line.startswith("  guess: t")):
        assert f"# {line}" in text
    assert ("stiffness" in yaml.safe_load(text)) == ("times the rule's" in out)


def test_shapes_whose_names_are_parts_of_others_have_their_roles(added):
    """`trunk` is a part of fl_trunk_thigh, whose contact ends no episode; fr_thigh of fr_thigh0, a hip."""
    text = urdf().replace('"fl_thigh"', '"fl_trunk_thigh"').replace('"fr_hip"', '"fr_thigh0"')
    ball = '<collision><geometry><sphere radius="0.03"/></geometry></collision>'
    out = added(text.replace('<link name="fr_thigh0">', f'<link name="fr_thigh0">{ball}'), "--name", "eighteenth_toy")
    changed = "trunk -> trunk_itself, fr_thigh -> fr_thigh_itself"
    assert f"shapes are renamed if other shapes' names contain their names: {changed}" in out
    robot = load_robot("mine/eighteenth_toy")
    names = np.array(robot.contact_names)
    assert set(names[list(robot.termination_indices)]) == {"trunk_itself"}
    rods = {f"{leg}_{part}" for leg in ("fl", "fr", "hl", "hr") for part in ("thigh", "calf")}
    expected = rods - {"fl_thigh", "fr_thigh"} | {"fl_trunk_thigh", "fr_thigh_itself"}
    assert set(names[list(robot.penalised_indices)]) == expected


def test_gains_may_be_given_and_joints_held(added):
    limit, inertia = '<limit lower="1" upper="2" effort="1" velocity="1"/>', 'ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"'
    arm = f'<joint name="arm" type="revolute"><parent link="trunk"/><child link="arm_link"/>{limit}</joint>'
    arm += f'<link name="arm_link"><inertial><mass value="1"/><inertia {inertia}/></inertial></link>'
    out = added(urdf(arm), "--name", "fourth_toy", "--stiffness", "40", "--damping", "1", "--hold", "arm")
    robot = load_robot("mine/fourth_toy")
    assert (robot.num_dof, robot.mass) == (12, pytest.approx(14.0))
    assert set(robot.stiffness) == {40.0}
    assert "joints are held because of --hold: arm at 1 rad" in out


@pytest.mark.slow
def test_a_lopsided_robot_learns_without_mirror_images(added):
    added(urdf().replace('xyz="0.2 0.1 0"', 'xyz="0.25 0.1 0"'), "--name", "fifth_toy")
    task = yaml.safe_load(Path("mine/fifth_toy_flat.yaml").read_text())
    assert task["train"]["algorithm"]["symmetry"] is False
    task_config(register_file("mine/fifth_toy_flat.yaml"), on_cpu=True)


@pytest.mark.slow
def test_a_default_pose_that_leans_to_a_side_has_no_mirror_images(added):
    """Left and right hips turn about x alike, so 0.1 rad on both sides spreads one leg and pulls the other one in."""
    added(urdf(), "--name", "leaning_toy")
    robot, task = Path("mine/leaning_toy/robot.yaml"), register_file("mine/leaning_toy_flat.yaml")
    before = robot.read_text()
    robot.write_text(before.replace("hip: 0", "hip: 0.1"))
    assert robot.read_text() != before
    with pytest.raises(ConfigError, match=r"symmetry: left and right default_joint_angles of 'leaning_toy'"):
        task_config(task, on_cpu=True)
    task_config(task, [("train.algorithm.symmetry", False)], on_cpu=True)
    robot.write_text(before.replace("hip: 0", "fl_hip: 0.1\n  hl_hip: 0.1\n  fr_hip: -0.1\n  hr_hip: -0.1"))
    task_config(task, on_cpu=True)


def test_legs_that_nothing_touches_get_feet(added):
    """A ball at the centre of mass of the last link: of a calf of 0.2 kg at -0.1 and a foot of 0.05 kg at -0.2, at -0.12."""
    text = re.sub(r"<collision>.*?</collision>", "", urdf().replace('<box size="0.5 0.16 0.1"/>', ""), flags=re.DOTALL)
    out = added(text, "--name", "twelfth_toy")
    assert "legs end in links without collision shapes, so a ball is added as the foot: fl_calf, fr_calf" in out
    assert "guess: the trunk has no collision shapes, so a box with the base's inertia is added" in out
    model = mujoco.MjModel.from_xml_path("mine/twelfth_toy/twelfth_toy.xml")
    np.testing.assert_allclose(model.geom("fl_foot").pos, [0, 0, -0.12], atol=1e-9)


@pytest.mark.slow
def test_a_shank_whose_mesh_has_the_foot_in_it_ends_above_the_foot(added, tmp_path):
    """Half lengths 0.02, 0.01 and 0.11 m down to -0.21; the foot's middle is at -0.2, so the end goes to -0.2 + 0.02."""
    corners = [f"v {x} {y} {z}" for x in (-0.02, 0.02) for y in (-0.01, 0.01) for z in (-0.11, 0.11)]
    faces = ["f 1 2 4 3", "f 5 7 8 6", "f 1 5 6 2", "f 3 4 8 7", "f 1 3 7 5", "f 2 6 8 4"]
    (tmp_path / "calf.obj").write_text("\n".join([*corners, *faces]))
    cylinder = '<collision><origin xyz="0 0 -0.09"/><geometry><cylinder radius="0.01" length="0.16"/></geometry>'
    mesh = '<collision><origin xyz="0 0 -0.1"/><geometry><mesh filename="calf.obj"/></geometry>'
    out = added(urdf().replace(cylinder, mesh), "--name", "thirteenth_toy")
    assert "a mesh that includes the foot are shortened to end above the foot: fl_calf, fr_calf, hl_calf, hr_calf" in out
    model = mujoco.MjModel.from_xml_path("mine/thirteenth_toy/thirteenth_toy.xml")
    np.testing.assert_allclose(sorted(model.geom("fl_calf").size), [0.01, 0.02, 0.095], atol=1e-6)
    np.testing.assert_allclose(model.geom("fl_calf").pos, [0, 0, -0.085], atol=1e-6)
    untouched = added(urdf().replace(cylinder, mesh.replace("-0.1", "-0.07")), "--name", "fourteenth_toy")
    assert "end above the foot" not in untouched  # it ends at -0.18
    rods = urdf().replace(cylinder, mesh).replace('<collision><geometry><sphere radius="0.02"/></geometry></collision>', "")
    out = added(rods, "--name", "fifteenth_toy")
    assert "so a ball is added as the foot" in out
    assert "end above the foot" not in out  # the rod was drawn back once already


@pytest.mark.slow
def test_a_robot_that_looks_along_y_is_turned(added):
    """Its left legs are at -x: a quarter turn clockwise brings them to +y."""
    places = {"fl": (-0.1, 0.2), "fr": (0.1, 0.2), "hl": (-0.1, -0.2), "hr": (0.1, -0.2)}
    text = urdf()
    for (x, y), (old_x, old_y) in zip(places.values(), ((0.2, 0.1), (0.2, -0.1), (-0.2, 0.1), (-0.2, -0.1)), strict=True):
        text = text.replace(f'xyz="{old_x} {old_y} 0"', f'xyz="{x} {y} 0.0"')
    out = added(text, "--name", "sixth_toy")
    assert "by the names, the left side is not at +y: the robot is turned by 270 degrees" in out
    model = mujoco.MjModel.from_xml_path("mine/sixth_toy/sixth_toy.xml")
    np.testing.assert_allclose(model.body("fl_hip").pos, [0.2, 0.1, 0.0], atol=1e-9)


def test_meshes_are_copied_and_drawn(added, tmp_path):
    """Beside the MJCF, under names of their own."""
    pytest.importorskip("trimesh")
    import trimesh

    (tmp_path / "shell.dae").write_bytes(trimesh.exchange.dae.export_collada(trimesh.creation.box((0.4, 0.2, 0.1))))
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "cube.stl")
    meshes = "".join(f'<visual><geometry><mesh filename="{name}"/></geometry></visual>' for name in ("shell.dae", "cube.stl"))
    out = added(urdf().replace("</inertial>", f"</inertial>{meshes}", 1), "--name", "seventh_toy")
    assert {path.name for path in Path("mine/seventh_toy/meshes").iterdir()} == {"shell.stl", "cube.stl"}
    assert "MiB of meshes" in out
    model = mujoco.MjModel.from_xml_path("mine/seventh_toy/seventh_toy.xml")
    assert model.nmesh == 2
    assert model.body_mass.sum() == pytest.approx(13.0)
    drawn = model.geom_bodyid[model.geom_contype + model.geom_conaffinity == 0]
    assert set(drawn) == set(range(1, 14)) - {i for i in range(1, 14) if model.body(i).name.endswith("_hip")}  # bare ones too


@pytest.mark.slow
def test_a_model_of_menagerie(added, tmp_path, monkeypatch, capsys):
    """Through its own package, from a folder that stands in for what it would download."""
    menagerie = pytest.importorskip("mujoco_menagerie")
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path / "menagerie"))
    robot = menagerie.get("unitree_go2")
    (tmp_path / "menagerie" / "unitree_go2").mkdir(parents=True)
    added(urdf(), "--name", "eighth_toy")
    model = Path("mine/eighth_toy/eighth_toy.xml").read_text()
    (tmp_path / "menagerie" / "unitree_go2" / robot.entry(robot.default_model).file).write_text(model)
    assert call(add.main, ["menagerie:unitree_go2", "--out", "theirs"]) == 0
    assert load_robot("theirs/unitree_go2").mass == pytest.approx(13.0)
    assert f"Licence: {robot.license}" in Path("theirs/unitree_go2/PROVENANCE.md").read_text()
    assert call(add.main, ["menagerie:unitree_go22"]) == 2
    assert "Menagerie has no such robot; did you mean 'unitree_go2'?" in capsys.readouterr().err
    assert call(add.main, ["menagerie:unitree_go1"]) == 1
    assert "error: menagerie:unitree_go1: 'unitree_go1' not found under MENAGERIE_ROOT" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    assert call(add.main, ["menagerie:unitree_go2"]) == 2
    assert "pip install mujoco-menagerie" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.urdf"], "'nowhere.urdf': there is no such file"),
        (["toy.txt"], "toy.txt: expected a URDF (.urdf) or an MJCF file (.xml, .mjcf)"),
        (["toy.urdf", "--name", "../toy"], "--name: the name of a robot must be a plain name"),
        (["toy.urdf", "--stiffness", "40"], "--stiffness and --damping: give both or neither"),
        (["toy.urdf", "--stiffness", "-1", "--damping", "1"], "--stiffness: must be between 0 and 1e6, got -1"),
        (["toy.urdf", "--hold", "arm"], "--hold: 'arm' is in no joint's name"),
        (["toy.urdf", "--extends", "nothing"], "--extends: there is no task 'nothing'"),
        (["arm.urdf"], "only one chain of hinges reaches down, to link 'fl_calf'; a robot that walks has two legs or more"),
        (["broken.urdf"], "broken.urdf: is not well-formed XML"),
    ],
)
def test_a_wrong_call_ends_with_one_line(tmp_path, capsys, arguments, message):
    (tmp_path / "toy.urdf").write_text(urdf())
    (tmp_path / "toy.txt").write_text("hello")
    (tmp_path / "arm.urdf").write_text(urdf(legs=URDF_LEG.format(n="fl", x=0.2, y=0.1, side=0.05)))
    (tmp_path / "broken.urdf").write_text(urdf()[:-3])
    assert call(add.main, [*arguments, "--out", "mine"]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1
    assert not Path("mine").exists()


@pytest.mark.slow
def test_a_task_on_rough_ground_is_called_like_its_robot(added):
    added(urdf(), "--name", "rough_toy", "--extends", "base/quadruped_rough")
    assert yaml.safe_load(Path("mine/rough_toy.yaml").read_text())["extends"] == "base/quadruped_rough"


@pytest.mark.slow
def test_nothing_is_written_over_unless_asked(added, capsys):
    added(urdf(), "--name", "ninth_toy")
    assert call(add.main, ["toy.urdf", "--name", "ninth_toy", "--out", "mine"]) == 2
    assert "mine/ninth_toy exists already; give another name, or --force" in capsys.readouterr().err
    assert "ninth_toy" in added(urdf(), "--name", "ninth_toy", "--force")


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_a_source_in_the_robots_own_folder_is_left_alone(tmp_path, capsys, force):
    """The model would be written over by what becomes of it, and meshes be copied onto themselves."""
    cube = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    mesh = '<visual><geometry><mesh filename="go/meshes/cube.obj"/></geometry></visual>'
    text = urdf().replace("</inertial>", f"</inertial>{mesh}", 1)
    (tmp_path / "go" / "meshes").mkdir(parents=True)
    for file in ("go/go.xml", "go.urdf"):
        (tmp_path / file).write_text(text)
    (tmp_path / "go/meshes/cube.obj").write_text(cube)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    assert call(add.main, ["go/go.xml", "--out", ".", *force]) == 2
    assert "go/go.xml: is in go, which the new robot would overwrite; give another --name or --out" in capsys.readouterr().err
    assert call(add.main, ["go.urdf", "--out", ".", *force]) == 2
    message = "go/meshes/cube.obj: is in go, which" if force else "go exists already"
    assert message in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


@pytest.mark.parametrize("name", ["2024", "1e3", "null", "toy: a #1", 'it\'s "a": b, [c]'])
def test_a_name_that_yaml_reads_as_something_else_is_in_quotes(name, tmp_path):
    """In its task, and in robot.yaml where joints have such names too."""
    path = tmp_path / "task.yaml"
    tree = Tree(name, path, [], 0.0)
    guesses = Guesses(name, 0.3, {name: 0.5}, "", [name], [name], [name], [name], {}, {}, {}, 4)
    path.write_text(task_yaml(name, name, name, True, guesses))
    assert read_yaml(path) == {"extends": name, "robot": name}
    path.write_text(robot_yaml(tree, guesses))
    read = read_yaml(path)
    assert (read["model"], read["base"], read["feet"]) == (f"{name}.xml", name, [name])
    assert read["default_joint_angles"] == {name: 0.5}


def test_a_name_of_two_lines_stays_one():
    guesses = Guesses("a\nb", 0.3, {"a\nb": 0.5}, "", [], ["a\nb"], [], [], {}, {}, {}, 4)
    read = yaml.safe_load(robot_yaml(Tree("toy", Path("toy.xml"), [], 0.0), guesses))
    assert (read["base"], read["feet"], read["default_joint_angles"]) == ("a\nb", ["a\nb"], {"a\nb": 0.5})


def test_tables_are_shortened_only_where_they_say_the_same():
    assert _compact({"fl_hip": 1.0, "fr_hip": 1.0, "fl_knee": 2.0}) == {"hip": 1.0, "knee": 2.0}
    different = {"fl_hip": 1.0, "fr_hip": 2.0}
    assert _compact(different) == different
    inside = {"l_ab": 1.0, "r_b": 2.0}  # 'b' is a part of 'ab' too, which is the longer match
    assert _compact(inside) == {"ab": 1.0, "b": 2.0}
    different = {"a_b": 1.0, "c_ab": 1.0, "x_a_b": 3.0}
    assert _compact(different) == different
