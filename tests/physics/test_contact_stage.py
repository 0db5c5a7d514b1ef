"""Contacts and rows of constraints in one launch: those of C MuJoCo, shape by shape, and rows as mujoco-warp makes them."""

import re

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp
from devices import ON_A_GPU, build, on_gpu
from reference import heaps, random_states, roll

from legged.config.robot import TerrainConfig
from legged.physics import ModelScene, RobotScene
from legged.physics.collider.contact_pairs import contact_pair, spring_of
from legged.physics.fused.contact_stage import ContactStage
from legged.terrain import Terrain, TileSpec

ALOFT = '<geom name="plane" type="plane" size="0 0 1" pos=".1 -.2 .3" quat=".9 .2 -.3 .1" condim="1"/>'
SHAPES = {
    "sphere": 'type="sphere" size=".1"',
    "capsule": 'type="capsule" size=".05 .2"',
    "box": 'type="box" size=".2 .15 .1"',
    "cylinder": 'type="cylinder" size=".2 .15"',
    "ellipsoid": 'type="ellipsoid" size=".2 .15 .1"',
}
DEEPEST = 0.04
"""Less than any shape is thick: deeper, mujoco-warp has contacts at corners of a box where C MuJoCo has none [m]."""


def on_tilted_plane(shape: str) -> mujoco.MjModel:
    """Return a model of one free shape on a plane aslant, in which contacts are solved to their end."""
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep=".004" tolerance="1e-10" iterations="50" ls_iterations="50" impratio="3"/>'
        f'<worldbody>{ALOFT}<body><freejoint/><geom {SHAPES[shape]} mass="2" friction=".6 .02 .01" condim="3"/></body>'
        "</worldbody></mujoco>"
    )


def near_the_plane(model: mujoco.MjModel, count: int, seed: int) -> np.ndarray:
    """Return positions (count, 7) of the free shape at which its lowest point is from DEEPEST below the plane to as much
    above it, in any orientation; by C MuJoCo's distance to the plane.
    """
    rng, data, poses = np.random.default_rng(seed), mujoco.MjData(model), []
    normal = np.zeros(9)
    mujoco.mju_quat2Mat(normal, model.geom_quat[0])
    up = normal[2::3]
    for _ in range(count):
        quat = rng.normal(size=4)
        data.qpos[:3], data.qpos[3:] = rng.uniform(-1.0, 1.0, 3), quat / np.linalg.norm(quat)
        data.qpos[:3] += up * (2.0 - up @ (data.qpos[:3] - model.geom_pos[0]))
        mujoco.mj_kinematics(model, data)
        distance = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)
        data.qpos[:3] -= up * (distance + rng.uniform(-DEEPEST, DEEPEST))
        poses.append(np.float32(data.qpos))
    return np.float64(poses)


class Stage:
    """Worlds of mujoco-warp whose contacts and rows are made by the one launch, or by mujoco-warp's own."""

    def __init__(
        self, model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, own: bool = True, device: str = "cpu"
    ) -> None:
        """Put the worlds into states and make their rows."""
        self.count = len(qpos)
        with wp.ScopedDevice(device):
            self.m = m = mjw.put_model(model)
            self.d = d = mjw.make_data(model, nworld=self.count, nconmax=24, njmax=80)
            d.qpos.assign(np.float32(qpos))
            d.qvel.assign(np.float32(qvel))
            for stage in (mjw.kinematics, mjw.com_pos, mjw.com_vel):
                stage(m, d)
            if own:
                assert ContactStage.why_not(model, m, d) == ""
                ContactStage(model, m, d).launch()
            else:
                mjw.collision(m, d)
                mjw.make_constraint(m, d)

    def contacts(self, world: int) -> list[dict[str, np.ndarray]]:
        """Return what there is of each contact of a world."""
        contact, slots = self.d.contact, len(self.d.contact.dist) // self.count
        names = ("dist", "pos", "frame", "friction", "dim", "geom", "includemargin", "worldid")
        rows = contact.efc_address.numpy()[world * slots : (world + 1) * slots, 0] >= 0
        of_world = slice(world * slots, (world + 1) * slots)
        found = {name: getattr(contact, name).numpy()[of_world][rows] for name in names}
        assert (found.pop("worldid") == world).all()
        return [{name: found[name][k] for name in found} for k in range(rows.sum())]

    def rows(self, world: int) -> np.ndarray:
        """Return (rows, nv + 3): the Jacobian, reference, stiffness and dry friction of each row, in their order."""
        d, count = self.d, int(self.d.nefc.numpy()[world])
        columns = [d.efc.J.numpy()[world, :count, : self.m.nv]]
        columns += [getattr(d.efc, name).numpy()[world, :count, None] for name in ("aref", "D", "frictionloss")]
        return np.concatenate(columns, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("device", ["cpu", on_gpu("cuda:0")])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_shape_meets_a_plane_as_in_c_mujoco(shape, device):
    """Places, distances and axes of every contact of 200 poses, in C MuJoCo's order."""
    model = on_tilted_plane(shape)
    qpos = near_the_plane(model, 200, seed=1)
    stage = Stage(model, qpos, np.zeros((200, 6)), device=device)
    data, touching = mujoco.MjData(model), 0
    for world, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        found = stage.contacts(world)
        assert len(found) == len(data.contact), world
        touching += len(found) > 0
        for mine, c in zip(found, data.contact, strict=True):
            assert mine["geom"].tolist() == c.geom.tolist() == [0, 1]
            assert mine["dim"] == c.dim
            np.testing.assert_allclose(mine["dist"], c.dist, atol=1e-6)
            np.testing.assert_allclose(mine["pos"], c.pos, atol=2e-6)
            np.testing.assert_allclose(mine["frame"], c.frame.reshape(3, 3), atol=2e-4 if shape == "capsule" else 2e-6)
            np.testing.assert_allclose(mine["friction"], c.friction, rtol=1e-6)
    assert 70 < touching < 130


def test_an_upright_cylinder_stands_on_three_points():
    """Worked by hand: radius 0.2, half length 0.15, 1 cm deep; one point along its own x axis, two at 120 degrees from it."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="plane" size="0 0 1"/><body><freejoint/><geom type="cylinder" size=".2 .15"/></body>'
        "</worldbody></mujoco>"
    )
    half = np.sqrt(0.5)
    found = Stage(model, np.array([[1.0, 2.0, 0.14, half, 0.0, 0.0, half]]), np.zeros((1, 6))).contacts(0)
    assert [float(c["dist"]) for c in found] == pytest.approx([-0.01] * 3, abs=1e-6)
    side = 0.1 * np.sqrt(3.0)
    places = sorted(tuple(np.round(c["pos"] - [1.0, 2.0, -0.005], 5)) for c in found)
    np.testing.assert_allclose(places, [(-side, -0.1, 0.0), (0.0, 0.2, 0.0), (side, -0.1, 0.0)], atol=1e-5)


def test_round_shapes_meet_each_other_as_in_c_mujoco():
    """Spheres and capsules of two bodies, side by side, crossed, end to end and parallel; parents and children do not."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><freejoint/><geom type="capsule" size=".05 .2"/><geom size=".1" pos="0 0 .3"/>'
        '<body pos="0 0 .3"><joint axis="1 0 0"/><geom type="capsule" fromto="0 0 0 0 0 .2" size=".04"/></body></body>'
        '<body><freejoint/><geom type="capsule" size=".06 .15" margin=".02"/><geom size=".08" pos="0 .2 0"/></body>'
        "</worldbody></mujoco>"
    )
    rng, count = np.random.default_rng(2), 300
    qpos = np.tile(model.qpos0, (count, 1))
    qpos[:, :3] = rng.uniform(-0.2, 0.2, (count, 3))
    qpos[:, 7] = rng.uniform(-2.0, 2.0, count)
    quat = rng.normal(size=(2, count, 4))
    quat[1, ::10] = quat[0, ::10]  # parallel axes
    qpos[:, 3:7], qpos[:, 11:] = quat[0], quat[1]
    qpos = np.float64(np.float32(qpos))
    stage, data = Stage(model, qpos, np.zeros((count, model.nv))), mujoco.MjData(model)
    pairs: set[tuple[int, int]] = set()
    most = 0
    for world, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        theirs = [c for c in data.contact if c.dist < c.includemargin]
        found = stage.contacts(world)
        if any(abs(c.dist - c.includemargin) < 1e-5 for c in data.contact):
            continue
        assert len(found) == len(theirs), world
        for c in theirs:
            pairs.add(tuple(c.geom.tolist()))
            near = [k for k in found if k["geom"].tolist() == c.geom.tolist() and abs(k["dist"] - c.dist) < 2e-6]
            assert min(np.abs(k["pos"] - c.pos).max() + np.abs(k["frame"][0] - c.frame[:3]).max() for k in near) < 1e-4
        most = max(most, sum(c.geom.tolist() == [0, 3] for c in theirs))
    assert len(pairs) >= 6
    assert most == 2  # parallel capsules touch in two places


EVERYTHING = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.004" cone="{cone}" impratio="5"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction=".9 .03 .002" conaffinity="3"/>
    <body name="box" pos="0 0 .099">
      <freejoint/><geom type="box" size=".1 .1 .1" mass="3" friction=".7" margin=".01"
        solref=".03 1.2" solimp=".8 .97 .01 .4 3" contype="2" conaffinity="0"/>
      <body name="arm" pos=".1 0 .1">
        <joint name="dry" type="hinge" axis="0 1 0" frictionloss="0.8" solreffriction=".05 1" solimpfriction=".7 .9 .01"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".4" condim="{dim}" friction=".5 .02 .004"/>
        <body name="hand" pos=".3 0 0">
          <joint name="limited" type="hinge" axis="0 0 1" limited="true" range="-0.2 0.2" margin=".02"
            solreflimit="-900 -30"/>
          <geom type="sphere" size=".05" mass=".2" priority="2" condim="{dim}" friction=".4 .01 .003"/>
          <body name="ball" pos=".1 0 0">
            <joint name="ball" type="ball" range="0 .2" limited="true"/>
              <geom type="capsule" fromto="0 0 0 .1 0 0" size=".03" condim="1" mass=".1"/>
          </body>
        </body>
      </body>
    </body>
    <body name="left" pos="1 0 1"><joint name="left" type="slide" axis="0 0 1" limited="true" range="-.1 .05"/>
      <geom name="left" size=".05" mass="1"/></body>
    <body name="right" pos="1.08 0 1"><joint name="right" type="slide" axis="0 .1 1" frictionloss="2"/>
      <geom name="right" size=".05" mass="2"/></body>
  </worldbody>
  <contact><pair geom1="left" geom2="right" condim="4" friction=".3 .2 .01 .002 .003" solref=".05 .9"/></contact>
  <equality>
    <joint joint1="left" joint2="right" polycoef="0 -1 0 0 0"/><connect body1="hand" body2="world" anchor=".1 0 0"/>
  </equality>
</mujoco>
"""
"""Rows of every kind, and contacts whose parameters come from either shape, from both, and from an explicit pair."""


def states_of_everything(model: mujoco.MjModel, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities of worlds in which all of the joints of EVERYTHING are moved, near the floor; no
    capsule stands, for mujoco-warp would have other tangents there.
    """
    rng = np.random.default_rng(3)
    qpos = np.tile(model.qpos0, (count, 1))
    qpos[:, 2] += rng.uniform(-0.02, 0.02, count)
    for first in (3, 9):
        qpos[:, first : first + 4] += 0.1 * rng.normal(size=(count, 4))
        qpos[:, first : first + 4] /= np.linalg.norm(qpos[:, first : first + 4], axis=1, keepdims=True)
    qpos[:, 7:9] = rng.uniform([-0.2, -0.4], [0.4, 0.4], (count, 2))
    qpos[:, -2:] = rng.uniform(-0.15, 0.15, (count, 2))
    return qpos, rng.normal(size=(count, model.nv))


@pytest.mark.slow
@pytest.mark.parametrize(("cone", "dim"), [("pyramidal", 6), ("elliptic", 6)])
def test_rows_of_every_kind_are_those_of_mujoco_warp(cone, dim):
    """Each row of 60 worlds has its like among mujoco-warp's, and each of those has its like here; equalities come first,
    then dry friction, limits and contacts.
    """
    model = mujoco.MjModel.from_xml_string(EVERYTHING.format(cone=cone, dim=dim))
    qpos, qvel = states_of_everything(model, 60)
    ours, theirs = Stage(model, qpos, qvel), Stage(model, qpos, qvel, own=False)
    for name in ("ne", "nf", "nl", "nefc"):
        np.testing.assert_array_equal(getattr(ours.d, name).numpy(), getattr(theirs.d, name).numpy(), err_msg=name)
    counts = {name: getattr(ours.d, name).numpy() for name in ("ne", "nf", "nl", "nefc")}
    assert (counts["ne"] == 4).all()
    assert (counts["nf"] == 2).all()
    assert counts["nl"].min() == 0
    assert counts["nl"].max() == 3
    assert len(set((counts["nefc"] - counts["ne"] - counts["nf"] - counts["nl"]).tolist())) > 6
    for world in range(60):
        mine, wanted = ours.rows(world), theirs.rows(world)
        start, first_limit = counts["ne"][world], counts["ne"][world] + counts["nf"][world]
        first_contact = first_limit + counts["nl"][world]
        for begin, end in ((0, start), (start, first_limit), (first_limit, first_contact), (first_contact, len(mine))):
            one, other = mine[begin:end], wanted[begin:end]
            scale = np.maximum(1.0, np.abs(wanted).max(axis=0))
            apart = np.abs((one[:, None] - other[None]) / scale).max(axis=2)
            if len(one):
                assert apart.min(axis=0).max() < 2e-5, world
                assert apart.min(axis=1).max() < 2e-5, world


def test_a_contact_is_known_by_its_rows_and_they_by_it():
    """As mujoco-warp's own functions ask: elliptic rows name their contact, contacts name their rows."""
    model = mujoco.MjModel.from_xml_string(EVERYTHING.format(cone="elliptic", dim=6))
    stage = Stage(model, *states_of_everything(model, 20))
    contact, slots = stage.d.contact, 24
    addresses, dims = contact.efc_address.numpy(), contact.dim.numpy()
    ids, nefc = stage.d.efc.id.numpy(), stage.d.nefc.numpy()
    before = sum(getattr(stage.d, name).numpy() for name in ("ne", "nf", "nl"))
    named = 0
    for world in range(20):
        rows = []
        for slot in range(world * slots, (world + 1) * slots):
            if addresses[slot, 0] >= 0:
                of_contact = addresses[slot, : dims[slot]].tolist()
                assert [ids[world, row] for row in of_contact] == [slot] * len(of_contact)
                rows += of_contact
        assert rows == list(range(before[world], nefc[world]))
        named += len(rows)
    assert named > 100


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_a_shape_is_pushed_as_in_c_mujoco(shape):
    """Its acceleration, with the rows of the one launch in mujoco-warp's own solver."""
    model = on_tilted_plane(shape)
    qpos = near_the_plane(model, 40, seed=4)
    qvel = 0.3 * np.random.default_rng(5).normal(size=(40, 6))
    stage = Stage(model, qpos, qvel)
    with wp.ScopedDevice("cpu"):
        m, d = stage.m, stage.d
        mjw.crb(m, d)
        mjw.factor_m(m, d)
        for part in (mjw.fwd_velocity, mjw.fwd_actuation, mjw.fwd_acceleration, mjw.solve):
            part(m, d)
    found, data = d.qacc.numpy(), mujoco.MjData(model)
    pushed = 0
    for world in range(40):
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos[world], qvel[world], 0.0
        mujoco.mj_forward(model, data)
        scale = max(1.0, np.abs(data.qacc).max())
        np.testing.assert_allclose(found[world] / scale, data.qacc / scale, atol=2e-3, err_msg=str(world))
        pushed += data.ncon > 0
    assert pushed > 10


@pytest.mark.parametrize(
    ("geoms", "reason"),
    [
        ('<geom name="a" type="box" size=".1 .1 .1"/>', r"shapes 'b' \(a sphere\) and 'a' \(a box\) may touch"),
        ('<geom name="a" type="capsule" size=".1 .1" surfacevel="0 0 0 1 0 0"/>', "surface velocities or adhesion"),
    ],
)
def test_what_it_does_not_make_is_said(geoms, reason):
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body><freejoint/>{geoms}</body><body pos="0 0 1"><freejoint/><geom name="b" size=".1"/></body>'
        "</worldbody></mujoco>"
    )
    with wp.ScopedDevice("cpu"):
        assert re.search(reason, ContactStage.why_not(model, mjw.put_model(model), mjw.make_data(model, njmax=20)))


@pytest.mark.parametrize("priority", [0, 1, 2])
@pytest.mark.parametrize("solrefs", [(".05 1", "-1000 -50"), ("-1000 -50", ".02 1"), (".05 1", ".01 .5")])
def test_springs_of_two_shapes_are_mixed_as_in_c_mujoco(priority, solrefs):
    """Of equal priority, and where one of them counts alone; a solref may be a time constant or a stiffness."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="0 0 1" solref="{solrefs[1]}" solimp=".5 .6 .01" priority="1"/>'
        f'<body pos="0 0 .09"><freejoint/><geom size=".1" solref="{solrefs[0]}" priority="{priority}"/></body>'
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    touch = contact_pair(model, 0, 1)
    np.testing.assert_allclose(touch.solref, data.contact[0].solref, rtol=1e-12)
    np.testing.assert_allclose(touch.solimp, data.contact[0].solimp, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("solref", ["0.1 0", "0.02 -50", "-1000 1"])
def test_a_solref_of_two_kinds_at_once_is_that_of_c_mujoco(solref, tmp_path):
    """C MuJoCo takes the default for it, of contacts, limits and equalities; a stiffness of 1e15 threw the ball away."""
    file = tmp_path / "ball.xml"
    file.write_text(
        f'<mujoco><worldbody><geom type="plane" size="0 0 1" solref="{solref}"/>'
        f'<body pos="0 0 .095"><freejoint/><geom size=".1" mass="1" solref="{solref}"/><body pos="0 0 .1">'
        f'<joint name="a" axis="0 1 0" limited="true" range="-1 -.1" solreflimit="{solref}"/><geom size=".05" pos=".3 0 .1"/>'
        f'</body><body pos="0 0 .2"><joint name="b" axis="1 0 0"/><geom size=".05" pos="0 0 .1"/></body></body></worldbody>'
        f'<equality><joint joint1="b" polycoef=".05 0 0 0 0" solref="{solref}"/></equality></mujoco>'
    )
    found = []
    for engine in ("mujoco", "mujoco_warp"):
        physics = build(ModelScene(file), engine, 1)
        for _ in range(20):
            physics.step()
        found.append(physics.qpos.clone())
    torch.testing.assert_close(found[1], found[0], atol=1e-4, rtol=0.0)


def test_impedance_and_spring_are_worked_by_hand():
    """timeconst 0.02, dampratio 1, dmax 0.95: k = 1 / (0.95 * 0.02)^2 = 2770.08, b = 2 / (0.95 * 0.02) = 105.263; a time
    constant below two steps of 15 ms counts as 30 ms: k = 1231.15.
    """
    solref, solimp = np.array([0.02, 1.0]), np.array([0.9, 0.95, 0.001, 0.5, 2.0])
    np.testing.assert_allclose(
        spring_of(solref, solimp, 0.005, True), [2770.083, 105.2632, 0.9, 0.95, 0.001, 0.5, 2.0], rtol=1e-6
    )
    assert spring_of(solref, solimp, 0.015, True)[0] == pytest.approx(1231.148, rel=1e-6)
    assert spring_of(solref, solimp, 0.015, False)[0] == pytest.approx(2770.083, rel=1e-6)
    np.testing.assert_allclose(spring_of(np.array([-900.0, -30.0]), solimp, 0.005, True)[:2], [997.2299, 31.57895], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("where", [pytest.param("", id="cpu"), on_gpu(ON_A_GPU, id="cuda")])
@pytest.mark.parametrize(("start", "self_collisions"), [(random_states, False), (heaps, False), (heaps, True)])
def test_robots_move_as_by_mujoco_warps_own_launches(robot, make_physics, start, self_collisions, where):
    """Ten steps on the plane, through contacts of feet, legs and trunks, also with each other; forces are read alike."""
    states, found = start(robot, 6, seed=4), []
    for step in ("library", "fused"):
        physics = make_physics("mujoco_warp" + where, step=step, self_collisions=self_collisions)
        states.write(physics)
        roll(physics, states.dof_pos, 10)
        found.append({name: getattr(physics.robot_state, name).clone() for name in ("base_pos", "base_quat", "dof_pos")})
        found[-1]["forces"] = physics.robot_state.contact_forces / 1e3
    for name in found[0]:
        torch.testing.assert_close(found[1][name], found[0][name], atol=2e-5, rtol=1e-4, msg=name)
    assert found[0]["forces"].abs().max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("where", [pytest.param("", id="cpu"), on_gpu(ON_A_GPU, id="cuda")])
def test_robots_on_stairs_move_as_by_mujoco_warps_own_launches(robot, where):
    """Fifty steps with our collider behind mujoco-warp's own, and inside our launch; the first take its solver 11 rounds."""
    cfg = TerrainConfig(mesh_type="height_map", border_size=4.0)
    ground = Terrain.of_tiles([[TileSpec("stairs_up", 0.15)]], cfg, np.random.default_rng(5))
    states, found = random_states(robot, 6, seed=4), []
    states.base_pos[:, :2] = torch.tensor(ground.origins[0, 0, :2] + [1.5, 0.0], dtype=torch.float32)
    states.base_pos[:, 1] += torch.linspace(-0.5, 0.5, 6)
    states.base_pos[:, 2] += float(ground.origins[0, 0, 2])
    for step in ("library", "fused"):
        physics = build(RobotScene(robot, ground), "mujoco_warp" + where, 6, step=step, njmax=128, nconmax=32, iterations=50)
        states.write(physics)
        force = torch.zeros(6)
        for _ in range(5):
            roll(physics, states.dof_pos, 10)
            force = torch.maximum(force, physics.robot_state.contact_forces.norm(dim=2).sum(dim=1))
        assert (force > 50.0).all()
        found.append(physics.robot_state)
    for name in ("base_pos", "base_quat", "dof_pos"):
        torch.testing.assert_close(getattr(found[1], name), getattr(found[0], name), atol=1e-4, rtol=0.0, msg=name)
