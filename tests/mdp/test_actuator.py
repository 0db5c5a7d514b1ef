"""Motors that are not ideal: torque over speed, friction and delay by numbers worked by hand, with and without kernels."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import assert_goes_on_alike, small_task

from legged.config import override
from legged.config.actuator import ActuatorConfig
from legged.config.loader import from_dict
from legged.config.robot import RobotControlConfig
from legged.errors import ConfigError
from legged.mdp.actuators.actuator import is_ideal
from legged.mdp.actuators.friction import Friction
from legged.mdp.actuators.motor_curve import MotorCurve, check_motor_model
from legged.mdp.actuators.network import NetworkWeights
from legged.mdp.control import Control
from legged.mdp.kernels.task import TaskKernels
from legged.mdp.random_pool import RandomPool
from legged.robots.robot import load_robot

N, D, DT = 8, 12, 0.005
ROBOT = load_robot("anymal_c")
ROBOT = replace(ROBOT, default_dof_pos=np.zeros(D), inertia=np.ones(D))  # numbers are round, and no motor is too strong
EFFORT = 80.0  # of ANYmal C's joints [N m]
KERNELS = pytest.mark.parametrize("kernels", [None, TaskKernels(nullcontext)], ids=["torch", "kernels"])


def control(kernels=None, law="P", decimation=4, **actuator) -> Control:
    """The control of N robots with gains 100 and 2, drawn delays among them."""
    numbers = RandomPool(N, torch.device("cpu"))
    gains = {"stiffness": {"H": 100.0, "K": 100.0}, "damping": {"H": 2.0, "K": 2.0}, "action_scale": 1.0}
    cfg = RobotControlConfig(decimation, control_type=law, actuator=ActuatorConfig(**actuator), **gains)
    made = Control(ROBOT, cfg, torch.zeros(N, D), DT, kernels, numbers)
    numbers.allocate()
    made.numbers = numbers
    return made


def full(value: float) -> torch.Tensor:
    return torch.full((N, D), value)


@pytest.mark.parametrize(
    ("speed", "low", "high"),
    [
        (0.0, -80.0, 80.0),  # at rest the stall torque of 120 is more than the joint bears
        (2.5, -80.0, 80.0),  # where the line 120 (1 - v / 7.5) crosses 80
        (5.0, -80.0, 40.0),  # two thirds of the way to the no-load speed
        (-5.0, -40.0, 80.0),
        (7.5, -80.0, 0.0),
        (10.0, -80.0, -40.0),  # driven beyond: the motor can only brake
        (100.0, -80.0, -80.0),  # but by no more than the joint bears
    ],
)
def test_a_motor_gives_less_the_faster_it_turns(speed, low, high):
    curve = MotorCurve(torch.tensor([120.0]), torch.tensor([7.5]))
    found = curve.limits(torch.tensor([[speed]]), torch.tensor([80.0]))
    assert [limit.item() for limit in found] == pytest.approx([low, high], abs=1e-4)


@pytest.mark.slow
@KERNELS
def test_torques_stay_on_the_line_of_the_motor(kernels):
    made = control(kernels, model="dc_motor", stall_torque={"H": 120.0, "K": 120.0}, no_load_speed={"H": 7.5, "K": 7.5})
    angle = made.default_dof_pos.expand(N, D)
    made.set_actions(full(1.0))  # 100 N m asked for at rest
    assert made.compute(angle, full(0.0)).unique().tolist() == [80.0]
    assert made.compute(angle, full(5.0)).unique().tolist() == pytest.approx([40.0], abs=1e-4)  # of 100 - 2 * 5
    assert made.compute(angle, full(-5.0)).unique().tolist() == [80.0]
    made.set_actions(full(0.1))
    assert made.compute(angle, full(1.0)).unique().tolist() == pytest.approx([8.0], abs=1e-4)  # 10 - 2 is within the limits


@KERNELS
def test_no_load_speeds_may_differ_from_robot_to_robot(kernels):
    """120 N m at rest and none at 7.5 rad/s, or at 3.75 of every second robot: at 2.5 rad/s 80, or 40."""
    made = control(kernels, model="dc_motor", stall_torque={"H": 120.0, "K": 120.0}, no_load_speed={"H": 7.5, "K": 7.5})
    factor = torch.ones(N, 1)
    for changed in (0.7, 0.5):  # the second time in place
        factor[1::2] = changed
        made.actuator.curve.vary(factor)
    made.reset(torch.ones(N, dtype=torch.bool))
    made.set_actions(full(5.0))
    found = made.compute(full(0.0), full(2.5))
    torch.testing.assert_close(found[::2], full(80.0)[::2])
    torch.testing.assert_close(found[1::2], full(40.0)[1::2])


@pytest.mark.slow
def test_velocity_limits_that_are_drawn_are_the_motors_own():
    task = small_task(("control.actuator.model", "dc_motor"), ("domain_rand.ranges", {"velocity_limit": [0.8, 0.8]}))
    curve = task.control.actuator.curve
    torch.testing.assert_close(curve.no_load_speed, 0.8 * curve.nominal_speed.expand_as(task.dof_vel))
    torch.testing.assert_close(curve.no_load_speed, task.dof_vel_limits)


@KERNELS
def test_ideal_motors_give_what_is_drawn_for_their_joints(kernels):
    made = control(kernels, model="dc_motor", joints=("KFE",))
    made.vary({"torque_limit": torch.full((N,), 1.5)})
    made.set_actions(full(2.0))  # 200 asked for
    ideal = torch.tensor(["KFE" not in name for name in ROBOT.joint_names])
    found = made.compute(made.default_dof_pos.expand(N, D), full(0.0))
    assert found[:, ideal].unique().tolist() == [1.5 * EFFORT]
    assert found[:, ~ideal].unique().tolist() == [EFFORT], "a motor's stall torque is not the joint's limit"


def test_stall_torque_and_no_load_speed_are_the_robots_unless_named():
    made = control(model="dc_motor", joints=("HFE",), no_load_speed={"LF_HFE": 5.0})
    curve = made.actuator.curve
    of = dict(zip(ROBOT.joint_names, curve.no_load_speed.tolist(), strict=True))
    assert (of["LF_HFE"], of["RF_HFE"], of["LF_HAA"]) == (5.0, 20.0, np.inf)
    assert curve.stall_torque.tolist() == [EFFORT if "HFE" in name else np.inf for name in ROBOT.joint_names]


def test_friction_by_hand():
    friction = Friction(torch.tensor([2.0]), torch.tensor([3.0]), torch.tensor([0.5]), stribeck_velocity=0.2, smoothing=0.1)
    speeds = torch.tensor([[0.0, 0.2, -0.2, 10.0]]).T
    at_02 = (2.0 + 1.0 * np.exp(-1.0)) * np.tanh(2.0) + 0.5 * 0.2
    assert friction.resistance(speeds)[:, 0].tolist() == pytest.approx([0.0, at_02, -at_02, 2.0 + 5.0], rel=1e-6)


@KERNELS
def test_friction_is_taken_from_what_the_motor_gives(kernels):
    made = control(kernels, coulomb_friction={"KFE": 2.0}, viscous_friction={"KFE": 0.5})
    knees = torch.tensor(["KFE" in name for name in ROBOT.joint_names])
    angle = made.default_dof_pos.expand(N, D)
    made.set_actions(full(2.0))  # 200 asked for, 80 given
    found = made.compute(angle, full(4.0))
    assert found[:, knees].unique().tolist() == pytest.approx([80.0 - 2.0 - 2.0], rel=1e-6)
    assert found[:, ~knees].unique().tolist() == [80.0]
    assert made.compute(angle, full(-4.0)).unique().tolist() == [80.0]  # the joint bears no more


@KERNELS
@pytest.mark.parametrize("law", ["P", "V", "T"])
def test_a_delay_of_two_steps_shifts_a_step_of_the_target_by_two(kernels, law):
    made, prompt = control(kernels, law, delay=(2, 2)), control(kernels, law)
    angle, still, found = made.default_dof_pos.expand(N, D), full(0.0), {made: [], prompt: []}
    for action in (0.0, 0.3, 0.3, -0.2):
        for each, torques in found.items():
            each.set_actions(full(action))
            torques += [each.compute(angle, still)[0, 0].item() for _ in range(4)]
    assert len(set(found[prompt])) == 3
    assert found[made][2:] == found[prompt][:-2]
    assert found[made][:2] == [0.0, 0.0]


@pytest.mark.parametrize("delay", [1, 3, 4, 5, 8, 11])
def test_any_delay_is_a_shift(delay):
    made, prompt = control(delay=(delay, delay), decimation=4), control()
    angle, still, found = made.default_dof_pos.expand(N, D), full(0.0), {made: [], prompt: []}
    for k in range(8):
        for each, torques in found.items():
            each.set_actions(full(0.05 * (k + 1)))
            torques += [each.compute(angle, still)[0, 0].item() for _ in range(4)]
    assert found[made] == [0.0] * delay + found[prompt][:-delay]


def test_delays_are_drawn_at_a_reset_and_held_in_between():
    made = control(delay=(1, 6))
    seen, everyone = [], torch.ones(N, dtype=torch.bool)
    for k in range(40):
        made.numbers.draw()
        mask = everyone if k % 4 == 0 else torch.zeros_like(everyone)
        before = made.actuator.delay.clone()
        made.reset(mask)
        assert k % 4 == 0 or torch.equal(made.actuator.delay, before)
        seen.append(made.actuator.delay.clone())
    assert torch.stack(seen).unique().tolist() == [1, 2, 3, 4, 5, 6]


def test_a_varying_delay_never_takes_a_target_back():
    torch.manual_seed(0)
    made = control(delay=(0, 11), delay_varies=True)
    made.numbers.draw()
    made.reset(torch.ones(N, dtype=torch.bool))
    angle, newest, delays = made.default_dof_pos.expand(N, D), full(-1.0), []
    for k in range(60):
        made.set_actions(full(0.01 * k))
        for _ in range(4):
            found = made.compute(angle, full(0.0)).clone()
            assert (found >= newest).all()
            newest = found
        made.numbers.draw()
        made.reset(torch.zeros(N, dtype=torch.bool))
        delays.append(made.actuator.delay.clone())
    assert len(torch.stack(delays).unique()) == 12


def test_a_reset_forgets_the_targets_on_their_way():
    made = control(delay=(4, 4))
    angle = made.default_dof_pos.expand(N, D)
    for _ in range(3):
        made.set_actions(full(0.5))
        made.compute(angle, full(0.0))
    mask = torch.arange(N) < 3
    made.reset(mask)
    made.set_actions(full(0.2))
    found = made.compute(angle, full(0.0))
    assert found[mask].unique().tolist() == [0.0]
    assert found[~mask].unique().tolist() == [50.0]


@KERNELS
def test_after_a_reset_joints_hold_what_their_encoders_show_as_default(kernels):
    """An encoder that shows 0.1 rad too much, gains 100: at the true angle 0 the law sees 0.1 rad and asks for -10 N m, until
    a target arrives.
    """
    made = control(kernels, delay=(4, 4))
    made.vary({"joint_offset": torch.full((N,), 0.1)})
    made.reset(torch.ones(N, dtype=torch.bool))
    made.set_actions(full(0.5))
    torch.testing.assert_close(made.compute(full(0.0), full(0.0)), full(-10.0))
    for _ in range(3):
        made.compute(full(0.0), full(0.0))
    torch.testing.assert_close(made.compute(full(0.0), full(0.0)), full(40.0))


@pytest.mark.slow
def test_kernels_and_torch_agree():
    """Bit by bit but for the friction, whose exponential and tangent are other libraries'."""
    plain = dict(model="dc_motor", joints=("HFE", "KFE"), no_load_speed={"H": 6.0, "K": 4.0}, delay=(0, 9))
    rough = dict(coulomb_friction={"H": 1.0, "K": 2.0}, breakaway_friction={"K": 3.0}, viscous_friction={"K": 0.3})
    for actuator, within in ((plain, 0.0), (plain | rough, 1e-5)):
        laws = [control(kernels, **actuator) for kernels in (None, TaskKernels(nullcontext))]
        state = torch.randn(30, 2, N, D)
        state[7, 1, 3, 5] = torch.nan
        hits = 0
        for k in range(30):
            torch.manual_seed(k)
            laws[0].numbers.draw()
            laws[1].numbers._values.copy_(laws[0].numbers._values)
            for each in laws:
                each.reset(torch.arange(N) == k % 11)
                each.set_actions(state[k - 1, 0])
            for _ in range(4):
                found = [each.compute(0.3 * state[k, 0], 5.0 * state[k, 1]) for each in laws]
                torch.testing.assert_close(*found, rtol=0.0, atol=within, equal_nan=True)
                hits += (found[0].abs() == EFFORT).sum()
        assert hits > 20


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
def test_networks_by_kernels_and_by_torch_agree(kind, tmp_path):
    random = np.random.default_rng(0)

    def weights(*shape):
        return random.standard_normal(shape).astype(np.float32) / 2.0

    if kind == "mlp":
        layers = [{"weight": weights(b, a), "bias": weights(b)} for a, b in ((6, 8), (8, 5), (5, 1))]
    else:
        cells = [
            {"input": weights(4 * b, a), "hidden": weights(4 * b, b), "bias": weights(4 * b)} for a, b in ((2, 6), (6, 4))
        ]
        layers = [*cells, {"weight": weights(1, 4), "bias": weights(1)}]
    scales, samples = np.array([2.0, 0.3, 20.0], np.float32), 3 if kind == "mlp" else 1
    path = tmp_path / "network.npz"
    NetworkWeights(kind, 2 * DT if kind == "mlp" else DT, samples, scales, tuple(layers)).save(path)
    laws = [control(k, network=str(path), joints=("KFE",), delay=(1, 1)) for k in (None, TaskKernels(nullcontext))]
    state = torch.randn(12, 2, N, D)
    for k in range(12):
        for law in laws:
            law.reset(torch.arange(N) == k)
            law.set_actions(0.3 * state[k - 1, 0])
        for _ in range(4):
            found = [law.compute(0.3 * state[k, 0], state[k, 1]) for law in laws]
            torch.testing.assert_close(*found, rtol=1e-5, atol=1e-4)
    assert found[0].std() > 1.0
    torch.testing.assert_close(*(law.actuator.past for law in laws), rtol=1e-5, atol=1e-5)


def test_ideal_motors_are_the_control_law_itself():
    assert is_ideal(ActuatorConfig())
    assert is_ideal(ActuatorConfig(coulomb_friction={"K": 0.0}, delay_varies=True))
    assert control().actuator is None
    for setting in ({"model": "dc_motor"}, {"delay": (0, 1)}, {"viscous_friction": {"K": 0.1}}, {"network": "x.npz"}):
        assert not is_ideal(replace(ActuatorConfig(), **setting))


@pytest.mark.slow
def test_a_task_with_every_model_is_checked_walks_and_resumes():
    settings = [
        ("control.actuator.model", "dc_motor"),
        ("control.actuator.no_load_speed", {"HAA": 8.0, "HFE": 8.0, "KFE": 9.0}),
        ("control.actuator.armature", {"KFE": 0.05}),
        ("control.actuator.coulomb_friction", {"KFE": 1.0}),
        ("control.actuator.delay", [0, 6]),
        ("control.actuator.delay_varies", True),
    ]
    task = assert_goes_on_alike(settings, 0.5 * torch.randn(12, 4, 12))
    assert task.control.actuator.delay.unique().numel() > 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("control.actuator.model", "dcmotor", "did you mean 'dc_motor'"),
        ("control.actuator.stall_torque", {"HFF": 10.0}, "pattern 'HFF' matches nothing"),
        ("control.actuator.coulomb_friction", {"KFE": -1.0}, "must be at least 0"),
        ("control.actuator.joints", ["knee"], "pattern 'knee' matches nothing"),
        ("control.actuator.delay", [3, 1], "expected [low, high] with low <= high"),
        ("control.actuator.delay", [0.5, 1], "expected a whole number"),
        ("control.actuator.delays", [0, 1], "unknown key 'delays'"),
        ("control.actuator.network", "missing.npz", "missing.npz: No such file"),
        ("control.actuator.stall_torque", {"KFE": 60.0}, "set control.actuator.model to dc_motor"),
        ("control.actuator.no_load_speed", {"KFE": 9.0}, "set control.actuator.model to dc_motor"),
    ],
)
def test_wrong_settings_are_one_line_that_names_them(path, value, said):
    with pytest.raises(ConfigError) as error:
        small_task((path, value))
    assert str(error.value).startswith(f"command line: {path}")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_who_says_ideal_may_leave_the_numbers_of_a_line():
    """So motors of a task with a torque-speed line are tried without it."""
    task = small_task(("control.actuator.stall_torque", {"KFE": 60.0}), ("control.actuator.model", "ideal"))
    assert task.control.actuator is None


def given_and_changed(given, *changes):
    """A configuration of a file, as that of a run is, and what the command line changes of it."""
    data = {"task": "anymal_c_flat", "robot": "anymal_c", "control": {"actuator": given}}
    return override(from_dict(data, source="config.yaml"), changes)


def test_motors_that_a_run_says_are_ideal_are_given_no_line_in_silence():
    """The configuration of a run says everything, also what nobody had set."""
    cfg = given_and_changed({"model": "ideal"}, ("control.actuator.no_load_speed", {"KFE": 9.0}))
    with pytest.raises(ConfigError, match=r"command line: control\.actuator\.no_load_speed: .*set control\.actuator\.model"):
        check_motor_model(cfg.control.actuator, cfg.origins)
    line = {"model": "dc_motor", "no_load_speed": {"KFE": 9.0}}
    for changes in ([], [("control.actuator.model", "ideal")], [("control.actuator.stall_torque", {"KFE": 60.0})]):
        cfg = given_and_changed(line, *changes)
        check_motor_model(cfg.control.actuator, cfg.origins)


def test_a_joint_needs_no_less_to_begin_to_move_than_to_go_on():
    rough = dict(coulomb_friction={"H": 1.0, "KFE": 2.0}, breakaway_friction={"HFE": 1.5, "KFE": 1.5})
    with pytest.raises(
        ConfigError, match=r"breakaway_friction: 1.5 N m for 'LF_KFE' is less than its coulomb_friction of 2 N m"
    ):
        control(**rough)
