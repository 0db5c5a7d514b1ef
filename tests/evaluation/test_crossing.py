"""One policy in every engine: the command, its table and its files."""

import json
from typing import get_args

import pytest
from helpers import TASK, call, kept_global_state, tiny_run
from rich.console import Console

from legged.cli.evaluate import grid
from legged.config.world import NewtonSolver
from legged.evaluation import following

GRID = ["--vx=0:0.5:0.5", "--vy=0", "--yaw=0", "--robots", "1"]
ENGINES = ["mujoco_warp", "mujoco", *(f"newton_{name}" for name in get_args(NewtonSolver))]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of one short run, trained in one of Newton's solvers."""
    folder = tmp_path_factory.mktemp("crossing")
    with pytest.MonkeyPatch.context() as patch, kept_global_state():
        patch.chdir(folder)
        path = tiny_run("--physics", "newton", "--solver", "steel", num_envs=4, iterations=1)
        assert "solver: steel" in (path / "config.yaml").read_text()
        yield folder / path


@pytest.fixture(autouse=True)
def beside(run, monkeypatch):
    monkeypatch.chdir(run.parents[2])


def result(engine: str, **changes: float | None) -> dict:
    """An engine's figures."""
    same = {"rmse_lin": 0.1, "rmse_ang": 0.2, "falls": 0.0, "cost_of_transport": 0.5, "base_height": 0.5}
    return {"physics": engine, "device": "cpu", "contact_overflows": 0, "steps_per_s": 1234.5, **same, **changes}


@pytest.mark.slow
def test_all_engines_there_are_take_part():
    asked = [dict(engine.overrides) for engine in following.ENGINES.values()]
    names = [f"newton_{one['sim.solver']}" if "sim.solver" in one else one["sim.physics"] for one in asked]
    assert names == list(following.ENGINES) == ENGINES


@pytest.mark.slow
def test_the_command_measures_each_engine_and_writes_beside_the_checkpoint(run, capsys, monkeypatch):
    chosen = {name: following.ENGINES[name] for name in ("mujoco", "newton_mujoco")}
    monkeypatch.setattr(following, "ENGINES", chosen)
    assert call(grid.main, [TASK, "--physics", "all", "--sim_device", "cpu", *GRID, "sim.threads=1"]) == 0
    out = capsys.readouterr().out
    found = json.loads((run / "crossing.json").read_text())
    assert "changes" not in found
    assert [row["physics"] for row in found["engines"]] == ["mujoco", "newton_mujoco"]
    assert (run / "crossing.png").read_bytes().startswith(b"\x89PNG")
    assert not list(run.glob(".crossing*"))
    one, other = found["engines"]
    # An untrained policy hardly moves; the same equations answer it the same.
    assert other["rmse_lin"] == pytest.approx(one["rmse_lin"], rel=0.1)
    assert other["base_height"] == pytest.approx(one["base_height"], abs=0.01)
    assert one["steps_per_s"] > 0
    for words in ("newton_mujoco", f"{one['rmse_lin']:.3f} m/s", "crossing.json", "2 commands x 1 robots"):
        assert words in out


@pytest.mark.slow
def test_the_file_says_what_was_changed(run, monkeypatch):
    figures = {"rmse_lin": {"mean": 0.1}, "rmse_ang": {"mean": 0.1}, "gait": {"base_height": 0.5}}
    figures |= {"falls": 0.0, "cost_of_transport": 0.5, "contact_overflows": 0}
    monkeypatch.setattr(following, "ENGINES", {"mujoco": following.ENGINES["mujoco"]})
    monkeypatch.setattr(following, "measure_tracking", lambda *_: figures)
    arguments = [TASK, "--physics", "all", "--sim_device", "cpu", *GRID, "sim.threads=1", "sim.iterations=30"]
    assert call(grid.main, arguments) == 0
    assert json.loads((run / "changed" / "crossing.json").read_text())["changes"] == {"sim.iterations": 30}


@pytest.mark.slow
def test_an_engine_in_which_everybody_fell_is_shown_without_numbers(tmp_path, capsys):
    nothing = dict.fromkeys(("rmse_lin", "rmse_ang", "cost_of_transport", "base_height"))
    rows = [result("mujoco"), result("newton_xpbd", **nothing, falls=1.0)]
    summary = {"task": TASK, "checkpoint": "m.pt", "grid": {"vx": [0], "vy": [0], "yaw": [0]}, "robots_per_cell": 2}
    summary["engines"] = rows
    Console(width=110).print(following.crossing_table(summary))
    line = next(line for line in capsys.readouterr().out.splitlines() if "newton_xpbd" in line)
    assert line.count("none") == 4
    assert "100.0 %" in line
    following.draw_crossing(summary, tmp_path / "p.png")
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")


def test_a_solver_of_a_single_engine_is_refused(capsys):
    assert call(grid.main, [TASK, "--physics", "all", "--sim_device", "cpu", *GRID, "--solver", "xpbd"]) == 2
    assert "error: --solver: --physics all" in capsys.readouterr().err
