"""What can be randomised: each field against C MuJoCo with its model changed by hand, on both engines of MuJoCo's names."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from devices import build, on_gpu
from reference import CWorlds, random_states

from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.physics import FIELDS, ModelScene, Physics, RobotScene, check_ranges
from legged.physics.fields import changed_arrays
from legged.physics.fused.smooth_dynamics import SmoothDynamics
from legged.physics.randomized_model import RandomizedModel
from legged.physics.warp.mujoco_warp import absent_stages

HUMANOID = ModelScene(Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "humanoid.xml")
CPU = torch.device("cpu")
SETTINGS = {"dt": 0.003, "impratio": 1.0, "iterations": 50, "ls_iterations": 50, "nconmax": 64, "njmax": 160, "threads": 1}
N, STEPS = 3, 25
ENGINES = ["mujoco", "mujoco_warp", on_gpu("mujoco_warp, cuda")]


def friction(model: mujoco.MjModel, value: float) -> None:
    model.geom_friction[:, 0] = value


def added_base_mass(model: mujoco.MjModel, value: float) -> None:
    model.body("torso").mass += value


def link_mass(model: mujoco.MjModel, value: float) -> None:
    model.body_mass[1:] *= value
    model.body_inertia[1:] *= value


def joint_armature(model: mujoco.MjModel, value: float) -> None:
    model.dof_armature[6:] += value


def joint_damping(model: mujoco.MjModel, value: float) -> None:
    model.dof_damping[6:] += value


def joint_friction(model: mujoco.MjModel, value: float) -> None:
    model.dof_frictionloss[6:] += value


def actuator_gain(model: mujoco.MjModel, value: float) -> None:
    for i, motor in enumerate(range(model.nu)):  # gear 25 to 300, gain 1
        model.actuator_gainprm[motor, 0] = (model.actuator_gear[i, 0] + value) / model.actuator_gear[i, 0]


def restitution(model: mujoco.MjModel, value: float) -> None:
    """Damping ratios that were solved for by hand, of 0.135 and less, of 0.4 and of 0.8; solref is (0.02, 1)."""
    ratio = {0.0: 1.0, 0.4: 0.354508, 0.8: 0.0743551}[value]
    model.geom_solref[:] = 0.02 / ratio, ratio


def base_com_x(model: mujoco.MjModel, value: float) -> None:
    model.body("torso").ipos[0] += value


def base_com_y(model: mujoco.MjModel, value: float) -> None:
    model.body("torso").ipos[1] += value


def base_com_z(model: mujoco.MjModel, value: float) -> None:
    model.body("torso").ipos[2] += value


def gravity_x(model: mujoco.MjModel, value: float) -> None:
    model.opt.gravity[0] = value


def gravity_y(model: mujoco.MjModel, value: float) -> None:
    model.opt.gravity[1] = value


def gravity_z(model: mujoco.MjModel, value: float) -> None:
    model.opt.gravity[2] = -9.81 + value


def motor_strength(model: mujoco.MjModel, value: float) -> None:
    model.actuator_gear[:] *= value


def added_mass_of_a_thigh(model: mujoco.MjModel, value: float) -> None:
    model.body("left_thigh").mass += value


def centre_of_a_thigh(model: mujoco.MjModel, value: float) -> None:
    model.body("left_thigh").ipos[1] += value


CHANGES = {  # by hand, and values for three worlds
    friction: (0.1, 0.6, 2.0),
    added_base_mass: (-3.0, 0.0, 10.0),
    link_mass: (0.6, 1.0, 1.7),
    joint_armature: (0.0, 0.5, 3.0),
    joint_damping: (0.0, 2.0, 20.0),
    joint_friction: (0.0, 1.0, 8.0),
    actuator_gain: (-20.0, 5.0, 60.0),
    restitution: (0.0, 0.4, 0.8),
    base_com_x: (-0.05, 0.0, 0.1),
    base_com_y: (-0.05, 0.0, 0.1),
    base_com_z: (-0.05, 0.0, 0.1),
    gravity_x: (-2.0, 0.0, 1.0),
    gravity_y: (-2.0, 0.0, 1.0),
    gravity_z: (-2.0, 0.0, 9.81),
    motor_strength: (0.5, 1.0, 1.3),
    added_mass_of_a_thigh: (-2.0, 0.0, 5.0),
    centre_of_a_thigh: (-0.05, 0.0, 0.1),
}
OF_BODIES = {"added_mass_of_a_thigh": "added_mass:left_thigh", "centre_of_a_thigh": "com_y:left_thigh"}
KNOWN = tuple(name for name, field in FIELDS.items() if field.changes)


@pytest.fixture(scope="module", params=ENGINES)
def physics(request) -> Physics:
    """Three humanoids whose every field may be given."""
    return build(HUMANOID, request.param, N, (*KNOWN, *OF_BODIES.values()), **SETTINGS)


def give(physics: Physics, field: str, values: tuple[float, ...]) -> None:
    """Give one field its values, and all others those that change nothing; friction is 0.6 then."""
    for name in (*KNOWN, *OF_BODIES.values()):
        physics.randomize(name, torch.full((N,), 0.6 if name == "friction" else FIELDS[name].neutral))
    physics.randomize(field, torch.tensor(values))


def landing(model: mujoco.MjModel) -> tuple[torch.Tensor, torch.Tensor]:
    """Feet a little in the ground, moving sideways."""
    generator = torch.Generator().manual_seed(1)
    qpos = torch.tensor(model.qpos0, dtype=torch.float32).repeat(N, 1)
    qpos[:, 2] -= 0.13
    qpos[:, 7:] += 0.05 * torch.randn(N, model.nq - 7, generator=generator)
    qvel = 0.3 * torch.randn(N, model.nv, generator=generator)
    qvel[:, 0] = 1.0
    return qpos, qvel


def rollout(model: mujoco.MjModel, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor) -> np.ndarray:
    """Positions of one world of C MuJoCo after each step."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    found = []
    for now in ctrl:
        data.ctrl[:] = now
        mujoco.mj_step(model, data)
        found.append(data.qpos.copy())
    return np.array(found)


def test_every_field_is_tested():
    assert {change.__name__ for change in CHANGES} == {*KNOWN, *OF_BODIES} - {"torque_limit"}  # motors here have none


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES)
def test_a_field_does_what_the_same_change_by_hand_does(physics, change):
    values = CHANGES[change]
    give(physics, OF_BODIES.get(change.__name__, change.__name__), values)
    qpos, qvel = landing(physics.model)
    ctrl = 0.4 * torch.randn(STEPS, physics.model.nu, generator=torch.Generator().manual_seed(2))
    physics.write(torch.ones(N, dtype=torch.bool), qpos, qvel)
    found = []
    for now in ctrl:
        physics.ctrl.copy_(now.expand(N, -1))
        physics.step()
        found.append(physics.qpos.clone().numpy())
    ends = []
    for world, value in enumerate(values):
        model = HUMANOID.model(SimConfig(**SETTINGS))
        friction(model, 0.6)
        plain = rollout(model, qpos[world], qvel[world], ctrl)[-1]
        change(model, value)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        expected = rollout(model, qpos[world], qvel[world], ctrl)
        np.testing.assert_allclose(np.array(found)[:, world], expected, atol=2e-5)
        ends.append(np.abs(expected[-1] - plain).max())
    assert max(ends) > 1e-3  # fifty times what is allowed above


@pytest.mark.slow
def test_values_given_again_replace_those_before(physics):
    """A resumed training gives what was drawn once more; and the order of fields that share an array does not matter."""
    model = physics.model
    give(physics, "link_mass", (0.5, 1.0, 2.0))
    for _ in range(2):
        physics.randomize("added_base_mass", torch.tensor([1.0, 2.0, 3.0]))
    found = RandomizedModel(HUMANOID, model, KNOWN, torch.float64, CPU)
    found.give("added_base_mass", torch.tensor([1.0, 2.0, 3.0]))
    found.give("added_base_mass", torch.tensor([1.0, 2.0, 3.0]))
    mass = found.give("link_mass", torch.tensor([0.5, 1.0, 2.0]))["body_mass"]
    own = model.body_mass[1]
    np.testing.assert_allclose(mass[:, 1], [0.5 * own + 1.0, own + 2.0, 2.0 * own + 3.0])
    np.testing.assert_allclose(mass[:, 2], [0.5 * model.body_mass[2], model.body_mass[2], 2.0 * model.body_mass[2]])
    qpos, qvel = landing(model)
    physics.write(torch.ones(N, dtype=torch.bool), qpos, qvel)
    for _ in range(STEPS):
        physics.step()
    for world in range(N):
        model = HUMANOID.model(SimConfig(**SETTINGS))
        friction(model, 0.6)
        link_mass(model, (0.5, 1.0, 2.0)[world])
        added_base_mass(model, (1.0, 2.0, 3.0)[world])
        mujoco.mj_setConst(model, mujoco.MjData(model))
        expected = rollout(model, qpos[world], qvel[world], torch.zeros(STEPS, model.nu))[-1]
        np.testing.assert_allclose(physics.qpos[world], expected, atol=2e-5)


SERVO = """<mujoco><option gravity='0 0 0'/><worldbody><body>
<joint name='x' type='slide' axis='1 0 0'/><geom size='0.1' mass='1'/>
<body pos='0 0 1'><joint name='y' type='hinge' axis='0 1 0'/><geom size='0.1' mass='1' pos='0 0 0.3'/></body>
</body></worldbody><actuator>{}<motor joint='y' gear='4'/></actuator></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_a_servos_pull_towards_its_target_grows_with_its_gain(engine, tmp_path):
    """A position servo of gear 2 and stiffness 50, to which 20 N a metre are added: that is a stiffness of 60. Each actuator
    has its own value; a motor of gear 4 with 6 N m more gives 10 N m per unit.
    """
    path = tmp_path / "servo.xml"
    path.write_text(SERVO.format("<position joint='x' gear='2' kp='50'/>"))
    physics = build(ModelScene(path), engine, 2, ["actuator_gain"], threads=1)
    physics.randomize("actuator_gain", torch.tensor([[0.0, 0.0], [20.0, 6.0]]))
    physics.write(torch.ones(2, dtype=torch.bool), torch.full((2, 2), 0.1), torch.zeros(2, 2))
    physics.ctrl[:] = torch.tensor([0.5, 0.3])
    for _ in range(40):
        physics.step()
    for world, (kp, gear) in enumerate([(50, 4), (60, 10)]):
        path.write_text(SERVO.replace("gear='4'", f"gear='{gear}'").format(f"<position joint='x' gear='2' kp='{kp}'/>"))
        ctrl = torch.tensor([[0.5, 0.3]]).repeat(40, 1)
        expected = rollout(ModelScene(path).model(SimConfig()), torch.full((2,), 0.1), torch.zeros(2), ctrl)[-1]
        np.testing.assert_allclose(physics.qpos[world], expected, atol=1e-5)
    with pytest.raises(ValueError, match=r"\(N,\) or \(N, 2\), not \(2, 3\)"):
        physics.randomize("actuator_gain", torch.zeros(2, 3))


# ---- the fused launches --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("field", KNOWN)
def test_the_fused_step_takes_every_field_of_the_table(robot, field):
    """Its launches read the arrays per world, or leave them to those that make contacts and constraint rows."""
    model = RobotScene(robot).model(SimConfig())
    assert SmoothDynamics.why_not(model, changed_arrays([field])) == ""


def test_stages_that_a_randomised_array_needs_are_launched():
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>")
    damping, loss = (int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in ("EULERDAMP", "FRICTIONLOSS"))
    assert absent_stages(model) == damping | loss
    assert absent_stages(model, ["dof_damping"]) == loss
    assert absent_stages(model, ["dof_frictionloss", "geom_friction"]) == damping


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_a_shipped_robot_without_dampers_can_be_given_some(robot, engine):
    """Damping and dry friction, of which its model has none, on 20 steps through contacts."""
    fields = {"joint_damping": torch.tensor([0.0, 3.0]), "joint_friction": torch.tensor([2.0, 0.0])}
    physics = build(RobotScene(robot), engine, 2, tuple(fields), threads=1, njmax=128)
    for name, values in fields.items():
        physics.randomize(name, values)
    states = random_states(robot, 2, seed=8)
    states.write(physics)
    torques = 40.0 * torch.randn(2, 12, generator=torch.Generator().manual_seed(1))
    physics.ctrl.copy_(torques)
    worlds = [CWorlds(robot, SimConfig(), states) for _ in range(2)]
    worlds[0].model.dof_frictionloss[6:] = 2.0
    worlds[1].model.dof_damping[6:] = 3.0
    for _ in range(20):
        physics.step()
        for each in worlds:
            each.step(torques)
    for world, each in enumerate(worlds):
        np.testing.assert_allclose(physics.qpos[world], each.worlds[world].qpos, atol=5e-5)


# ---- what is refused -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ranges", "error"),
    [
        ({"friction": (-0.5, 1.0)}, r"mine.yaml: domain_rand.ranges.friction: .* -0.5 .*geom_friction -0.5"),
        ({"added_base_mass": (-50.0, 1.0)}, r"ranges.added_base_mass: .* makes body_mass -4"),
        ({"link_mass": (0.0, 1.0)}, r"ranges.link_mass: .* makes body_mass 0"),
        ({"link_mass": (0.1, 1.0), "added_base_mass": (-2.0, 0.0)}, r"ranges.added_base_mass: .* makes body_mass "),
        (
            {"com_x:left_thihg": (0.0, 1.0)},
            r"ranges.com_x:left_thihg: .* has no body 'left_thihg'; did you mean 'left_thigh'\?",
        ),
        ({"added_mass:left_thigh": (-5.0, 1.0)}, r"ranges.added_mass:left_thigh: .* \(mass added to left_thigh\), makes"),
        ({"joint_damping": (-1.5, 1.0)}, r"ranges.joint_damping: .* makes dof_damping -0.5"),
    ],
)
def test_ranges_that_leave_no_model_are_refused(ranges, error):
    with pytest.raises(ConfigError, match=error):
        check_ranges(ranges, HUMANOID, SimConfig(), "mine.yaml: {}".format)


def test_ranges_need_something_to_change(tmp_path):
    path = tmp_path / "servo.xml"
    path.write_text(SERVO.format(""))
    scene = ModelScene(path)
    with pytest.raises(ConfigError, match=r"ranges.added_base_mass: .*servo.xml has no floating base"):
        check_ranges({"added_base_mass": (0.0, 1.0)}, scene, SimConfig())
    check_ranges({"actuator_gain": (-9.0, 1.0), "joint_friction": (0.0, 1.0)}, scene, SimConfig())
    check_ranges({}, scene, SimConfig())


# ---- restitution ---------------------------------------------------------------------------------------------------------

BALL = """<mujoco><worldbody><geom name='ground' type='plane' size='1 1 1'/><body pos='0 0 0.3'><freejoint/>
<geom size='0.1' mass='{}' priority='1'/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("mass", [0.5, 30.0])
def test_a_ball_keeps_the_share_of_its_speed_that_restitution_says(mass, tmp_path):
    """Dropped by 0.2 m, it leaves the ground at e times the 1.98 m/s at which it came, whatever it weighs; contacts of MuJoCo
    are soft and give way under gravity, which takes a few hundredths.
    """
    path = tmp_path / "ball.xml"
    path.write_text(BALL.format(mass))
    kept = torch.tensor([0.0, 0.3, 0.5, 0.7, 0.9])
    physics = build(ModelScene(path), "mujoco", 5, ["restitution"], threads=1, dt=0.001)
    physics.randomize("restitution", kept)
    down, up = torch.zeros(5), torch.zeros(5)
    for _ in range(600):
        physics.step()
        down = torch.maximum(down, -physics.qvel[:, 2])
        up = torch.maximum(up, physics.qvel[:, 2])
        if (up > 0.05).all() and (physics.qvel[:, 2] < up).all():
            break
    np.testing.assert_allclose(down, 1.98, atol=0.03)
    np.testing.assert_allclose((up / down)[1:], kept[1:], atol=0.05)
    assert 0.05 < float(up[0] / down[0]) < 0.2  # exp(-2) without gravity
