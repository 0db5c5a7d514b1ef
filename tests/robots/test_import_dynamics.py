"""Dynamics of MJCF files that the model of a robot has not: each has a line, or the file is refused."""

import pytest

from legged.errors import ConfigError
from legged.robots.importing.mjcf import read_mjcf

ROBOT = """<mujoco>{head}<worldbody><body name="trunk"><freejoint/><geom size=".1" mass="5"/>
<body name="a" pos=".1 0 0"><joint name="a" axis="0 1 0" range="-90 90" {joint}/><geom size=".05" mass="1" pos="0 0 -.2"/>
</body><body name="b" pos="-.1 0 0" {body}><joint name="b" axis="0 1 0" range="-90 90"/><geom size=".05" mass="1"
pos="0 0 -.2"/></body></body></worldbody>{tendon}<actuator>{actuator}</actuator></mujoco>"""
MOTORS = '<motor joint="a" ctrlrange="-20 20"/><motor joint="b" ctrlrange="-20 20"/>'
TENDON = '<tendon><fixed name="band" {}><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>'
SERVO = (
    '<general name="s" joint="a" biastype="affine" gainprm="9" biasprm="0 -9 -1" {}/><motor joint="b" ctrlrange="-20 20"/>'
)


def read(tmp_path, head="", joint="", body="", tendon="", actuator=MOTORS):
    path = tmp_path / "toy.xml"
    path.write_text(ROBOT.format(head=head, joint=joint, body=body, tendon=tendon, actuator=actuator))
    return read_mjcf(path)


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        ({"tendon": TENDON.format('stiffness="0.1"')}, "tendons are left out: band (stiffness)"),
        ({"tendon": TENDON.format('damping="1" range="-1 1"')}, "tendons are left out: band (damping, limited)"),
        ({"body": 'gravcomp="0.01"'}, "gravity compensation is left out: b"),
        ({"joint": 'stiffness="1 .2"'}, "nonlinear springs of joints become linear: a"),
        ({"head": '<option density="1.2"/>'}, "drag of air and water is left out: density"),
        ({"actuator": SERVO.format('dyntype="filterexact" dynprm=".04"')}, "stand in for them: s (filterexact, 0.04 s)"),
        ({"actuator": SERVO.format('forcerange="-10 30"')}, "become the smaller one: s (-10 to 30 N m)"),
        ({"joint": 'actuatorfrcrange="-5 8"'}, "become the smaller one: a (-5 to 8 N m)"),
        (
            {"actuator": SERVO.replace('gainprm="9"', 'gaintype="affine" gainprm="9 1"').format("")},
            "control law: s (gain affine, bias affine)",
        ),
    ],
)
def test_what_is_left_out_has_a_line(tmp_path, parts, says):
    assert any(says in line for line in read(tmp_path, **parts).said)


def test_what_is_kept_has_none(tmp_path):
    said = read(tmp_path, joint='stiffness="3" springref="20" damping="1" armature=".1" frictionloss=".2"').said
    assert not [line for line in said if "left out" in line or "become" in line]


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        # At 90 degrees each, a band of 15 N/rad pulls with 15 pi N m on both joints.
        ({"tendon": TENDON.format('stiffness="15"')}, r"'a' would lack up to .* of 20 N m.*tendons are left out: band"),
        ({"joint": 'stiffness="1 30"'}, r"joint 'a' would lack up to .* of 20 N m"),
        ({"body": 'gravcomp="1"'}, r"(the base|joint 'b') would lack up to"),
        (
            {"actuator": '<muscle name="m" joint="a" ctrlrange="0 1" lengthrange="0 1"/><motor joint="b"/>'},
            "actuator 'm' is a muscle",
        ),
    ],
)
def test_a_robot_that_would_be_another_one_is_refused(tmp_path, parts, says):
    with pytest.raises(ConfigError, match=says):
        read(tmp_path, **parts)
