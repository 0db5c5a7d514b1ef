"""Evaluations side by side: seeds become means and spreads, by hand."""

import json
import warnings

import pytest
from helpers import call

from legged.cli.runs import evaluations
from legged.evaluation.reports.comparison import grouped, shares, spread

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
    picture = tmp_path / "pictures" / "success.png"
    assert (
        evaluations.main([str(tmp_path / "a"), str(tmp_path / "b"), "--types", "stairs_up", "--out", str(picture.parent)])
        == 0
    )
    said = capsys.readouterr().out
    rows = rows_of(said)
    lines = {row[0]: row[1:] for row in rows}
    assert lines["velocity RMSE, mean [m/s]"] == ["0.110 (9 %)", "0.200"]
    assert lines["yaw rate RMSE, worst cell [rad/s]"] == ["0.330 (9 %)", "0.600"]
    assert lines["falls [%]"] == ["0.00 (0 %)", "0.00"]
    assert lines["stairs_up"] == ["0.1 m", "75.0 (50 to 100)", ""]
    assert ["", "0.2 m", "80.0 (70 to 90)", "25.0"] in rows
    assert "0.3 m" not in said  # not measured for both seeds
    assert "pit" not in said
    assert picture.stat().st_size > 10_000


def test_an_evaluation_that_is_named_twice_is_one_seed(tmp_path, capsys):
    evaluation(tmp_path / "a" / "evaluation_mujoco.json", physics="mujoco")
    assert evaluations.main([str(tmp_path / "a"), str(tmp_path / "a" / "evaluation_mujoco.json")]) == 0
    assert "C MuJoCo, 1 seed " in capsys.readouterr().out


@pytest.mark.slow
def test_panels_of_types_that_one_engine_has_not_seen_are_as_wide_as_the_others(tmp_path, capsys):
    """An empty line that is not clipped took the room of all panels; matplotlib said so, and drew them into corners."""
    there = evaluation(tmp_path / "evaluation_mujoco_warp.json", stairs={0.1: 1.0, 0.2: 0.9})
    evaluation(tmp_path / "evaluation_mujoco.json", physics="mujoco", stairs={0.1: 1.0, 0.2: 0.9})
    types = there["success"]["types"]
    types |= {"slope_up": types["pit"], "slope_down": types["pit"], "gap": types["pit"]}
    (tmp_path / "evaluation_mujoco_warp.json").write_text(json.dumps(there))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert evaluations.main([str(tmp_path), "--out", str(tmp_path)]) == 0
    assert "written:" in capsys.readouterr().out


def test_seeds_are_those_of_one_task_in_one_engine(tmp_path):
    results = [
        evaluation(tmp_path / "1.json"),
        evaluation(tmp_path / "2.json", task="anymal_c_flat"),
        evaluation(tmp_path / "3.json", physics="mujoco"),
        evaluation(tmp_path / "4.json"),
    ]
    groups = grouped(results)
    assert [len(group) for group in groups.values()] == [2, 1, 1]
    assert list(groups) == [("anymal_c", "mujoco_warp", ""), ("anymal_c_flat", "mujoco_warp", ""), ("anymal_c", "mujoco", "")]


def rows_of(said):
    """The cells of tables, line by line."""
    return [[cell.strip() for cell in line.split("│")[1:-1]] for line in said.split("\n") if "│" in line]


def test_evaluations_under_other_conditions_are_no_seeds_of_each_other(tmp_path, capsys):
    """One policy with its own map, with another one, and on another grid: none of them is averaged with another."""
    own = evaluation(tmp_path / "1.json", rmse=0.1, stairs={0.2: 0.9})
    other = evaluation(tmp_path / "2.json", rmse=0.3, stairs={0.2: 0.1}) | {"changes": {"terrain.scan": "highest"}}
    (tmp_path / "2.json").write_text(json.dumps(other))
    assert evaluations.main([str(tmp_path / "1.json"), str(tmp_path / "2.json"), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "terrain.scan=highest" in said
    assert " seeds " not in said.replace("mean of seeds (", "")
    assert ["velocity RMSE, mean [m/s]", "0.100", "0.300"] in rows_of(said)
    assert ["stairs_up", "0.2 m", "90.0", "10.0"] in rows_of(said)
    grids = {"vx": [-1.0, 0.0, 1.0], "vy": [0.0], "yaw": [0.0, 0.5]}, {"vx": [0.5], "vy": [0.0], "yaw": [0.0]}
    for name, grid in zip("34", grids, strict=True):
        (tmp_path / f"{name}.json").write_text(json.dumps(own | {"rough": own["rough"] | {"grid": grid}}))
    groups = grouped([json.loads((tmp_path / f"{name}.json").read_text()) for name in "34"])
    assert [key[2] for key in groups] == ["vx -1 to 1, vy 0, yaw 0 to 0.5 (6 commands)", "vx 0.5, vy 0, yaw 0 (1 command)"]
    (alone,) = grouped([json.loads((tmp_path / "3.json").read_text())] * 2)
    assert alone == ("anymal_c", "mujoco_warp", "")  # where all have one grid there is nothing to tell


def test_success_of_some_of_the_seeds_says_of_how_many_it_is(tmp_path, capsys):
    """Of three seeds one was measured on the plane only, and one on stairs but not on a pit."""
    evaluation(tmp_path / "1.json", stairs={0.1: 1.0})
    second = evaluation(tmp_path / "2.json", stairs={0.1: 0.5})
    del second["success"]["types"]["pit"]
    (tmp_path / "2.json").write_text(json.dumps(second))
    evaluation(tmp_path / "3.json")
    names = [str(tmp_path / f"{i}.json") for i in (1, 2, 3)]
    assert evaluations.main([*names, "--out", str(tmp_path)]) == 0
    rows = rows_of(capsys.readouterr().out)
    assert ["stairs_up", "0.1 m", "75.0 (50 to 100, of 2 of 3 seeds)"] in rows
    assert ["pit", "0.1 m", "100.0 (of 1 of 3 seeds)"] in rows


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
        (["flat.json", "--out", "x"], "--out: there is nothing to draw"),
    ],
)
def test_wrong_input_is_named(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    evaluation(tmp_path / "good.json", stairs={0.1: 1.0})
    evaluation(tmp_path / "flat.json")
    (tmp_path / "other.json").write_text("{}", encoding="utf-8")
    assert call(evaluations.main, arguments) == 2
    assert message in capsys.readouterr().err


def changed(result, path, value):
    """The result with another value at a path of keys."""
    inner = result = json.loads(json.dumps(result))  # its parts may be one object
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return result


POINT = ("success", "types", "pit", "points")


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("task",), 3, "task: expected a text, got int '3'"),
        (("rough",), [], "rough: expected a mapping, got list"),
        (("rough", "falls"), None, "rough.falls: expected a number, got nothing"),
        (("rough", "falls"), float("nan"), "rough.falls: expected a number, got float 'nan'"),
        (("rough", "rmse_lin", "mean"), "0.1", "rough.rmse_lin.mean: expected a number or null, got str '0.1'"),
        (("success",), 1, "success: expected a mapping, got int"),
        (("success", "types"), None, "success.types: expected a mapping, got nothing"),
        (("success", "types", "pit"), [], "success.types.pit: expected a mapping"),
        ((*POINT[:-1], "unit"), 1, "success.types.pit.unit: expected a text"),
        (POINT, {}, "success.types.pit.points: expected a list"),
        (("changes",), 3, "changes: expected a mapping, got int '3'"),
        (("rough", "grid"), {"vx": []}, "rough.grid.vx: expected a list with entries, got list '[]'"),
        (("rough", "grid"), {"vx": ["a"]}, "rough.grid.vx[0]: expected a number, got str 'a'"),
        ((*POINT, 0, "share"), True, "success.types.pit.points[0].share: expected a number, got bool"),
    ],
)
def test_a_field_of_another_type_is_named(path, value, words, tmp_path, capsys):
    result = evaluation(tmp_path / "x.json", stairs={0.1: 1.0})
    (tmp_path / "x.json").write_text(json.dumps(changed(result, path, value)))
    assert evaluations.main([str(tmp_path / "x.json")]) == 2
    err = capsys.readouterr().err
    assert f"x.json: is not the result of an evaluation: {words}" in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("text", ["[1, 2]", "3", "null", "[" * 100_000, "\udcff", "{"])
def test_a_file_of_something_else_is_named(text, tmp_path, capsys):
    (tmp_path / "x.json").write_bytes(text.encode("utf-8", errors="surrogateescape"))
    assert evaluations.main([str(tmp_path / "x.json")]) == 2
    assert "x.json: is not the result of an evaluation" in capsys.readouterr().err


def test_who_fell_before_anything_was_measured_has_no_error(tmp_path, capsys):
    nothing = {"mean": None, "worst": None}
    for name in ("1", "2"):
        result = evaluation(tmp_path / f"{name}.json", rmse=0.3)
        (tmp_path / f"{name}.json").write_text(json.dumps({**result, "rmse_lin": nothing, "falls": 1.0}))
    assert evaluations.main([str(tmp_path / "1.json"), str(tmp_path / "2.json")]) == 0
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in capsys.readouterr().out.split("\n") if "│" in line]
    lines = {row[0]: row[1:] for row in rows}
    assert lines["velocity RMSE, mean [m/s]"] == ["none"]
    assert lines["yaw rate RMSE, mean [rad/s]"] == ["0.300 (0 %)"]
    assert lines["falls [%]"] == ["100.00 (0 %)"]


def test_a_mean_without_the_seeds_that_fell_says_of_how_many_it_is(tmp_path, capsys):
    for name, rmse in (("1", 0.3), ("2", 0.5), ("3", None), ("4", None)):
        result = evaluation(tmp_path / f"{name}.json", rmse=rmse or 0.1)
        changes = {} if rmse else {"rmse_lin": {"mean": None, "worst": None}, "falls": 1.0}
        (tmp_path / f"{name}.json").write_text(json.dumps({**result, **changes}))

    def told(*names):
        assert evaluations.main([str(tmp_path / f"{name}.json") for name in names]) == 0
        lines = capsys.readouterr().out.split("\n")
        return {line.split("│")[1].strip(): line.split("│")[2].strip() for line in lines if line.count("│") == 3}

    assert told("1", "3")["velocity RMSE, mean [m/s]"] == "0.300 (of 1 of 2 seeds)"
    found = told("1", "2", "3", "4")
    assert found["velocity RMSE, worst cell [m/s]"] == "0.800 (25 %, of 2 of 4 seeds)"
    assert found["falls [%]"] == "50.00 (100 %)"


def test_an_engine_of_another_version_and_brackets_in_names_are_shown_as_they_are(tmp_path, capsys):
    evaluation(tmp_path / "1.json", task="[/x]", physics="[red]physx", stairs={0.1: 1.0, 0.2: 0.5})
    out = tmp_path / "new" / "success.png"
    assert evaluations.main([str(tmp_path / "1.json"), "--out", str(out.parent)]) == 0
    said = capsys.readouterr().out
    assert "[/x]" in said
    assert "[red]physx, 1 seed" in said
    assert out.stat().st_size > 10_000


def test_a_folder_that_is_a_file_is_refused_before_anything_is_read(tmp_path, capsys):
    (tmp_path / "taken").touch()
    assert evaluations.main([str(tmp_path / "none"), "--out", str(tmp_path / "taken")]) in (1, 2)
    err = capsys.readouterr().err
    assert str(tmp_path / "taken") in err
    assert str(tmp_path / "none") not in err
