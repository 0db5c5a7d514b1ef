"""The benchmark: what it times, and that its numbers fit together."""

import json

import pytest
from helpers import call, small_task

from legged.rl.captured import CapturedRunner
from legged.rl.runner import Runner
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


@pytest.mark.parametrize("kind", [Runner, CapturedRunner])
def test_iterations_are_counted_without_the_first(kind):
    task = small_task(num_envs=4)
    times = benchmark.time_iterations(kind, task, 3)
    low, high = times["iteration_ms_range"]
    assert low <= times["iteration_ms"] <= high
    assert times["rollout_ms"] + times["update_ms"] == pytest.approx(times["iteration_ms"], rel=0.7)
    assert times["note"] == ""


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--task", "anymal_c", "--grounds", "--sim_device", "cpu"], "compares colliders of mujoco_warp"),
        (["--task", "anymal_c_flat", "--grounds", "--sim_device", "cpu", "sim.physics=mujoco_warp"], "has no terrain"),
    ],
)
def test_grounds_need_mujoco_warp_and_terrain(arguments, words, capsys):
    assert call(benchmark.main, arguments) == 2
    assert words in capsys.readouterr().err
