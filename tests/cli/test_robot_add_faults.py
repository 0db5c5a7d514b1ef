"""Files with the faults that files have: each is mended with a line, or refused in one line, and nothing is left behind."""

import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from helpers import call
from importing_fixtures import TRUNK, urdf

from legged.cli.robot import add
from legged.errors import ConfigError
from legged.physics.standing import height_under_gains
from legged.robots.robot import load_robot

pytestmark = pytest.mark.usefixtures("workplace")
CORNERS = [f"v {x} {y} {z}" for x in (-0.2, 0.2) for y in (-0.1, 0.1) for z in (-0.05, 0.05)]
FACES = ["1 2 4", "1 4 3", "5 8 6", "5 7 8", "1 5 6", "1 6 2", "3 4 8", "3 8 7", "1 3 7", "1 7 5", "2 6 8", "2 8 4"]
CUBE = "\n".join([*CORNERS, *(f"f {face}" for face in FACES)])
MESHED = TRUNK.replace('<box size="0.5 0.16 0.1"/>', '<mesh filename="Meshes/Cube.OBJ" {}/>')
XML = """<mujoco>{head}<worldbody><body name="trunk" pos="0 0 .4"><freejoint/><geom type="box" size=".2 .1 .05" mass="6"/>
{legs}</body></worldbody></mujoco>"""
LEG = """<body pos="{x} {y} 0"><joint name="{n}_haa" axis="1 0 0" range="-46 46"/><geom size=".03" mass=".5"/><body>
<joint name="{n}_hfe" axis="0 1 0" range="-57 143"/><geom type="capsule" size=".02 .08" pos="0 0 -.1" mass=".8"/>
<body pos="0 0 -.2"><joint name="{n}_kfe" axis="0 1 0" range="-143 -29"/><geom type="capsule" size=".015 .08" pos="0 0 -.1"
mass=".2"/><geom name="{n}_foot" size=".02" pos="0 0 -.2" mass=".05"/></body></body></body>"""
LEGS = "".join(
    LEG.format(n=n, x=x, y=y) for n, x, y in (("fl", 0.2, 0.1), ("fr", 0.2, -0.1), ("hl", -0.2, 0.1), ("hr", -0.2, -0.1))
)


def refused(capsys, tmp_path, text: str, file: str = "toy.urdf") -> str:
    """The error of one line; the command leaves nothing behind."""
    (tmp_path / file).write_text(text)
    assert call(add.main, [file, "--out", "mine"]) == 2
    assert not Path("mine").exists()
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert file in error
    return error


def degrees(text: str) -> str:
    for low, high in (("-0.8", "0.8"), ("-1.5", "3"), ("-2.7", "-0.5")):
        wide = [f"{np.degrees(float(value)):.0f}" for value in (low, high)]
        text = text.replace(f'lower="{low}" upper="{high}"', f'lower="{wide[0]}" upper="{wide[1]}"')
    return text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (degrees(urdf()), "limits of -155 and -29 look like degrees; a URDF has radians (-2.705 and -0.5061)"),
        (urdf().replace('lower="-0.8" upper="0.8"', 'lower="0.8" upper="-0.8"', 1), "lower 0.8 is above upper -0.8"),
        (urdf().replace('link name="fr_calf"', 'link name="fl_calf"'), "link 'fl_calf' comes twice"),
        (urdf().replace('<mass value="6"/>', '<mass value="${m}"/>'), "xacro toy.urdf > toy.plain.urdf"),
        (
            urdf(extra='<xacro:property xmlns:xacro="http://www.ros.org/wiki/xacro" name="m" value="1"/>'),
            "is a xacro file; write the URDF first with `xacro toy.urdf > toy.plain.urdf`",
        ),
        (urdf().replace("<axis", '<mimic joint="fl_knee"/><axis', 1), "mimic: there is no joint 'fl_knee'"),
        (
            urdf(trunk=MESHED.format('scale="1000 1000 1000"')),
            "mesh 'Cube.OBJ' is 400 m long; if it is in millimetres, add scale=",
        ),
    ],
)
def test_a_fault_of_a_urdf_is_named(tmp_path, capsys, text, says):
    (tmp_path / "Meshes").mkdir()
    (tmp_path / "Meshes" / "Cube.OBJ").write_text(CUBE)
    assert says in refused(capsys, tmp_path, text)


def test_a_xacro_suffix_and_unknown_attributes_of_bodies_are_refused(tmp_path, capsys):
    assert "xacro toy.urdf.xacro > toy.plain.urdf" in refused(capsys, tmp_path, urdf(), "toy.urdf.xacro")
    text = XML.format(head="", legs=LEGS.replace('axis="1 0 0"', 'axs="1 0 0"'))
    assert "unrecognized attribute: 'axs'" in refused(capsys, tmp_path, text, "toy.xml")


def test_nothing_is_left_of_a_robot_that_fails_after_it_was_written(tmp_path, capsys, monkeypatch):
    def fail(_):
        raise ConfigError("toy.urdf: it can't be loaded")

    monkeypatch.setattr("legged.cli.robot.load_robot", fail)
    assert "can't be loaded" in refused(capsys, tmp_path, urdf())


def test_wide_limits_of_one_joint_have_a_line_only(added):
    out = added(urdf().replace('lower="-1.5" upper="3"', 'lower="-15" upper="30"', 1), "--name", "one_wide")
    assert "limits of more than two turns; are they in degrees?" in out


@pytest.mark.parametrize("kind", ["urdf", "xml"])
def test_names_of_meshes_may_differ_in_case(added, tmp_path, kind):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "cube.obj").write_text(CUBE)
    if kind == "urdf":
        out = added(urdf(trunk=MESHED.format("")), "--name", "cased_urdf")
    else:
        asset = '<asset><mesh name="cube" file="Meshes/Cube.OBJ"/></asset>'
        mesh = XML.format(head=asset, legs=LEGS).replace('type="box" size=".2 .1 .05"', 'type="mesh" mesh="cube"')
        out = added(mesh, "--name", "cased_xml", file="toy.xml")
    assert "1 collision meshes become primitives around them: 1 box" in out


@pytest.mark.parametrize("suffix", [".mjcf", ".XML"])
def test_any_suffix_of_mjcf_and_settings_of_older_versions_are_read(added, tmp_path, suffix):
    head = '<option timestep="0.002"><flag sensornoise="enable"/></option><include file="rest.xml"/>'
    (tmp_path / "rest.xml").write_text("<mujoco><compiler angle='degree'/></mujoco>")
    name = f"old{suffix[1:].lower()}{suffix[1]}"
    out = added(XML.format(head=head, legs=LEGS), "--name", name, file=f"toy{suffix}")
    assert "settings that this MuJoCo does not know are left out: sensornoise of <flag>" in out
    shutil.copy(tmp_path / f"toy{suffix}", f"mine/{name}/direct{suffix}")  # as model: of a robot.yaml too
    shutil.copy(tmp_path / "rest.xml", f"mine/{name}/rest.xml")
    settings = yaml.safe_load(Path(f"mine/{name}/robot.yaml").read_text()) | {"model": f"direct{suffix}"}
    Path(f"mine/{name}/robot.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(ConfigError, match="has no limit: every motor needs a forcerange"):
        load_robot(f"mine/{name}")


def test_a_knee_that_mimics_the_other_bends_with_it(added):
    """Both knees bend by the same angle; the right one has no motor."""
    mimic = '<joint name="hr_calf" type="revolute"><mimic joint="hl_calf" multiplier="1" offset="0"/>'
    out = added(urdf().replace('<joint name="hr_calf" type="revolute">', mimic), "--name", "mimic")
    assert "12 hinges, 11 motors" in out
    robot = load_robot("mine/mimic")
    assert robot.passive is not None
    assert robot.passive.names == ("hr_calf",)
    knee = robot.default_dof_pos[robot.joint_names.index("hl_calf")]
    assert knee < -0.7
    assert robot.default_qpos[robot.passive.qpos_columns[0]] == pytest.approx(knee, abs=1e-6)


def test_counts_are_of_after_the_feet_were_fitted(added, tmp_path):
    """The mesh of a foot, a cube, is fitted as a ball, and then counted."""
    (tmp_path / "cube.obj").write_text(CUBE.replace("0.2", "0.02").replace("0.1", "0.02").replace("0.05", "0.02"))
    ball = '<geometry><sphere radius="0.02"/></geometry>'
    out = added(urdf().replace(ball, '<geometry><mesh filename="cube.obj"/></geometry>'), "--name", "counted")
    model = mujoco.MjModel.from_xml_path("mine/counted/counted.xml")
    kind = mujoco.mjtGeom(int(model.geom("fl_foot").type[0])).name[7:].lower()
    assert kind != "box"
    assert f"4 collision meshes become primitives around them: 4 {kind}" in out


def test_gains_are_raised_until_the_robot_stands(added):
    """The rule's gains let this one sink to three quarters: its light shanks limit them."""
    out = added(XML.format(head="", legs=LEGS), "--name", "sinker", file="toy.xml")
    assert "times the rule's. With the rule's gains, in C MuJoCo the base sinks from " in out
    robot = load_robot("mine/sinker")
    assert height_under_gains(robot, robot.stiffness, robot.damping) > 0.84 * robot.height
    out = added(XML.format(head="", legs=LEGS), "--name", "soft", "--stiffness", "5", "--damping", "0.3", file="toy.xml")
    assert "in C MuJoCo the base sinks from " in out
    assert "check the gains" in out
    assert "times the rule's" not in out
