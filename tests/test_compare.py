"""Evaluations side by side: seeds become means and spreads, by hand."""

import json

import pytest
from helpers import call

from legged.tools.compare import grouped, main, shares, spread

RULE = {"distance_m": 4.0, "time_s": 20.0, "vx": 0.75}


def evaluation(path, task="anymal_c", physics="mujoco_warp", rmse=0.1, stairs=None):
    """A small result file."""
    tracking = {"rmse_lin": {"mean": rmse, "worst": 2 * rmse}, "rmse_ang": {"mean": rmse, "worst": 3 * rmse}, "falls": 0.0}
    result = {"task": task, "checkpoint": "model.pt", "physics": physics}
    if stairs is None:
        result |= tracking
    else:
        points = [{"size": size, "share": share} for size, share in stairs.items()]
        entry = {"unit": "m", "what": "step height", "trained_to": 0.2, "points": points}
        success = {"definition": RULE, "robots_per_point": 4, "types": {"stairs_up": entry, "pit": entry}}
        result |= {"rough": tracking, "success": success}
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(result), encoding="utf-8")
    return result


def test_seeds_are_averaged_and_their_spread_is_told(tmp_path, capsys):
    evaluation(tmp_path / "a" / "evaluation_mujoco_warp.json", rmse=0.10, stairs={0.1: 1.0, 0.2: 0.9})
    evaluation(tmp_path / "b" / "evaluation_mujoco_warp.json", rmse=0.12, stairs={0.1: 0.5, 0.2: 0.7, 0.3: 0.2})
    evaluation(tmp_path / "b" / "evaluation_mujoco.json", physics="mujoco", rmse=0.2, stairs={0.2: 0.25})
    picture = tmp_path / "success.png"
    assert main([str(tmp_path / "a"), str(tmp_path / "b"), "--types", "stairs_up", "--out", str(picture)]) == 0
    said = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in said.split("\n") if "│" in line]
    lines = {row[0]: row[1:] for row in rows}
    assert lines["velocity RMSE, mean [m/s]"] == ["0.110 (9 %)", "0.200"]
    assert lines["yaw rate RMSE, worst cell [rad/s]"] == ["0.330 (9 %)", "0.600"]
    assert lines["falls [%]"] == ["0.00 (0 %)", "0.00"]
    assert lines["stairs_up"] == ["0.1 m", "75.0 (50 to 100)", ""]
    assert ["", "0.2 m", "80.0 (70 to 90)", "25.0"] in rows
    assert "0.3 m" not in said  # not measured for both seeds
    assert "pit" not in said
    assert picture.stat().st_size > 10_000


def test_seeds_are_those_of_one_task_in_one_engine(tmp_path):
    results = [
        evaluation(tmp_path / "1.json"),
        evaluation(tmp_path / "2.json", task="anymal_c_flat"),
        evaluation(tmp_path / "3.json", physics="mujoco"),
        evaluation(tmp_path / "4.json"),
    ]
    groups = grouped(results)
    assert [len(group) for group in groups.values()] == [2, 1, 1]
    assert list(groups) == [("anymal_c", "mujoco_warp"), ("anymal_c_flat", "mujoco_warp"), ("anymal_c", "mujoco")]


def test_spread_is_that_of_the_farthest():
    assert spread([1.0, 1.0, 4.0]) == pytest.approx(1.0)
    assert spread([0.0, 0.0]) == 0.0


def test_only_sizes_of_all_seeds_are_compared(tmp_path):
    results = [
        evaluation(tmp_path / "1.json", stairs={0.1: 1.0, 0.2: 0.5}),
        evaluation(tmp_path / "2.json", stairs={0.2: 0.6, 0.3: 0.1}),
    ]
    assert shares(results, "stairs_up") == {0.2: [0.5, 0.6]}
    assert shares(results, "gap") == {}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere: holds no evaluation_<physics>.json"),
        (["other.json"], "other.json: is not the result of an evaluation"),
        (["good.json", "--types", "stair_up"], "stair_up: none of the evaluations holds it; did you mean 'stairs_up'"),
        (["flat.json", "--out", "x.png"], "--out: draws success against difficulty, and none"),
    ],
)
def test_wrong_input_is_named(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    evaluation(tmp_path / "good.json", stairs={0.1: 1.0})
    evaluation(tmp_path / "flat.json")
    (tmp_path / "other.json").write_text("{}", encoding="utf-8")
    assert call(main, arguments) == 2
    assert message in capsys.readouterr().err
