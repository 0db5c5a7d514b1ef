"""`legged evaluate stress`: its files, where its robots are, and its errors."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import ENGINE, POLICY, call, kept_global_state, tiny_run

from legged.cli.evaluate import stress
from legged.evaluation import success
from legged.evaluation.measurement import Setting
from legged.evaluation.stress import measuring
from legged.evaluation.stress.disturbances import ALONE, Disturbance
from legged.evaluation.stress.measuring import GROUND, STAIRS, Bench
from legged.evaluation.success import FELL, REACHED, STUCK, Scores
from legged.policies.restore import policy_of

make = measuring.make_stressed
pytestmark = [pytest.mark.usefixtures("workplace"), pytest.mark.slow]
FLAGS = ["--physics", "mujoco", "sim.threads=1"]
LINES = 1 + len(ALONE) + 2


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of one short run on a small terrain."""
    folder = tmp_path_factory.mktemp("trained")
    small = ["terrain.num_rows=2", "terrain.max_init_terrain_level=1", "terrain.border_size=3"]
    with pytest.MonkeyPatch.context() as patch, kept_global_state():
        patch.chdir(folder)
        return folder / tiny_run("--task", "anymal_c", *small, num_envs=20, iterations=1)


def setting_of(run, overrides=ENGINE) -> Setting:
    return Setting(policy_of(str(run)), torch.device("cpu"), Path(), overrides, graph=False)


@pytest.fixture
def short(monkeypatch):
    """Measure for a moment."""
    monkeypatch.setattr(success, "TIME_S", 0.06)
    monkeypatch.setattr(measuring, "HOLD_S", 0.1)
    monkeypatch.setattr(measuring, "SETTLE_S", 0.04)


def test_the_stress_test_writes_a_table_and_a_picture(trained, short, tmp_path, capsys):
    arguments = [str(trained), "--robots-per-point", "2", "--out", str(tmp_path / "o")]
    assert call(stress.main, [*arguments, *FLAGS, "--riser", "0.12"]) == 0
    assert {path.name for path in (tmp_path / "o").iterdir()} == {"stress_mujoco.json", "stress_mujoco.png"}
    assert (tmp_path / "o" / "stress_mujoco.png").read_bytes().startswith(b"\x89PNG")
    result = json.loads((tmp_path / "o" / "stress_mujoco.json").read_text())
    assert (result["task"], result["physics"], result["contact_overflows"]) == ("anymal_c", "mujoco", 0)
    rule = result["definition"]
    assert (rule["riser_m"], rule["tread_m"], rule["robots_per_line"], rule["limit"]) == (0.12, 0.28, 2, 0.25)
    assert [line["name"] for line in result["lines"]][:3] == ["nominal", "payload", "friction"]
    assert len(result["lines"]) == LINES
    for line in result["lines"]:
        assert (line["stairs"]["robots"], line["stairs"]["stuck"], line["stairs"]["size"]) == (2, 2, 0.12)
        assert (line["flat"]["robots"], line["flat"]["fell"]) == (2, 0)
        assert line["flat"]["rmse_lin"] > 0.0
    assert {name: entry["size"] for name, entry in result["ground"].items()} == GROUND
    assert all(entry["robots"] == 2 for entry in result["ground"].values())
    assert result["settings"].keys() == {"half the time step", "elliptic cones", "impratio 100"}
    for lines in result["settings"].values():
        assert [line["name"] for line in lines] == ["nominal", "together"]
    followed = sum(line["flat"]["successes"] for line in result["lines"][1:])
    assert result["score"]["value"] == pytest.approx(followed / 2 / (2 * (LINES - 1) + len(GROUND)))
    out = capsys.readouterr().out
    for words in (
        "weak motors: motors at 85%",
        "impratio 100: together",
        "dense blocks, 0.25 m",
        "stress score",
        "0.12 x 0.28 m",
    ):
        assert words in out


def test_some_lines_are_measured_alone_at_solver_settings_of_one_s_own(trained, short, tmp_path, capsys, monkeypatch):
    """Both the lines and, with --full, the other solvers; those are others than the one that was asked for."""
    steps = []
    monkeypatch.setattr(measuring, "make_stressed", lambda *given: steps.append(given[1].sim.dt) or make(*given))
    arguments = [str(trained), "--robots-per-point", "2", "--lines", "nominal, together"]
    own = ["sim.dt=0.004", "control.decimation=5", "sim.cone=elliptic"]
    assert call(stress.main, [*arguments, *FLAGS, *own, "--out", str(tmp_path / "a")]) == 0
    result = json.loads((tmp_path / "a" / "stress_mujoco.json").read_text())
    assert [line["name"] for line in result["lines"]] == ["nominal", "together"]
    assert (result["ground"], result["settings"], result["score"]) == ({}, {}, None)
    assert result["changes"] == {"sim.threads": 1, "sim.dt": 0.004, "control.decimation": 5, "sim.cone": "elliptic"}
    assert "stairs of 0.17 x 0.28 m" in capsys.readouterr().out
    assert steps == [0.004] * 2
    steps.clear()
    assert call(stress.main, [*arguments, *FLAGS, *own, "--full", "--out", str(tmp_path / "b")]) == 0
    result = json.loads((tmp_path / "b" / "stress_mujoco.json").read_text())
    assert list(result["settings"]) == ["half the time step", "elliptic cones", "impratio 100"]
    assert steps == [0.004] * 2 + [0.002] * 2 + [0.004] * 4


def test_a_policy_of_a_plane_is_stressed_on_the_flat_only(short, tmp_path):
    arguments = [str(POLICY), "--robots-per-point", "1", "--out", str(tmp_path)]
    assert call(stress.main, [*arguments, *FLAGS]) == 0
    result = json.loads((tmp_path / "stress_mujoco.json").read_text())
    assert len(result["lines"]) == LINES
    assert not any("stairs" in line for line in result["lines"])
    assert result["ground"] == {}
    assert result["score"].keys() == {"value", "low", "high", "flat"}


def test_half_of_a_lines_robots_go_up_and_the_others_down(trained, monkeypatch):
    """Two lines of four robots: of the first, those that go up get out; of the second, those that go down fall."""
    bench = Bench(setting_of(trained), 4, tread=0.3, payload=3.0)
    assert (bench.riser, bench.limit, bench.on_plane) == (0.17, 0.25, False)
    assert [row.payload for row in bench.rows if row.payload] == [3.0] * 3  # alone, together, everything
    seen = {}

    def decide(task, act, robots):
        seen["z"] = task.terrain.origins[::2, 0, 2]
        seen["rows"], seen["each"] = task.rows, robots
        ground = task.terrain.height_map
        line = ground.heights[:, ground.heights.shape[1] // 2]
        seen["treads"] = np.diff(np.flatnonzero(np.diff(line) < -0.1)) * ground.cell
        scores = Scores(task.base_pos)
        scores.outcome.copy_(torch.tensor([REACHED, REACHED, STUCK, STUCK, STUCK, STUCK, FELL, FELL]))
        return scores, 3

    monkeypatch.setattr(measuring, "run_out", decide)
    first, second = bench.on_stairs([Disturbance("a", payload=1.0), Disturbance("b", motors=0.5)])
    assert STAIRS == ("stairs_up", "stairs_down")
    assert seen["z"][0] < 0.0 < seen["z"][1]
    assert seen["each"] == 4
    assert [row.name for row in seen["rows"]] == ["a", "a", "b", "b", "a", "a", "b", "b"]
    assert np.sort(seen["treads"])[:5] == pytest.approx(0.3)
    assert (first["successes"], first["fell"], first["stuck"], first["robots"]) == (2, 0, 2, 4)
    assert (second["successes"], second["fell"], second["stuck"]) == (0, 2, 2)
    assert bench.lost == 3


def test_what_is_asked_of_ground_and_grid_counts_for_what_is_measured(trained, monkeypatch):
    """Stairs, distances and limits of the scale that is asked for, in cells that divide the tread; commands of its grid."""
    asked = [*ENGINE, ("terrain.scale", 0.5), ("terrain.horizontal_scale", 0.1), ("evaluation.vx", [-0.3, 0.6, 0.3])]
    bench = Bench(setting_of(trained, asked), 2)
    assert (bench.riser, bench.limit) == (0.085, pytest.approx(0.25 * 0.5**0.5))
    seen = {}

    def look(task, act, robots):
        ground = task.terrain.height_map
        line = ground.heights[:, ground.heights.shape[1] // 2]
        seen["treads"] = np.diff(np.flatnonzero(np.diff(line) < -0.05)) * ground.cell
        seen["side"], seen["cell"] = task.terrain.tile_size[0], task.cfg.terrain.horizontal_scale
        return Scores(task.base_pos), 0

    monkeypatch.setattr(measuring, "run_out", look)
    bench.on_stairs([Disturbance("a", payload=1.0)])
    assert seen["cell"] == pytest.approx(0.28 / 3)
    assert np.sort(seen["treads"])[:3] == pytest.approx(0.28)
    assert seen["side"] == pytest.approx(4.0, abs=0.1)

    def follow(task, act, commands):
        seen["vx"] = commands[:, 0].tolist()
        return torch.zeros(len(commands)), torch.zeros(len(commands), dtype=torch.bool)

    monkeypatch.setattr(bench, "_follow", follow)
    bench.on_flat([Disturbance("a")])
    assert seen["vx"] == pytest.approx([0.6, -0.3])


def test_robots_take_turns_at_commands_within_the_tasks_grid(trained, monkeypatch):
    bench = Bench(setting_of(trained), 9)
    seen = {}

    def look(task, act, commands):
        seen["commands"], seen["plane"] = commands, task.terrain is None
        return torch.full((len(commands),), 0.01), torch.zeros(len(commands), dtype=torch.bool)

    monkeypatch.setattr(bench, "_follow", look)
    found = bench.on_flat([Disturbance("a"), Disturbance("b", motors=0.5)])
    assert seen["plane"]
    assert seen["commands"].shape == (18, 3)
    assert torch.equal(seen["commands"][:9], seen["commands"][9:])
    assert torch.equal(seen["commands"][0], seen["commands"][8])
    assert seen["commands"][:8].tolist()[:2] == [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]
    assert [one["rmse_lin"] for one in found] == pytest.approx([0.1, 0.1])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--physics", "all"], ["sim.physics", "'all'"]),
        (["--tread", "0"], ["--tread: must be between 0.05 and 2 m, got 0"]),
        (["--riser", "nan"], ["--riser: must be between 0 and 1 m, got nan"]),
        (["--payload", "-1"], ["--payload: must be between 0 and 1000 kg, got -1"]),
        (["--lines", "nominal,paylaod"], ["--lines: there is no line 'paylaod'; did you mean 'payload'?"]),
        (
            ["domain_rand.ranges.friction=[0.5,0.6]"],
            ["domain_rand.ranges.friction: leave it out, because `legged evaluate stress` sets this property"],
        ),
        (["domain_rand.ranges={joint_offset: [0,0.1]}"], ["domain_rand.ranges.joint_offset: leave it out"]),
        (["--robots-per-point", "0"], ["--robots-per-point", "at least 1, got 0"]),
    ],
)
def test_wrong_flags(arguments, words, capsys):
    assert call(stress.main, [str(POLICY), *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    for word in words:
        assert word in error


def test_a_task_without_commands_is_not_stressed(capsys):
    assert call(stress.main, ["half_cheetah"]) == 2
    assert "POLICY: 'half_cheetah' has no velocity commands" in capsys.readouterr().err
