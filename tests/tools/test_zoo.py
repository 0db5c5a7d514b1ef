"""Many tasks in one command: what is run beside what, what is not done again, what is left of failures and stops."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from helpers import TASK, TINY_TRAINING, call, run_folders, tiny_run, wait_for

from legged.errors import ConfigError
from legged.evaluation.evaluated_run import find_runs
from legged.learning.timing import read_timing
from legged.process.startup import STAGES_FILE
from legged.tools import zoo
from legged.tools.campaign.crew import BUILT, Crew, Job, Kind, why_failed
from legged.tools.campaign.plan import Order, evaluation_command, finished_run, missing_engines, trainings_of
from legged.tools.campaign.shipping import LARGEST, ship

pytestmark = pytest.mark.usefixtures("workplace")

GRID = ["evaluation.vx=[0,0.5,0.5]", "evaluation.vy=[0,0,1]", "evaluation.yaw=[0,0,1]"]
TINY = ["env.num_envs=8", "train.runner.max_iterations=1", *TINY_TRAINING, *GRID]
JUDGED = ["--engines", "mujoco", "--robots", "1", "--sim_device", "cpu"]
ORDER = Order(overrides=tuple(TINY), on_cpu=True, engines=("mujoco",), robots=1)


@pytest.fixture(autouse=True)
def package_is_found(monkeypatch):
    """What is started here finds the package where this process did."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(str(Path(entry or ".").resolve()) for entry in sys.path))


# ---- processes side by side ------------------------------------------------------------------------------------------


def script(kind, name, log, built_after=0.0, lasts=0.3, code="", done=lambda job, code: []):
    """A job that notes when it begins and ends, and says after some time that it is built."""
    text = (
        "import os, time\n"
        f"note = lambda what: open({str(log)!r}, 'a').write(f'{name} {{what}}\\n')\n"
        "note('begins')\n"
        f"time.sleep({built_after})\n"
        f"open(os.environ[{STAGES_FILE!r}], 'a').write('1.0 {BUILT}\\n')\n"
        f"note('is built')\n{code}\n"
        f"time.sleep({lasts})\n"
        "note('ends')\n"
    )
    return Job(kind, [sys.executable, "-c", text], log.with_name(f"{name}.txt"), done)


def ran(jobs, room, shared=()):
    """What jobs noted, in the order of time, when a crew had run them."""
    log = jobs[0].output.with_name("log")
    Crew(room, shared).run(jobs)
    return log.read_text().splitlines()


def test_as_many_run_side_by_side_as_there_is_room_for(tmp_path):
    jobs = [script(Kind.ON_CORES, name, tmp_path / "log") for name in "abc"]
    noted = ran(jobs, {Kind.ON_CORES: 2})
    assert noted.index("b begins") < noted.index("a ends")
    assert noted.index("c begins") > min(noted.index("a ends"), noted.index("b ends"))


def test_a_training_begins_when_the_one_before_it_is_built(tmp_path):
    jobs = [script(Kind.TRAINING, name, tmp_path / "log", built_after=0.2, lasts=1.0) for name in "abc"]
    noted = ran(jobs, {Kind.TRAINING: 2})
    assert noted[:3] == ["a begins", "a is built", "b begins"]
    assert noted.index("a ends") < noted.index("c begins")
    assert not list(tmp_path.glob("*.stages"))


def test_what_shares_the_device_waits_for_all_trainings_and_the_rest_does_not(tmp_path):
    log = tmp_path / "log"
    after = script(Kind.ON_GPU, "gpu", log)
    first = script(Kind.TRAINING, "a", log, done=lambda job, code: [after, script(Kind.ON_CORES, "cores", log, lasts=0.1)])
    second = script(Kind.TRAINING, "b", log, lasts=1.0)
    noted = ran([first, second], dict.fromkeys(Kind, 1), (Kind.ON_GPU,))
    assert noted.index("a ends") < noted.index("cores begins") < noted.index("b ends") < noted.index("gpu begins")


def test_a_crew_that_is_stopped_starts_nothing_more_and_tells_those_that_run(tmp_path):
    log = tmp_path / "log"
    asked = "import signal\nsignal.signal(signal.SIGTERM, lambda *_: (note('was asked'), exit(3)))"
    codes = []
    jobs = [script(Kind.TRAINING, "a", log, lasts=60, code=asked, done=lambda job, code: codes.append(code) or [])]
    jobs.append(script(Kind.TRAINING, "b", log))
    crew = Crew({Kind.TRAINING: 1}, ())
    handler = signal.signal(signal.SIGALRM, lambda *_: crew.stop() if log.is_file() and "built" in log.read_text() else None)
    signal.setitimer(signal.ITIMER_REAL, 0.1, 0.1)
    try:
        crew.run(jobs)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
    assert log.read_text().splitlines() == ["a begins", "a is built", "a was asked"]
    assert codes == [3]


def test_why_a_process_failed(tmp_path):
    job = Job(Kind.TRAINING, [], tmp_path / "out.txt", lambda job, code: [])
    assert why_failed(job, 7) == "exit code 7"
    job.output.write_text("hello\nValueError: no\n\n")
    assert why_failed(job, 1) == "ValueError: no"
    assert why_failed(job, -9) == "killed by SIGKILL, maybe for want of memory"
    assert why_failed(job, -11) == "killed by SIGSEGV"
    job.output.write_text("error: --task: there is no task\nbye\n")
    assert why_failed(job, 2) == "--task: there is no task"


# ---- what is to be done ----------------------------------------------------------------------------------------------


def test_first_seeds_of_all_tasks_come_first_with_their_own_configurations():
    order = Order(overrides=("env.num_envs=8",), on_cpu=True)
    wanted = trainings_of([(TASK, TASK), ("go2_flat", "go2_flat")], [3, 1], order)
    assert [one.label for one in wanted] == [f"{TASK}, seed 3", "go2_flat, seed 3", f"{TASK}, seed 1", "go2_flat, seed 1"]
    assert [(one.cfg.env.seed, one.cfg.train.runner.run_name, one.cfg.env.num_envs) for one in wanted[:3]] == [
        *[(3, "s3", 8)] * 2,
        (1, "s1", 8),
    ]


def test_a_run_is_done_if_it_was_trained_to_its_end_with_the_same_configuration():
    (wanted,) = trainings_of([(TASK, TASK)], [1], ORDER)
    assert finished_run(wanted.cfg) is None
    folder = tiny_run("--run_name", "s1", "--seed", "1", *GRID, iterations=1)
    assert finished_run(wanted.cfg) == folder
    for other in ("evaluation.yaw=[0,1,1]", "rewards.scales.torques=-2e-5"):
        (changed,) = trainings_of([(TASK, TASK)], [1], Order(overrides=(*TINY, other), on_cpu=True))
        assert finished_run(changed.cfg) == (folder if other.startswith("evaluation") else None)
    (second,) = trainings_of([(TASK, TASK)], [2], ORDER)
    assert finished_run(second.cfg) is None
    timing = json.loads((folder / "timing.json").read_text())
    (folder / "timing.json").write_text(json.dumps(timing | {"finished": False}))
    assert finished_run(wanted.cfg) is None


def test_an_evaluation_is_done_again_if_it_asked_for_something_else(monkeypatch):
    (one,) = trainings_of([(TASK, TASK)], [1], ORDER)
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
    assert missing_engines(one, ORDER) == []
    assert list(one.judged(ORDER).results) == ["mujoco"]
    other_grid = {"grid": {"vx": [0.0], "vy": [0.0], "yaw": [0.0]}}
    for changed in ({"checkpoint": "model_9.pt"}, {"robots_per_cell": 2}, other_grid, {"changes": {"sim.dt": 0.002}}):
        path.write_text(json.dumps(result | changed))
        assert missing_engines(one, ORDER) == ["mujoco"]
        assert not one.judged(ORDER).results


def test_evaluations_are_asked_for_as_the_order_says():
    order = Order(overrides=tuple(TINY[:-3]), on_cpu=True, threads=3, robots=2, types="stairs_up", sim_device="cpu")
    (one,) = trainings_of([(TASK, TASK)], [1], Order(overrides=tuple(TINY), on_cpu=True))
    one.folder = tiny_run("--run_name", "s1", "--seed", "1", iterations=1)
    words = evaluation_command(one, "newton_xpbd", order)
    assert words[1:5] == ["-m", "legged.tools.evaluate", "--task", TASK]
    text = " ".join(words)
    assert f"--load_run {one.folder.resolve()} --robots 2 --physics newton --solver xpbd --sim_device cpu" in text
    assert "evaluation.vx=[0.0, 0.5, 0.5] evaluation.vy=[0.0, 0.0, 1.0]" in text  # the run was trained with another grid
    assert "sim.threads" not in text  # the run's own
    assert "--types" not in text  # it stands on a plane
    assert "--sim_device" not in " ".join(evaluation_command(one, "mujoco", order))
    (rough,) = trainings_of([("anymal_c", "anymal_c")], [1], Order(on_cpu=True))
    rough.folder = one.folder
    assert "--robots-per-point 32 --types stairs_up" in " ".join(evaluation_command(rough, "mujoco", order))
    assert "sim.threads=3" in evaluation_command(rough, "mujoco", order)


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

    start = time.perf_counter()
    assert call(zoo.main, [TASK, *TINY, *JUDGED]) == 0  # nothing is left to do
    assert time.perf_counter() - start < 3.0
    assert "is in logs" in capfd.readouterr().out
    assert call(zoo.main, ["--table", "logs", "--out", "elsewhere"]) == 0
    assert (tmp_path / "elsewhere" / "table.md").read_text() == Path("logs/zoo/table.md").read_text()


def test_a_stop_leaves_the_table_and_no_process(tmp_path):
    slow = [text.replace("max_iterations=1", "max_iterations=100000") for text in TINY]
    with open("out.txt", "w") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "legged.tools.zoo", TASK, "go2_flat", *slow, *JUDGED], stdout=out, stderr=out
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
    assert lines[1:] == [f"{place}: draw anew what shows the policy before: play.gif"]
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
    with pytest.raises(ConfigError, match=f"--ship: shipped/{TASK} is shipped there already"):
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
        ([TASK, "--seeds", "1,1"], "--seeds: '1,1' names one twice"),
        ([TASK, "--jobs", "0"], "--jobs: must be at least 1, got 0"),
        ([TASK, "--engines", "mujoco_wrap"], "--engines: there is no engine 'mujoco_wrap'; did you mean 'mujoco_warp'?"),
        ([TASK, "--robots-per-point", "0"], "--robots-per-point: must be at least 1, got 0"),
        ([TASK, "rewards.scales.torqes=1"], "torqes"),
        (["anymal_c", "--types", "stair_up"], "did you mean 'stairs_up'"),
        ([TASK, "--table", "logs"], f"--table: trains nothing; leave out {TASK}"),
        (["--table", "nowhere"], "nowhere: holds no run folder"),
        ([TASK, "--sim_device", "tpu"], "--sim_device: 'tpu'"),
    ],
)
def test_wrong_input_is_named_before_anything_is_trained(arguments, words, capsys):
    assert call(zoo.main, [*arguments]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert not Path("logs").exists()
