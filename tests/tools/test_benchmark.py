"""The benchmark: what it times, and that its numbers fit together."""

import json

import pytest
import torch
from helpers import POLICY, TASK, call, small_config, small_task

from legged import registry
from legged.benchmarks.iteration_times import loops_of, time_iterations
from legged.benchmarks.scale import without
from legged.benchmarks.step_times import Driver, report, time_steps
from legged.learning.captured import CapturedRunner
from legged.learning.runner import Runner
from legged.learning.student_runner import StudentRunner
from legged.learning.teacher import find_teacher, with_teacher
from legged.policies.actor import Actor
from legged.registry import make_task
from legged.tools import benchmark

SMALL = ["--sim_device", "cpu", "--num_envs", "8", "sim.physics=mujoco", "sim.threads=1", "train.runner.num_steps_per_env=4"]

pytestmark = pytest.mark.usefixtures("workplace")


def test_times_of_step_physics_and_iterations_are_written(tmp_path, capsys):
    steps = ["--steps", "5", "--repeats", "3", "--iterations", "2", "--json", str(tmp_path / "b.json")]
    assert benchmark.main(["--task", "anymal_c_flat", *SMALL, *steps]) == 0
    result = json.loads((tmp_path / "b.json").read_text())
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


def test_why_a_step_is_mujoco_warps_own_is_said():
    task = make_task(small_config(("sim.physics", "mujoco_warp"), ("sim.step", "library"), num_envs=2))
    text = report(task, time_steps(task, 1, 1) | {"build_s": 0.0})
    assert "  mujoco-warp's own launches: sim.step=library\n" in text


def test_a_policy_is_named(capsys):
    arguments = ["--policy", TASK, "--steps", "2", "--repeats", "1", "--iterations", "0"]
    assert benchmark.main(["--task", TASK, *SMALL, *arguments]) == 0
    assert f"resources/policies/{TASK}/model.pt" in capsys.readouterr().out


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
    assert benchmark.main(["--task", TASK, *SMALL, "--policy", "go2_flat", "--iterations", "0"]) == 2
    assert "go2" in capsys.readouterr().err


@pytest.mark.parametrize("kind", [Runner, CapturedRunner])
def test_iterations_are_counted_without_the_first(kind):
    task = small_task(num_envs=4)
    times = time_iterations(kind, task, 3)
    low, high = times["iteration_ms_range"]
    assert low <= times["iteration_ms"] <= high
    assert times["rollout_ms"] + times["update_ms"] == pytest.approx(times["iteration_ms"], rel=0.7)
    assert times["note"] == ""


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
            ["--task", "anymal_c", "--grounds", "--sim_device", "cpu", "sim.physics=mujoco"],
            "colliders of mujoco_warp",
        ),
        (["--task", "anymal_c_flat", "--grounds", "--sim_device", "cpu", "sim.physics=mujoco_warp"], "has no terrain"),
    ],
)
def test_grounds_need_mujoco_warp_and_terrain(arguments, words, capsys):
    assert call(benchmark.main, arguments) == 2
    assert words in capsys.readouterr().err


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
    small = [text for text in SMALL if text not in ("--num_envs", "8")]
    steps = ["--steps", "2", "--repeats", "1", "--iterations", "1", "--json", str(tmp_path / "s.json")]
    assert benchmark.main(["--import", "hungry.py", "--task", "hungry", *small, *steps, "--scale", f"{too_many},4"]) == 0
    result = json.loads((tmp_path / "s.json").read_text())
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


def test_sizes_of_a_task_that_is_a_file(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(registry, "_REGISTERED", {})  # another test's file may be called so
    (tmp_path / "mine.yaml").write_text("extends: anymal_c_flat\n")
    monkeypatch.chdir(tmp_path)
    small = [text for text in SMALL if text not in ("--num_envs", "8")]
    steps = ["--steps", "2", "--repeats", "1", "--iterations", "1"]
    assert benchmark.main(["--task", "mine.yaml", *small, *steps, "--scale", "4"]) == 0
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
    return ["--task", "broken", "--import", "broken.py", "--sim_device", "cpu", "--scale", "4,5"]


def test_a_size_that_fails_otherwise_is_told_too(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert benchmark.main(broken_task(tmp_path, "os._exit(3)")) == 1
    rows = capfd.readouterr().out.splitlines()[-2:]
    assert [row.split() for row in rows] == [[size, "exit", "code", "3"] for size in ("4", "5")]


def test_a_mistake_that_is_the_same_for_all_sizes_is_told_once(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert benchmark.main(broken_task(tmp_path, "raise ValueError('no such thing')")) == 2
    err = capfd.readouterr().err
    assert err.startswith("error: _obs_broken: no such thing (")
    assert err.count("\n") == 1


@pytest.mark.parametrize("sizes", ["", "4,", "0", "many", "-4", "1e3"])
def test_sizes_are_numbers(sizes, capsys):
    assert call(benchmark.main, ["--task", "anymal_c_flat", "--sim_device", "cpu", f"--scale={sizes}"]) == 2
    assert "is not a list of numbers of robots" in capsys.readouterr().err


@pytest.mark.parametrize("other", [["--num_envs", "4"], ["--grounds"]])
def test_scale_sets_the_number_of_robots_itself(other, capsys):
    assert call(benchmark.main, ["--task", "anymal_c", "--sim_device", "cpu", "--scale", "4", *other]) == 2
    assert f"leave out {other[0]}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--steps=0", "--steps: must be at least 1, got 0"),
        ("--repeats=0", "--repeats: must be at least 1, got 0"),
        ("--iterations=-1", "--iterations: must be at least 0, got -1"),
        ("--kernels=0", "--kernels: must be at least 1, got 0"),
        ("--json=.", "--json: . is a folder"),
    ],
)
@pytest.mark.parametrize("more", [[], ["--scale", "4"]])
def test_options_out_of_range_are_refused(option, words, more, capsys):
    assert call(benchmark.main, ["--task", "anymal_c_flat", "--sim_device", "cpu", option, *more]) == 2
    assert words in capsys.readouterr().err


def test_each_size_is_measured_as_the_command_line_says():
    kept = ["--task", "x", "--physics", "newton", "--solver", "kamino", "--kernels", "3", "--steps=5", "sim.dt=0.01"]
    own = ["--scale", "4,8", "--json=out.json", "--runner", "stock", "--num_env", "3"]
    flags = ("--scale", "--json", "--num_envs", "--runner")
    assert without([*own[:2], *kept[:3], *own[2:], *kept[3:]], *flags) == kept


def test_the_engine_of_a_scale_is_the_one_asked_for(capsys, monkeypatch):
    """The C engine is the default here, so that only its name in the row tells."""
    seen = []

    def run(command, **_):
        seen.append(command)
        raise KeyboardInterrupt

    monkeypatch.setattr("legged.benchmarks.scale.subprocess.run", run)
    arguments = ["--task", "anymal_c_flat", "--sim_device", "cpu", "--scale=4", "--physics", "newton", "--solver", "xpbd"]
    assert benchmark.main(arguments) == 130
    (command,) = seen
    assert command[command.index("--physics") + 1] == "newton"
    assert command[command.index("--solver") + 1] == "xpbd"
    assert "--scale=4" not in command


def test_a_start_is_timed_beside_importing_torch(tmp_path, capsys):
    arguments = ["--startup", "--repeats", "1", "--json", str(tmp_path / "s.json"), "--task", "anymal_c_flat", *SMALL]
    assert benchmark.main(arguments) == 0
    times = json.loads((tmp_path / "s.json").read_text())
    stages = list(times["stages"].values())
    assert list(times["stages"])[-2:] == ["first iteration", "end"]
    assert stages == sorted(stages)
    assert times["ratio"] == pytest.approx(times["stages"]["first iteration"] / times["torch_s"])
    assert times["ratio_without_capture"] < times["ratio"]
    assert "x import torch" in capsys.readouterr().out
