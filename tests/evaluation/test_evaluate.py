"""Measuring a policy over a grid of commands, with policies whose result is known beforehand; and play's table."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import POLICY, TASK, call, kept_global_state, run_folders, small_config, stand, tiny_run

from legged import make_task
from legged.cli.evaluate import grid as evaluate_grid
from legged.cli.evaluate import terrain as evaluate_terrain
from legged.cli.play import play
from legged.config import override
from legged.errors import RunError
from legged.evaluation import following, result_file
from legged.evaluation.velocity_grid import Grid, axes_of, axis_values
from legged.evaluation.velocity_tracking import draw_tracking, hold, measure_tracking, print_tracking
from legged.play import demonstrations
from legged.policies.restore import TrainedPolicy, undisturbed
from legged.registry import task_config

pytestmark = pytest.mark.usefixtures("workplace")


def on_grid(grid: Grid, act=stand, *settings):
    cfg = small_config()
    changes = [*undisturbed(cfg, grid.num_envs, grid.hold_s), ("init_state.base_velocity", [0.0, 0.0]), *settings]
    return measure_tracking(make_task(override(cfg, changes)), act, grid)


# ---- the grid --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("-1:1:0.5", [-1.0, -0.5, 0.0, 0.5, 1.0]),
        ("0:0.3:0.1", [0.0, 0.1, 0.2, 0.3]),  # the end belongs to it, in spite of rounding
        ("0:1:0.3", [0.0, 0.3, 0.6, 0.9]),
        ("-1:1:0.3", [-1.0, -0.7, -0.4, -0.1, 0.2, 0.5, 0.8]),  # never beyond the end, however near the next step is
        ("0:1:0.6", [0.0, 0.6]),
        ("0.25", [0.25]),
        ("-2", [-2.0]),
        ("1:1:0.5", [1.0]),
    ],
)
def test_axis_values(text, values):
    assert axis_values("--vx", text) == values


def test_a_grid_is_all_combinations_with_the_same_number_of_robots():
    grid = Grid([0.0, 1.0], [0.0], [-1.0, 0.0, 1.0], robots=5)
    assert grid.num_envs == 30
    assert grid.cells.tolist()[:4] == [[0, 0, -1], [0, 0, 0], [0, 0, 1], [1, 0, -1]]


@pytest.mark.slow
def test_robots_that_stand_have_the_error_of_what_they_are_asked_for():
    result = on_grid(Grid([0.0, 0.5], [0.0, -0.3], [0.0, 0.4], robots=2, hold_s=2.0))
    cells = {tuple(cell["command"]): cell for cell in result["cells"]}
    assert len(cells) == 8
    for (vx, vy, yaw), cell in cells.items():
        assert cell["rmse_lin"] == pytest.approx((vx**2 + vy**2) ** 0.5, abs=0.05)
        assert cell["rmse_ang"] == pytest.approx(yaw, abs=0.05)
        assert cell["falls"] == 0.0
        assert cell["duty_factor"] == pytest.approx(1.0, abs=0.05)
        assert cell["thigh_contact"] == 0.0
        assert 0.45 < cell["base_height"] < 0.6
        assert cell["cost_of_transport"] is None  # nobody gets anywhere
    assert result["falls"] == 0.0
    assert result["measured_s"] == pytest.approx(1.0)
    assert result["rmse_lin"]["worst"] == pytest.approx(0.34**0.5, abs=0.05)
    assert result["rmse_lin"]["worst_cell"][:2] == [0.5, -0.3]
    # Mean of 0, 0.3, 0.5 and 0.583 over the cells.
    assert result["rmse_lin"]["mean"] == pytest.approx(0.346, abs=0.03)
    assert result["gait"]["command"] == [0.5, 0.0, 0.0]
    json.dumps(result, allow_nan=False)


@pytest.mark.slow
def test_robots_that_stand_have_the_errors_of_the_heights_and_pitches_they_are_asked_for(capsys):
    """Four robots of a cell have heights in the middle of four equal parts of the range, and pitches of the same kind."""
    grid = Grid([0.0], [0.0], [0.0, 0.4], robots=4, hold_s=2.0)
    ranges = {"base_height": [0.3, 0.7], "base_pitch": [-0.2, 0.6]}
    result = on_grid(grid, stand, *((f"commands.ranges.{name}", values) for name, values in ranges.items()))
    height = result["gait"]["base_height"]
    asked = np.array([0.35, 0.45, 0.55, 0.65])
    pitches = -0.2 + 0.8 * np.array([0.5, 0.118034, 0.736068, 0.354102])  # 0.5 + k * 0.618034, modulo 1
    for cell in result["cells"]:
        assert cell["rmse_height"] == pytest.approx(np.sqrt(np.mean((height - asked) ** 2)), abs=0.005)
        assert cell["rmse_pitch"] == pytest.approx(np.sqrt(np.mean(pitches**2)), abs=0.03)
    assert result["rmse_height"]["mean"] == pytest.approx(np.mean([cell["rmse_height"] for cell in result["cells"]]))
    print_tracking({"task": "t", "checkpoint": "c", "physics": "mujoco", "ground": "", **result})
    assert f"{result['rmse_pitch']['mean']:.3f} rad" in capsys.readouterr().out
    fixed = on_grid(Grid([0.0], [0.0], [0.0], robots=1, hold_s=1.1))
    assert "rmse_height" not in fixed
    only_pitch = on_grid(grid, stand, ("commands.ranges.base_pitch", [0.0, 0.2]))  # the height is the usual one
    usual = small_config().rewards.base_height_target
    assert only_pitch["rmse_height"]["mean"] == pytest.approx(abs(height - usual), abs=0.01)


@pytest.mark.slow
def test_robots_that_are_made_to_fall_are_counted_and_measured_up_to_their_fall():
    grid = Grid([0.0, 0.5], [0.0], [0.0], robots=4, hold_s=1.0, settle_s=0.2)
    config = override(
        small_config(), [*undisturbed(small_config(), grid.num_envs, grid.hold_s), ("init_state.base_velocity", [0.0, 0.0])]
    )
    task = make_task(config)
    steps = 0

    def topple(observations):
        """Lays three of the four robots of the second command on their backs after half a second."""
        nonlocal steps
        steps += 1
        if steps == 25:
            task.physics._qpos[5:, 2] = 0.1
            task.physics._qpos[5:, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
        return stand(observations)

    result = measure_tracking(task, topple, grid)
    assert [cell["falls"] for cell in result["cells"]] == [0.0, 0.75]
    assert result["falls"] == 0.375
    assert result["cells"][1]["rmse_lin"] == pytest.approx(0.5, abs=0.15)
    json.dumps(result, allow_nan=False)


def test_a_cell_in_which_nobody_stands_long_enough_to_be_measured_does_not_count_as_perfect():
    grid = Grid([0.5, 1.0], [0.0], [0.0], robots=2, hold_s=0.6, settle_s=0.3)
    result = on_grid(grid, stand, ("terminations.min_base_height", 5.0))
    assert result["falls"] == 1.0
    for cell in result["cells"]:
        assert cell["rmse_lin"] is None or cell["rmse_lin"] > 0.3
    assert not result["rmse_lin"]["mean"] or result["rmse_lin"]["mean"] > 0.3
    json.dumps(result, allow_nan=False)


@pytest.mark.slow
def test_a_robot_is_measured_up_to_a_time_out_and_has_not_fallen():
    """Its time is up at the end of step 15, so that of 30 steps those from 10 to 13 are of its first episode."""
    task = make_task(override(small_config(), [*undisturbed(small_config(), 2, 0.6), ("env.episode_length_s", 0.3)]))
    sums, fell, lost = hold(task, stand, torch.tensor([[0.5, 0.0, 0.0]] * 2), 0.2, 0.6, lambda _: {"ones": torch.ones(2, 3)})
    assert sums["steps"].tolist() == [4.0, 4.0]
    assert sums["ones"].tolist() == [[4.0] * 3] * 2
    assert not fell.any()
    assert lost == 0
    grid = Grid([0.5], [0.0], [0.0], robots=2, hold_s=0.6, settle_s=0.2)
    assert on_grid(grid, stand, ("env.episode_length_s", 0.3))["cells"][0]["rmse_lin"] == pytest.approx(0.5, abs=0.2)


def test_a_cell_in_which_nobody_was_measured_has_no_gait_either(capsys):
    grid = Grid([0.5], [0.0], [0.0], robots=2, hold_s=0.6, settle_s=0.3)
    fallen = on_grid(grid, stand, ("terminations.min_base_height", 5.0))
    assert fallen["gait"] == {**dict.fromkeys(fallen["gait"]), "command": [0.5, 0.0, 0.0], "falls": 1.0}
    said = {"task": TASK, "checkpoint": "model_0.pt", "physics": "mujoco", "ground": ""}
    print_tracking({**said, **fallen})
    lines = capsys.readouterr().out.splitlines()
    for label in ("duty factor", "steps per second and foot", "base height", "thigh or shank contact"):
        (line,) = (line for line in lines if label in line)
        assert " none " in line


def test_a_picture_of_nothing_measured_is_drawn_without_a_warning(tmp_path, recwarn):
    cells = [{"rmse_lin": None, "rmse_ang": None}] * 2
    result = {"grid": {"vx": [0.5, 1.0], "vy": [0.0], "yaw": [0.0]}, "cells": cells}
    draw_tracking({**result, "task": TASK, "physics": "mujoco", "ground": False, "falls": 1.0}, tmp_path / "none.png")
    assert (tmp_path / "none.png").is_file()
    assert not [str(warning.message) for warning in recwarn]


# ---- the commands ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with one short run."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch, kept_global_state():
        patch.chdir(folder)
        tiny_run("--run_name", "short", num_envs=4, iterations=1)
    return folder


@pytest.fixture
def run(trained, monkeypatch) -> Path:
    monkeypatch.chdir(trained)
    (folder,) = run_folders()
    return folder


@pytest.mark.slow
def test_evaluate_writes_json_and_picture_beside_the_checkpoint(run, capsys):
    arguments = [TASK, "--physics", "mujoco", "--vx=0:0.5:0.5", "--vy=0", "--yaw=-0.5:0.5:1", "--robots", "2"]
    assert call(evaluate_grid.main, [*arguments, "sim.threads=1"]) == 0
    out = capsys.readouterr().out
    result = json.loads((run / "evaluation_mujoco.json").read_text())
    assert result["grid"] == {"vx": [0.0, 0.5], "vy": [0.0], "yaw": [-0.5, 0.5]}
    assert len(result["cells"]) == 4
    assert (result["task"], result["checkpoint"], result["physics"], result["device"]) == (
        TASK,
        "model_0.pt",
        "mujoco",
        "cpu",
    )
    assert (run / "evaluation_mujoco.png").read_bytes().startswith(b"\x89PNG")
    assert not list(run.glob(".*"))  # nothing half written
    for words in ("velocity RMSE, mean", f"{result['rmse_lin']['mean']:.3f} m/s", "falls", "evaluation_mujoco.json"):
        assert words in out


@pytest.mark.slow
def test_the_grid_is_that_of_the_task_where_no_flag_says_otherwise(run, tmp_path):
    judged = ["evaluation.vx=[-0.5,1,1.5]", "evaluation.vy=[0.3,0.3,1]", "evaluation.yaw=[0,0,1]"]
    arguments = [TASK, "--physics", "mujoco", "--robots", "1", "--yaw=-0.2", "--out", str(tmp_path)]
    assert call(evaluate_grid.main, [*arguments, *judged, "sim.threads=1"]) == 0
    result = json.loads((tmp_path / "evaluation_mujoco.json").read_text())
    assert result["grid"] == {"vx": [-0.5, 1.0], "vy": [0.3], "yaw": [-0.2]}


@pytest.mark.slow
def test_a_grid_is_no_changed_field_however_it_is_asked_for(run):
    """The zoo judges again what was trained with another grid, and looks for the result beside the checkpoint."""
    judged = ["evaluation.vx=[0.5,0.5,1]", "evaluation.vy=[0,0,1]", "evaluation.yaw=[0,0,1]", "evaluation.stairs=0.3"]
    assert call(evaluate_grid.main, [TASK, "--physics", "mujoco", "--robots", "1", *judged, "sim.threads=1"]) == 0
    result = json.loads((run / "evaluation_mujoco.json").read_text())
    assert result["grid"] == {"vx": [0.5], "vy": [0.0], "yaw": [0.0]}
    assert "changes" not in result
    assert not (run / "changed").exists()


@pytest.mark.parametrize(
    ("task", "axes"),
    [
        ("go2_flat", {"vx": [-1.0, -0.5, 0.0, 0.5, 1.0], "vy": [-1.0, -0.5, 0.0, 0.5, 1.0]}),
        ("h1_flat", {"vx": [-0.5, 0.0, 0.5, 1.0], "vy": [-0.3, 0.0, 0.3], "yaw": [-0.8, 0.0, 0.8]}),
    ],
)
def test_grids_of_quadrupeds_and_bipeds(task, axes):
    """They are the same for every robot of a kind: what is carried over by its size is not what is asked of it."""
    found = axes_of(task_config(task))
    assert {axis: found[axis] for axis in axes} == axes


@pytest.mark.slow
def test_evaluate_writes_elsewhere_if_asked(run, tmp_path):
    before = sorted(run.iterdir())
    arguments = [TASK, "--physics", "mujoco", "--vx=0", "--vy=0", "--yaw=0", "--robots", "1", "--out", str(tmp_path / "o")]
    assert call(evaluate_grid.main, [*arguments, "sim.threads=1"]) == 0
    assert {path.name for path in (tmp_path / "o").iterdir()} == {"evaluation_mujoco.json", "evaluation_mujoco.png"}
    assert sorted(run.iterdir()) == before


SHORT = ((1.1, (0.5, 0.0, 0.0)), (1.1, (9.0, 0.0, 0.0)))  # the second is outside what the task was trained on


@pytest.mark.slow
def test_play_without_video_exports_and_prints_a_table(run, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(demonstrations, "SCHEDULE", SHORT)
    arguments = [
        "--task",
        TASK,
        "--sim_device",
        "cpu",
        "--no-video",
        "--num_envs",
        "2",
        "--out",
        str(tmp_path),
        "sim.threads=1",
    ]
    assert call(play.main, arguments) == 0
    out = capsys.readouterr().out
    for name in ("policy.pt", "policy.onnx"):
        assert (tmp_path / "exported" / name).is_file()
        assert f"exported/{name}, largest difference to the policy" in out
    assert (tmp_path / "exported" / "policy.json").is_file()
    assert not list(tmp_path.rglob("play*"))
    # The column heads with their units, which rich would take for markup.
    assert "vx, vy [m/s], yaw [rad/s]" in out
    highest = small_config().commands.ranges.lin_vel_x[1]
    assert "0.5, 0, 0" in out
    assert f"{highest:g}, 0, 0" in out
    assert out.count(" m/s ") >= 2
    assert out.count("rad/s ") >= 2


@pytest.mark.slow
def test_play_records_a_short_video_where_something_can_be_drawn(run, capsys, monkeypatch, tmp_path):
    import mujoco

    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except Exception as error:
        pytest.skip(f"nothing can be rendered here: {error}")
    monkeypatch.setattr(demonstrations, "SCHEDULE", SHORT[:1])
    arguments = [
        "--task",
        TASK,
        "--sim_device",
        "cpu",
        "--headless",
        "--num_envs",
        "1",
        "--out",
        str(tmp_path),
        "sim.threads=1",
    ]
    assert call(play.main, arguments) == 0
    assert os.path.getsize(tmp_path / "play.mp4") > 1000
    assert not list(tmp_path.glob(".*"))  # nothing half written
    assert "recorded 28 frames" in capsys.readouterr().out  # 1.1 s at 25 frames a second: steps 0, 2, ... 54


def test_evaluations_of_a_shipped_policy_do_not_touch_the_package(tmp_path):
    shipped = TrainedPolicy(small_config(), tmp_path / "resources" / "policies" / TASK / "model.pt")
    assert shipped.output("evaluate") == Path("logs") / "evaluate" / TASK
    own = TrainedPolicy(small_config(), tmp_path / "logs" / TASK / "run" / "model_1.pt")
    assert own.output("evaluate") == tmp_path / "logs" / TASK / "run"


# ---- what can't be measured, or not written --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--vx=-1:1:1e-9"], "--vx: '-1:1:1e-9' makes 2,000,000,001 values"),
        (["--vx=1e30"], "--vx: '1e30' asks for more than 20"),
        (["--robots", "100000000"], "125 cells x 100,000,000 robots are 12,500,000,000 robots"),
    ],
)
def test_grids_that_no_machine_holds_are_refused_with_their_size(options, words, capsys):
    assert call(evaluate_grid.main, [TASK, "--sim-device", "cpu", *options]) == 2
    assert words in capsys.readouterr().err


def test_more_robots_a_size_than_any_machine_holds_are_refused(capsys):
    assert call(evaluate_terrain.main, [TASK, "--sim-device", "cpu", "--robots-per-point", "99999999"]) == 2
    assert "--robots-per-point: must be at most 65,536, got 99,999,999" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_found_before_anything_is_measured(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("mine")
    monkeypatch.setattr(following, "ready_to_track", lambda *_, **__: pytest.fail("measured"))
    arguments = [str(POLICY), "--sim_device", "cpu", "--out", str(tmp_path / "file")]
    for physics in ("mujoco", "all"):
        assert call(evaluate_grid.main, [*arguments, "--physics", physics]) == 2
        assert "file: cannot make the folder" in capsys.readouterr().err


@pytest.mark.slow
def test_a_disk_that_fills_up_meanwhile_costs_the_files_and_not_the_table(tmp_path, monkeypatch, capsys):
    def full(path, _text):
        raise RunError(f"{path.name}: no space left on the disk")

    monkeypatch.setattr(result_file, "write_text", full)
    grid = ["--vx=0", "--vy=0", "--yaw=0", "--robots", "1", "--physics", "mujoco", "sim.threads=1"]
    arguments = [str(POLICY), "--out", str(tmp_path), *grid]
    assert call(evaluate_grid.main, arguments) == 1
    out, err = capsys.readouterr()
    assert "velocity RMSE, mean" in out
    assert err == "error: evaluation_mujoco.json: no space left on the disk\n"


@pytest.mark.slow
def test_an_evaluation_with_changed_fields_says_so_and_does_not_take_the_place_of_the_policy_s_own(tmp_path):
    run = tmp_path / "run"
    shutil.copytree(POLICY, run)
    own = (run / "evaluation_mujoco.json").read_bytes()
    grid = ["--vx=0", "--vy=0", "--yaw=0", "--robots", "1", "--physics", "mujoco", "sim.threads=1"]
    arguments = [str(run), *grid]
    assert evaluate_grid.main([*arguments, "domain_rand.ranges.added_base_mass=[40,40]"]) == 0
    assert (run / "evaluation_mujoco.json").read_bytes() == own
    changed = json.loads((run / "changed" / "evaluation_mujoco.json").read_text())
    assert changed["changes"] == {"domain_rand.ranges.added_base_mass": [40, 40]}
    assert evaluate_grid.main(arguments) == 0
    assert "changes" not in json.loads((run / "evaluation_mujoco.json").read_text())
