"""Evaluating policies of tasks with terrain: types and sizes, rough ground, and the command with its files and errors."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import POLICY, call, kept_global_state, run_folders, small_config, stand, tiny_run

from legged import make_task
from legged.cli.evaluate import evaluate
from legged.cli.evaluate import grid as evaluate_grid
from legged.cli.evaluate import terrain as evaluate_terrain
from legged.config import override
from legged.errors import ConfigError
from legged.evaluation import success
from legged.evaluation.following import evaluate_following
from legged.evaluation.measurement import Setting, warn_of_overflows
from legged.evaluation.success import (
    chosen_sizes,
    is_beyond,
    panels_of,
    sizes_of,
    trained_to,
    with_other_engines,
)
from legged.evaluation.tiles import cell_for, dividing_cell, on_terrain, rough_ground, rough_side, tiles_of_sizes
from legged.evaluation.velocity_grid import Grid
from legged.evaluation.velocity_tracking import measure_tracking, place_to_track
from legged.learning.run_folder import find_checkpoint, run_config
from legged.policies.restore import TrainedPolicy, undisturbed
from legged.registry import task_config
from legged.terrain import Terrain, TileSpec, check_terrain

pytestmark = pytest.mark.usefixtures("workplace")


# ---- types and sizes -------------------------------------------------------------------------------------------------


def test_where_training_ended():
    cfg = task_config("anymal_c", [("terrain.num_rows", 10), ("terrain.proportions.waves", 0.0)], on_cpu=True)
    ends = trained_to(cfg)
    assert ends.keys() == {name for name, share in cfg.terrain.proportions.items() if share > 0.0}
    assert ends["stairs_up"] == pytest.approx(0.05 + 0.18 * 0.9)  # the hardest of ten rows has difficulty 0.9
    assert ends["obstacles"] == pytest.approx(0.05 + 0.2 * 0.9)
    assert ends["slope_down"] == pytest.approx(math.degrees(math.atan(0.36)))
    assert trained_to(small_config()) == {}
    two_rows = task_config("anymal_c", [("terrain.num_rows", 2), ("terrain.max_init_terrain_level", 1)], on_cpu=True)
    assert trained_to(two_rows)["stairs_up"] == pytest.approx(0.14)


def test_sweeps_go_beyond_training_and_stones_get_harder_as_they_shrink():
    for name, end in trained_to(task_config("anymal_c", on_cpu=True)).items():
        for full in (False, True):
            sizes = sizes_of(name, full)
            assert list(sizes) == sorted(sizes)
            assert sizes[0] < end < sizes[-1]
        assert set(sizes_of(name, False)) <= set(sizes_of(name, True))
    assert is_beyond("stairs_up", 0.25, 0.212)
    assert not is_beyond("stairs_up", 0.2, 0.212)
    assert not is_beyond("stairs_up", 0.25, None)
    assert is_beyond("stepping_stones", 0.2, 0.225)
    assert not is_beyond("stepping_stones", 0.3, 0.225)


def test_panels():
    assert panels_of(["pit", "stairs_down", "slope_up", "stairs_up", "pit"]) == {
        "stairs": ("stairs_up", "stairs_down"),
        "slopes": ("slope_up",),
        "pit": ("pit",),
    }


def test_types_that_are_asked_for():
    rough, flat = task_config("anymal_c", on_cpu=True), small_config()
    trained = [name for name, share in rough.terrain.proportions.items() if share > 0.0]
    assert list(chosen_sizes(rough, None, False, 1.0)) == trained
    assert chosen_sizes(rough, "pit, gap", True, 0.5) == {name: sizes_of(name, True, 0.5) for name in ("pit", "gap")}
    assert chosen_sizes(flat, None, False, 1.0) == {}
    assert list(chosen_sizes(flat, "pit", False, 1.0)) == ["pit"]
    with pytest.raises(ConfigError, match=r"--types: there is no terrain type 'stair_up'; did you mean 'stairs_up'"):
        chosen_sizes(rough, "stair_up", False, 1.0)
    blind_ground = task_config("anymal_c", [("terrain.mesh_type", "plane")], on_cpu=True)
    with pytest.raises(ConfigError, match=r"--types: .*'heights'"):
        chosen_sizes(blind_ground, "pit", False, 1.0)


def test_sizes_that_are_asked_for():
    """As they are, whatever the scale and --full; the others as ever."""
    cfg = task_config("anymal_c", on_cpu=True)
    chosen = chosen_sizes(cfg, "kerbs=0.17, pit,slope_up = 10:25:5,stairs_down=0.2:0.31:0.05", True, 0.5)
    assert chosen == {
        "kerbs": (0.17,),
        "pit": sizes_of("pit", True, 0.5),
        "slope_up": (10.0, 15.0, 20.0, 25.0),
        "stairs_down": (0.2, 0.25, 0.3),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ("kerbs=", "kerbs: '' is not of the form low:high:step, e.g. kerbs=0.1:0.2:0.05"),
        ("kerbs=high", "kerbs: 'high' is not of the form"),
        ("kerbs=0.3:0.1:0.1", "kerbs: '0.3:0.1:0.1' is not of the form"),
        ("kerbs=0", "kerbs: sizes are at least 0.001 and at most 100 m, got '0'"),
        ("slope_up=10:90:10", "slope_up: sizes are at least 0.001 and at most 80 degrees, got '10:90:10'"),
        ("kerbs=0.1:1:0.001", "kerbs: '0.1:1:0.001' makes 901 sizes; at most 100 are possible"),
        ("kerbs=nan", "kerbs: 'nan' is not of the form"),
        ("kerbs=0.1,kerbs=0.2", "'kerbs' is given twice"),
        ("kerb=0.1", "there is no terrain type 'kerb'; did you mean 'kerbs'"),
    ],
)
def test_sizes_that_are_none_are_refused(asked, says):
    with pytest.raises(ConfigError, match=f"^--types: {re.escape(says)}"):
        chosen_sizes(task_config("anymal_c", on_cpu=True), asked, False, 1.0)


# ---- rough ground ----------------------------------------------------------------------------------------------------


def test_rough_ground_is_large_enough_and_has_bumps_of_5_cm():
    assert rough_side(Grid([-1.0, 1.0], [-1.0, 1.0], [0.0])) == 20.0  # 2 + 4 * 1.414 + 1.5 = 9.2 m to each side
    assert rough_side(Grid([3.0], [0.0], [0.0])) == 32.0  # 2 + 12 + 1.5
    cfg = override(small_config(), on_terrain(small_config(), 20.0, 2.0)).terrain
    terrain = rough_ground(cfg, seed=1)
    assert terrain.tile_size == (20.0, 20.0)
    tile = terrain.height_map.heights[30:-30, 30:-30]
    assert tile.shape == (200, 200)
    assert (tile.min(), tile.max()) == pytest.approx((-0.05, 0.05))
    assert abs(tile.mean()) < 0.002
    blocks = tile.reshape(4, 50, 4, 50).std(axis=(1, 3))
    assert blocks.min() > 0.01  # everywhere, and no slope
    assert abs(tile.reshape(4, 50, 4, 50).mean(axis=(1, 3))).max() < 0.01


def test_small_robots_are_tracked_on_rough_ground_too():
    """Their cells are small: on ten times twenty tiles of 20 m they would be too many, and only one is built."""
    cfg = task_config("go2", [("sim.physics", "mujoco")])
    grid = Grid([-1.0, 1.0], [-1.0, 1.0], [0.0])
    changes, ground = place_to_track(cfg, grid, [])
    check_terrain(override(cfg, changes).terrain, cfg.origins)
    assert min(ground.tile_size) == pytest.approx(rough_side(grid), abs=cfg.terrain.horizontal_scale)


@pytest.mark.slow
def test_bumps_are_as_high_as_is_said_for_a_small_robot(tmp_path, capsys):
    """A Go2's ground is 0.589 times an ANYmal's."""
    cfg = override(run_config(POLICY.with_name("go2")), [("sim.physics", "mujoco"), ("sim.threads", 1)])
    heights = place_to_track(cfg, Grid([0.5], [0.0], [0.0]), [])[1].height_map.heights
    assert (heights.min(), heights.max()) == pytest.approx((-0.0295, 0.0295), abs=1e-4)
    policy = TrainedPolicy(cfg, find_checkpoint(POLICY.with_name("go2"), None))
    grid = Grid([0.5], [0.0], [0.0], robots=1, hold_s=1.2)
    assert evaluate_following(Setting(policy, torch.device("cpu"), tmp_path, graph=False), grid) == 0
    assert "on level ground with bumps of up to 2.9 cm" in capsys.readouterr().out
    assert json.loads((tmp_path / "evaluation_mujoco.json").read_text())["rough"]["bumps"] == pytest.approx(0.0295, abs=1e-4)


def test_types_are_measured_in_cells_that_make_what_they_are_called():
    """0.28 m are 3 cells of 0.0933 m, not 2 of 0.1 m; a robot of another size has treads and cells times the scale."""
    terrain = task_config("anymal_c", on_cpu=True).terrain
    assert (terrain.scale, terrain.horizontal_scale) == (1.0, 0.1)
    assert cell_for("stairs_up", terrain) == 0.1
    assert cell_for("narrow_stairs_up", terrain) == pytest.approx(0.28 / 3)
    assert dividing_cell(0.4, 0.1) == pytest.approx(0.1)
    half = replace(terrain, scale=0.5, horizontal_scale=0.05)
    assert cell_for("narrow_stairs_down", half) == pytest.approx(0.14 / 3)
    cfg = replace(terrain, horizontal_scale=cell_for("narrow_stairs_down", terrain), terrain_length=8.0, terrain_width=8.0)
    heights = tiles_of_sizes("narrow_stairs_down", [0.1], cfg, 1).height_map
    middle = heights.heights[:, heights.heights.shape[1] // 2]
    rises = np.flatnonzero(np.diff(middle) > 0.05)
    assert len(rises) > 5
    assert np.diff(rises) * heights.cell == pytest.approx(0.28)


@pytest.mark.slow
def test_height_of_the_gait_is_above_the_ground():
    grid = Grid([0.0], [0.0], [0.0], robots=2, hold_s=1.0, settle_s=0.5)
    cfg = override(small_config(), [*undisturbed(small_config(), 2, 1.0), *on_terrain(small_config(), 8.0, 0.1)])
    pit = Terrain.of_tiles([[TileSpec("pit", 0.8)]], cfg.terrain, None)
    result = measure_tracking(make_task(cfg, terrain=pit), stand, grid)
    assert 0.45 < result["gait"]["base_height"] < 0.6
    assert result["contact_overflows"] == 0


@pytest.mark.slow
def test_lost_contacts_are_counted_over_all_rollouts(monkeypatch):
    grid = Grid([0.0], [0.0], [0.0], robots=3, hold_s=0.6, settle_s=0.2)
    cfg = small_config()
    changes = [*undisturbed(cfg, 3, 0.6), ("train.runner.num_steps_per_env", 24)]  # so that 30 steps are a rollout and a part
    task = make_task(override(cfg, changes))
    refresh = task.physics.refresh

    def lose():
        refresh()
        task.physics.overflowed.fill_(True)

    monkeypatch.setattr(task.physics, "refresh", lose)
    assert measure_tracking(task, stand, grid)["contact_overflows"] == 90


# ---- the command -----------------------------------------------------------------------------------------------------

HERE = ["--physics", "mujoco", "sim.threads=1"]
CELL = ["--vx=0", "--vy=0", "--yaw=0", "--robots", "1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with one short run on a small terrain."""
    folder = tmp_path_factory.mktemp("trained")
    small = ["terrain.num_rows=2", "terrain.max_init_terrain_level=1", "terrain.border_size=3"]
    with pytest.MonkeyPatch.context() as patch, kept_global_state():
        patch.chdir(folder)
        tiny_run("--task", "anymal_c", *small, num_envs=20, iterations=1)
    return folder


@pytest.fixture
def run(trained, monkeypatch) -> Path:
    monkeypatch.chdir(trained)
    monkeypatch.setattr(success, "TIME_S", 0.1)
    monkeypatch.setattr(success, "FEWER", dict.fromkeys(("stairs_up", "slope_down"), (0.1, 0.2)))
    (folder,) = run_folders()
    return folder


@pytest.mark.slow
def test_terrain_and_grid_write_their_parts_into_one_file(run, tmp_path, capsys):
    """Each keeps the other's part, as long as both are of the same policy, engine and settings."""
    out = ["--out", str(tmp_path / "o")]
    points = ["--types", "stairs_up,slope_down", "--robots-per-point", "2"]
    assert call(evaluate_terrain.main, ["anymal_c", *HERE, *points, *out]) == 0
    path = tmp_path / "o" / "evaluation_mujoco.json"
    alone = json.loads(path.read_text())
    assert "success" in alone
    assert "rough" not in alone
    assert call(evaluate_grid.main, ["anymal_c", *HERE, *CELL, *out]) == 0
    both = json.loads(path.read_text())
    assert both["success"] == alone["success"]
    assert call(evaluate_terrain.main, ["anymal_c", *HERE, "--types", "slope_down", "--robots-per-point", "1", *out]) == 0
    again = json.loads(path.read_text())
    assert again["rough"] == both["rough"]
    assert list(again["success"]["types"]) == ["slope_down"]
    changed = [*HERE, "sim.iterations=30"]
    assert call(evaluate_grid.main, ["anymal_c", *changed, *CELL, *out]) == 0
    assert "success" not in json.loads(path.read_text())
    path.write_text(json.dumps({**again, "checkpoint": "model_7.pt"}))
    assert call(evaluate_grid.main, ["anymal_c", *HERE, *CELL, *out]) == 0
    assert "success" not in json.loads(path.read_text())


@pytest.mark.slow
def test_evaluate_measures_success_and_tracking_on_rough_ground(run, tmp_path, capsys):
    """Each by its own command, into the same folder."""
    here = ["anymal_c", *HERE, "--out", str(tmp_path / "o")]
    assert call(evaluate_grid.main, [*here, *CELL]) == 0
    assert call(evaluate_terrain.main, [*here, "--types", "stairs_up,slope_down", "--robots-per-point", "2"]) == 0
    out = capsys.readouterr().out
    files = {path.name for path in (tmp_path / "o").iterdir()}
    assert files == {"evaluation_mujoco.json", "evaluation_mujoco.png", "success_mujoco.png"}
    assert (tmp_path / "o" / "success_mujoco.png").read_bytes().startswith(b"\x89PNG")
    result = json.loads((tmp_path / "o" / "evaluation_mujoco.json").read_text())
    assert {"rough", "success"} <= result.keys()
    assert "rmse_lin" not in result  # figures of a plane and of rough ground must not be taken for each other
    assert len(result["rough"]["cells"]) == 1
    assert result["rough"]["contact_overflows"] == 0
    found = result["success"]
    assert (found["robots_per_point"], found["contact_overflows"]) == (2, 0)
    stairs = found["types"]["stairs_up"]
    assert (stairs["unit"], stairs["what"], stairs["trained_to"]) == ("m", "step height", pytest.approx(0.14))
    assert [(entry["size"], entry["robots"], entry["stuck"]) for entry in stairs["points"]] == [(0.1, 2, 2), (0.2, 2, 2)]
    for words in ("tracking on rough ground: 1 commands", "stairs_up: 2 sizes x 2 robots", "0.2 m *", "0/2 = 0 %"):
        assert words in out
    assert "success_mujoco.png" in out


@pytest.mark.slow
def test_a_policy_of_rough_ground_is_measured_on_the_plane_that_is_asked_for(run, tmp_path, capsys):
    """It was put on bumps, and nothing said so."""
    here = ["anymal_c", *HERE, "terrain.mesh_type=plane", "--out", str(tmp_path)]
    assert call(evaluate_grid.main, [*here, *CELL]) == 0
    assert "on rough ground" not in capsys.readouterr().out
    result = json.loads((tmp_path / "evaluation_mujoco.json").read_text())
    assert "rough" not in result
    assert len(result["cells"]) == 1


@pytest.mark.slow
def test_evaluate_alone_measures_both_on_the_task_s_own_grid_and_types(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(trained)
    asked = []
    monkeypatch.setattr("legged.cli.evaluate.evaluate_following", lambda *given: asked.append(given) or 0)
    assert call(evaluate.main, ["anymal_c", *HERE, "--out", str(tmp_path / "o")]) == 0
    ((setting, grid, sizes, robots),) = asked
    assert grid.axes["vx"] == [-1.0, -0.5, 0.0, 0.5, 1.0]
    assert {name for name, share in setting.cfg.terrain.proportions.items() if share > 0.0} == set(sizes)
    assert robots == 32


def test_the_other_engine_is_drawn_too_if_it_is_of_the_same_checkpoint(tmp_path):
    entry = {"unit": "m", "what": "step height", "trained_to": None, "points": []}
    success = {"types": {"stairs_up": entry}, "robots_per_point": 2}
    mine = {"task": "t", "checkpoint": "model_1.pt", "physics": "mujoco", "success": success}
    bare = {"types": {"stairs_up": {**entry, "points": [{"size": 0.1, "share": 1.0}]}}, "robots_per_point": 2}  # no interval
    others = ("physics", "physx"), ("checkpoint", "model_2.pt")
    foreign = [{"success": bare}, {"success": {"types": {}}}, {"success": 3}, *({name: value} for name, value in others)]
    path, other = tmp_path / "evaluation_mujoco.json", tmp_path / "evaluation_mujoco_warp.json"
    assert with_other_engines(mine, path) == [mine]
    for text in ("{}", "[]", "nonsense", *(json.dumps({**mine, "physics": "mujoco_warp", **change}) for change in foreign)):
        other.write_text(text)
        assert with_other_engines(mine, path) == [mine]
    other.write_text(json.dumps({**mine, "physics": "mujoco_warp"}))
    assert [one["physics"] for one in with_other_engines(mine, path)] == ["mujoco_warp", "mujoco"]
    other.write_text(json.dumps({**mine, "physics": "mujoco_warp", "changes": {"terrain.scan": "lowest"}}))
    assert with_other_engines(mine, path) == [mine]  # its curve is of other settings, and the picture would not say so


@pytest.mark.slow
def test_a_plane_task_is_evaluated_as_ever_and_crosses_terrain_only_if_asked(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(success, "TIME_S", 0.1)
    monkeypatch.setattr("legged.cli.evaluate.ROBOTS", 1)
    arguments = [str(POLICY), *HERE, *(f"evaluation.{axis}=[0,0,1]" for axis in ("vx", "vy", "yaw"))]
    shipped = json.loads((POLICY / "evaluation_mujoco.json").read_text())
    assert call(evaluate.main, [*arguments, "--out", str(tmp_path / "plane")]) == 0
    plane = json.loads((tmp_path / "plane" / "evaluation_mujoco.json").read_text())
    assert plane.keys() == shipped.keys()
    assert plane["cells"][0].keys() == shipped["cells"][0].keys()
    assert not (tmp_path / "plane" / "success_mujoco.png").exists()
    assert "success" not in capsys.readouterr().out
    assert call(evaluate.main, [*arguments, "--out", str(tmp_path / "both")]) == 0
    crossed = ["--types", "waves", "--robots-per-point", "1", "--out", str(tmp_path / "both")]
    assert call(evaluate_terrain.main, [str(POLICY), *HERE, *crossed]) == 0
    both = json.loads((tmp_path / "both" / "evaluation_mujoco.json").read_text())
    assert both.keys() == shipped.keys() | {"success"}
    assert both["success"]["types"]["waves"]["trained_to"] is None
    assert both["rmse_lin"] == plane["rmse_lin"]


def test_lost_contacts_are_warned_of(capsys):
    warn_of_overflows("success", 0)
    assert capsys.readouterr().err == ""
    warn_of_overflows("success", 7)
    assert "7 times" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--types", "stairsup"], ["--types", "did you mean 'stairs_up'?"]),
        (["--types", ""], ["--types", "no terrain type ''"]),
        (["--types", "pit,gap,pit"], ["--types: 'pit' is given twice"]),
        (["--robots-per-point", "0"], ["--robots-per-point", "at least 1, got 0"]),
    ],
)
def test_wrong_input(arguments, words, capsys):
    assert call(evaluate_terrain.main, [str(POLICY), *HERE, *arguments]) == 2
    error = capsys.readouterr().err
    for word in words:
        assert word in error
