"""The simulated robot's motors: those of a task, in numbers worked by hand and beside the task's own class."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import call, small_task

from legged.cli import deploy
from legged.config.actuator import ActuatorConfig
from legged.config.robot import RobotControlConfig
from legged.config.world import SimConfig
from legged.deploy.contract import read_contract
from legged.errors import ConfigError
from legged.learning.runner import Runner
from legged.mdp.actuators.network import NetworkWeights
from legged.mdp.control import Control
from legged.policies.export import export
from legged.robots.robot import load_robot
from legged.simulated_robot.robot import Motors, SimulatedRobot, motors_config

ROBOT = load_robot("anymal_c")
DT = 0.005
DC = {
    "model": "dc_motor",
    "stall_torque": {"H": 120.0, "K": 110.0},
    "no_load_speed": {"H": 7.5, "K": 9.0},
    "armature": {"K": 0.1},
}
ROUGH = {"coulomb_friction": {"KFE": 1.2}, "breakaway_friction": {"KFE": 2.0}, "viscous_friction": {"H": 0.25}}
JOINTS = ROBOT.num_dof


def motors(dt=DT, counted=DT, **settings) -> Motors:
    return Motors(ROBOT, ActuatorConfig(**settings), dt, counted)


def command(target, stiffness=0.0, damping=0.0):
    return np.array([np.full(JOINTS, float(each)) for each in (target, stiffness, damping)])


def network(tmp_path, dt=DT) -> str:
    """A small MLP that sees two samples."""
    rng = np.random.default_rng(5)
    shapes = ((8, 4), (1, 8))
    layers = [{"weight": rng.normal(size=shape), "bias": rng.normal(size=shape[0])} for shape in shapes]
    NetworkWeights("mlp", dt, 2, np.array([2.0, 0.2, 20.0]), tuple(layers)).save(tmp_path / "net.npz")
    return str(tmp_path / "net.npz")


@pytest.mark.parametrize(
    "settings",
    [{}, DC, {**DC, "joints": ("HAA",)}, ROUGH, {**DC, **ROUGH, "delay": (3, 3)}, {"delay": (5, 5)}, {"network": True}],
    ids=["ideal", "curve", "curve of some", "friction", "all", "delay", "network"],
)
def test_torques_are_those_of_the_tasks_motors(settings, tmp_path):
    """Ten control steps of four physics steps, at angles and velocities out to twice the no-load speed."""
    if "network" in settings:
        settings = {"network": network(tmp_path), "joints": ("KFE",)}
    own = motors(**settings)
    control = Control(ROBOT, RobotControlConfig(actuator=ActuatorConfig(**settings)), torch.zeros(1, JOINTS), DT)
    random = torch.Generator().manual_seed(2)
    gains = np.stack([control.stiffness, control.damping]).astype(float)
    differ = 0.0
    for _ in range(10):
        actions = torch.randn(1, JOINTS, generator=random)
        control.set_actions(actions)
        asked = np.stack([(control.default_dof_pos + 0.5 * actions[0]).double().numpy(), *gains])
        for _ in range(4):
            q, dq = torch.randn(1, JOINTS, generator=random), 6.0 * torch.randn(1, JOINTS, generator=random)
            expected = control.compute(q, dq)[0].double().numpy()
            if control.actuator is not None and not own._past[-1].any():  # the task's begins with the target of action 0
                own._past[-1][:] = np.stack([ROBOT.default_dof_pos, *gains])
            found = own.torques(asked, q[0].double().numpy(), dq[0].double().numpy())
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3)
            differ = max(differ, np.ptp(found))
    assert differ > 50.0


def test_a_motor_gives_less_the_faster_it_turns():
    """120 N m at rest, none at 7.5 rad/s, at most 80 N m: 40 N m at 5 rad/s; beyond the end it only brakes."""
    turning = motors(model="dc_motor", stall_torque={"_": 120.0}, no_load_speed={"_": 7.5})
    speeds = np.array([0.0, 2.5, 5.0, 7.5, 10.0, -5.0] + [0.0] * (JOINTS - 6))
    found = turning.torques(command(10.0, stiffness=100.0), np.zeros(JOINTS), speeds)
    np.testing.assert_allclose(found[:6], [80.0, 80.0, 40.0, 0.0, -40.0, 80.0], atol=1e-9)


def test_a_command_arrives_after_its_delay_by_the_clock():
    """Four steps of 5 ms are ten of 2 ms; gains arrive with their target."""
    late = motors(dt=0.002, counted=DT, delay=(4, 4))
    assert late.delay == 10
    at_rest = np.zeros(JOINTS), np.zeros(JOINTS)
    found = [late.torques(command(1.0, stiffness=20.0), *at_rest)[0] for _ in range(12)]
    assert found == [0.0] * 10 + [20.0] * 2


def test_a_delay_is_drawn_within_its_range_and_arrived_commands_are_not_taken_back():
    assert {motors(delay=(1, 3)).delay for _ in range(3)} == {motors(delay=(1, 3)).delay}, "the same seed, the same delay"
    assert {Motors(ROBOT, ActuatorConfig(delay=(1, 3)), DT, DT, seed).delay for seed in range(30)} == {1, 2, 3}
    late, at_rest = motors(delay=(0, 6), delay_varies=True), (np.zeros(JOINTS), np.zeros(JOINTS))
    arrived, delays = [], set()
    for step in range(200):
        arrived.append(late.torques(command(1.0 + step // 4, stiffness=0.1), *at_rest)[0])
        delays.add(late.delay)
    assert delays == set(range(7))
    assert np.all(np.diff(arrived) >= 0.0)
    assert arrived[-1] >= 0.1 * (200 // 4 - 3)


def test_a_robot_that_brakes_is_not_driven_by_what_a_network_learned(tmp_path):
    learned = motors(network=network(tmp_path))
    q, dq = np.zeros(JOINTS), np.full(JOINTS, 2.0)
    np.testing.assert_allclose(learned.torques(command(1.0, damping=3.0), q, dq), -6.0)
    assert np.abs(learned.torques(command(1.0, 80.0, 3.0), q, dq) - 74.0).min() > 1.0


@pytest.fixture(scope="module")
def contract(tmp_path_factory):
    """The contract of a policy whose motors are late and slow."""
    changes = [(f"control.actuator.{key}", value) for key, value in {**DC, "delay": [2, 4]}.items()]
    task = small_task(*changes, ("train.policy.actor_hidden_dims", [8]), num_envs=1)
    folder = tmp_path_factory.mktemp("export")
    export(task, Runner(task).alg.get_policy(), folder)
    return read_contract(folder / "policy.json")


@pytest.mark.slow
def test_a_simulated_robot_has_the_motors_that_its_policy_was_trained_with(contract):
    cfg, counted = motors_config(ROBOT, contract, False, [], 0.002)
    assert (cfg.model, cfg.delay, cfg.stall_torque, counted) == ("dc_motor", (2, 4), DC["stall_torque"], DT)
    changed, _ = motors_config(ROBOT, contract, False, [("control.actuator.delay", [1, 1])], 0.002)
    assert (changed.model, changed.delay) == ("dc_motor", (1, 1))
    assert motors_config(ROBOT, contract, True, [], 0.002)[0] == ActuatorConfig()
    own, counted = motors_config(ROBOT, None, False, [("control.actuator.delay", [3, 3])], 0.002)
    assert (own.delay, counted) == ((3, 3), 0.002)


def test_the_network_of_the_motors_travels_with_the_policy(tmp_path):
    """The export is moved to another machine, which has no file of the training."""
    (tmp_path / "training").mkdir()
    learned = network(tmp_path / "training")
    task = small_task(
        ("control.actuator.network", learned), ("train.policy.actor_hidden_dims", [8]), ("sim.dt", DT), num_envs=1
    )
    export(task, Runner(task).alg.get_policy(), tmp_path / "export")
    (tmp_path / "export").rename(tmp_path / "moved")
    Path(learned).unlink()
    there = read_contract(tmp_path / "moved" / "policy.json")
    cfg, _ = motors_config(ROBOT, there, False, [], DT)
    assert cfg.network == str(tmp_path / "moved" / "motors.npz")
    assert np.isfinite(Motors(ROBOT, cfg, DT, DT).torques(command(0.5, 80.0, 2.0), np.zeros(JOINTS), np.zeros(JOINTS))).all()


def test_the_command_gives_the_robot_what_the_contract_says(contract):
    args = deploy.robot.build_parser().parse_intermixed_args(["anymal_c", "control.actuator.delay=[4, 4]"])
    robot, built = deploy.motors_of(args, ROBOT, contract)
    assert built.delay == 10
    simulated = SimulatedRobot(robot, None, SimConfig(dt=0.002), built)
    rotors = simulated.model.dof_armature[list(ROBOT.qvel_columns)]
    assert np.array_equal(rotors, np.where(["K" in name for name in ROBOT.joint_names], DC["armature"]["K"], 0.0))
    simulated.asked = command(ROBOT.default_dof_pos[0] + 1.0, 80.0, 2.0)
    for _ in range(10):
        simulated.step()
        assert not simulated.data.ctrl.any()
    simulated.step()
    assert simulated.data.ctrl.any()
    assert deploy.scan_of(None) == "lowest"
    term = SimpleNamespace(scan="highest")
    assert deploy.scan_of(SimpleNamespace(sources={"heights": term})) == "highest"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (["sim.dt=0.001"], "command line: sim.dt: a simulated robot takes only settings of control.actuator"),
        (["control.actuator.modell=dc_motor"], "unknown key 'modell'; did you mean 'model'?"),
        (["control.actuator.stall_torque={WHEEL: 3}"], "control.actuator.stall_torque: "),
        (["control.actuator.stall_torque={KFE: 3}"], "set control.actuator.model to dc_motor"),
        (["control.actuator.delay"], "command line: 'control.actuator.delay' is not of the form section.key=value"),
    ],
)
def test_wrong_changes_end_both_commands_with_one_line(changes, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call(deploy.robot.main, ["anymal_c", *changes]) == 2
    shown = capsys.readouterr().err
    assert says in shown
    assert len(shown.splitlines()) == 1
    assert call(deploy.sim.main, ["anymal_c_flat", *changes]) == 2
    assert says in capsys.readouterr().err


def test_a_network_says_which_step_it_needs(contract, tmp_path):
    own = {"control.actuator.network": network(tmp_path, dt=0.003)}
    with pytest.raises(ConfigError, match=r"steps of --sim-dt=0\.002; --sim-dt must be 0\.003"):
        motors_config(ROBOT, contract, False, own.items(), 0.002)


def test_motors_of_another_robot_are_refused_by_the_name_of_the_contract(contract):
    with pytest.raises(ConfigError) as refused:
        motors_config(load_robot("g1"), contract, False, [], 0.002)
    assert str(refused.value).startswith(f"{contract.path}: actuator: control.actuator.")
    assert json.loads(contract.path.read_text())["actuator"]["model"] == "dc_motor"
