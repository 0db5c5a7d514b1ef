"""Actuators fitted to logs: of a simulated motor whose numbers are known, and of logs that are none."""

import json
import re

import numpy as np
import pytest
import torch
import yaml
from helpers import call, small_task
from simulated_motor import TRUTH, simulated_log

from legged.cli.fit_actuator import fit_actuator
from legged.config import load_config
from legged.errors import ConfigError
from legged.fitting.log import check_alike, read_log
from legged.fitting.parametric import SMOOTHING, Drive, delayed, fit_drive
from legged.mdp.actuators.friction import Friction
from legged.mdp.actuators.motor_curve import MotorCurve
from legged.mdp.actuators.network import NetworkWeights

pytestmark = pytest.mark.usefixtures("workplace")


def write(tmp_path, **changes):
    """A log with some arrays in the place of those that were simulated; None leaves one out."""
    arrays = {**simulated_log(4.0), **changes}
    np.savez(tmp_path / "log.npz", **{name: value for name, value in arrays.items() if value is not None})
    return tmp_path / "log.npz"


@pytest.mark.slow
def test_the_motor_that_was_simulated_is_found_within_5_percent(tmp_path):
    np.savez(tmp_path / "log.npz", **simulated_log(12.0, noise=0.2))
    drive = fit_drive(read_log(tmp_path / "log.npz"), longest_delay=0.02)
    found = {name: getattr(drive, name) for name in TRUTH}
    assert found == pytest.approx(TRUTH, rel=0.05)


@pytest.mark.slow
def test_a_peak_of_the_friction_that_the_log_does_not_show_is_not_invented(tmp_path, capsys):
    """Dry friction alike at all speeds once came out as 4.4 N m below 0.005 rad/s, or as none beyond 5 rad/s."""
    np.savez(tmp_path / "log.npz", **simulated_log(12.0, noise=1.0, breakaway=TRUTH["coulomb"]))
    drive = fit_drive(read_log(tmp_path / "log.npz"), longest_delay=0.02)
    assert drive.coulomb == drive.breakaway == pytest.approx(TRUTH["coulomb"], rel=0.05)
    assert drive.viscous == pytest.approx(TRUTH["viscous"], rel=0.05)
    flags = ["--updates", "5", "--out", "fit", "--longest-delay", "0.01"]
    assert fit_actuator.main([str(tmp_path / "log.npz"), *flags]) == 0
    assert re.search(
        r"friction: 1\.\d+ N m \(the log shows no higher breakaway torque\), viscous 0\.2", capsys.readouterr().out
    )


@pytest.mark.slow
def test_unknown_gains_are_found_too_with_the_viscous_friction_in_them(tmp_path):
    arrays = simulated_log(12.0, noise=0.1)
    np.savez(tmp_path / "log.npz", **{name: a for name, a in arrays.items() if name not in ("stiffness", "damping")})
    drive = fit_drive(read_log(tmp_path / "log.npz"), longest_delay=0.015)
    assert drive.stiffness == pytest.approx(60.0, rel=0.05)
    assert drive.damping == pytest.approx(1.5 + 0.25, rel=0.08)
    assert drive.delay == pytest.approx(0.0075, rel=0.05)
    assert drive.viscous == 0.0


def test_a_limit_that_the_log_does_not_reach_is_not_invented(tmp_path):
    log = read_log(write(tmp_path))
    weak = Drive(60.0, 1.5, 1.2, 2.0, 0.3, 0.25, delay=0.0075)
    small = 0.1 * log.target
    calm = type(log)(
        log.joint_names,
        log.dt,
        log.run,
        small,
        0.0 * small,
        0.1 * log.velocity,
        0.0 * small,
        *[np.array(g) for g in ([60.0] * 2, [1.5] * 2)],
    )
    calm = type(calm)(**{**vars(calm), "torque": weak.predict(calm)})
    found = fit_drive(calm, longest_delay=0.015)
    assert np.isinf(found.stall_torque)
    assert found.delay == pytest.approx(0.0075, rel=0.05)


def test_the_drive_is_the_actuator_of_the_task():
    drive = Drive(50.0, 2.0, 1.0, 1.5, 0.2, 0.3, 40.0, 12.0, 35.0)
    velocity, error = np.linspace(-20.0, 20.0, 101), np.linspace(1.0, -1.0, 101)
    stall, fastest, effort = (torch.tensor([value]) for value in (40.0, 12.0, 35.0))
    speeds = torch.tensor(velocity, dtype=torch.float32).unsqueeze(1)
    low, high = MotorCurve(stall, fastest).limits(speeds, effort)
    asked = torch.tensor(50.0 * error - 2.0 * velocity, dtype=torch.float32).unsqueeze(1)
    friction = Friction(*[torch.tensor([v]) for v in (1.0, 1.5, 0.3)], 0.2, SMOOTHING)
    wanted = torch.minimum(torch.maximum(asked, low), high) - friction.resistance(speeds)
    np.testing.assert_allclose(drive.torques(error, velocity), wanted[:, 0].numpy(), atol=1e-4)


def test_targets_are_delayed_within_their_run(tmp_path):
    log = read_log(write(tmp_path, run=np.repeat([0, 1], 800)))
    target = np.arange(1600.0)[:, None].repeat(2, 1)
    log = type(log)(**{**vars(log), "target": target})
    assert delayed(log, 2.0)[[0, 1, 5, 800, 801, 805], 0].tolist() == [0.0, 0.0, 3.0, 800.0, 800.0, 803.0]
    assert delayed(log, 2.5)[5, 0] == 2.5


def test_held_out_samples_are_blocks_of_time_or_whole_runs(tmp_path):
    held = read_log(write(tmp_path)).held_out
    assert np.flatnonzero(np.diff(held.astype(int))).tolist() == [639, 799, 1439]  # the fifth and the tenth tenth
    held = read_log(write(tmp_path, run=np.repeat(np.arange(10), 160))).held_out
    assert sorted(set(np.flatnonzero(held) // 160)) == [4, 9]


@pytest.mark.parametrize(
    ("lengths", "kept"),
    [
        ([25, 25, 25, 25, 500], [0, 1, 2, 3]),  # 100 of 600; the fifth run alone is 500
        ([390, 390, 390, 390, 10], [3, 4]),  # 400 of 1570; the fifth run alone is 10
        ([100, 50, 150, 300, 150, 200, 50], [1, 4]),  # exactly a fifth of 1000
    ],
)
def test_a_fifth_of_the_samples_is_held_out_however_long_the_runs_are(tmp_path, lengths, kept):
    log = read_log(write(tmp_path))
    rows = {name: getattr(log, name)[: sum(lengths)] for name in ("target", "position", "velocity", "torque")}
    log = type(log)(**{**vars(log), **rows, "run": np.repeat(np.arange(len(lengths)), lengths)})
    assert sorted(set(log.run[log.held_out])) == kept
    assert log.held_out.sum() == sum(lengths[i] for i in kept)
    again = log.resampled(0.005)
    assert sorted(set(again.run[again.held_out])) == kept  # what is fitted to one is judged on the same runs of the other


def test_of_a_log_that_is_nearly_all_one_run_blocks_of_time_are_held_out(tmp_path):
    log = read_log(write(tmp_path, run=np.repeat(np.arange(5), [10, 10, 1560, 10, 10])))
    assert log.held_out.sum() == 4 * 2 + 312
    assert set(log.run[~log.held_out]) == set(range(5))


def test_a_run_whose_number_comes_back_is_another_one(tmp_path):
    """As where two logs were put together, each of which begins with run 0: nothing lies between their ends."""
    run = np.repeat([0, 1, 0], [802, 398, 400])
    position = np.where(run == 1, 5.0, np.repeat([0.0, 0.0, 1.0], [802, 398, 400]))[:, None] * np.ones(2)
    log = read_log(write(tmp_path, run=run, position=position))
    assert [rows.tolist() for rows in np.unique(log.run, return_counts=True)] == [[0, 1, 2], [802, 398, 400]]
    assert set(log.resampled(0.004).position.ravel()) == {0.0, 5.0, 1.0}, "not half-way between two runs"


def test_a_log_is_resampled_without_looking_ahead(tmp_path):
    log = read_log(write(tmp_path))
    half = log.resampled(0.00375)
    assert len(half.run) == 1067  # 3.9975 s of 3.75 ms
    assert half.target[1, 0] == log.target[1, 0]  # at 3.75 ms the target of 2.5 ms
    assert half.position[1, 0] == pytest.approx(0.5 * (log.position[1, 0] + log.position[2, 0]))
    with pytest.raises(ConfigError, match=r"--dt: must be at least 0.0025 s"):
        log.resampled(0.001)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mlp", "lstm"])
def test_the_command_writes_what_a_task_reads(tmp_path, kind, capsys):
    np.savez(tmp_path / "log.npz", **simulated_log(6.0))
    flags = ["--joints", "joint_0,joint_1", "--kind", kind, "--updates", "150", "--out", "fit", "--longest-delay", "0.01"]
    assert fit_actuator.main([str(tmp_path / "log.npz"), *flags]) == 0
    said = capsys.readouterr().out
    assert "motor: 4" in said
    assert "network" in said
    judged = json.loads((tmp_path / "fit" / "fit.json").read_text())["held_out"]
    assert judged["parametric"]["rmse"] < 0.5 < judged["network"]["rmse"] < judged["ideal PD"]["rmse"]
    assert (tmp_path / "fit" / "fit.png").stat().st_size > 10_000
    section = yaml.safe_load((tmp_path / "fit" / "actuator.yaml").read_text())["control"]["actuator"]
    assert section["delay"] == [1, 2]  # 7.5 ms at 5 ms a step
    renamed = {
        f"control.actuator.{key}": {"KFE": value["joint_0"]} if isinstance(value, dict) else value
        for key, value in section.items()
    }
    renamed["control.actuator.joints"] = ["KFE"]
    task = small_task(*renamed.items(), ("control.actuator.network", "fit/network.npz"))
    task.step(torch.zeros(4, 12))
    assert task.control.actuator.learned.network.kind == kind
    assert torch.isfinite(task.torques).all()


@pytest.mark.slow
def test_a_network_in_a_task_gives_what_the_fit_says_of_it(tmp_path):
    """The torques of a task, step by step, are those of the same network as plain torch runs it on the whole history."""
    np.savez(tmp_path / "log.npz", **simulated_log(6.0))
    fit_actuator.main([str(tmp_path / "log.npz"), "--updates", "50", "--hidden", "8,6,4", "--out", "fit"])
    weights = NetworkWeights.load("fit/network.npz")
    assert [layer["weight"].shape[0] for layer in weights.layers] == [8, 6, 4, 1]
    task = small_task(("control.actuator.network", "fit/network.npz"), ("control.clip_actions", 1.0))
    law = task.control
    torch.manual_seed(0)
    angles, speeds, actions = 0.1 * torch.randn(3, 12, 4, 12)
    errors = []
    law.reset(torch.ones(4, dtype=torch.bool))
    for k in range(12):
        law.set_actions(actions[k])
        found = law.compute(angles[k], speeds[k]).clone()
        errors.append(law.actuator.line.newest - angles[k])
    seen = [e * float(weights.scales[0]) for e in (errors[11], errors[9], errors[7])]
    seen += [v * float(weights.scales[1]) for v in (speeds[11], speeds[9], speeds[7])]
    x = torch.stack(seen, dim=2)
    for i, layer in enumerate(weights.layers):
        x = x @ torch.tensor(layer["weight"]).T + torch.tensor(layer["bias"])
        x = torch.nn.functional.softsign(x) if i < 3 else x
    wanted = (x[..., 0] * float(weights.scales[2])).clamp(-80.0, 80.0)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


def test_the_file_is_looked_for_beside_the_yaml_that_names_it(tmp_path, monkeypatch):
    layers = ({"weight": np.zeros((1, 2), np.float32), "bias": np.ones(1, np.float32)},)
    (tmp_path / "mine").mkdir()
    NetworkWeights("mlp", 0.005, 1, np.ones(3, np.float32), layers).save(tmp_path / "mine" / "ones.npz")
    (tmp_path / "mine" / "own.yaml").write_text("extends: anymal_c_flat\ncontrol: {actuator: {network: ones.npz}}\n")
    cfg = load_config(tmp_path / "mine" / "own.yaml", "own")
    assert cfg.control.actuator.network == str(tmp_path / "mine" / "ones.npz")
    cfg = load_config(tmp_path / "mine" / "own.yaml", "own", [("control.actuator.network", "mine/ones.npz")])
    assert cfg.control.actuator.network == str(tmp_path / "mine" / "ones.npz")


def test_an_lstm_in_a_task_is_torchs():
    torch.manual_seed(0)
    cells, last = [torch.nn.LSTM(2, 8), torch.nn.LSTM(8, 8)], torch.nn.Linear(8, 1)
    layers = [
        {
            "input": c.weight_ih_l0.detach().numpy(),
            "hidden": c.weight_hh_l0.detach().numpy(),
            "bias": (c.bias_ih_l0 + c.bias_hh_l0).detach().numpy(),
        }
        for c in cells
    ]
    layers.append({"weight": last.weight.detach().numpy(), "bias": last.bias.detach().numpy()})
    NetworkWeights("lstm", 0.005, 1, np.array([2.0, 0.25, 20.0], np.float32), tuple(layers)).save("lstm.npz")
    law = small_task(("control.actuator.network", "lstm.npz")).control
    law.reset(torch.ones(4, dtype=torch.bool))
    angles, speeds = 0.3 * torch.randn(2, 9, 4, 12)
    law.set_actions(torch.zeros(4, 12))
    for k in range(9):
        found = law.compute(angles[k], speeds[k])
    x = torch.stack([2.0 * (law.default_dof_pos - angles), 0.25 * speeds], dim=3).view(9, 48, 2)
    with torch.no_grad():
        for cell in cells:
            x, _ = cell(x)
        wanted = 20.0 * last(x[-1]).view(4, 12)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"torque": None}, "'torque' is missing"),
        ({"velocity": np.zeros((3, 2))}, "velocity: expected (1600, 2)"),
        ({"velocity": np.full((1600, 2), np.nan)}, "velocity: expected finite numbers"),
        ({"torques": np.zeros(3)}, "unknown key 'torques'; did you mean 'torque'"),
        ({"dt": None}, "'dt' is missing"),
        ({"dt": np.array(0.0)}, "dt: must be above 0"),
        ({"dt": np.zeros(0)}, "dt: expected a number, got (0,)"),
        ({"dt": None, "time": np.arange(1600.0), "run": np.arange(1600)}, "run: no two consecutive samples have the same"),
        ({"dt": None, "time": np.arange(1600.0) ** 1.1}, "time: samples are not evenly spaced"),
        ({"stiffness": np.zeros(5)}, "stiffness: expected a number or (2,)"),
        ({"stiffness": np.array(-80.0)}, "stiffness: must be 0 or more, got -80"),
        ({"torque_limit": np.array(0.0)}, "torque_limit: must be above 0, got 0"),
        ({"torque": np.zeros((1600, 2))}, "torque: is 0 N m throughout; nothing can be fitted to that"),
        ({"run": np.full(1600, np.nan)}, "run: expected finite numbers"),
        ({"run": np.array(["walk"] * 1600)}, "run: expected finite numbers"),
        ({"time": 0.005 * np.arange(1600)}, "dt: got 0.0025 s, but 'time' says 0.005 s"),
        ({"time": 0.0025 * np.arange(1600)[::-1]}, "time: samples are not evenly spaced (median step -0.0025 s"),
        ({"joint_names": np.array(["knee", "knee"])}, "joint_names: must differ from each other, got knee, knee"),
    ],
)
def test_a_wrong_log_is_one_line(tmp_path, changes, said, capsys):
    path = write(tmp_path, **changes)
    assert call(fit_actuator.main, [str(path)]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"error: {path}: {said}")
    assert told.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"stiffness": [14.0, 99.0]}, "stiffness: 14 at joint_0, 99 at joint_1; one drive is fitted to all joints"),
        ({"damping": [2.0, 1.5]}, "damping: 1.5 at joint_1, 2 at joint_0"),
        ({"torque_limit": [80.0, 40.0]}, "torque_limit: 40 at joint_1, 80 at joint_0"),
    ],
)
def test_joints_with_drives_of_their_own_are_not_fitted_as_one(tmp_path, changes, said, capsys):
    path = write(tmp_path, **{name: np.array(values) for name, values in changes.items()})
    assert call(fit_actuator.main, [str(path), "--out", "fit"]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"error: {path}: {said}")
    assert told.endswith("so use --joints to select joints with equal values\n")
    check_alike(read_log(path).only(["joint_1"]), path)
    check_alike(read_log(write(tmp_path, stiffness=np.array([14.0, 99.0]), damping=None)), path)  # the gains are fitted


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--joints", "knee"], "--joints: pattern 'knee' matches nothing"),
        (["--spacing", "0.007"], "--spacing: must be a whole multiple of --dt"),
        (["--dt", "0.001"], "--dt: must be at least 0.0025 s (the time step of the log)"),
        (["--hidden", "8,0"], "--hidden: must be 1 to 1024, got 0"),
        (["--hidden", "8 8"], "--hidden: expected numbers like 32,32,32, got '8 8'"),
    ],
)
def test_a_wrong_flag_is_one_line(tmp_path, flags, said, capsys):
    assert call(fit_actuator.main, [str(write(tmp_path)), *flags]) == 2
    assert capsys.readouterr().err.startswith(f"error: {said}")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"kind": "gru"}, "unknown kind 'gru'"),
        ({"layer1.weight": np.zeros((3, 3))}, "layer 1 does not fit"),
        ({"layer1.bias": None}, "'bias' is missing"),
        ({"layer0.weight": np.full((4, 6), np.nan)}, "layer 0 has weights that are NaN"),
        ({"dt": 0.007}, "sim.dt must be 0.007 divided by a whole number"),
    ],
)
def test_a_wrong_network_is_one_line(changes, said):
    arrays = {"format": 1, "kind": "mlp", "dt": 0.01, "samples": 3, "scales": np.ones(3)}
    arrays |= {"layer0.weight": np.zeros((4, 6)), "layer0.bias": np.zeros(4)}
    arrays |= {"layer1.weight": np.zeros((1, 4)), "layer1.bias": np.zeros(1), **changes}
    np.savez("network.npz", **{name: value for name, value in arrays.items() if value is not None})
    with pytest.raises(ConfigError, match=r"^command line: control\.actuator\.network: ") as error:
        small_task(("control.actuator.network", "network.npz"))
    assert said in str(error.value)
