"""Hinges that are not drawn at 0, hinges without a motor, and what ties parts together, in MJCF that is adapted."""

import mujoco
import numpy as np
import pytest
from helpers import call

from legged.cli.robot import add
from legged.robots.importing.convert import robot_spec_of
from legged.robots.importing.mjcf import read_mjcf
from legged.robots.importing.mjcf_writer import mjcf_of
from legged.robots.importing.repair import repair
from legged.robots.robot import load_robot

ARMS = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint/><geom size=".1" mass="1"/>
      <body name="arm" pos=".2 .1 0" quat=".8 .2 -.3 .1">
        <joint name="a" axis="1 .3 0" pos=".1 0 .05" ref="-.3"/><joint name="b" axis="0 1 .4" pos="0 .07 0" ref=".5"/>
        <geom type="box" size=".1 .05 .02" pos=".1 0 0" mass="1"/>
        <body name="hand" pos=".3 0 0"><joint name="c" axis="0 0 1" ref=".4"/><geom size=".03" mass=".5"/></body>
      </body>
      <body name="other" pos="0 -.2 0">
        <joint name="d" axis="0 1 0" ref="-.2"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".02" mass=".4"/>
      </body>
    </body>
  </worldbody>
  <equality>{tied}</equality>
</mujoco>
"""
"""Two arms; one body turns about two hinges; none is drawn at 0."""
CONNECT = '<connect body1="hand" body2="other" anchor=".1 0 0"/>'


@pytest.mark.parametrize(
    "tied",
    [
        CONNECT,
        '<connect body1="other" body2="base" anchor=".4 0 0"/>',
        '<joint joint1="c" joint2="d" polycoef=".1 .5 .2 -.3 .4"/>',
        '<joint joint1="c" polycoef=".1 0 0 0 0"/>',
    ],
)
def test_parts_are_where_the_file_has_them_and_tied_as_there(tmp_path, tied):
    """At any angles: centres of mass, and by how much the constraint is violated."""
    path = tmp_path / "arms.xml"
    path.write_text(ARMS.format(tied=tied))
    theirs, ours = mujoco.MjModel.from_xml_string(path.read_text()), robot_spec_of(path).compile()
    rng, errors = np.random.default_rng(0), []
    for _ in range(5):
        datas = []
        angles = rng.normal(size=4)
        for model in (theirs, ours):
            data = mujoco.MjData(model)
            data.qpos[:7] = [0.3, 0.2, 1.0, 0.5, -0.5, 0.5, 0.5]
            for name, angle in zip("abcd", angles, strict=True):
                data.joint(name).qpos[0] = angle
            mujoco.mj_forward(model, data)
            datas.append(data)
        for body in ("arm", "hand", "other"):
            np.testing.assert_allclose(datas[1].body(body).xipos, datas[0].body(body).xipos, atol=1e-5, err_msg=body)
        count = 3 if tied.startswith("<connect") else 1
        found, wanted = (data.efc_pos[:count] for data in (datas[1], datas[0]))
        np.testing.assert_allclose(found, wanted, atol=1e-5)
        errors.append(np.abs(wanted).max())
    assert max(errors) > 0.1


def test_a_hinge_is_held_where_another_one_of_its_body_turns(tmp_path):
    """The second hinge of the arm at 0.7 rad: the first one turns the body about the same line as before."""
    path = tmp_path / "arms.xml"
    path.write_text(ARMS.format(tied=CONNECT))
    tree = read_mjcf(path)
    tree.home = {"b": 0.7}
    repair(tree, hold=("b",))
    theirs, ours = mujoco.MjModel.from_xml_string(path.read_text()), mujoco.MjModel.from_xml_string(mjcf_of(tree))
    for angle in (0.0, 1.1):
        places = []
        for model in (theirs, ours):
            data = mujoco.MjData(model)
            data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
            for name, value in (("a", angle), ("b", 0.7), ("c", 0.2), ("d", -0.4)):
                if name in {model.joint(i).name for i in range(model.njnt)}:
                    data.joint(name).qpos[0] = value
            mujoco.mj_forward(model, data)
            places.append(np.hstack([data.body("hand").xipos, data.efc_pos[:3]]))
        np.testing.assert_allclose(places[1], places[0], atol=1e-5)


@pytest.mark.parametrize(
    ("tied", "hold", "said"),
    [
        ('<joint joint1="c" joint2="d"/>', ("d",), "constraints of held joints are left out: c and d"),
        (CONNECT, ("a", "b", "c"), None),
        ('<connect body1="hand" body2="arm" anchor="0 0 0"/>', ("c",), "welded to each other are left out: arm"),
    ],
)
def test_what_ties_parts_that_are_held_is_left_out(tmp_path, tied, hold, said):
    path = tmp_path / "arms.xml"
    path.write_text(ARMS.format(tied=tied))
    tree = read_mjcf(path)
    repair(tree, hold=hold)
    model = mujoco.MjModel.from_xml_string(mjcf_of(tree))
    assert model.neq == (said is None)
    assert said is None or any(said in line for line in tree.said)


LEG = """
<body name="{n}_thigh" pos="{x} {y} 0"><joint name="{n}_hip" axis="0 1 0" range="-2 2"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="1"/>
  <body name="{n}_shank" pos="0 0 -0.2"><joint name="{n}_knee" axis="0 1 0" range="-2.5 2.5"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass=".4"/>
    <body name="{n}_foot" pos="0 0 -0.2"><joint name="{n}" axis="0 1 0" stiffness="5" damping=".1"/>
      <geom size="0.03" mass="0.1"/></body>
  </body>
</body>
"""


@pytest.mark.usefixtures("workplace")
def test_hinges_without_a_motor_become_passive_joints(tmp_path, capsys):
    """Feet on springs. Their joints' names are parts of the others' names, so they are renamed."""
    sides = {"fl": (0.2, 0.1), "fr": (0.2, -0.1), "hl": (-0.2, 0.1), "hr": (-0.2, -0.1)}
    legs = "".join(LEG.format(n=n, x=x, y=y) for n, (x, y) in sides.items())
    motors = "".join(f'<motor joint="{n}_{joint}" forcerange="-20 20"/>' for n in sides for joint in ("hip", "knee"))
    (tmp_path / "springs.xml").write_text(
        f'<mujoco><worldbody><body name="trunk"><freejoint/><geom type="box" size="0.25 0.08 0.05" mass="6"/>{legs}</body>'
        f"</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    assert call(add.main, ["springs.xml", "--out", "mine"]) == 0, capsys.readouterr().err
    assert "names contain their names: fl -> fl_passive" in capsys.readouterr().out
    robot = load_robot("mine/springs")
    assert robot.joint_names == tuple(f"{n}_{joint}" for n in sides for joint in ("hip", "knee"))
    assert robot.passive is not None
    assert robot.passive.names == tuple(f"{n}_passive" for n in sides)
    assert robot.passive.model.joint("hr_passive").stiffness[0] == 5.0
