"""What the command that brings a robot guesses of legs, and of a pose to stand in."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from helpers import call
from importing_fixtures import URDF_LEG, urdf

from legged.cli.robot import add
from legged.robots.robot import load_robot

pytestmark = pytest.mark.usefixtures("workplace")


def test_the_stance_is_that_of_a_two_link_leg(added):
    """Thigh and shank of 0.2 m. The knee keeps 5 % of its range from -0.5 rad away: stretched, it is at -0.61 rad, and the
    foot 0.4 cos(0.305) = 0.3815 m from the hip; a stance has 0.8 of that, 0.305 m: the knee at -2 acos(0.763) = -1.405 rad,
    and the thigh at half of that the other way.
    """
    added(urdf(), "--name", "second_toy")
    robot = load_robot("mine/second_toy")
    angles = dict(zip(robot.joint_names, robot.default_dof_pos, strict=True))
    assert angles["fl_calf"] == pytest.approx(-1.405, abs=0.03)
    assert angles["fl_thigh"] == pytest.approx(0.703, abs=0.03)
    assert robot.height == pytest.approx(0.305 + 0.02, abs=0.004)
    assert robot.file.spawn_height == pytest.approx(1.03 * robot.height, abs=1e-3)
    for joint in ("hip", "thigh", "calf"):
        for front in "fh":
            sign = -1.0 if joint == "hip" else 1.0
            assert angles[f"{front}l_{joint}"] == pytest.approx(sign * angles[f"{front}r_{joint}"], abs=1e-9)
    limits = robot.dof_pos_limits
    assert ((limits[:, 0] < robot.default_dof_pos) & (robot.default_dof_pos < limits[:, 1])).all()
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    data = mujoco.MjData(model)
    data.qpos[7:] = robot.default_dof_pos
    mujoco.mj_kinematics(model, data)
    for leg, x, y in (("fl", 0.2, 0.15), ("hr", -0.2, -0.15)):
        np.testing.assert_allclose(data.geom(f"{leg}_foot").xpos[:2], [x, y], atol=0.005)


@pytest.mark.slow
def test_a_robot_that_can_not_stand_on_what_looks_like_its_feet_is_refused(tmp_path, capsys):
    """Thighs that only point backwards, at least 1.3 rad from down, and knees that hardly bend."""
    arms = (
        urdf()
        .replace('lower="-1.5" upper="3"', 'lower="1.3" upper="1.6"')
        .replace('lower="-2.7" upper', 'lower="-0.6" upper')
    )
    (tmp_path / "toy.urdf").write_text(arms)
    assert call(add.main, ["toy.urdf", "--out", "mine"]) == 2
    error = capsys.readouterr().err
    assert "toy.urdf: the robot can't stand on " in error
    assert error.count("\n") == 1
    assert not Path("mine").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hind", "called"), [(("hl", "hr"), "robot with 3 legs"), (("hl", "hr", "ml", "mr"), "robot with 5 legs")]
)
def test_any_number_of_legs_stands_as_four_do(added, hind, called):
    """One leg in front, in the middle; the stance is that of the test above, 0.8 of a stretched leg of 0.3815 m."""
    places = {"f": (0.3, 0.0), "hl": (-0.2, 0.1), "hr": (-0.2, -0.1), "ml": (0.05, 0.1), "mr": (0.05, -0.1)}
    legs = "".join(URDF_LEG.format(n=n, x=x, y=y, side=0.5 * y) for n, (x, y) in places.items() if n in ("f", *hind))
    name = f"toy_of_{1 + len(hind)}_legs"
    out = added(urdf(legs=legs), "--name", name)
    assert f"{name}: a {called} of " in out
    assert f"guess: a {called} with feet: f_foot, " in out
    robot = load_robot(f"mine/{name}")
    angles = dict(zip(robot.joint_names, robot.default_dof_pos, strict=True))
    assert robot.height == pytest.approx(0.305 + 0.02, abs=0.004)
    for leg in ("f", *hind):
        assert angles[f"{leg}_calf"] == pytest.approx(-1.405, abs=0.03)
        assert angles[f"{leg}_thigh"] == pytest.approx(0.703, abs=0.03)
    assert yaml.safe_load(Path(f"mine/{name}_flat.yaml").read_text())["extends"] == "base/quadruped_flat"


@pytest.mark.slow
@pytest.mark.parametrize(("low", "high", "left", "right"), [(-1.3, -0.5, -1.26, -1.26), (0.5, 2.7, -1.405, 1.405)])
def test_legs_of_a_pair_keep_the_limits_of_both(added, low, high, left, right):
    """The right knee bends less than the left one, which wants -1.405 rad, or the other way; 0.05 of a range is kept free."""
    knee = URDF_LEG.format(n="fr", x=0.2, y=-0.1, side=-0.05)
    changed = knee.replace('lower="-2.7" upper="-0.5"', f'lower="{low}" upper="{high}"')
    name = f"toy_whose_knee_bends_to_{high:g}".replace(".", "_").replace("-", "minus_")
    added(urdf().replace(knee, changed), "--name", name)
    robot = load_robot(f"mine/{name}")
    angles = dict(zip(robot.joint_names, robot.default_dof_pos, strict=True))
    assert (angles["fl_calf"], angles["fr_calf"]) == (pytest.approx(left, abs=0.03), pytest.approx(right, abs=0.03))
    limits = robot.dof_pos_limits
    assert ((limits[:, 0] < robot.default_dof_pos) & (robot.default_dof_pos < limits[:, 1])).all()


SPIDER = """<mujoco><worldbody><body name="core"><freejoint/><geom type="cylinder" size="0.2 0.04" mass="4"/>
<replicate count="{count}" euler="0 0 {turn}"><body name="coxa" pos="0.2 0 0"><joint name="coxa" axis="0 0 1" range="-40 40"/>
<geom size="0.02" mass="0.1"/><body name="femur" pos="0.05 0 0"><joint name="femur" axis="0 1 0" range="-80 80"/>
<geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.1"/><body name="tibia" pos="0.1 0 0">
<joint name="tibia" axis="0 1 0" range="-20 140"/><geom type="capsule" fromto="0 0 0 0.13 0 0" size="0.008" mass="0.05"/>
<geom name="foot" size="0.01" pos="0.15 0 0" mass="0.01"/></body></body></body></replicate></body></worldbody></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("legs", ["spider of 3", "spider of 6", "short behind"])
def test_all_feet_stand_on_the_same_ground(added, legs):
    """Legs drawn stretched to all sides, and hind shanks of 0.15 m: the base is level, as high as the shortest leg allows.
    The foremost leg of a spider, of 0.1 and 0.15 m, has its hip at the femur and stands 0.8 of 0.25 m below it.
    """
    name = legs.replace(" ", "_")
    if legs == "short behind":
        rear = [URDF_LEG.format(n=n, x=-0.2, y=y, side=y / 2) for n, y in (("hl", 0.1), ("hr", -0.1))]
        text = urdf()
        for leg in rear:
            assert leg in text
            text = text.replace(leg, leg.replace('<origin xyz="0 0 -0.2"/></joint>', '<origin xyz="0 0 -0.15"/></joint>'))
        out = added(text, "--name", name)
    else:
        count = int(legs[-1])
        out = added(SPIDER.format(count=count, turn=360 / count), "--name", name, file="toy.xml")
    assert "look at the default pose" not in out
    robot = load_robot(f"mine/{name}")
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    data = mujoco.MjData(model)
    data.qpos[3:] = [1.0, 0.0, 0.0, 0.0, *robot.default_dof_pos]
    mujoco.mj_kinematics(model, data)
    depths = [data.geom(foot).xpos[2] - data.xpos[1, 2] for foot in robot.feet_names]
    np.testing.assert_allclose(depths, np.mean(depths), atol=0.004)
    if legs != "short behind":
        assert np.mean(depths) == pytest.approx(-0.2, abs=0.004)
