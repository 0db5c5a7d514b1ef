"""The benchmark: what it times, and that its numbers fit together."""

import json
from pathlib import Path

import pytest
import torch
from helpers import POLICY, TASK, call, small_config, small_task

from legged import registry
from legged.cli.benchmark import (
    Driver,
    ground,
    loops_of,
    report,
    scale,
    startup,
    step,
    time_iterations,
    time_steps,
    without,
)
from legged.learning.captured import CapturedRunner
from legged.learning.runner import Runner
from legged.learning.student_runner import StudentRunner
from legged.learning.teacher import find_teacher, with_teacher
from legged.policies.actor import Actor
from legged.registry import make_task

SMALL = ["--sim-device", "cpu", "--num-envs", "8", "sim.physics=mujoco", "sim.threads=1", "train.runner.num_steps_per_env=4"]

pytestmark = pytest.mark.usefixtures("workplace")


@pytest.mark.slow
def test_times_of_step_physics_and_iterations_are_written(tmp_path, capsys):
    steps = ["--steps", "5", "--repeats", "3", "--iterations", "2", "--out", str(tmp_path / "times")]
    assert step.main(["anymal_c_flat", *SMALL, *steps]) == 0
    result = json.loads((tmp_path / "times" / "benchmark.json").read_text())
    assert 0.0 < result["physics_ms"] < result["control_step_ms"]
    assert result["ratio"] == pytest.approx(result["control_step_ms"] / result["physics_ms"])
    assert result["env_steps_per_s"] == pytest.approx(8 / result["control_step_ms"] * 1e3)
    low, high = result["control_step_ms_range"]
    assert low <= result["control_step_ms"] <= high
    for loop in ("stock", "captured"):
        times = result["iterations"][loop]
        assert times["iteration_ms"] >= 4 * result["physics_ms"] * 0.3  # the clock of a shared machine is rough
        assert times["rollout_ms"] > 0.0 < times["update_ms"]
        assert times["robot_steps_per_s"] == pytest.approx(32 / times["iteration_ms"] * 1e3)
    said = capsys.readouterr().out
    assert "stock training" in said
    assert "captured training" in said
    assert not list(tmp_path.glob("logs*"))


@pytest.mark.slow
def test_mujoco_warps_own_step_is_timed_beside_ours():
    """Both move the robots; on the CPU too ours takes less."""
    task = make_task(small_config(("sim.physics", "mujoco_warp"), num_envs=8))
    before = task.physics.robot_state.base_pos.clone()
    result = time_steps(task, 10, 3)
    assert not before.equal(task.physics.robot_state.base_pos)
    assert result["library_ms"] > result["physics_ms"] > 0.0
    low, high = result["library_ms_range"]
    assert low <= result["library_ms"] <= high
    assert "own launches" not in report(task, result | {"build_s": 0.0})


@pytest.mark.slow
def test_why_a_step_is_mujoco_warps_own_is_said():
    task = make_task(small_config(("sim.physics", "mujoco_warp"), ("sim.step", "library"), num_envs=2))
    text = report(task, time_steps(task, 1, 1) | {"build_s": 0.0})
    assert "  part of the step uses mujoco-warp's own launches: sim.step=library\n" in text


@pytest.mark.slow
def test_a_policy_is_named(capsys):
    arguments = ["--policy", TASK, "--steps", "2", "--repeats", "1", "--iterations", "0"]
    assert step.main([TASK, *SMALL, *arguments]) == 0
    assert f"resources/policies/{TASK}/model.pt" in capsys.readouterr().out


@pytest.mark.slow
def test_robots_of_a_policy_are_where_it_moved_them():
    """Physics alone is timed in turns with their steps, and leaves no trace."""
    places = []
    for timed in (True, False):
        task = small_task(num_envs=4)
        actor = Actor(task, "cpu")
        actor.load(POLICY / "model.pt")
        if timed:
            assert time_steps(task, 20, 1, actor)["physics_ms"] > 0.0
        else:
            driver = Driver(task, actor)
            with torch.inference_mode():
                for _ in range(70):
                    driver.decide()
                    task.step(driver.actions)
        places.append(task.physics.qpos.clone())
    assert torch.equal(*places)


def test_a_policy_of_another_robot_is_refused(capsys):
    assert step.main([TASK, *SMALL, "--policy", "go2_flat", "--iterations", "0"]) == 2
    assert "go2" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Runner, CapturedRunner])
def test_iterations_are_counted_without_the_first(kind):
    task = small_task(num_envs=4)
    times = time_iterations(kind, task, 3)
    low, high = times["iteration_ms_range"]
    assert low <= times["iteration_ms"] <= high
    assert times["rollout_ms"] + times["update_ms"] == pytest.approx(times["iteration_ms"], rel=0.7)
    assert times["note"] == ""


@pytest.mark.slow
def test_students_and_estimators_are_timed_as_they_are_trained():
    """Both loops for others; a student by its own runner, with its teacher's observations beside the task's."""
    plain, estimating = small_config(), small_config(("train.policy.estimator.targets", ["base_lin_vel"]))
    assert [*loops_of(plain, None, None)] == ["stock", "captured"]
    assert [*loops_of(plain, None, "stock")] == ["stock"]
    assert loops_of(estimating, None, None) == {"captured": CapturedRunner}
    student = small_config(
        ("train.algorithm.class_name", "Distillation"),
        ("train.distillation", {"teacher": TASK, "gradient_length": 4}),
        ("train.runner.num_steps_per_env", 4),
        num_envs=4,
    )
    teacher = find_teacher(student)
    kinds = loops_of(student, teacher, None)
    assert [*kinds] == ["captured"]
    task = make_task(with_teacher(student, teacher))
    assert isinstance(kinds["captured"](task), StudentRunner)
    assert time_iterations(kinds["captured"], task, 1)["update_ms"] > 0.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["anymal_c", "sim.physics=mujoco"],
            "error: command line: sim.physics: this command compares colliders of mujoco_warp",
        ),
        (["anymal_c_flat", "sim.physics=mujoco_warp"], "error: TASK: 'anymal_c_flat' has no terrain"),
    ],
)
def test_grounds_need_mujoco_warp_and_terrain(arguments, words, capsys):
    assert call(ground.main, [*arguments, "--sim-device", "cpu"]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.slow
def test_sizes_are_compared_in_processes_of_their_own(tmp_path, capfd, monkeypatch):
    """The first size wants 4 PB, which no process can have; the next is none the worse for it."""
    too_many = 1_000_000
    (tmp_path / "hungry.py").write_text(
        "import torch\n"
        "from legged import LeggedRobot, register\n"
        "class Hungry(LeggedRobot):\n"
        "    def __init__(self, cfg, *args, **kwargs):\n"
        "        self.reserve = torch.empty(cfg.env.num_envs // 1000 * 10**12)\n"
        "        super().__init__(cfg, *args, **kwargs)\n"
        "register('hungry', {'extends': 'anymal_c_flat'}, Hungry)\n"
    )
    monkeypatch.chdir(tmp_path)
    small = [text for text in SMALL if text not in ("--num-envs", "8")]
    steps = ["--steps", "2", "--repeats", "1", "--iterations", "1", "--out", "times"]
    assert scale.main(["--import", "hungry.py", "hungry", *small, *steps, "--robots", f"{too_many},4"]) == 0
    result = json.loads(Path("times/benchmark.json").read_text())
    assert (result["task"], result["device"], result["loop"]) == ("hungry", "CPU", "captured")
    first, second = result["sizes"]
    assert first == {"num_envs": too_many, "failed": "out of memory"}
    assert second["num_envs"] == 4
    assert second["env_steps_per_s"] == pytest.approx(4 / second["control_step_ms"] * 1e3)
    assert second["robot_steps_per_s"] == pytest.approx(4 * 4 / second["iteration_ms"] * 1e3)
    title, heading, *rows = capfd.readouterr().out.splitlines()
    assert title == "hungry, CPU, captured training"
    assert heading.split() == ["robots", "control", "step", "steps/s", "iteration", "training", "steps/s", "GPU", "memory"]
    assert [row.split()[0] for row in rows] == [f"{too_many:,}", "4"]
    assert rows[0].endswith("  out of memory")
    assert rows[1].endswith(" -")  # memory of a GPU
    assert not list(tmp_path.glob("logs*"))


@pytest.mark.slow
def test_sizes_of_a_task_that_is_a_file(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(registry, "_REGISTERED", {})  # another test's file may be called so
    (tmp_path / "mine.yaml").write_text("extends: anymal_c_flat\n")
    monkeypatch.chdir(tmp_path)
    small = [text for text in SMALL if text not in ("--num-envs", "8")]
    steps = ["--steps", "2", "--repeats", "1", "--iterations", "1"]
    assert scale.main(["mine.yaml", *small, *steps, "--robots", "4"]) == 0
    assert capfd.readouterr().out.splitlines()[-1].split()[0] == "4"


def broken_task(folder, statement: str) -> list[str]:
    """Arguments for a task in `folder` whose observation ends in a statement."""
    (folder / "broken.py").write_text(
        "import os\n"
        "from legged import LeggedRobot, register\n"
        "class Broken(LeggedRobot):\n"
        f"    def _obs_broken(self): {statement}\n"
        "cfg = {'extends': 'anymal_c_flat', 'observations': {'groups': {'actor': {'terms': ['broken']}}}}\n"
        "register('broken', {**cfg, 'train': {'algorithm': {'symmetry': False}}}, Broken)\n"
    )
    return ["broken", "--import", "broken.py", "--sim-device", "cpu", "--robots", "4,5"]


@pytest.mark.slow
def test_a_size_that_fails_otherwise_is_told_too(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert scale.main(broken_task(tmp_path, "os._exit(3)")) == 1
    rows = capfd.readouterr().out.splitlines()[-2:]
    assert [row.split() for row in rows] == [[size, "exit", "code", "3"] for size in ("4", "5")]


@pytest.mark.slow
def test_a_mistake_that_is_the_same_for_all_sizes_is_told_once(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert scale.main(broken_task(tmp_path, "raise ValueError('no such thing')")) == 2
    err = capfd.readouterr().err
    assert err.startswith("error: _obs_broken: no such thing (")
    assert err.count("\n") == 1


@pytest.mark.parametrize("sizes", ["", "4,", "0", "many", "-4", "1e3"])
def test_sizes_are_numbers(sizes, capsys):
    assert call(scale.main, ["anymal_c_flat", "--sim-device", "cpu", f"--robots={sizes}"]) == 2
    assert f"error: --robots: '{sizes}' is not a list of numbers of robots" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--num-envs", "--num_envs"])
def test_scale_sets_the_number_of_robots_itself(option, capsys):
    assert call(scale.main, ["anymal_c", "--sim-device", "cpu", "--robots", "4", option, "4"]) == 2
    assert capsys.readouterr().err.startswith("error: --num-envs: leave it out, because --robots")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--steps=0", "--steps: must be at least 1, got 0"),
        ("--repeats=0", "--repeats: must be at least 1, got 0"),
        ("--iterations=-1", "--iterations: must be at least 0, got -1"),
        ("--kernels=0", "--kernels: must be at least 1, got 0"),
        ("--out=taken", "taken: "),
    ],
)
@pytest.mark.parametrize(("command", "more"), [(step, []), (scale, ["--robots", "4"])])
def test_options_out_of_range_are_refused(option, words, command, more, capsys):
    if command is scale and option.startswith("--kernels"):
        words = "unrecognized arguments: --kernels=0"
    Path("taken").touch()
    assert call(command.main, ["anymal_c_flat", "--sim-device", "cpu", option, *more]) == 2
    assert words in capsys.readouterr().err


def test_each_size_is_measured_as_the_command_line_says():
    kept = ["x", "--physics", "newton", "--solver", "kamino", "--steps=5", "sim.dt=0.01"]
    own = ["--robots", "4,8", "--out=times", "--runner", "stock"]
    flags = ("--robots", "--out", "--num-envs", "--runner")
    assert without([*own[:2], *kept[:3], *own[2:], *kept[3:]], *flags) == kept


def test_the_engine_of_a_scale_is_the_one_asked_for(capsys, monkeypatch):
    """The C engine is the default here, so that only its name in the row tells."""
    seen = []

    def run(command, **_):
        seen.append(command)
        raise KeyboardInterrupt

    monkeypatch.setattr("legged.cli.benchmark.subprocess.run", run)
    arguments = ["anymal_c_flat", "--sim-device", "cpu", "--robots=4", "--physics", "newton", "--solver", "xpbd"]
    assert scale.main(arguments) == 130
    (command,) = seen
    assert command[command.index("--physics") + 1] == "newton"
    assert command[command.index("--solver") + 1] == "xpbd"
    assert "--robots=4" not in command
    assert command[1:6] == ["-m", "legged", "benchmark", "step", "anymal_c_flat"]


@pytest.mark.slow
def test_a_start_is_timed_beside_importing_torch(capsys):
    assert startup.main(["--repeats", "1", "--out", "times", "anymal_c_flat", *SMALL]) == 0
    times = json.loads(Path("times/benchmark.json").read_text())
    stages = list(times["stages"].values())
    assert list(times["stages"])[-2:] == ["first iteration", "end"]
    assert stages == sorted(stages)
    assert times["ratio"] == pytest.approx(times["stages"]["first iteration"] / times["torch_s"])
    assert times["ratio_without_capture"] < times["ratio"]
    assert "x import torch" in capsys.readouterr().out
