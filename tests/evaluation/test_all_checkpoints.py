"""When a training's checkpoints first walk."""

import json

import pytest
import torch
from helpers import TASK, call, run_folders, tiny_run

from legged.cli.evaluate import checkpoints
from legged.evaluation import following
from legged.evaluation.following import walks
from legged.learning.checkpoint import read_checkpoint, write_checkpoint

pytestmark = pytest.mark.usefixtures("workplace")

HERE = [TASK, "--sim-device", "cpu", "--robots", "1", "sim.threads=1"]
AXIS = (-1.0, 0.0, 1.0)
GRID = ["--vx=-1:1:1", "--vy=-1:1:1", "--yaw=0:1:1"]


@pytest.mark.slow
def test_checkpoints_are_judged_in_order_and_the_first_good_one_is_named(capsys):
    """Networks of zeros stand still whatever they are asked for, so their error is sqrt(vx^2 + vy^2), averaged over the
    grid's 9 pairs, and the limit decides who walks.
    """
    tiny_run("train.runner.save_interval=1", iterations=3)
    (folder,) = run_folders()
    for number, seconds in ((0, 4.0), (1, 5.0), (2, 6.5)):
        path = folder / f"model_{number}.pt"
        saved = read_checkpoint(path)
        assert saved["infos"]["wall_s"] > 0.0
        saved["infos"]["wall_s"] = seconds
        for name, tensor in saved["actor_state_dict"].items():
            if number and "mlp" in name:
                saved["actor_state_dict"][name] = torch.zeros_like(tensor)
        write_checkpoint(path, saved)
    stands = sum((x * x + y * y) ** 0.5 for x in AXIS for y in AXIS) / 9
    assert checkpoints.main([*HERE, *GRID, "--rmse", "0.1"]) == 0
    assert "never" in capsys.readouterr().out
    result = json.loads((folder / "time_to_walk.json").read_text())
    assert result["first"] is None
    assert [row["iteration"] for row in result["checkpoints"]] == [1, 2, 3]
    assert result["checkpoints"][1]["rmse_lin"] == pytest.approx(stands, abs=0.05)
    assert [row["wall_s"] for row in result["checkpoints"]] == [4.0, 5.0, 6.5]
    limit = result["checkpoints"][1]["rmse_lin"] + 0.02  # resets are random
    assert checkpoints.main([*HERE, *GRID, "--rmse", str(limit), "--falls", "0.5"]) == 0
    first = json.loads((folder / "time_to_walk.json").read_text())["first"]
    wanted = 4.0 if result["checkpoints"][0]["rmse_lin"] < limit else 5.0
    assert first["wall_s"] == wanted
    assert f"after {wanted:.1f} s" in capsys.readouterr().out


@pytest.mark.slow
def test_the_file_says_under_what_conditions_checkpoints_were_judged_and_lost_contacts_are_warned_of(capsys, monkeypatch):
    tiny_run(iterations=1)
    (folder,) = run_folders()
    figures = {"rmse_lin": {"mean": 0.1}, "rmse_ang": {"mean": 0.1}, "falls": 0.0, "contact_overflows": 3}
    monkeypatch.setattr(following, "measure_tracking", lambda *_: figures)
    assert checkpoints.main([*HERE, "--vx=0.5", "--vy=0", "--yaw=0", "sim.iterations=30"]) == 0
    result = json.loads((folder / "changed" / "time_to_walk.json").read_text())
    assert result["changes"] == {"sim.iterations": 30}
    assert (result["grid"], result["robots_per_cell"]) == ({"vx": [0.5], "vy": [0.0], "yaw": [0.0]}, 1)
    assert result["contact_overflows"] == 3
    assert "warning: tracking: contacts were lost 3 times (robots x steps)" in capsys.readouterr().err


def test_a_robot_that_always_falls_does_not_walk():
    row = {"rmse_lin": None, "falls": 1.0}
    assert not walks(row, 10.0, 2.0)
    assert walks({"rmse_lin": 0.14, "falls": 0.005}, 0.15, 0.01)
    assert not walks({"rmse_lin": 0.14, "falls": 0.02}, 0.15, 0.01)


def test_wrong_limits_are_refused(capsys):
    assert call(checkpoints.main, [*HERE, "--rmse", "-1"]) == 2
    assert "--rmse: must be above 0" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([*HERE, "--checkpoint", "3"], "--checkpoint: leave it out, because all checkpoints of the run are measured"),
        ([*HERE, "--types", "pit"], "unrecognized arguments: --types"),
        ([*HERE, "--physics", "all"], "command line: sim.physics: unknown value 'all'"),
        (["half_cheetah"], "POLICY: 'half_cheetah' has no velocity commands"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(arguments, words, capsys):
    assert call(checkpoints.main, arguments) == 2
    assert words in capsys.readouterr().err
