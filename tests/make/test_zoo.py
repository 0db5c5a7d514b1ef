"""docs/make/zoo.py: skipped work, commands, failures and stops, and what it ships."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import zoo
from evaluated_run import find_runs
from helpers import TASK, TINY_TRAINING, call, run_folders, tiny_run, wait_for
from shipping import LARGEST, ship

from legged.errors import ConfigError
from legged.learning.timing import read_timing

pytestmark = [pytest.mark.usefixtures("workplace"), pytest.mark.slow]

GRID = ["evaluation.vx=[0,0.5,0.5]", "evaluation.vy=[0,0,1]", "evaluation.yaw=[0,0,1]"]
TINY = ["env.num_envs=8", "train.runner.max_iterations=1", *TINY_TRAINING, *GRID]
JUDGED = ["--engines", "mujoco", "--robots", "1", "--sim-device", "cpu"]


def planned(*words):
    """The trainings that a command line asks for, and its arguments."""
    args = zoo.build_parser().parse_intermixed_args([*words, "--sim-device", "cpu"])
    return zoo._plan(args), args


@pytest.fixture(autouse=True)
def package_is_found(monkeypatch):
    """What is started here finds the package where this process did."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(str(Path(entry or ".").resolve()) for entry in sys.path))


# ---- what is to be done ----------------------------------------------------------------------------------------------


def test_first_seeds_of_all_tasks_come_first_with_their_own_configurations():
    wanted, _ = planned(TASK, "go2_flat", "--seeds", "3,1", "env.num_envs=8")
    assert [one.label for one in wanted] == [f"{TASK}, seed 3", "go2_flat, seed 3", f"{TASK}, seed 1", "go2_flat, seed 1"]
    assert [(one.cfg.env.seed, one.cfg.train.runner.run_name, one.cfg.env.num_envs) for one in wanted[:3]] == [
        *[(3, "s3", 8)] * 2,
        (1, "s1", 8),
    ]


def test_a_run_is_done_if_it_was_trained_to_its_end_with_the_same_configuration():
    ((wanted,), _) = planned(TASK, *TINY)
    assert zoo.finished_run(wanted.cfg) is None
    folder = tiny_run("--run_name", "s1", "--seed", "1", *GRID, iterations=1)
    assert zoo.finished_run(wanted.cfg) == folder
    for other in ("evaluation.yaw=[0,1,1]", "rewards.scales.torques=-2e-5"):
        ((changed,), _) = planned(TASK, *TINY, other)
        assert zoo.finished_run(changed.cfg) == (folder if other.startswith("evaluation") else None)
    ((second,), _) = planned(TASK, *TINY, "--seeds", "2")
    assert zoo.finished_run(second.cfg) is None
    timing = json.loads((folder / "timing.json").read_text())
    (folder / "timing.json").write_text(json.dumps(timing | {"finished": False}))
    assert zoo.finished_run(wanted.cfg) is None


def test_an_evaluation_is_done_again_if_it_asked_for_something_else():
    ((one,), args) = planned(TASK, *TINY, *JUDGED)
    one.folder = tiny_run("--run_name", "s1", "--seed", "1", *GRID, iterations=1)
    result = {
        "task": TASK,
        "physics": "mujoco",
        "checkpoint": "model_0.pt",
        "grid": {"vx": [0.0, 0.5], "vy": [0.0], "yaw": [0.0]},
        "robots_per_cell": 1,
        "rmse_lin": {"mean": 0.1, "worst": 0.2},
        "rmse_ang": {"mean": 0.1, "worst": 0.2},
        "falls": 0.0,
    }
    path = one.folder / "evaluation_mujoco.json"
    path.write_text(json.dumps(result))
    assert zoo.missing_engines(one, args) == []
    assert list(zoo.judged(one, args).results) == ["mujoco"]
    other_grid = {"grid": {"vx": [0.0], "vy": [0.0], "yaw": [0.0]}}
    for changed in ({"checkpoint": "model_9.pt"}, {"robots_per_cell": 2}, other_grid, {"changes": {"sim.dt": 0.002}}):
        path.write_text(json.dumps(result | changed))
        assert zoo.missing_engines(one, args) == ["mujoco"]
        assert not zoo.judged(one, args).results


def test_evaluations_are_asked_for_as_the_arguments_say():
    ((one,), args) = planned(TASK, *TINY, "--robots", "2", "--types", "stairs_up")
    one.folder = tiny_run("--run_name", "s1", "--seed", "1", iterations=1)
    (words,) = zoo.evaluation_commands(one, "newton_xpbd", args, threads=3)
    assert words[1:5] == ["-m", "legged", "evaluate", "grid"]
    text = " ".join(words)
    assert f"{one.folder.resolve()} --robots 2 --physics newton --solver xpbd --sim-device cpu" in text
    assert "evaluation.vx=[0.0, 0.5, 0.5] evaluation.vy=[0.0, 0.0, 1.0]" in text  # the run was trained with another grid
    assert "sim.threads" not in text  # the run's own
    assert "--types" not in text  # it stands on a plane
    assert "--sim-device" not in " ".join(zoo.evaluation_commands(one, "mujoco", args)[0])
    ((rough,), args) = planned("anymal_c", "--types", "stairs_up")
    rough.folder = one.folder
    grid, terrain = zoo.evaluation_commands(rough, "mujoco", args, threads=3)
    assert "evaluate grid" in " ".join(grid)
    assert "evaluate terrain" in " ".join(terrain)
    assert "--robots-per-point 32 --types stairs_up" in " ".join(terrain)
    assert "sim.threads=3" in grid
    assert "sim.threads=3" in terrain


# ---- the command -----------------------------------------------------------------------------------------------------


def test_tasks_are_trained_judged_tabulated_and_shipped_and_nothing_is_done_twice(tmp_path, capfd, monkeypatch):
    (tmp_path / "bad.py").write_text(
        "import os, signal\n"
        "from legged import LeggedRobot, register\n"
        "class Killed(LeggedRobot):\n"
        "    def __init__(self, *args, **kwargs):\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "register('doomed', {'extends': 'anymal_c_flat'}, Killed)\n"
    )
    command = [TASK, "doomed", "--import", "bad.py", "--jobs", "2", *TINY, *JUDGED, "--ship", "shipped"]
    assert call(zoo.main, command) == 1
    said = capfd.readouterr().out
    table = Path("logs/zoo/table.md").read_text()
    assert table in said
    assert "- doomed, seed 1: training failed: killed by SIGKILL" in table
    (good, bad) = json.loads(Path("logs/zoo/table.json").read_text())["tasks"]
    assert [row["failure"] for row in good["seeds"]] == [""]
    assert bad["seeds"][0]["failure"].startswith("killed by SIGKILL")
    (folder,) = run_folders()[:1]
    assert folder.name.endswith("_s1")
    result = json.loads((folder / "evaluation_mujoco.json").read_text())
    assert result["grid"] == {"vx": [0.0, 0.5], "vy": [0.0], "yaw": [0.0]}
    assert good["seeds"][0]["engines"]["mujoco"]["rmse_lin"]["mean"] == result["rmse_lin"]["mean"]
    assert good["seeds"][0]["loop_s"] == read_timing(folder).loop_s

    shipped = Path("shipped") / TASK
    assert {path.name for path in shipped.iterdir()} == {"config.yaml", "model.pt", "timing.json", "evaluation_mujoco.json"}
    assert set(torch.load(shipped / "model.pt", weights_only=True)) == {
        *("actor_state_dict", "critic_state_dict", "iter", "infos")
    }
    (again,) = find_runs([shipped])
    assert again.results["mujoco"] == result
    assert not Path("shipped/doomed").exists()

    before = {path: path.stat().st_mtime_ns for path in Path("logs").rglob("*") if "zoo" not in path.parts}
    assert call(zoo.main, [TASK, *TINY, *JUDGED]) == 0  # nothing is left to do
    assert {path: path.stat().st_mtime_ns for path in Path("logs").rglob("*") if "zoo" not in path.parts} == before
    assert "is in logs" in capfd.readouterr().out
    assert call(zoo.main, ["--table", "logs", "--out", "elsewhere"]) == 0
    assert (tmp_path / "elsewhere" / "table.md").read_text() == Path("logs/zoo/table.md").read_text()


def test_a_stop_leaves_the_table_and_no_process(tmp_path):
    slow = [text.replace("max_iterations=1", "max_iterations=100000") for text in TINY]
    with open("out.txt", "w") as out:
        process = subprocess.Popen(
            [sys.executable, str(Path(zoo.__file__)), TASK, "go2_flat", *slow, *JUDGED], stdout=out, stderr=out
        )
        wait_for(lambda: list(Path("logs").glob("*/*/model_0.pt")), process)
        process.terminate()
        assert process.wait(30) == 128 + signal.SIGTERM
    table = Path("logs/zoo/table.md").read_text()
    assert f"- {TASK}, seed 1: training failed: stopped\n- go2_flat, seed 1: training failed: not trained yet\n" in table
    (folder,) = (path for path in run_folders() if path.parent.name == TASK)
    assert not read_timing(folder).finished
    assert "stopping after this iteration" in Path(f"logs/zoo/output/{TASK}_s1_train.txt").read_text()


def test_of_a_large_policy_the_actor_alone_is_shipped():
    one = find_runs([tiny_run(iterations=1)])
    path = one[0].folder / "model_0.pt"
    saved = torch.load(path, weights_only=True)
    saved["critic_state_dict"]["large"] = torch.zeros(LARGEST // 4)
    torch.save(saved, path)
    (line,) = ship(one, Path("shipped"))
    assert line.startswith(f"shipped/{TASK}: policy of seed 1, 0.0")
    assert set(torch.load(Path("shipped") / TASK / "model.pt", weights_only=True)) == {"actor_state_dict", "iter", "infos"}


def test_of_several_seeds_the_lowest_gives_the_policy_and_the_others_what_they_came_to():
    for seed in (2, 1, 1):
        folder = tiny_run("--run_name", f"s{seed}", "--seed", str(seed), iterations=1)
    (line,) = ship(find_runs([Path("logs")]), Path("shipped"))
    assert "policy of seed 1, " in line
    assert line.endswith(", evaluations of seed 2")
    assert [path.name for path in (Path("shipped") / TASK / "seed_2").iterdir()] == ["timing.json"]
    shipped, trained = (torch.load(path / name, weights_only=True)["infos"]["id"] for path, name in (
        (Path("shipped") / TASK, "model.pt"),
        (folder, "model_0.pt"),
    ))  # fmt: skip
    assert shipped == trained  # the last of that seed


def test_a_shipment_leaves_nothing_of_the_one_before_it():
    place = Path("shipped") / TASK
    for left in ("seed_2/timing.json", "seed_2/evaluation_mujoco.json", "seed_3/own.txt", "evaluation_newton_xpbd.json",
                 "evaluation_mujoco.png", "timing.json", "play.gif", "model.pt", "crossing.json", "crossing.png",
                 "time_to_walk.json", "stress_mujoco.json", "seed_2/stress_mujoco.json"):  # fmt: skip
        (place / left).parent.mkdir(parents=True, exist_ok=True)
        (place / left).write_text(left)
    run = tiny_run("--run_name", "s1", "--seed", "1", iterations=1)
    whole = (run / "model_0.pt").read_bytes()
    (run / "model_0.pt").write_bytes(b"damaged")
    with pytest.raises(ConfigError):
        ship(find_runs([run]), Path("shipped"))
    assert (place / "model.pt").read_text() == "model.pt"
    assert (place / "seed_2" / "evaluation_mujoco.json").exists()  # the old one is there as it was
    (run / "model_0.pt").write_bytes(whole)
    lines = ship(find_runs([run]), Path("shipped"))
    assert lines[1:] == [f"{place}: pictures show the earlier policy; draw them again: play.gif"]
    names = {str(path.relative_to(place)) for path in place.rglob("*") if path.is_file()}
    assert names == {"model.pt", "config.yaml", "timing.json", "play.gif", "seed_3/own.txt"}
    assert not (place / "seed_2").exists()
    assert read_timing(place) == read_timing(run)


def test_stress_tests_of_the_policy_are_shipped_with_it():
    run = tiny_run("--run_name", "s1", "--seed", "1", iterations=1)
    (run / "stress_mujoco.json").write_text('{"checkpoint": "model_0.pt"}')
    (run / "stress_mujoco_warp.json").write_text('{"checkpoint": "model_best.pt"}')  # of another one
    ship(find_runs([run]), Path("shipped"))
    assert [path.name for path in (Path("shipped") / TASK).glob("stress_*")] == ["stress_mujoco.json"]
    (run / "stress_mujoco.json").write_text("[]")
    with pytest.raises(ConfigError, match=r"stress_mujoco\.json: is not the result of a stress test"):
        ship(find_runs([run]), Path("shipped"))
    assert (Path("shipped") / TASK / "stress_mujoco.json").exists()  # the old one is there as it was


def test_a_shipped_policy_is_not_shipped_over_itself():
    ship(find_runs([tiny_run(iterations=1)]), Path("shipped"))
    before = {path: path.read_bytes() for path in Path("shipped").rglob("*.*")}
    with pytest.raises(ConfigError, match=f"--ship: shipped/{TASK} is in that folder already"):
        ship(find_runs([Path("shipped")]), Path("shipped"))
    assert {path: path.read_bytes() for path in Path("shipped").rglob("*.*")} == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "zoo: name the tasks to train"),
        (["anymal_flat"], "did you mean 'anymal_"),
        (["half_cheetah"], "'half_cheetah' follows no commands"),
        ([TASK, TASK], f"zoo: '{TASK}' is named twice"),
        ([TASK, "--seeds", "1,x"], "--seeds: '1,x' is not a list of whole numbers, like 1,2,3"),
        ([TASK, "--seeds", "1,1"], "--seeds: '1,1' names a seed twice"),
        ([TASK, "--jobs", "0"], "--jobs: must be at least 1, got 0"),
        ([TASK, "--engines", "mujoco_wrap"], "--engines: there is no engine 'mujoco_wrap'; did you mean 'mujoco_warp'?"),
        ([TASK, "--robots-per-point", "0"], "--robots-per-point: must be at least 1, got 0"),
        ([TASK, "rewards.scales.torqes=1"], "torqes"),
        (["anymal_c", "--types", "stair_up"], "did you mean 'stairs_up'"),
        ([TASK, "--table", "logs"], f"--table: trains nothing; leave out {TASK}"),
        (["--table", "nowhere"], "nowhere: holds no run folder"),
        ([TASK, "--sim-device", "tpu"], "--sim-device: 'tpu'"),
    ],
)
def test_wrong_input_is_named_before_anything_is_trained(arguments, words, capsys):
    assert call(zoo.main, [*arguments]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert not Path("logs").exists()
