"""docs/make/zoo.py: skipped work, commands, failures and stops, its table, and what it ships."""

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import zoo
from helpers import POLICY, TASK, TINY_TRAINING, call, run_folders, tiny_run, wait_for
from shipping import FEW, LARGEST, ship

from legged.errors import ConfigError
from legged.evaluation.reports.record import read_record
from legged.learning.timing import read_timing

pytestmark = [pytest.mark.usefixtures("workplace"), pytest.mark.slow]

GRID = ["evaluation.vx=[0,0.5,0.5]", "evaluation.vy=[0,0,1]", "evaluation.yaw=[0,0,1]"]
TINY = ["env.num_envs=8", "train.runner.max_iterations=1", *TINY_TRAINING, *GRID]
RESULT = {
    "task": TASK,
    "physics": "mujoco",
    "checkpoint": "model_0.pt",
    "grid": {"vx": [0.0, 0.5], "vy": [0.0], "yaw": [0.0]},
    "robots_per_cell": 1,
    "rmse_lin": {"mean": 0.1, "worst": 0.2},
    "rmse_ang": {"mean": 0.1, "worst": 0.2},
    "falls": 0.0,
}


@pytest.fixture(autouse=True)
def without_gpu(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")


def planned(*words):
    """The trainings that a command line asks for, and its arguments."""
    args = zoo.build_parser().parse_intermixed_args(words)
    return zoo.plan(args), args


def run_of_seed(seed, *more):
    return tiny_run("--run_name", f"s{seed}", "--seed", str(seed), *more, iterations=1)


# ---- what is to be done ----------------------------------------------------------------------------------------------


def test_first_seeds_of_all_tasks_come_first_with_their_own_configurations():
    trainings, _ = planned(TASK, "go2_flat", "--seeds", "3,1", "env.num_envs=8")
    assert [(cfg.task, cfg.env.seed, cfg.env.num_envs) for cfg, *_ in trainings] == [
        *((TASK, 3, 8), ("go2_flat", 3, 8)),
        *((TASK, 1, 8), ("go2_flat", 1, 8)),
    ]


def test_a_run_is_done_if_it_was_trained_to_its_end_with_the_same_configuration():
    def found(*words):
        ((training,), _) = planned(TASK, *TINY, *words)
        run = zoo.finished_run(training.cfg)
        return run and run.folder

    assert found() is None
    folder = run_of_seed(1, *GRID)
    assert found() == found("evaluation.yaw=[0,1,1]") == folder
    assert found("rewards.scales.torques=-2e-5") is None
    assert found("--seeds", "2") is None
    timing = json.loads((folder / "timing.json").read_text())
    (folder / "timing.json").write_text(json.dumps(timing | {"finished": False}))
    assert found() is None


def test_an_evaluation_is_done_again_if_it_asked_for_something_else():
    ((training,), args) = planned(TASK, *TINY, "--robots", "1")
    folder = run_of_seed(1, *GRID)

    def missing(result):
        (folder / "evaluation_mujoco.json").write_text(json.dumps(result))
        return [*zoo.missing_evaluations(read_record(folder), training, args)]

    assert missing(RESULT) == []
    other_grid = {"grid": {"vx": [0.0], "vy": [0.0], "yaw": [0.0]}}
    for changed in ({"checkpoint": "model_9.pt"}, {"robots_per_cell": 2}, other_grid, {"changes": {"sim.dt": 0.002}}):
        assert missing(RESULT | changed) == [["grid", str(folder), "--physics", "mujoco", "--robots", "1"]]


def test_evaluations_are_asked_for_as_the_arguments_say():
    run = read_record(run_of_seed(1))  # with another grid than GRID
    ((flat,), args) = planned(TASK, *TINY, "sim.physics=mujoco_warp", "--robots", "2", "--types", "stairs_up")
    warp, c = zoo.missing_evaluations(run, flat, args)
    other_grid = ["evaluation.vx=[0.0, 0.5, 0.5]", "evaluation.vy=[0.0, 0.0, 1.0]", "evaluation.yaw=[0.0, 0.0, 1.0]"]
    assert warp == ["grid", str(run.folder), "--physics", "mujoco_warp", *other_grid, "--robots", "2"]  # on a plane
    assert c == [word.replace("_warp", "") for word in warp]
    ((rough,), args) = planned("anymal_c", "sim.physics=mujoco", "--types", "stairs_up", "--robots-per-point", "5")
    grid, terrain = zoo.missing_evaluations(run, rough, args)
    assert grid == ["grid", str(run.folder), "--physics", "mujoco", "--robots", "16"]
    assert terrain == ["terrain", *grid[1:4], "--types", "stairs_up", "--robots-per-point", "5"]
    points = {
        "unit": "m",
        "what": "",
        "trained_to": 0.2,
        "points": [{"size": s, "share": 1.0} for s in rough.sizes["stairs_up"]],
    }
    success = {"robots_per_point": 5, "types": {"stairs_up": points}}
    grid = {"grid": rough.grid, "robots_per_cell": 16}
    (run.folder / "evaluation_mujoco.json").write_text(json.dumps(RESULT | grid | {"success": success}))
    assert not [*zoo.missing_evaluations(read_record(run.folder), rough, args)]


# ---- the command -----------------------------------------------------------------------------------------------------


def test_tasks_are_trained_judged_tabulated_and_shipped_and_nothing_is_done_twice(tmp_path, capfd):
    (tmp_path / "bad.py").write_text(
        "import os, signal\n"
        "from legged import LeggedRobot, register\n"
        "class Killed(LeggedRobot):\n"
        "    def __init__(self, *args, **kwargs):\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "register('doomed', {'extends': 'anymal_c_flat'}, Killed)\n"
    )
    judged = ["--robots", "1", "--ship", "shipped"]
    assert call(zoo.main, [TASK, "doomed", "--import", "bad.py", *TINY, *judged]) == 1
    said = capfd.readouterr()
    assert said.err.endswith("failed: doomed, seed 1: training\n")
    (folder,) = run_folders()[:1]
    assert folder.name.endswith("_s1")
    result = json.loads((folder / "evaluation_mujoco.json").read_text())
    assert result["grid"] == RESULT["grid"]
    row = f"|{TASK}|1|cpu|8 x 1|"
    assert row in said.out
    assert f"|C MuJoCo|{result['rmse_lin']['mean']:.3f} (" in said.out

    shipped = Path("shipped") / TASK
    assert {path.name for path in shipped.iterdir()} == {"config.yaml", "model.pt", "timing.json", "evaluation_mujoco.json"}
    assert set(torch.load(shipped / "model.pt", weights_only=True)) == {
        *("actor_state_dict", "critic_state_dict", "iter", "infos")
    }
    (again,) = zoo.runs_in([shipped])
    assert again.results["mujoco"] == result
    assert not Path("shipped/doomed").exists()

    before = {path: path.stat().st_mtime_ns for path in Path("logs").rglob("*")}
    assert call(zoo.main, [TASK, *TINY, *judged[:2]]) == 0  # nothing is left to do
    assert {path: path.stat().st_mtime_ns for path in Path("logs").rglob("*")} == before
    told = capfd.readouterr().out
    assert "$ legged" not in told
    assert call(zoo.main, ["--table", "logs"]) == 0
    assert capfd.readouterr().out == told


def test_a_stop_ends_the_training_and_starts_no_other(tmp_path):
    slow = [text.replace("max_iterations=1", "max_iterations=100000") for text in TINY]
    with open("out.txt", "w") as out:
        process = subprocess.Popen([sys.executable, zoo.__file__, TASK, "go2_flat", *slow], stdout=out, stderr=out)
        wait_for(lambda: list(Path("logs").glob("*/*/model_0.pt")), process)
        process.terminate()
        assert process.wait(30) == 128 + signal.SIGTERM
    (folder,) = run_folders()
    assert folder.parent.name == TASK
    assert not read_timing(folder).finished
    assert "stopping after this iteration" in Path("out.txt").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "zoo: name the tasks to train"),
        (["anymal_flat"], "did you mean 'anymal_"),
        (["half_cheetah"], "'half_cheetah' follows no commands"),
        ([TASK, "--seeds", "1,x"], "--seeds: '1,x' is not a list of whole numbers, like 1,2,3"),
        ([TASK, "--robots", "0"], "--robots: must be at least 1, got 0"),
        ([TASK, "--robots-per-point", "0"], "--robots-per-point: must be at least 1, got 0"),
        ([TASK, "rewards.scales.torqes=1"], "torqes"),
        (["anymal_c", "--types", "stair_up"], "did you mean 'stairs_up'"),
        ([TASK, "--table", "logs"], f"--table: trains nothing; leave out {TASK}"),
        (["--table", "nowhere"], "nowhere: holds no run folder"),
    ],
)
def test_wrong_input_is_named_before_anything_is_trained(arguments, words, capsys):
    assert call(zoo.main, [*arguments]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert not Path("logs").exists()


# ---- runs and their table --------------------------------------------------------------------------------------------


def copied(folder, *names, source=POLICY):
    """A folder with some files of a shipped policy."""
    folder.mkdir(parents=True)
    for name in ("config.yaml", "model.pt", *names):
        shutil.copy(source / name, folder)
    return folder


def test_each_evaluation_is_a_line_and_below_is_the_mean_of_the_seeds():
    for seed in (1, 2):
        folder = copied(Path("runs", str(seed)), "timing.json", "evaluation_mujoco.json")
        (folder / "config.yaml").write_text((folder / "config.yaml").read_text().replace("seed: 1", f"seed: {seed}"))
        result = RESULT | {"rmse_lin": {"mean": 0.04 + 0.02 * seed, "worst": 0.2}}
        (folder / "evaluation_mujoco.json").write_text(json.dumps(result))
    copied(Path("runs", "3"))
    text = zoo.table(zoo.runs_in([Path("runs")]))
    head, _, *rows = [line.split("|")[1:-1] for line in text.splitlines() if line[:1] == "|"]
    assert [row[:2] + row[6:8] for row in rows] == [
        ["anymal_c_flat", "1", "C MuJoCo", "0.060 (0.200)"],
        ["anymal_c_flat", "2", "C MuJoCo", "0.080 (0.200)"],
        ["anymal_c_flat", "1", "not evaluated", ""],
    ]
    assert {len(row) for row in rows} == {len(head)}
    assert text.endswith("\n- anymal_c_flat, C MuJoCo: velocity RMSE 0.070 (0.060 to 0.080) m/s")


def test_what_is_no_finished_run_of_a_task_with_commands_is_left_out_and_named(capsys):
    kept = copied(Path("runs", "new"))
    old = copied(Path("runs", "old"))
    (old / "config.yaml").write_text((old / "config.yaml").read_text().replace("env:", "evn:", 1))
    begun = copied(Path("runs", "begun"))
    (begun / "model.pt").rename(begun / "model_9.pt")
    copied(Path("runs", "cheetah"), source=POLICY.parent / "half_cheetah")
    assert [run.folder for run in zoo.runs_in([Path("runs"), kept])] == [kept]  # once, although it is named twice
    begun, cheetah, old = capsys.readouterr().err.splitlines()
    assert begun.startswith("left out: runs/begun: killed after 10 of ")
    assert cheetah == "left out: runs/cheetah: 'half_cheetah' follows no commands"
    assert old.startswith("left out: runs/old: ")
    assert "did you mean 'env'" in old


def test_an_evaluation_of_another_policy_is_left_out_and_one_on_another_grid_is_named(capsys):
    folder = copied(Path("run"), "evaluation_mujoco.json", "evaluation_mujoco_warp.json")
    (run,) = zoo.runs_in([folder])
    assert [*run.results] == ["mujoco_warp", "mujoco"]
    assert capsys.readouterr().err == ""
    c, warp = (folder / f"evaluation_{engine}.json" for engine in ("mujoco", "mujoco_warp"))
    c.write_text(json.dumps(json.loads(c.read_text()) | {"changes": {"sim.dt": 0.002}}))
    warp.write_text(json.dumps(json.loads(warp.read_text()) | {"grid": {"vx": [0.5], "vy": [0.0], "yaw": [0.0]}}))
    (run,) = zoo.runs_in([folder])
    assert [*run.results] == ["mujoco_warp"]
    assert capsys.readouterr().err.splitlines() == [
        f"note: {warp}: is not on the task's grid of commands, but on vx 0.5, vy 0, yaw 0 (1 command)",
        f"left out: {c}: was made with sim.dt=0.002",
    ]
    (folder / "model.pt").rename(folder / "model_9999.pt")
    warp.write_text(json.dumps(json.loads(warp.read_text()) | {"checkpoint": "model_best.pt"}))
    (run,) = zoo.runs_in([folder])
    assert not run.results
    assert f"left out: {warp}: is of model_best.pt, not of the last policy" in capsys.readouterr().err


# ---- shipped policies ------------------------------------------------------------------------------------------------


def test_of_a_large_policy_the_actor_alone_is_shipped():
    run = read_record(run_of_seed(1))
    saved = torch.load(run.folder / "model_0.pt", weights_only=True)
    saved["critic_state_dict"]["large"] = torch.zeros(LARGEST // 4)
    torch.save(saved, run.folder / "model_0.pt")
    (line,) = ship([run], Path("shipped"))
    assert line.startswith(f"shipped/{TASK}: policy of seed 1, 0.0")
    assert set(torch.load(Path("shipped") / TASK / "model.pt", weights_only=True)) == {"actor_state_dict", "iter", "infos"}


def test_weights_of_a_large_actor_are_shipped_in_float16():
    run = read_record(run_of_seed(1))
    saved = torch.load(run.folder / "model_0.pt", weights_only=True)
    saved["actor_state_dict"]["large"] = torch.full((LARGEST // 4,), 1.0 / 3.0)
    torch.save(saved, run.folder / "model_0.pt")
    ship([run], Path("shipped"))
    actor = torch.load(Path("shipped") / TASK / "model.pt", weights_only=True)["actor_state_dict"]
    assert actor.pop("large").dtype == torch.float16
    assert {value.dtype for name, value in actor.items() if value.numel() <= FEW} == {torch.float32}


def test_a_shipped_policy_names_no_folder_of_the_machine_that_trained_it():
    run = read_record(run_of_seed(1))
    saved = torch.load(run.folder / "model_0.pt", weights_only=True)
    saved["infos"]["teacher"] = {"file": "/home/me/runs/model_9.pt", "task": TASK, "iteration": 9}
    torch.save(saved, run.folder / "model_0.pt")
    ship([run], Path("shipped"))
    teacher = torch.load(Path("shipped") / TASK / "model.pt", weights_only=True)["infos"]["teacher"]
    assert teacher == {"file": "model_9.pt", "task": TASK, "iteration": 9}


def test_of_several_seeds_the_lowest_gives_the_policy_and_the_others_what_they_came_to():
    for seed in (2, 1, 1):
        folder = run_of_seed(seed)
    (line,) = ship(zoo.runs_in([Path("logs")]), Path("shipped"))
    assert "policy of seed 1, " in line
    assert line.endswith(", evaluations of seed 2")
    assert [path.name for path in (Path("shipped") / TASK / "seed_2").iterdir()] == ["timing.json"]
    models = (Path("shipped") / TASK / "model.pt", folder / "model_0.pt")
    shipped, trained = (torch.load(model, weights_only=True)["infos"]["id"] for model in models)
    assert shipped == trained  # the last of that seed


def test_a_shipment_leaves_nothing_of_the_one_before_it():
    place = Path("shipped") / TASK
    for left in ("seed_2/timing.json", "seed_2/evaluation_mujoco.json", "seed_3/own.txt", "evaluation_newton_xpbd.json",
                 "evaluation_mujoco.png", "timing.json", "play.gif", "model.pt", "crossing.json", "crossing.png",
                 "time_to_walk.json", "stress_mujoco.json", "seed_2/stress_mujoco.json"):  # fmt: skip
        (place / left).parent.mkdir(parents=True, exist_ok=True)
        (place / left).write_text(left)
    run = read_record(run_of_seed(1))
    whole = (run.folder / "model_0.pt").read_bytes()
    (run.folder / "model_0.pt").write_bytes(b"damaged")
    with pytest.raises(ConfigError):
        ship([run], Path("shipped"))
    assert (place / "model.pt").read_text() == "model.pt"
    assert (place / "seed_2" / "evaluation_mujoco.json").exists()  # the old one is there as it was
    (run.folder / "model_0.pt").write_bytes(whole)
    lines = ship([run], Path("shipped"))
    assert lines[1:] == [f"{place}: pictures show the earlier policy; draw them again: play.gif"]
    names = {str(path.relative_to(place)) for path in place.rglob("*") if path.is_file()}
    assert names == {"model.pt", "config.yaml", "timing.json", "play.gif", "seed_3/own.txt"}
    assert not (place / "seed_2").exists()
    assert read_timing(place) == run.timing


def test_stress_tests_of_the_policy_are_shipped_with_it():
    run = read_record(run_of_seed(1))
    (run.folder / "stress_mujoco.json").write_text('{"checkpoint": "model_0.pt"}')
    (run.folder / "stress_mujoco_warp.json").write_text('{"checkpoint": "model_best.pt"}')  # of another one
    ship([run], Path("shipped"))
    assert [path.name for path in (Path("shipped") / TASK).glob("stress_*")] == ["stress_mujoco.json"]
    (run.folder / "stress_mujoco.json").write_text("[1]")
    with pytest.raises(ConfigError, match=r"stress_mujoco\.json: is not the result of an evaluation"):
        ship([run], Path("shipped"))
    assert (Path("shipped") / TASK / "stress_mujoco.json").exists()  # the old one is there as it was


def test_a_shipped_policy_is_not_shipped_over_itself():
    ship([read_record(run_of_seed(1))], Path("shipped"))
    before = {path: path.read_bytes() for path in Path("shipped").rglob("*.*")}
    with pytest.raises(ConfigError, match=f"--ship: shipped/{TASK} is in that folder already"):
        ship(zoo.runs_in([Path("shipped")]), Path("shipped"))
    assert {path: path.read_bytes() for path in Path("shipped").rglob("*.*")} == before
