"""Models that are no robots with feet: two of Gymnasium's, stepped as C MuJoCo steps them, and what may be asked of them."""

import re
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from devices import build, engine_of, on_gpu

from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.physics import ModelScene, RobotScene, check_engine, make_physics
from legged.physics.base import Physics
from legged.physics.quantities import LAST_STEP, STAGES

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
CPU = torch.device("cpu")
QUANTITIES = (*STAGES, *LAST_STEP)
SETTINGS = {"impratio": 1.0, "iterations": 50, "ls_iterations": 50, "nconmax": 64, "njmax": 160, "threads": 1}
MODELS = {  # time step, and how much lower than in the file the first body starts, so that it lands
    "half_cheetah": (0.01, 1, 0.1),
    "humanoid": (0.003, 2, 0.15),
}
N = 5


@pytest.fixture(scope="module", params=["mujoco", "mujoco_warp", on_gpu("mujoco_warp, cuda")])
def engine(request) -> str:
    return request.param


@pytest.fixture(scope="module", params=MODELS)
def model(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def physics(engine, model) -> Physics:
    return build(ModelScene(ASSETS / f"{model}.xml"), engine, N, (), QUANTITIES, dt=MODELS[model][0], **SETTINGS)


def starts(name: str, model: mujoco.MjModel, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and velocities near the model's own, low enough to touch the floor soon."""
    generator = torch.Generator().manual_seed(seed)
    _, height, lower = MODELS[name]
    qpos = torch.tensor(model.qpos0, dtype=torch.float32).repeat(N, 1)
    qpos += 0.1 * (2.0 * torch.rand(qpos.shape, generator=generator) - 1.0)
    qpos[:, height] -= lower
    if name == "humanoid":
        qpos[:, 3:7] /= qpos[:, 3:7].norm(dim=1, keepdim=True)
    return qpos, 0.5 * torch.randn(N, model.nv, generator=generator)


def everyone() -> torch.Tensor:
    return torch.ones(N, dtype=torch.bool)


class References:
    """One MjData a world."""

    def __init__(self, model: mujoco.MjModel, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        self.model, self.contacts = model, 0
        self.worlds = [mujoco.MjData(model) for _ in qpos]
        for data, position, velocity in zip(self.worlds, qpos, qvel, strict=True):
            data.qpos[:], data.qvel[:] = position, velocity

    def step(self, ctrl: torch.Tensor) -> None:
        for data, control in zip(self.worlds, ctrl, strict=True):
            data.ctrl[:] = control
            mujoco.mj_step(self.model, data)
            self.contacts += data.ncon

    def all(self, name: str) -> np.ndarray:
        return np.stack([np.array(getattr(data, name)) for data in self.worlds])


def controls(physics: Physics, generator: torch.Generator) -> torch.Tensor:
    """Random ones, beyond what the motors take."""
    return 0.6 * torch.randn(N, physics.ctrl.shape[1], generator=generator)


@pytest.mark.slow
def test_it_has_no_state_of_a_robot(physics):
    assert physics.robot_state is None
    assert physics.model.nq == physics.qpos.shape[1]
    assert (physics.qvel.shape, physics.ctrl.shape) == ((N, physics.model.nv), (N, physics.model.nu))
    assert {tensor.dtype for tensor in (physics.qpos, physics.qvel, physics.ctrl)} == {torch.float32}


def test_it_moves_as_in_c_mujoco(physics, engine, model):
    """Under random controls, through contacts and limits: within 1e-5 over 30 steps, 1e-3 over 80, in which differences
    of float32 grow; the C engine within 1e-5 throughout.
    """
    scene = ModelScene(ASSETS / f"{model}.xml")
    qpos, qvel = starts(model, physics.model, seed=1)
    reference = References(scene.model(SimConfig(dt=MODELS[model][0], **SETTINGS)), qpos, qvel)
    physics.write(everyone(), qpos, qvel)
    generator = torch.Generator().manual_seed(2)
    for step in range(80):
        ctrl = controls(physics, generator)
        physics.ctrl.copy_(ctrl)
        physics.step()
        reference.step(ctrl)
        atol = 1e-5 if step < 30 or engine == "mujoco" else 1e-3
        np.testing.assert_allclose(physics.qpos, reference.all("qpos"), atol=atol, err_msg=f"step {step}")
        np.testing.assert_allclose(physics.qvel, reference.all("qvel"), atol=100.0 * atol, err_msg=f"step {step}")
    assert reference.contacts > 50
    physics.refresh()
    assert not physics.overflowed.any()


def test_quantities_agree_with_mj_forward(physics, model):
    """After steps, after a write and after a push; forces are those of the last step, and none in written worlds."""
    qpos, qvel = starts(model, physics.model, seed=3)
    physics.write(everyone(), qpos, qvel)
    generator = torch.Generator().manual_seed(4)
    addresses = {name: engine_of(physics).quantity(name).data_ptr() for name in QUANTITIES}

    def check() -> None:
        reference = References(physics.model, physics.qpos, physics.qvel)
        for data in reference.worlds:
            mujoco.mj_forward(reference.model, data)
        for name in STAGES:
            np.testing.assert_allclose(physics.quantity(name), reference.all(name), atol=2e-4, rtol=1e-4, err_msg=name)
            assert physics.quantity(name).dtype == torch.float32

    for _ in range(5):
        before = physics.qpos.clone(), physics.qvel.clone()
        ctrl = controls(physics, generator)
        physics.ctrl.copy_(ctrl)
        physics.step()
    physics.refresh()
    check()
    last = References(physics.model, *before)
    last.step(ctrl)
    forces = last.all("qfrc_actuator")
    np.testing.assert_allclose(physics.quantity("qfrc_actuator"), forces, rtol=1e-5, atol=1e-4)
    assert np.abs(forces).max() > 10.0
    physics.refresh()
    np.testing.assert_allclose(physics.quantity("qfrc_actuator"), forces, rtol=1e-5, atol=1e-4)
    mask = torch.tensor([True, False, False, True, False])
    other = starts(model, physics.model, seed=5)
    physics.write(mask, *other)
    physics.push(~mask, torch.full((N, 2), 0.7))
    physics.refresh()
    assert torch.equal(physics.qpos[mask], other[0][mask])
    check()
    assert (physics.quantity("qfrc_actuator")[mask] == 0.0).all()
    np.testing.assert_allclose(physics.quantity("qfrc_actuator")[~mask], forces[~mask.numpy()], rtol=1e-5, atol=1e-4)
    assert addresses == {name: engine_of(physics).quantity(name).data_ptr() for name in QUANTITIES}


def assert_same(physics: Physics, found: torch.Tensor, expected: torch.Tensor) -> None:
    """Check that positions are the same to the bit; on a GPU, where constraints come in another order each time, to 1e-4."""
    atol = 0.0 if engine_of(physics).device.type == "cpu" else 1e-4
    torch.testing.assert_close(found, expected, rtol=0.0, atol=atol)


def test_a_write_touches_its_worlds_only(physics, model):
    """The others go on to the bit as if nothing had happened; written ones start without controls and without a past."""
    generator = torch.Generator().manual_seed(6)
    qpos, qvel = starts(model, physics.model, seed=7)
    ctrl = controls(physics, generator)
    found = []
    for mask in (torch.zeros(N, dtype=torch.bool), torch.tensor([False, True, False, False, True])):
        physics.write(everyone(), qpos, qvel)
        physics.ctrl.copy_(ctrl)
        for _ in range(20):
            physics.step()
        physics.write(mask, qpos, qvel)
        physics.refresh()
        assert torch.equal(physics.ctrl, torch.where(mask[:, None], 0.0, ctrl))
        assert torch.equal(physics.qpos[mask], qpos[mask])
        assert torch.equal(physics.qvel[mask], qvel[mask])
        physics.ctrl.copy_(ctrl)
        for _ in range(20):
            physics.step()
        found.append(physics.qpos.clone())
    assert_same(physics, found[0][~mask], found[1][~mask])
    physics.write(everyone(), qpos, qvel)
    physics.ctrl.copy_(ctrl)
    for _ in range(20):
        physics.step()
    assert_same(physics, physics.qpos[mask], found[1][mask])


def test_a_state_put_back_goes_on_the_same(physics, model):
    """With the forces of the last step, which nothing else could tell again."""

    def go_on() -> torch.Tensor:
        for _ in range(15):
            physics.ctrl.copy_(ctrl)
            physics.step()
        physics.refresh()
        return physics.qpos.clone()

    physics.write(everyone(), *starts(model, physics.model, seed=9))
    ctrl = controls(physics, torch.Generator().manual_seed(8))
    go_on()
    saved = {name: tensor.clone() for name, tensor in physics.state_tensors().items()}
    forces, velocities = physics.quantity("qfrc_actuator").clone(), physics.quantity("cvel").clone()
    after = go_on()
    physics.write(everyone(), *starts(model, physics.model, seed=1))
    physics.refresh()
    physics.load_state(saved)
    assert torch.equal(physics.quantity("qfrc_actuator"), forces)
    assert torch.equal(physics.quantity("cvel"), velocities)
    assert_same(physics, go_on(), after)


FILTERED = """<mujoco><option gravity='0 0 0'>{}</option><worldbody><body><joint name='x' type='slide' axis='1 0 0'/>
<geom size='0.1' mass='2'/></body></worldbody>
<actuator><general joint='x' dyntype='filter' dynprm='0.05' gainprm='4'/></actuator></mujoco>"""


@pytest.mark.slow
def test_a_write_empties_actuators_that_have_a_state(engine, tmp_path):
    """A filter that has filled pushes on without control; that of a written world does not."""
    path = tmp_path / "filtered.xml"
    path.write_text(FILTERED.format(""))
    physics = build(ModelScene(path), engine, 2, (), ["qfrc_actuator"], threads=1)
    zeros = torch.zeros(2, 1)
    assert not physics.quantity("qfrc_actuator").any()
    physics.write(torch.ones(2, dtype=torch.bool), zeros, zeros)
    for _ in range(10):
        physics.ctrl.fill_(1.0)
        physics.step()
    saved = {name: tensor.clone() for name, tensor in physics.state_tensors().items()}
    physics.write(torch.tensor([True, False]), zeros, zeros)
    physics.ctrl.zero_()
    physics.step()
    physics.refresh()
    assert physics.qvel[0] == 0.0
    # 4 N on 2 kg under an activation of 1 - 0.9^k before step k (dt / T = 0.1): 0.01 m/s * sum over eleven steps.
    going = physics.qvel[1].clone()
    assert going.item() == pytest.approx(0.01 * (11.0 - 10.0 * (1.0 - 0.9**11)), abs=1e-6)
    physics.load_state(saved)
    physics.ctrl.zero_()
    physics.step()
    assert torch.equal(physics.qvel[1], going)
    assert torch.equal(physics.qvel[0], going)


def test_a_model_that_mujoco_warp_does_not_know_is_one_line(tmp_path):
    path = tmp_path / "override.xml"
    path.write_text(FILTERED.format("<flag override='enable'/>"))
    sim = SimConfig(physics="mujoco_warp")
    with pytest.raises(ConfigError, match=r"sim.physics: mujoco_warp cannot simulate .*override.xml.*OVERRIDE"):
        make_physics(ModelScene(path), sim, 1, CPU)


def test_a_quantity_that_was_not_asked_for_is_refused(robot):
    physics = make_physics(RobotScene(robot), SimConfig(physics="mujoco", threads=1), 1, CPU, (), ["cvel"])
    with pytest.raises(ValueError, match=r"quantity: .*'xpos'.*cvel"):
        physics.quantity("xpos")
    with pytest.raises(ValueError, match="no quantity 'cvels'; did you mean 'cvel'"):
        make_physics(RobotScene(robot), SimConfig(physics="mujoco"), 1, CPU, (), ["cvels"])


@pytest.mark.parametrize("name", ["mujoco", "mujoco_warp"])
def test_a_robot_has_quantities_too(robot, make_physics, name):
    """Beside its own state, whose forces they must leave alone."""
    from reference import standing

    from legged.physics import make_physics as build

    plain = make_physics(name)
    physics = build(RobotScene(robot), SimConfig(physics=name, threads=1), 6, CPU, (), ["cvel", "qfrc_actuator"])
    states = standing(robot, 6)
    for each in (plain, physics):
        states.write(each)
        for _ in range(60):
            each.ctrl.copy_((90.0 * (states.dof_pos - each.qpos[:, 7:]) - 4.0 * each.qvel[:, 6:]).clamp(-80.0, 80.0))
            each.step()
        for _ in range(2):
            each.refresh()
    torch.testing.assert_close(physics.robot_state.contact_forces, plain.robot_state.contact_forces, rtol=1e-3, atol=0.1)
    assert physics.robot_state.contact_forces[:, :, 2].sum(dim=1).min() > 300.0
    assert torch.equal(physics.quantity("qfrc_actuator")[:, 6:], physics.ctrl)


# ---- what is refused -----------------------------------------------------------------------------------------------------


def test_newton_simulates_robots_only(robot):
    sim = SimConfig(physics="newton")
    with pytest.raises(
        ConfigError, match=r"mine.yaml: sim.physics: newton .* not .*half_cheetah.xml; use sim.physics=mujoco_warp or"
    ):
        check_engine(ModelScene(ASSETS / "half_cheetah.xml"), sim, CPU, "mine.yaml: {}".format)
    with pytest.raises(ConfigError, match=r"sim.physics: newton does not compute cinert"):
        check_engine(RobotScene(robot), sim, CPU, quantities=["cinert"])
    steel = SimConfig(physics="newton", solver="steel")
    with pytest.raises(ConfigError, match=r"ranges.joint_damping: newton's steel cannot .*added_base_mass, friction"):
        make_physics(RobotScene(robot), steel, 1, CPU, randomized=["friction", "joint_damping"])
    check_engine(RobotScene(robot), steel, CPU, randomized=["friction"])
    check_engine(RobotScene(robot), sim, CPU, randomized=["friction", "joint_damping"])


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (None, "No such file|cannot read"),
        ("<mujoco", "cannot read"),
        ("<mujoco><worldbody><body mocap='true'><geom size='1'/></body></worldbody></mujoco>", "the model has mocap bodies"),
        ("<mujoco><option><flag sleep='enable'/></option></mujoco>", "sleeping bodies"),
    ],
)
def test_a_file_that_is_no_model_is_one_line(tmp_path, text, error):
    path = tmp_path / "model.xml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=error) as found:
        ModelScene(path).model(SimConfig())
    assert str(found.value).startswith(str(path))
    assert "\n" not in str(found.value)


def test_solver_options_are_laid_over_those_of_the_file():
    """The humanoid's file asks for RK4 and another solver; what is no option of ours stays as it is there."""
    path = ASSETS / "humanoid.xml"
    sim = SimConfig(dt=0.004, cone="elliptic", impratio=3.0, iterations=7, ls_iterations=9)
    model, own = ModelScene(path).model(sim), mujoco.MjModel.from_xml_path(str(path))
    option = model.opt
    assert (option.timestep, option.impratio, option.iterations, option.ls_iterations) == (0.004, 3.0, 7, 9)
    assert option.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert option.solver == mujoco.mjtSolver.mjSOL_NEWTON
    for name in ("geom_contype", "geom_conaffinity", "geom_friction", "geom_condim", "body_mass", "dof_damping"):
        np.testing.assert_array_equal(getattr(model, name), getattr(own, name))


HINGE = """<mujoco><compiler angle="radian"/><option actuatorgroupdisable="{off}"/>
<worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 1">
  <joint name="a" axis="0 1 0" range="-.02 .03" margin="{margin}"/><geom size=".1" pos=".2 0 0"/></body></worldbody>
<actuator><motor joint="a" group="1"/></actuator></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("off", "margin", "error"),
    [
        ("1", ".02", "the model disables the actuators of group 1"),
        ("2", ".04", r"joint 'a' .*margin \(0.04\).* 0.05 apart"),
        ("2", ".02", ""),
    ],
)
def test_what_mujoco_warp_would_pass_over_is_said(tmp_path, off, margin, error):
    """C MuJoCo has two rows for a hinge within the margin of both limits, and no force of a group that is disabled."""
    path = tmp_path / "hinge.xml"
    path.write_text(HINGE.format(off=off, margin=margin))
    if error:
        with pytest.raises(ConfigError, match=error):
            build(ModelScene(path), "mujoco_warp", 1)
        auto = make_physics(ModelScene(path), SimConfig(), 300, CPU)
        assert re.search(error, auto.why_c_engine)  # on a CPU, for many worlds: it takes the C engine and says so
        return
    found = []
    for engine in ("mujoco", "mujoco_warp"):
        physics = build(ModelScene(path), engine, 1)
        for _ in range(20):
            physics.ctrl.fill_(1.0)
            physics.step()
        found.append(physics.qpos.clone())
    torch.testing.assert_close(found[1], found[0], atol=1e-5, rtol=0.0)
