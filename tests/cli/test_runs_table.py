"""All runs in one table, and several side by side."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers import POLICY, POLICY_ITERATION, TASK, call, tiny_run
from torch.utils.tensorboard import SummaryWriter

import legged
from legged.cli.runs import compare, report
from legged.cli.runs import runs as table
from legged.config import to_dict
from legged.evaluation.reports.comparison import apart, comparison_parts
from legged.evaluation.reports.document import Table
from legged.evaluation.reports.experiments import highest_stairs
from legged.evaluation.reports.record import read_record
from legged.learning.timing import Timing, write_timing
from legged.registry import task_config

pytestmark = pytest.mark.usefixtures("workplace")

STAMPS = ("2026-01-02_03-04-05", "2025-12-31_23-59-59", "2026-03-01_00-00-00")


def write_run(stamp: str, level: float = 0.5, logs: str = "logs", **settings) -> Path:
    """A finished run with a log of five iterations and the times of its training."""
    folder = Path(logs) / TASK / stamp
    folder.mkdir(parents=True)
    config = to_dict(task_config(TASK, settings.items()))
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    write_timing(folder, Timing(TASK, True, 4096, 5, False, 2_500_000, 6.25, 12.5, 20.0, "NVIDIA H200", 0))
    with SummaryWriter(str(folder)) as writer:
        for step in range(5):
            writer.add_scalar("Train/mean_reward", level * step, step)
            writer.add_scalar("Metrics/lin_vel_rmse", level, step)
    return folder


def rows(text: str) -> list[list[str]]:
    """Cells of the table of a Markdown page, its head first."""
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in (lines[0], *lines[2:])]


def table_in(name: str = "logs/experiments.md") -> list[dict[str, str]]:
    head, *found = rows(Path(name).read_text(encoding="utf-8").replace("\\_", "_").replace("&nbsp;", ""))
    return [dict(zip((text.replace("\\", "") for text in head), row, strict=True)) for row in found]


@pytest.mark.slow
def test_runs_are_in_one_table_newest_first(capsys):
    folders = [write_run(stamp) for stamp in STAMPS]
    (folders[0] / "note.txt").write_text("first steps")
    shutil.copyfile(POLICY / "evaluation_mujoco.json", folders[2] / "evaluation_mujoco.json")
    assert report.main([str(folders[2])]) == 0
    assert table.main([]) == 0
    assert "written: logs/experiments.html, 3 runs\n" in capsys.readouterr().out
    found = table_in()
    assert [row["began"] for row in found] == [
        f"[2026-03-01 00:00]({TASK}/{STAMPS[2]}/report.md)",
        "2026-01-02 03:04",
        "2025-12-31 23:59",
    ]
    assert f'<a href="{TASK}/{STAMPS[2]}/report.html">' in Path("logs/experiments.html").read_text()
    assert [row["what changed"] for row in found] == ["", "first steps", ""]
    one = found[0]
    judged = json.loads((POLICY / "evaluation_mujoco.json").read_text())
    wanted = {
        "task": TASK,
        "status": "finished",
        "robots": "4,096",
        "steps [M]": "2.5",
        "start-up [s]": "6.2",
        "loop [s]": "12.5",
        "steps/s": "200,000",
        "return": "1.50",  # 1, 1.5 and 2: at its end a running mean over five is one over three
        "velocity error [m/s]": "0.500",
        "RMSE [m/s]": f"{judged['rmse_lin']['mean']:.3f}",
        "falls [%]": f"{100 * judged['falls']:.2f}",
        "device": "NVIDIA H200",
    }
    assert {key: one[key] for key in wanted} == wanted
    assert found[1]["RMSE [m/s]"] == "-"
    assert "return, evaluated" not in one  # of no run


@pytest.mark.slow
def test_an_evaluation_of_another_checkpoint_than_the_last_is_called_that(capsys):
    """As after evaluate --checkpoint best, or of a training that went on afterwards."""
    last = f"model_{POLICY_ITERATION}.pt"
    folders = [write_run(stamp) for stamp in STAMPS[:2]]
    for folder in folders:
        (folder / "model_4.pt").touch()
        shutil.copyfile(POLICY / "evaluation_mujoco.json", folder / "evaluation_mujoco.json")
    path = folders[1] / "evaluation_mujoco.json"
    of_the_last = path.read_text().replace(f'"{last}"', '"model_4.pt"')
    path.write_text(of_the_last)
    assert table.main([]) == 0
    assert [row["evaluated"] for row in table_in()] == [last, ""]
    assert report.main([*map(str, folders)]) == 0
    said = f"In C MuJoCo the evaluation is of `{last}`, which is not the last policy."
    assert [said in (folder / "report.md").read_text() for folder in folders] == [True, False]
    assert compare.main([*map(str, folders)]) == 0
    text = Path("logs/comparison.md").read_text().replace("\\", "")
    assert text.count(f"({STAMPS[0]}): the evaluation is of `{last}`, not the last policy") == 1
    (folders[0] / "evaluation_mujoco.json").write_text(of_the_last)
    assert table.main([]) == 0
    assert "evaluated" not in table_in()[0]
    capsys.readouterr()


@pytest.mark.slow
def test_a_page_elsewhere_leads_to_no_report():
    folder = write_run(STAMPS[0])
    assert report.main([str(folder)]) == 0
    assert table.main(["logs", "--out", "docs"]) == 0
    (row,) = table_in("docs/experiments.md")
    assert row["began"] == "2026-01-02 03:04"
    assert sorted(path.name for path in Path("docs").iterdir()) == ["experiments.html", "experiments.md"]
    assert str(Path.cwd()) not in Path("docs/experiments.md").read_text()


@pytest.mark.slow
def test_a_folder_of_several_and_one_inside_it_name_a_run_once():
    write_run(STAMPS[0])
    other = write_run(STAMPS[1], logs="elsewhere")
    assert table.main(["logs", str(other), "elsewhere", "--out", "pages"]) == 0
    assert len(table_in("pages/experiments.md")) == 2


@pytest.mark.slow
def test_seeds_of_a_training_share_a_row():
    """RMSE of 0.04 and 0.07 m/s; the third seed learned with another reward, the fourth run has a note."""
    for stamp, seed, error in zip(STAMPS, (2, 1, 3), (0.04, 0.07, 0.5), strict=True):
        other = {"rewards.scales.torques": -2e-4} if seed == 3 else {}
        folder = write_run(stamp, **{"env.seed": seed, "train.runner.run_name": f"s{seed}", **other})
        means = {"rmse_lin": {"mean": error, "worst": 1.0}, "rmse_ang": {"mean": 2 * error, "worst": 1.0}}
        result = {"task": TASK, "physics": "mujoco", "falls": seed / 100, **means}
        (folder / "evaluation_mujoco.json").write_text(json.dumps(result))
    (write_run("2025-01-01_00-00-00") / "note.txt").write_text("as it was")
    assert table.main(["--seeds-share"]) == 0
    names = ("began", "what changed", "seed", "RMSE [m/s]", "yaw rate RMSE [rad/s]", "falls [%]", "loop [s]")
    assert [tuple(row[name] for name in names) for row in table_in()] == [
        ("2026-03-01 00:00", "s3: scales.torques -0.0002", "3", "0.500", "1.000", "3.00", "12.5"),
        ("2026-01-02 03:04", "", "1, 2", "0.055", "0.110", "1.50", "12.5"),
        ("2025-01-01 00:00", "as it was", "1", "-", "-", "-", "12.5"),
    ]
    text = Path("logs/experiments.md").read_text()
    assert text.splitlines()[2].startswith("4 runs, newest first")
    assert "share a row" in text
    assert table.main([]) == 0
    assert len(table_in()) == 4


@pytest.mark.parametrize(
    ("up", "down", "highest"),
    [
        ({0.05: 1.0, 0.1: 0.95, 0.15: 0.9, 0.2: 0.89}, {0.05: 1.0, 0.1: 1.0, 0.15: 0.91, 0.2: 1.0}, 0.15),
        ({0.05: 1.0, 0.1: 0.8, 0.15: 0.95}, {0.05: 1.0, 0.1: 1.0, 0.15: 1.0}, 0.05),
        ({0.05: 0.5, 0.1: 1.0}, {0.05: 1.0, 0.1: 1.0}, 0.0),
        ({0.05: 1.0}, {0.1: 1.0}, None),
        ({}, {0.1: 1.0}, None),
    ],
)
def test_highest_stairs_that_were_crossed(up, down, highest):
    ways = {"stairs_up": up, "stairs_down": down}
    types = {
        name: {"points": [{"size": size, "share": share} for size, share in found.items()]} for name, found in ways.items()
    }
    assert highest_stairs({"success": {"types": types}}) == highest
    assert highest_stairs({}) is None


def test_labels_leave_out_what_all_have():
    assert apart(["go2, wide, seed 1", "go2, narrow, seed 1"]) == ("go2, seed 1", ["wide", "narrow"])
    assert apart(["go2, seed 1", "a1, seed 1"]) == ("seed 1", ["go2", "a1"])
    assert apart(["go2, seed 1", "go2, wide, seed 1"]) == ("", ["go2, seed 1", "go2, wide, seed 1"])


@pytest.mark.slow
def test_real_runs_are_compared():
    a = tiny_run("train.runner.run_name=a", "env.episode_length_s=0.1", iterations=2)
    b = tiny_run("train.runner.run_name=b", "env.episode_length_s=0.1", "rewards.scales.torques=-3e-4", iterations=3)
    assert compare.main([str(a), f"{TASK}/{b.name}"]) == 0
    page, text = (Path(f"logs/comparison.{ending}").read_text() for ending in ("html", "md"))
    assert "| `rewards.scales.torques` | `-1.0e-05` | `-0.0003` |" in text
    assert "episode_length_s" not in text
    drawing = page.partition('aria-label="velocity error [m/s]"')[2].partition("</svg>")[0]
    assert re.findall(r'data-name="([^"]+)"', drawing) == ["a", "b"]
    assert re.findall(r'data-x="([^"]+)"', drawing) == ["1 2", "1 2 3"]
    assert text.splitlines()[2] == f"All runs: {TASK.replace('_', chr(92) + '_')}, seed 1."
    assert "note" not in rows(text)[0]
    assert Path("logs/comparison_curves.svg").is_file()
    assert "No two of the runs were evaluated in the same engine." in page


def judged(stamp: str, result: dict) -> Path:
    folder = write_run(stamp)
    (folder / "evaluation_mujoco.json").write_text(json.dumps(result))
    return folder


def figures(*folders: Path) -> dict[str, list[str]]:
    """Measure -> cells of the table of evaluations."""
    parts = comparison_parts([read_record(folder) for folder in folders])
    (found,) = [part for part in parts if isinstance(part, Table) and part.head[0] == "measure"]
    return {row[0]: list(row[1:]) for row in found.rows}


@pytest.mark.slow
def test_evaluations_have_intervals():
    """The second policy is worse by 0.02 m/s in every cell, so that the difference has no width. 2 and 14 of 80 robots fall:
    Wilson's intervals are 0.04676 -+ 0.03988 and 0.18989 -+ 0.08269, Newcombe's 0.15 - 0.0916 and 0.15 + 0.0992.
    """
    cells = [{"command": [x, 0.0, 0.0], "rmse_lin": 0.1 + 0.01 * i, "rmse_ang": 0.3} for i, x in enumerate(np.arange(10.0))]
    worse = [{**cell, "rmse_lin": cell["rmse_lin"] + 0.02} for cell in cells]
    means = {"rmse_lin": {"mean": 0.1, "worst": 0.2}, "rmse_ang": {"mean": 0.3, "worst": 0.3}}
    base = {"task": TASK, "physics": "mujoco", "robots_per_cell": 8, **means}
    a = judged(STAMPS[0], {**base, "cells": cells, "falls": 2 / 80})
    b = judged(STAMPS[1], {**base, "cells": worse, "falls": 14 / 80})
    found = figures(a, b)
    assert found["velocity RMSE [m/s]"][0].startswith("0.145 (0.1")
    assert found["velocity RMSE [m/s]"][2] == "+0.020 (+0.020 to +0.020) *"
    assert found["yaw rate RMSE [rad/s]"] == ["0.300 (0.300 to 0.300)"] * 2 + ["+0.000 (+0.000 to +0.000)"]
    assert found["falls [%]"] == ["2.50 (0.69 to 8.66)", "17.50 (10.72 to 27.26)", "+15.00 (+5.84 to +24.92) *"]
    assert found == {**found, "velocity RMSE [m/s]": figures(a, b)["velocity RMSE [m/s]"]}  # the same every time


def test_returns_of_episodes_have_intervals():
    def episodes(mean: float, std: float, failures: float) -> dict:
        spread = {"mean": mean, "std": std, "min": 0.0, "max": 1.0}
        rest = {"length": spread, "terms": {}, "metrics": {}, "count": 400, "failures": failures}
        return {"task": TASK, "physics": "mujoco", "episodes": {"return": spread, **rest}}

    found = figures(judged(STAMPS[0], episodes(100.0, 30.0, 0.0)), judged(STAMPS[1], episodes(102.0, 40.0, 0.0)))
    assert found["return"] == ["100.0 (97.1 to 102.9)", "102.0 (98.1 to 105.9)", "+2.0 (-2.9 to +6.9)"]
    assert found["episodes that ended in a failure [%]"][2] == "+0.00 (-0.95 to +0.95)"


def test_success_is_drawn_where_two_runs_have_it():
    for name in ("anymal_c", "anymal_c_blind"):
        shutil.copytree(POLICY.with_name(name), Path("logs") / name / STAMPS[0])
    runs = [f"{name}/{STAMPS[0]}" for name in ("anymal_c", "anymal_c_blind")]
    assert compare.main([*runs, "--out", "pages"]) == 0
    page = Path("pages/comparison.html").read_text()
    drawing = page.partition('aria-label="success: stairs up"')[2].partition("</svg>")[0]
    assert len(re.findall(r'data-name="([^"]+)"', drawing)) == 2
    assert drawing.count("<polygon") == 2  # their intervals
    assert Path("pages/comparison_success_mujoco.svg").is_file()


@pytest.mark.parametrize(
    ("command", "arguments", "words"),
    [
        (table, [], "error: logs: holds no run folder (there is no config.yaml in it)"),
        (table, ["nowhere"], "error: nowhere: "),
        (table, ["elsewhere", "--out", "taken"], "error: taken: "),
        (compare, ["a"], "error: RUN: expected 2 to 8 runs, got 1"),
        (compare, ["a", "b"], "error: RUN: there is no task and no run 'a'"),
        (compare, [TASK, TASK], f"error: RUN: '{TASK}' has no run in logs/"),
    ],
)
def test_a_wrong_command_line_is_one_line(command, arguments, words, capsys):
    Path("taken").touch()
    assert call(command.main, arguments) == 2
    err = capsys.readouterr().err
    assert err.startswith(words)
    assert len(err.splitlines()) == 1


def test_a_run_is_compared_with_others_only(capsys):
    folder = write_run(STAMPS[0])
    for same in (str(folder), f"{TASK}/{folder.name}", TASK):
        assert call(compare.main, [str(folder), same]) == 2
        assert "RUN: a run is given twice" in capsys.readouterr().err
    assert call(compare.main, [str(folder), f"{TASK}/{folder.name}x"]) == 2
    assert f"did you mean '{TASK}/{folder.name}'" in capsys.readouterr().err


def test_the_log_of_this_project_is_one_that_the_tool_writes():
    page = Path(legged.__file__).parents[1] / "docs" / "lab" / "experiments.md"
    found = table_in(str(page))
    assert {"began", "task", "what changed", "status", "steps/s"} <= found[0].keys()
    began = [row["began"] for row in found]
    assert began == sorted(began, reverse=True)
    runs = sum(len(row["seed"].split(",")) for row in found)
    assert f"{runs} runs, newest first" in page.read_text(encoding="utf-8")
