"""timing.json: what a training says of how long it took."""

import json

import pytest
from helpers import TASK, TINY_TRAINING, run_folders, small_task, tiny_run

from legged.cli.train import train
from legged.errors import ConfigError
from legged.learning.timing import TIMING_FILE, Timing, read_timing, write_timing
from legged.physics.warp import mujoco_warp

pytestmark = pytest.mark.usefixtures("workplace")

TIMING = Timing("walk", True, 8, 2, False, 64, 1.5, 0.25, 2.0, "cpu", 0)


@pytest.mark.slow
def test_a_training_says_how_long_it_took_and_a_resumed_one_that_it_was_resumed():
    folder = tiny_run(num_envs=8, iterations=2)
    first = read_timing(folder)
    assert (first.task, first.finished, first.robots, first.iterations, first.resumed) == (TASK, True, 8, 2, False)
    assert first.steps == 8 * 2 * 4  # 4 steps an iteration
    assert first.steps_per_s == pytest.approx(64 / first.loop_s)
    assert 0.0 < first.loop_s < first.wall_s
    assert 0.0 < first.start_up_s < first.wall_s - first.loop_s
    assert (first.device, first.kernels_compiled, first.beside) == ("cpu", 0, 0)

    again = read_timing(tiny_run("--resume", num_envs=8, iterations=5))
    assert (again.iterations, again.steps, again.resumed) == (3, 96, True)


@pytest.mark.slow
def test_numbers_are_those_that_are_printed(capsys):
    arguments = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "4", "--max_iterations", "1", *TINY_TRAINING]
    assert train.main(arguments) == 0
    (folder,) = run_folders()
    said = json.loads((folder / TIMING_FILE).read_text())
    printed = capsys.readouterr().out
    assert (
        f"finished after 1 iterations: {said['steps']} steps in {said['loop_s']:.1f} s of training loop"
        f" ({said['steps_per_s']:,.0f} steps/s), {said['start_up_s']:.1f} s of start-up" in printed
    )
    assert f"{said['wall_s']:.1f} s in all" in printed


def test_what_is_written_is_read_again(tmp_path):
    write_timing(tmp_path, TIMING)
    assert read_timing(tmp_path) == TIMING
    assert json.loads((tmp_path / TIMING_FILE).read_text())["steps_per_s"] == 64 / 0.25
    assert read_timing(tmp_path / "elsewhere") is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "timing.json: does not hold the times of a training (Expecting"),
        ("[1]", "timing.json: does not hold"),
        ('{"task": "walk"}', "(finished: expected bool, got None)"),
        (json.dumps(vars(TIMING) | {"loop_s": "long"}), "(loop_s: expected float, got 'long')"),
    ],
)
def test_a_file_that_says_something_else_is_refused(tmp_path, text, words):
    (tmp_path / TIMING_FILE).write_text(text)
    with pytest.raises(ConfigError) as error:
        read_timing(tmp_path)
    assert words in str(error.value)


@pytest.mark.slow
def test_an_engine_counts_the_kernel_modules_that_it_had_to_compile(monkeypatch):
    monkeypatch.setattr(mujoco_warp, "compile_ahead", lambda *_: 7)
    assert small_task(("sim.physics", "mujoco_warp"), num_envs=2).physics.compiled == 7
    assert small_task(num_envs=2).physics.compiled == 0
