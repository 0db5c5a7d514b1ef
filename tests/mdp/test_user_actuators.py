"""Actuator models of users: the one on the page, by its formula, in the chain, in a training; and their mistakes."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import assert_goes_on_alike, call, forget_modules_of, small_task, tiny_run
from test_actuator import DT, EFFORT, KERNELS, ROBOT, D, N, control, full

from legged import user_modules
from legged.cli.train import train
from legged.config.actuator import ActuatorConfig
from legged.config.loader import read_yaml
from legged.errors import ConfigError
from legged.mdp.actuators import ActuatorModel, model, register_actuator
from legged.simulated_robot.robot import Motors

pytestmark = pytest.mark.usefixtures("workplace", "lag")
PAGE = Path(__file__).resolve().parents[2] / "docs" / "actuators.md"
SETTING = "control.actuator.models.lag.time_constant"
TAU = 0.01


@pytest.fixture
def lag(workplace, tmp_path, monkeypatch):
    """The module of the page in the working directory, imported."""
    monkeypatch.setattr(model, "_REGISTERED", {})
    monkeypatch.setattr(user_modules, "_IMPORTED", set())
    (source,) = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    assert len(source.splitlines()) <= 60
    Path("lag.py").write_text(source, encoding="utf-8")
    user_modules.run_module("lag.py")
    yield
    forget_modules_of(tmp_path)


@KERNELS
@pytest.mark.parametrize("law", ["P", "T"])
def test_a_torque_that_lags_follows_the_exponential(kernels, law):
    """10 N m asked for from the first step on: after k steps 10 (1 - exp(-k dt / tau)) at the knees; at other joints all."""
    made = control(kernels, law, models={"lag": {"time_constant": {"KFE": TAU}}})
    knees = ["KFE" in name for name in ("LF_HAA", "LF_HFE", "LF_KFE") * 4]
    made.set_actions(full(0.1 if law == "P" else 10.0))
    for k in range(1, 6):
        found = made.compute(full(0.0), full(0.0))
        wanted = torch.where(torch.tensor(knees), 10.0 * (1.0 - math.exp(-k * DT / TAU)), 10.0)
        torch.testing.assert_close(found, wanted.expand(N, D))
    made.reset(torch.arange(N) < 3)
    assert made.actuator.own["lag"].given[:, 2].unique().tolist() == [0.0, pytest.approx(found[5, 2].item())]


@KERNELS
def test_a_model_gets_what_the_built_in_ones_give_and_no_joint_bears_more_than_its_limit(kernels):
    """200 N m asked for, 80 given, 2 of them to friction: the lag's first step is (1 - exp(-1/2)) of 78."""

    @register_actuator("twice")
    class Twice(ActuatorModel):
        Settings = model._REGISTERED["lag"].Settings

        def __init__(self, settings, motors):
            pass

        def torques(self, torques, step):
            assert step.target.shape == step.dof_vel.shape == (N, D)
            return 2.0 * torques

    of_all = {"lag": {"time_constant": {"K": TAU, "H": TAU}}}
    made = control(kernels, coulomb_friction={"K": 2.0, "H": 2.0}, delay=(1, 1), models=of_all)
    made.set_actions(full(2.02))
    speed = full(1.0)  # tanh(1 / 0.1) is 1 in float32
    first = made.compute(full(0.0), speed)  # the target of action 0 still: -2 N m of damping, and as much friction
    torch.testing.assert_close(first, full(-4.0 * (1.0 - math.exp(-0.5))))
    before = first[0, 0].item()
    torch.testing.assert_close(made.compute(full(0.0), speed), full(before + (78.0 - before) * (1.0 - math.exp(-0.5))))
    made = control(kernels, models={"twice": {}, "lag": None})
    made.set_actions(full(0.6))
    assert list(made.actuator.own) == ["twice"]
    assert made.compute(full(0.0), full(0.0)).unique().tolist() == [EFFORT]


@KERNELS
def test_a_model_may_change_the_targets(kernels):
    @register_actuator("deaf")
    class Deaf(ActuatorModel):
        Settings = model._REGISTERED["lag"].Settings

        def __init__(self, settings, motors):
            pass

        def targets(self, targets):
            return torch.where(targets.abs() < 0.2, 0.0, targets)

    made = control(kernels, models={"deaf": {}})
    for action, torque in ((0.1, 0.0), (0.3, 30.0)):
        made.set_actions(full(action))
        torch.testing.assert_close(made.compute(full(0.0), full(0.0)), full(torque))


def test_a_training_with_a_model_of_ones_own_runs_and_resumes():
    folder = tiny_run("--import", "lag.py", f"{SETTING}={{KFE: 0.01}}", iterations=2)
    of_run = read_yaml(folder / "config.yaml")["control"]["actuator"]["models"]
    assert of_run == {"lag": {"time_constant": {"KFE": 0.01}}}
    task = assert_goes_on_alike([(SETTING, {"KFE": 0.1})], 0.5 * torch.randn(6, 4, 12))
    assert task.control.actuator.own["lag"].given.abs().max() > 1.0
    assert task.control.actuator.describe(2) == "lag 0.1 s"
    assert task.control.actuator.describe(0) == "ideal motor"


def test_a_simulated_robot_has_the_model_too():
    """Gains 100 and a target of 0.1 rad: the second step of 10 N m."""
    motors = Motors(ROBOT, ActuatorConfig(models={"lag": {"time_constant": {"KFE": TAU}}}), DT, DT)
    command, still = np.stack([np.full(D, 0.1), np.full(D, 100.0), np.full(D, 2.0)]), np.zeros(D)
    motors.torques(command, still, still)
    found = motors.torques(command, still, still)
    assert found.tolist() == pytest.approx([10.0, 10.0, 10.0 * (1.0 - math.exp(-2.0 * DT / TAU))] * 4)


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("control.actuator.models.lagg", {}, "there is no actuator model 'lagg'; did you mean 'lag'? (models: lag)"),
        ("control.actuator.models.lag", 3, "expected a mapping with keys of LagSettings, got 3"),
        ("control.actuator.models.lag.tau", 3, "unknown key 'tau'"),
        (SETTING, {"KFE": 2.0}, "must be at most 1, got 2"),
        (SETTING, {"knee": 0.1}, "pattern 'knee' matches nothing"),
    ],
)
def test_a_wrong_setting_of_a_model_is_one_line_that_names_it(path, value, said):
    with pytest.raises(ConfigError) as error:
        small_task((path, value))
    assert str(error.value).startswith(f"command line: {path}")
    assert said in str(error.value)


def test_a_model_that_was_not_imported_is_asked_for(capsys):
    model._REGISTERED.clear()
    code = call(train.main, ["--task", "anymal_c_flat", f"{SETTING}={{KFE: 0.01}}", "--show"])
    assert code == 2
    assert "models.lag: there is no actuator model 'lag' (models: none); --import names the module" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [
        ("a.b", ActuatorModel, "no dots; got 'a.b'"),
        ("mine", int, "expected a subclass of ActuatorModel, got <class 'int'>"),
        ("mine", ActuatorModel, "ActuatorModel.Settings must be a dataclass"),
    ],
)
def test_what_is_no_model_is_not_registered(name, kind, said):
    with pytest.raises(ConfigError, match=re.escape(said)):
        register_actuator(name)(kind)
