"""What touches what: the ground always, each other only if asked, whatever bits and priorities a robot's file brings."""

import itertools

import mujoco
import numpy as np
import pytest

from legged.config.robot import TerrainConfig
from legged.config.world import SimConfig
from legged.physics.scene import RobotScene
from legged.physics.scene.robot_scene import robot_source
from legged.robots.robot import Robot, load_robot
from legged.terrain import Terrain, TileSpec

LEG = """
<body name="{n}_thigh" pos="{x} {y} 0">
  <joint name="{n}_hip" axis="0 1 0" range="-3 3"/>
  <geom name="{n}_thigh" type="capsule" size="0.03" fromto="0 0 0 0 0 -0.2" mass="1" {bits}/>
  <body name="{n}_shank" pos="0 0 -0.2">
    <joint name="{n}_knee" axis="0 1 0" range="-3 3"/>
    <geom name="{n}_shank" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.5" {bits}/>
    <geom name="{n}_foot" size="0.03" pos="0 0 -0.2" mass="0.1" {bits}/>
  </body>
</body>
"""
LEGS = {"fl": (0.2, 0.1), "fr": (0.2, -0.1), "hl": (-0.2, 0.1), "hr": (-0.2, -0.1)}
YAML = """
model: dog.xml
base: trunk
spawn_height: 0.45
default_joint_angles: {hip: 0.0, knee: 0.0}
stiffness: {hip: 40, knee: 40}
damping: {hip: 1, knee: 1}
velocity_limit: {hip: 20, knee: 20}
feet: [foot]
"""
FILES = {  # contype and conaffinity as people write them
    "MuJoCo's defaults": "",
    "one bit": 'contype="1" conaffinity="0"',
    "the other": 'contype="0" conaffinity="1"',
    "all bits": 'contype="15" conaffinity="15"',
    "a bit of its own": 'contype="8" conaffinity="8"',
    "as the scene": 'contype="1" conaffinity="2" priority="1"',
}


@pytest.fixture
def dog(tmp_path):
    """dog(bits, extra): a robot of eight hinges, whose shapes have those attributes."""

    def dog(bits: str = "", extra: str = "", options: str = "") -> Robot:
        legs = "".join(LEG.format(n=n, x=x, y=y, bits=bits) for n, (x, y) in LEGS.items())
        motors = "".join(f'<motor joint="{n}_{joint}" forcerange="-30 30"/>' for n in LEGS for joint in ("hip", "knee"))
        trunk = f'<geom name="trunk" type="box" size="0.25 0.08 0.05" mass="6" {bits}/>'
        (tmp_path / "dog.xml").write_text(
            f'<mujoco><compiler angle="radian"/>{options}<worldbody><body name="trunk" pos="0 0 0.45"><freejoint/>{trunk}'
            f"{legs}</body></worldbody><actuator>{motors}</actuator>{extra}</mujoco>"
        )
        (tmp_path / "robot.yaml").write_text(YAML)
        return load_robot(str(tmp_path))

    return dog


def touching(model: mujoco.MjModel, height: float, angles: float | list[float]) -> set[frozenset[str]]:
    """Pairs of shapes in contact with the base at that height and all hips and knees at those angles."""
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, height, 1, 0, 0, 0]
    data.qpos[7:] = angles
    mujoco.mj_forward(model, data)
    return {frozenset((model.geom(c.geom1).name, model.geom(c.geom2).name)) for c in data.contact if c.dist < 0}


FOLDED = [1.4, -2.8] * 4
"""Thighs forward, shanks back below them: feet at the hips, in the trunk or near it."""


@pytest.mark.parametrize("bits", FILES.values(), ids=FILES)
def test_a_folded_robot_touches_itself_only_if_asked(dog, bits):
    robot = dog(bits)
    alone = RobotScene(robot).model(SimConfig(self_collisions=False))
    assert touching(alone, 3.0, FOLDED) == set()
    among = RobotScene(robot).model(SimConfig(self_collisions=True))
    found = touching(among, 3.0, FOLDED)
    assert frozenset(("trunk", "fl_foot")) in found
    for pair in found:  # never neighbours: the trunk and a thigh, a thigh and its shank
        assert pair != {"trunk", next(iter(pair - {"trunk"}))} or not next(iter(pair - {"trunk"})).endswith("thigh")
        legs = {name.split("_")[0] for name in pair}
        assert not (len(legs) == 1 and any(name.endswith("thigh") for name in pair))


@pytest.mark.parametrize("self_collisions", [False, True])
@pytest.mark.parametrize("bits", FILES.values(), ids=FILES)
def test_every_shape_meets_every_kind_of_ground(dog, bits, self_collisions):
    own, sim = dog(bits), SimConfig(self_collisions=self_collisions)
    model = RobotScene(own).model(sim)
    # Half a metre below the ground, everything is in it.
    met = touching(model, -0.5, 0.0)
    assert {frozenset((name, "floor")) for name in own.contact_names} <= met
    small = TerrainConfig(terrain_length=2.0, terrain_width=2.0, border_size=2.0)
    terrain = Terrain.of_tiles([[TileSpec("flat", 0.0)]], small, np.random.default_rng(0))
    for ground in ("exact", "height_field"):
        met = touching(RobotScene(own, terrain).model(sim, ground), 0.3, 0.0)
        feet = {next(iter(pair - {name})) for pair in met for name in pair if name.startswith("terrain_")}
        assert {f"{leg}_foot" for leg in LEGS} <= feet


def test_explicit_pairs_and_an_unfiltered_file_change_nothing(dog):
    pairs = "".join(f'<pair geom1="{n}_foot" geom2="trunk"/>' for n in LEGS)
    robot = dog(extra=f"<contact>{pairs}</contact>", options='<option><flag filterparent="disable"/></option>')
    assert touching(RobotScene(robot).model(SimConfig()), 3.0, FOLDED) == set()
    among = touching(RobotScene(robot).model(SimConfig(self_collisions=True)), 3.0, 0.0)
    assert frozenset(("fl_thigh", "fl_shank")) not in among


@pytest.mark.parametrize("bits", ["", 'condim="1"', 'priority="-1"', 'friction="0.01 0.005 0.0001"'])
def test_the_friction_of_the_robot_acts(dog, bits):
    """That is what randomisation sets. The ground has 1; without a priority MuJoCo takes the larger, and slides at 1."""
    model = RobotScene(dog(bits)).model(SimConfig())
    model.geom_friction[[model.geom(name).id for name in shapes_of(model)], 0] = 0.25
    data = mujoco.MjData(model)
    data.qpos[2] = 0.425  # the feet are half a centimetre in the ground, the shanks above it
    mujoco.mj_forward(model, data)
    assert data.ncon == 4
    assert {round(float(contact.friction[0]), 9) for contact in data.contact} == {0.25}
    assert {int(contact.dim) for contact in data.contact} == {3}  # a contact of dimension 1 has no friction


def test_shapes_have_priority_over_the_ground(dog):
    for bits, priority, condim in (("", 1, 3), ('priority="5" condim="4"', 5, 4), ('condim="1"', 1, 3), ('condim="6"', 1, 6)):
        model = RobotScene(dog(bits)).model(SimConfig())
        shapes = [model.geom(name).id for name in shapes_of(model)]
        assert set(model.geom_priority[shapes]) == {priority}
        assert set(model.geom_condim[shapes]) == {condim}
        assert model.geom("floor").priority[0] == 0


def shapes_of(model: mujoco.MjModel) -> list[str]:
    """Names of all geoms but the ground's."""
    return [model.geom(i).name for i in range(model.ngeom) if model.geom(i).name != "floor"]


def test_anymal_c_is_simulated_as_its_file_says(robot):
    """Its bits and priorities are the scene's already, so an engine that reads files gets its file, and C MuJoCo the same."""
    assert robot_source(robot, False) == str(robot.model_path)
    model, file = RobotScene(robot).model(SimConfig()), mujoco.MjModel.from_xml_path(str(robot.model_path))
    for name, field in itertools.product(robot.contact_names, ("contype", "conaffinity", "priority", "condim", "friction")):
        np.testing.assert_array_equal(getattr(model.geom(name), field), getattr(file.geom(name), field))


def test_an_engine_that_reads_files_gets_what_the_scene_says(dog):
    """As a text, with the bits and priorities; meshes are still found."""
    source = robot_source(dog(), False)
    model = mujoco.MjModel.from_xml_string(source)
    assert touching(model, 3.0, FOLDED) == set()
    assert set(model.geom_priority) == {1}
