"""Our collider against C MuJoCo: the same shapes at the same places, on planes, slopes, steps and edges.

Penetrations agree within 1 mm, normals within 1 degree, resting heights within 2 mm; forces sum to the weight.
"""

from dataclasses import dataclass

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp
from reference import tiles

from legged.errors import ConfigError
from legged.physics.collider.terrain_contact import TerrainContact
from legged.physics.scene.terrain_geoms import add_terrain
from legged.terrain import HeightMap

STEP = 0.2
SHAPES = {
    "foot": '<geom name="a" type="sphere" size="0.03" {c}/>',
    "ball": '<geom name="a" type="sphere" size="0.12" {c}/>',  # wider than a cell
    "shank": '<geom name="a" type="capsule" size="0.0175 0.1" {c}/>',
    "trunk": '<geom name="a" type="capsule" size="0.1 0.375" {c}/>',
    "box": '<geom name="a" type="box" size="0.1 0.06 0.04" {c}/>',
    "wheel": '<geom name="a" type="cylinder" size="0.12 0.04" {c}/>',
    "drum": '<geom name="a" type="cylinder" size="0.06 0.15" {c}/>',
}
LENGTH = {"shank": 0.1, "trunk": 0.375, "box": 0.12, "wheel": 0.04, "drum": 0.15}
RADIUS = {"foot": 0.03, "ball": 0.12, "shank": 0.0175, "trunk": 0.1, "box": 0.0, "wheel": 0.12, "drum": 0.06}
PLACEHOLDER = '<geom name="ground" type="plane" size="0 0 1" contype="0" conaffinity="0"/>'


@dataclass
class Contact:
    dist: float
    normal: np.ndarray
    pos: np.ndarray


def compile_model(ground: str, bodies: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="0.005" impratio="10" iterations="50" integrator="Euler"/>'
        f"<worldbody>{ground}{bodies}</worldbody></mujoco>"
    )


def free_body(shape: str, name: str = "b") -> str:
    geom = SHAPES[shape].format(c='mass="2" contype="1" conaffinity="2" priority="1"')
    return f'<body name="{name}"><freejoint/>{geom}</body>'


def height_map(heights: np.ndarray, steepest: float = 0.2, cell: float = 0.1) -> HeightMap:
    """Centred on the origin."""
    origin = (-0.5 * heights.shape[0] * cell, -0.5 * heights.shape[1] * cell)
    return HeightMap.of(heights, cell, origin, np.full(heights.shape, steepest))


def slope_map(along_x: float, along_y: float) -> HeightMap:
    x, y = np.meshgrid(*(0.1 * (np.arange(60) - 29.5),) * 2, indexing="ij")
    return height_map(along_x * x + along_y * y, steepest=np.inf)


class Ours:
    """Bodies in many worlds of mujoco-warp on Warp's CPU device, with our collider."""

    def __init__(self, bodies: str, ground: HeightMap, worlds: int) -> None:
        self.model = compile_model(PLACEHOLDER, bodies)
        with wp.ScopedDevice("cpu"):
            self.m = mjw.put_model(self.model)
            self.d = mjw.make_data(self.model, nworld=worlds, nconmax=24, njmax=96)
            shapes = np.flatnonzero(self.model.geom_bodyid)
            TerrainContact(self.m, self.d, self.model, self.model.geom("ground").id, ground, shapes)

    def contacts(self, qpos: np.ndarray) -> list[list[Contact]]:
        """One list a world."""
        with wp.ScopedDevice("cpu"):
            wp.copy(self.d.qpos, wp.array(qpos, dtype=float))
            mjw.forward(self.m, self.d)
        count = int(self.d.nacon.numpy()[0])
        assert count <= self.d.naconmax
        found: list[list[Contact]] = [[] for _ in qpos]
        contact = self.d.contact
        columns = (contact.worldid, contact.dist, contact.frame, contact.pos, contact.geom)
        for world, dist, frame, pos, geom in zip(*(column.numpy()[:count] for column in columns), strict=True):
            assert geom[0] == 0  # the ground comes first: normals point at the robot
            if np.isfinite(frame).all():
                np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-5)
            found[world].append(Contact(float(dist), frame[0].astype(float), pos.astype(float)))
        return found

    def settle(self, qpos: np.ndarray, steps: int) -> np.ndarray:
        """(worlds, nq) after `steps`, from rest."""
        with wp.ScopedDevice("cpu"):
            wp.copy(self.d.qpos, wp.array(qpos, dtype=float))
            self.d.qvel.zero_()
            self.d.qacc_warmstart.zero_()
            mjw.step(self.m, self.d)
            with wp.ScopedCapture("cpu") as capture:
                mjw.step(self.m, self.d)
            for _ in range(steps - 1):
                wp.capture_launch(capture.graph)
        return self.d.qpos.numpy()


def c_contacts(model: mujoco.MjModel, qpos: np.ndarray) -> list[list[Contact]]:
    data = mujoco.MjData(model)
    found = []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        rows = []
        for c in data.contact:
            sign = 1.0 if model.geom_bodyid[c.geom1] == 0 else -1.0  # C orders geoms by type
            rows.append(Contact(c.dist, sign * c.frame[:3], c.pos.copy()))
        found.append(rows)
    return found


def poses(count: int, low: list[float], high: list[float], seed: int) -> np.ndarray:
    """Random places in a box, random orientations."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(count, 4))
    return np.hstack([rng.uniform(low, high, (count, 3)), quat / np.linalg.norm(quat, axis=1, keepdims=True)])


def compare(ours: list[list[Contact]], theirs: list[list[Contact]], deepest: float, first_only: bool = False) -> int:
    """Every contact of C MuJoCo is one of ours (or only its deepest), and the deepest are as deep, in worlds that are not
    penetrated by more than `deepest`; returns how many worlds were compared.
    """
    compared = 0
    for mine, wanted in zip(ours, theirs, strict=True):
        depth = min((c.dist for c in wanted), default=0.0)
        if depth < -deepest or (depth > -1e-3 and not mine):
            continue
        assert min((c.dist for c in mine), default=0.0) == pytest.approx(depth, abs=1e-3)
        for c in sorted(wanted, key=lambda c: c.dist)[: 1 if first_only else None]:
            if c.dist < -1e-3:
                near = [k for k in mine if abs(k.dist - c.dist) < 1e-3 and k.normal @ c.normal > np.cos(np.radians(1.0))]
                assert near, f"C MuJoCo has {c}, ours are {mine}"
                assert min(np.linalg.norm(k.pos - c.pos) for k in near) < 2e-3
        compared += bool(wanted)
    return compared


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["foot", "shank", "trunk", "ball"])
def test_a_step_and_its_edge(shape):
    """Tread, riser and rim of a box step: C MuJoCo's contacts, of random poses that cut into it a little.

    Of a capsule, the deepest one: C MuJoCo adds a second where the capsule leaves the tread, with the tread's normal, ours
    is at the other end or at the rim, with the normal of the nearest points.
    """
    heights = np.zeros((40, 40))
    heights[20:] = STEP
    reach = LENGTH.get(shape, 0.0) + RADIUS[shape]
    qpos = poses(500, [-0.07 - reach, -0.5, 0.0], [0.07 + reach, 0.5, STEP + reach], seed=1)
    ground = (
        '<geom type="plane" size="0 0 1" contype="2" conaffinity="1"/>'
        '<geom type="box" size="1 4 0.6" pos="1 0 -0.4" contype="2" conaffinity="1"/>'
    )
    ours = Ours(free_body(shape), height_map(heights), len(qpos)).contacts(qpos)
    theirs = c_contacts(compile_model(ground, free_body(shape)), qpos)
    capsule = shape in ("shank", "trunk")
    assert compare(ours, theirs, min(0.7 * RADIUS[shape], 0.03), first_only=capsule) >= 20


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "share"), [("wheel", 0.8), ("drum", 0.95)])
def test_a_cylinder_at_a_step(shape, share):
    """Of random poses that cut into it by up to 3 cm, most are as deep as in C MuJoCo, within 1 mm; what differs are
    cylinders that lie on the rim with neither a lowest point nor an end disc over it, as boxes do with their edges.
    """
    heights = np.zeros((40, 40))
    heights[20:] = STEP
    reach = LENGTH[shape] + RADIUS[shape]
    qpos = poses(500, [-0.07 - reach, -0.5, 0.0], [0.07 + reach, 0.5, STEP + reach], seed=1)
    ground = (
        '<geom type="plane" size="0 0 1" contype="2" conaffinity="1"/>'
        '<geom type="box" size="1 4 0.6" pos="1 0 -0.4" contype="2" conaffinity="1"/>'
    )
    ours = Ours(free_body(shape), height_map(heights), len(qpos)).contacts(qpos)
    theirs = c_contacts(compile_model(ground, free_body(shape)), qpos)
    depths = [[min((c.dist for c in found), default=0.0) for found in way] for way in (ours, theirs)]
    cut = [(mine, wanted) for mine, wanted in zip(*depths, strict=True) if -0.03 < min(mine, wanted) < 0.0]
    assert len(cut) > 40
    assert np.mean([abs(mine - wanted) < 1e-3 for mine, wanted in cut]) >= share


def test_a_wheel_meets_a_curb_at_its_rim():
    """Worked by hand: a wheel of radius 0.12, its axle along y, 0.09 before the rim and 0.07 above it: the rim is 0.11402
    from the axle, so 5.98 mm deep, and pushes along (-0.09, 0, 0.07) / 0.11402, at both ends of the wheel.
    """
    heights = np.zeros((40, 40))
    heights[20:] = STEP
    half = np.sqrt(0.5)
    pose = np.array([[-0.09, 0.03, STEP + 0.07, half, half, 0.0, 0.0]])
    (found,) = Ours(free_body("wheel"), height_map(heights), 1).contacts(pose)
    assert len(found) == 2
    for contact in found:
        assert contact.dist == pytest.approx(0.1140175 - 0.12, abs=1e-5)
        np.testing.assert_allclose(contact.normal, [-0.7893522, 0.0, 0.6139406], atol=1e-4)
    np.testing.assert_allclose(sorted(c.pos[1] for c in found), [-0.01, 0.07], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["foot", "shank", "trunk", "box", "wheel", "drum"])
@pytest.mark.parametrize(("along_x", "along_y"), [(0.0, 0.0), (0.4, 0.0), (-0.25, 0.3)])
def test_planes_and_slopes(shape, along_x, along_y):
    """A tilted plane of C MuJoCo: same contacts, one a sphere, one an end of a capsule, one a corner of a box."""
    up = np.array([-along_x, -along_y, 1.0]) / np.sqrt(1.0 + along_x**2 + along_y**2)
    qpos = poses(200, [-1.0, -1.0, 0.0], [1.0, 1.0, 0.0], seed=2)
    offset = np.random.default_rng(3).uniform(0.0, LENGTH.get(shape, 0.0) + RADIUS[shape], len(qpos))
    qpos[:, 2] = along_x * qpos[:, 0] + along_y * qpos[:, 1] + offset / up[2]
    plane = f'<geom type="plane" size="0 0 1" zaxis="{up[0]} {up[1]} {up[2]}" contype="2" conaffinity="1"/>'
    ours = Ours(free_body(shape), slope_map(along_x, along_y), len(qpos)).contacts(qpos)
    theirs = c_contacts(compile_model(plane, free_body(shape)), qpos)
    assert compare(ours, theirs, deepest=0.07 if shape == "box" else 0.9 * RADIUS[shape]) > 30


def test_a_foot_in_a_corner_feels_tread_and_riser():
    heights = np.zeros((40, 40))
    heights[20:] = STEP
    (found,) = Ours(free_body("foot"), height_map(heights), 1).contacts(np.array([[-0.028, 0.02, 0.029, 1, 0, 0, 0]]))
    normals = sorted(tuple(np.round(c.normal, 5)) for c in found)
    assert normals == [(-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)]
    assert sorted(c.dist for c in found) == pytest.approx([-0.002, -0.001], abs=1e-5)


def test_a_foot_at_an_outer_corner_is_pushed_away_from_it():
    """Where two faces meet in a vertical edge: the nearest point of the edge, (0, 0), decides."""
    heights = np.zeros((40, 40))
    heights[20:, 20:] = STEP
    (found,) = Ours(free_body("foot"), height_map(heights), 1).contacts(np.array([[-0.012, -0.016, 0.1, 1, 0, 0, 0]]))
    assert len(found) == 1
    np.testing.assert_allclose(found[0].normal, [-0.6, -0.8, 0.0], atol=1e-5)
    assert found[0].dist == pytest.approx(0.02 - 0.03, abs=1e-6)


def test_a_foot_behind_a_face_leaves_through_it():
    """2 cm inside the riser and 10 cm below the tread: out through the riser, not up by 13 cm."""
    heights = np.zeros((40, 40))
    heights[20:] = STEP
    (found,) = Ours(free_body("foot"), height_map(heights), 1).contacts(np.array([[0.02, 0.03, 0.1, 1, 0, 0, 0]]))
    assert len(found) == 1
    np.testing.assert_allclose(found[0].normal, [-1.0, 0.0, 0.0], atol=1e-6)
    assert found[0].dist == pytest.approx(-0.02 - 0.03, abs=1e-6)


def test_level_cells_have_no_seams():
    """Anywhere on level ground, on borders of cells too, a sphere has one contact, straight up."""
    x = np.linspace(-0.2, 0.2, 41)
    qpos = np.array([[a, b, 0.029, 1.0, 0, 0, 0] for a in x for b in (0.0, 0.013, 0.05)])
    for found in Ours(free_body("foot"), height_map(np.zeros((40, 40))), len(qpos)).contacts(qpos):
        assert len(found) == 1
        np.testing.assert_allclose(found[0].normal, [0.0, 0.0, 1.0], atol=1e-6)
        assert found[0].dist == pytest.approx(-0.001, abs=1e-6)


def test_c_mujoco_s_height_fields_lean_at_seams_and_ours_follow_the_slope():
    """A convention that differs: a foot 2 mm deep in an even slope of 20 degrees, at 300 random places, as each back-end
    represents it. C MuJoCo meets triangle by triangle: of its 690 contacts 16 % lean by more than 10 degrees, up to 13.
    """
    ground = tiles(("slope_up", 20.0))
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-3.5, -2.0, 300), rng.uniform(-1.5, 1.5, 300)  # one face of the pit, whose floor begins at -1.5
    up = np.array([np.sin(np.radians(20.0)), 0.0, np.cos(np.radians(20.0))])
    surface = np.stack([x, y, ground.height_map.height_at(x, y)], axis=1)
    qpos = np.hstack([surface + (RADIUS["foot"] - 0.002) * up, np.tile([1.0, 0.0, 0.0, 0.0], (300, 1))])

    def leans(contacts: list[list[Contact]]) -> np.ndarray:
        """Degrees between each contact's normal and the slope's."""
        assert all(contacts)  # everywhere the foot is held
        return np.degrees([np.arccos(min(c.normal @ up, 1.0)) for found in contacts for c in found])

    ours = leans(Ours(free_body("foot"), ground.height_map, len(qpos)).contacts(qpos))
    assert len(ours) == len(qpos)
    assert ours.max() < 1.0
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{free_body('foot')}</worldbody></mujoco>")
    add_terrain(spec, ground)
    theirs = leans(c_contacts(spec.compile(), qpos))
    # A bracket around the figure in docs/results.md and engines.md: outside it MuJoCo has changed, and both must, too.
    assert 0.12 < (theirs > 10.0).mean() < 0.2
    assert theirs.max() < 15.0


def test_a_capsule_rests_on_a_ridge_between_its_ends():
    """A roof of two 20 % slopes along y: a trunk across it touches the top, 1 mm deep."""
    x = 0.1 * (np.arange(60) - 29.5)
    roof = height_map(np.repeat(-0.2 * np.abs(x)[:, None], 60, axis=1), steepest=np.inf)
    top = float(roof.height_at(np.array(0.0), np.array(0.0)))
    level = [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]  # the capsule's axis along x
    (found,) = Ours(free_body("trunk"), roof, 1).contacts(np.array([[0.0, 0.03, top + 0.099, *level]]))
    assert found
    assert min(c.dist for c in found) == pytest.approx(-0.001, abs=1e-4)
    np.testing.assert_allclose(min(found, key=lambda c: c.dist).normal, [0.0, 0.0, 1.0], atol=0.02)


@pytest.mark.slow
def test_resting_heights_and_positions_are_those_of_c_mujoco():
    """Dropped from 1 cm and left for 1 s on a tread; on a slope of 15 %, which friction holds."""
    heights = np.zeros((40, 40))
    heights[20:] = STEP
    flat_poses = {"foot": 0.03, "shank": 0.0175, "trunk": 0.1, "box": 0.04, "wheel": 0.04, "drum": 0.06}
    lying = [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]
    for shape, height in flat_poses.items():
        turn = lying if shape in ("shank", "trunk", "drum") else [1.0, 0.0, 0.0, 0.0]
        qpos = np.array([[1.0, 0.0, STEP + height + 0.01, *turn], [-1.0, 0.0, height + 0.01, *turn]])
        rest = Ours(free_body(shape), height_map(heights), 2).settle(qpos, 200)
        np.testing.assert_allclose(rest[:, 2], [STEP + height, height], atol=2e-3)
        np.testing.assert_allclose(rest[:, :2], qpos[:, :2], atol=2e-3)
    model = compile_model('<geom type="plane" size="0 0 1" zaxis="-0.15 0 1" contype="2" conaffinity="1"/>', free_body("box"))
    data = mujoco.MjData(model)
    tilt = np.zeros(4)
    mujoco.mju_axisAngle2Quat(tilt, np.array([0.0, 1.0, 0.0]), -np.arctan(0.15))
    start = np.array([0.013, 0.027, 0.013 * 0.15 + 0.055, *tilt])
    data.qpos[:] = start
    mujoco.mj_step(model, data, 200)
    rest = Ours(free_body("box"), slope_map(0.15, 0.0), 1).settle(start[None], 200)
    np.testing.assert_allclose(rest[0], data.qpos, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("far", [1e9, 1e30, np.inf, np.nan])
def test_a_world_that_blew_up_ends_and_harms_no_neighbour(far):
    """Its trunk is somewhere absurd, below the ground too; the next world's lies on the ground as ever."""
    lying = [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]
    for place in ([far, 0.0, -1.0], [-far, far, -far], [0.0, 0.0, far]):
        qpos = np.array([[*place, *lying], [0.033, 0.041, 0.099, *lying]])
        lost, well = Ours(free_body("trunk"), height_map(np.zeros((40, 40))), 2).contacts(qpos)
        assert len(lost) <= 8
        assert [c.dist for c in well] == pytest.approx([-0.001, -0.001], abs=1e-5)


def test_shapes_without_contact_features_are_named():
    egg = '<body><freejoint/><geom name="egg" type="ellipsoid" size="0.1 0.1 0.2" contype="1" conaffinity="2"/></body>'
    with pytest.raises(ConfigError, match=r"shape 'egg' is of type ellipsoid.*sim\.physics=mujoco"):
        Ours(egg, height_map(np.zeros((4, 4))), 1)
