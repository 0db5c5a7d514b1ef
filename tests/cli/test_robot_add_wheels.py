"""Wheels and soles that `legged robot add` finds: round shapes become cylinders, and all of a foot stands on the ground."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import yaml
from helpers import ENGINE
from importing_fixtures import urdf

from legged.registry import make_task, register_file, task_config
from legged.robots.robot import load_robot

pytestmark = pytest.mark.usefixtures("workplace")
CYLINDER = '<origin rpy="1.5707963 0 0"/><geometry><cylinder radius="0.06" length="0.03"/></geometry>'
MESH = '<geometry><mesh filename="disc.obj"/></geometry>'


def disc(path: Path, radius: float, half: float, corners: int = 24) -> None:
    """A prism about y, as a mesh."""
    angles = np.arange(corners) * 2.0 * np.pi / corners
    points = [(radius * np.cos(a), y, radius * np.sin(a)) for y in (-half, half) for a in angles]
    faces = []
    for i in range(corners):
        j = (i + 1) % corners
        faces += [(i, j, corners + i), (j, corners + j, corners + i)]
        faces += [(0, j, i), (corners, corners + i, corners + j)]
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines))


def on_wheels(shape: str, axis: str = "0 1 0", ending: str = "foot") -> str:
    """The quadruped of the other tests, whose feet are wheels on a hinge."""
    text = urdf()
    for leg in ("fl", "fr", "hl", "hr"):
        fixed = f'<joint name="{leg}_foot_fixed" type="fixed" dont_collapse="true">'
        driven = f'<joint name="{leg}_roll" type="continuous"><axis xyz="{axis}"/><limit effort="5" velocity="25"/>'
        assert fixed in text
        text = text.replace(fixed, driven)
    ball = '<collision><geometry><sphere radius="0.02"/></geometry></collision>'
    return text.replace(ball, f"<collision>{shape}</collision>").replace("_foot", f"_{ending}")


@pytest.mark.parametrize(
    ("what", "shape", "ending", "size"),
    [
        ("cylinder", CYLINDER, "foot", (0.06, 0.015)),
        ("flat_cylinder", CYLINDER.replace("1.5707963", "0"), "wheel", (0.06, 0.015)),
        ("thin_mesh", MESH, "foot", (0.05, 0.02)),
        ("wide_mesh", MESH, "foot", (0.05, 0.0433)),  # its moments of inertia are equal, as those of a ball
        ("two_meshes", f"{MESH}</collision><collision>{MESH}", "foot", (0.05, 0.02)),
        ("octagon", MESH, "foot", (0.05, 0.02)),
    ],
)
def test_round_shapes_on_their_axis_are_wheels(added, tmp_path, what, shape, ending, size):
    disc(tmp_path / "disc.obj", *size, corners=8 if what == "octagon" else 24)
    out = added(on_wheels(shape, ending=ending), "--name", what)
    assert f"{what}: a quadruped on wheels of " in out
    robot = load_robot(f"mine/{what}")
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    assert len(robot.feet_names) == 4
    assert not any(ending in robot.contact_names[i] for i in robot.penalised_indices)
    for shapes in robot.feet_shapes:
        assert len(shapes) == (2 if what == "two_meshes" else 1)
        for name in shapes:
            geom = model.geom(name)
            assert geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER
            np.testing.assert_allclose(geom.size[:2], size, rtol=0.03)
            turned = np.zeros(9)
            mujoco.mju_quat2Mat(turned, geom.quat)
            np.testing.assert_allclose(np.abs(turned.reshape(3, 3)[:, 2]), [0, 1, 0], atol=1e-6)
    wheels = [name for name, rolls in zip(robot.joint_names, robot.wheels, strict=True) if rolls]
    assert wheels == ["fl_roll", "fr_roll", "hl_roll", "hr_roll"]
    # The whole torque at an error of the whole speed: 5 N m and 25 rad/s.
    assert robot.stiffness[robot.wheels] == pytest.approx([0.2] * 4, rel=0.02)
    assert robot.default_dof_pos[robot.wheels].tolist() == [0.0] * 4
    task = yaml.safe_load(Path(f"mine/{what}_flat.yaml").read_text())
    assert task["extends"] == "base/wheeled_flat"
    assert task["control"]["control_type"] == {"hip": "P", "thigh": "P", "calf": "P", "roll": "V"}
    assert task["control"]["action_scale"]["roll"] > 5.0
    if what == "two_meshes":
        assert "8 collision meshes become primitives around them: 8 cylinder" in out


@pytest.mark.slow
def test_a_robot_on_wheels_stands_and_drives(added):
    """Nothing balances its legs: it leans back while it accelerates, so that its base is slower than its wheels roll."""
    added(on_wheels(CYLINDER), "--name", "cart")
    still = [("init_state.base_velocity", [0.0, 0.0]), ("init_state.dof_pos_factor", [1.0, 1.0])]
    calm = [("domain_rand.push_robots", False), ("domain_rand.randomize_base_mass", False), *still]
    task = make_task(task_config(register_file("mine/cart_flat.yaml"), [("env.num_envs", 2), *ENGINE, *calm], on_cpu=True))
    scale = float(task.control.action_scale[3])
    actions = torch.zeros(2, 16)
    for _ in range(75):
        task.step(actions)
    for step in range(100):
        actions[:, 3::4] = step / 100 * 4.0 / scale
        task.step(actions)
    rolled = 0.06 * task.dof_vel[:, 3::4].mean(dim=1)
    assert (rolled > 0.2).all()
    shares = task.base_lin_vel[:, 0] / rolled
    assert ((shares > 0.7) & (shares < 1.1)).all()
    assert (task.base_pos[:, 2] > 0.7 * task.robot.height).all()


@pytest.mark.parametrize("axis", ["1 0 0", "0 0 1"])
def test_what_does_not_roll_is_no_wheel(added, axis):
    """A disc on a hinge across its axis, which no name calls a wheel."""
    out = added(on_wheels(CYLINDER, axis), "--name", f"no_wheel_{axis[0]}{axis[4]}")
    assert "on wheels" not in out


LEG = """<body name="{n}_yaw" pos="0 {y} -.05"><inertial pos="0 0 0" mass=".8" diaginertia=".002 .002 .002"/>
<joint name="{n}_hip_yaw" axis="0 0 1" range="-.8 .8"/><body name="{n}_roll"><inertial pos="0 0 0" mass=".8"
diaginertia=".002 .002 .002"/><joint name="{n}_hip_roll" axis="1 0 0" range="-.5 .5"/><body name="{n}_thigh"><inertial
pos="0 0 -.15" mass="3" diaginertia=".03 .03 .004"/><joint name="{n}_hip_pitch" axis="0 1 0" range="-2 1"/>
<geom type="capsule" size=".04 .1" pos="0 0 -.16"/><body name="{n}_shank" pos="0 0 -.32"><inertial pos="0 0 -.15" mass="2"
diaginertia=".02 .02 .002"/><joint name="{n}_knee" axis="0 1 0" range="0 2.4"/><geom type="capsule" size=".03 .1"
pos="0 0 -.16"/><body name="{n}_last" pos="0 0 -.32"><inertial pos=".02 0 -.03" mass=".7" diaginertia=".001 .002 .002"/>
<joint name="{n}_ankle_pitch" axis="0 1 0" range="-.9 .6"/>{sole}</body></body></body></body></body>"""
SOLES = {
    "corners": [(x, y) for x in (-0.06, 0.1) for y in (-0.03, 0.03)],
    "rails": [(0.02, -0.03), (0.02, 0.03)],
}


@pytest.mark.parametrize("sole", sorted(SOLES))
def test_all_that_stands_of_a_sole_is_the_foot(added, sole):
    """A plate that does not touch the ground, with balls at its corners, or with two rails under it."""
    plate = '<geom type="box" size=".08 .025 .0075" pos=".02 0 -.03"/>'
    under = 'size=".008"' if sole == "corners" else 'type="capsule" size=".008 .08" euler="0 90 0"'
    text = plate + "".join(f'<geom {under} pos="{x} {y} -.052"/>' for x, y in SOLES[sole])
    legs = "".join(LEG.format(n=n, y=y, sole=text) for n, y in (("left", 0.09), ("right", -0.09)))
    out = added(
        f"""<mujoco><worldbody><body name="pelvis" pos="0 0 .8"><freejoint/><geom type="box" size=".08 .1 .15" mass="12"
        pos="0 0 .15"/>{legs}</body></worldbody></mujoco>""",
        *("--name", sole),
        file="toy.xml",
    )
    robot = load_robot(f"mine/{sole}")
    assert [len(shapes) for shapes in robot.feet_shapes] == [len(SOLES[sole])] * 2
    assert not any("last" in robot.contact_names[i] for i in robot.penalised_indices)
    assert any("shank" in robot.contact_names[i] for i in robot.penalised_indices)
    assert "look at the default pose" not in out
    data = mujoco.MjData(model := mujoco.MjModel.from_xml_path(str(robot.model_path)))
    data.qpos[3:] = [1.0, 0.0, 0.0, 0.0, *robot.default_dof_pos]
    mujoco.mj_kinematics(model, data)
    heights = [data.geom(name).xpos[2] for shapes in robot.feet_shapes for name in shapes]
    np.testing.assert_allclose(heights, np.mean(heights), atol=0.003)
    for shapes, y in zip(robot.feet_shapes, (0.09, -0.09), strict=True):  # the middle of the sole is under the hip
        assert np.mean([data.geom(name).xpos for name in shapes], axis=0)[1] == pytest.approx(y, abs=0.01)


def test_shanks_that_end_in_a_ball_are_penalised_still(added):
    added(urdf(), "--name", "on_balls")
    robot = load_robot("mine/on_balls")
    assert {robot.contact_names[i] for i in robot.penalised_indices} >= {"fl_calf", "hr_calf"}


def test_gains_of_the_file_are_kept_where_wheels_have_none(added):
    """Legs have position actuators, wheels torque motors: their gain is the rule's, 15 N m at 30 rad/s."""
    leg = """<body name="{n}_hip" pos="{x} {y} 0"><joint name="{n}_haa" axis="1 0 0" range="-46 46" armature=".02"/>
    <geom size=".03" mass=".5"/><body name="{n}_thigh"><joint name="{n}_hfe" axis="0 1 0" range="-57 143" armature=".02"/>
    <geom type="capsule" size=".02 .08" pos="0 0 -.1" mass=".8"/><body name="{n}_shank" pos="0 0 -.2">
    <joint name="{n}_kfe" axis="0 1 0" range="-143 -29" armature=".02"/><geom type="capsule" size=".015 .07" pos="0 0 -.1"
    mass=".3"/><body name="{n}_tyre" pos="0 0 -.2"><joint name="{n}_spin" axis="0 1 0"/><geom type="cylinder"
    size=".05 .02" euler="90 0 0" mass=".3"/></body></body></body></body>"""
    places = {"lf": (0.2, 0.1), "rf": (0.2, -0.1), "lh": (-0.2, 0.1), "rh": (-0.2, -0.1)}
    legs = "".join(leg.format(n=n, x=x, y=y) for n, (x, y) in places.items())
    servos = "".join(
        f'<position joint="{n}_{j}" kp="{kp}" kv="0.6" forcerange="-25 25"/>'
        for n in places
        for j, kp in (("haa", 25), ("hfe", 30), ("kfe", 35))
    )
    motors = "".join(f'<motor joint="{n}_spin" ctrlrange="-15 15"/>' for n in places)
    out = added(
        f"""<mujoco><worldbody><body name="trunk" pos="0 0 .4"><freejoint/><geom type="box" size=".2 .1 .05" mass="6"/>
        {legs}</body></worldbody><actuator>{servos}{motors}</actuator></mujoco>""",
        *("--name", "mixed"),
        file="toy.xml",
    )
    assert "gains are those of the file's position actuators" in out
    assert "guess: a rule chooses the gains of joints without a position actuator: lf_spin, rf_spin" in out
    robot = load_robot("mine/mixed")
    assert robot.stiffness[:4] == pytest.approx([25.0, 30.0, 35.0, 0.5], rel=0.02)
    assert robot.damping[:4] == pytest.approx([0.6, 0.6, 0.6, 0.0])
