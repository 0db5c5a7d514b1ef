"""The report on a run: written when a training ends, however it ends, and made anew for any run folder."""

import contextlib
import io
import json
import os
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers import POLICY, TASK, TINY_TRAINING, call, run_folders, tiny_run
from torch.utils.tensorboard import SummaryWriter

from legged import registry
from legged.cli.evaluate import grid
from legged.cli.runs import report
from legged.cli.runs import runs as table
from legged.cli.train import train
from legged.errors import RunError
from legged.evaluation.learning_curves import read_scalars, smooth
from legged.evaluation.reports.record import read_record
from legged.evaluation.reports.run_report import over_training, write_report
from legged.learning.captured import CapturedRunner
from legged.learning.invocation import INVOCATION_FILE
from legged.learning.report_process import LOG, NICENESS, STARTED, wait_for_reports
from legged.learning.timing import TIMING_FILE
from legged.process import processes

pytestmark = [pytest.mark.usefixtures("workplace"), pytest.mark.slow]

REPORTED = ["train.runner.report=true", "train.runner.film=false", "env.episode_length_s=0.1"]
FLAGS = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", *TINY_TRAINING]


def read(folder: Path, name: str = "report.html") -> str:
    return (folder / name).read_text(encoding="utf-8")


def test_a_training_ends_with_a_report():
    folder = tiny_run(*REPORTED, "rewards.scales.torques=-3e-4", "--note", "torques cost more", iterations=3)
    page, text = read(folder), read(folder, "report.md")
    for words in ("torques cost more", "finished", "3 of 3 iterations", "rewards.scales.torques", "-0.0003", "-1.0e-05"):
        assert words in page
        assert words in text
    titles = set(re.findall(r'aria-label="([^"]+)"', page))
    assert {
        "return of an episode, and standard deviation over episodes",
        "parts of the reward, per second of a full episode",
        "velocity error [m/s]",
        "length of an episode [s]",
        "learning rate",
        "standard deviation of actions (noise)",
        "divergence (KL) within an update [nat]",
    } <= titles
    assert "![learning curves](report_curves.svg)" in text
    assert read(folder, "report_curves.svg").count("<svg") == len(titles) + 1
    assert not (folder / "film.gif").exists()


def test_evaluations_during_training_have_their_time_and_their_best():
    evaluated = ["train.runner.evaluate_interval=1", "train.runner.evaluate_envs=8", "train.runner.evaluate_s=1.1"]
    folder = tiny_run(*REPORTED, *evaluated, "commands.curriculum.enabled=true")
    text, timing = read(folder, "report.md"), read_record(folder).timing
    rest_s = timing.wall_s - timing.start_up_s - timing.loop_s - timing.evaluation_s
    assert 0.0 < timing.evaluation_s < timing.wall_s - timing.start_up_s - timing.loop_s
    assert f"| time to evaluate | {timing.evaluation_s:.1f} s |" in text
    assert f"| time for the rest | {rest_s:.1f} s (" in text
    assert r"the best by its evaluations is model\_best.pt" in text
    titles = set(re.findall(r'aria-label="([^"]+)"', read(folder)))
    assert {"largest commanded vx [m/s]", "largest commanded yaw rate [rad/s]"} <= titles
    assert {"evaluated: velocity RMSE [m/s]", "evaluated: robots that fell [%]"} <= titles


def test_levels_are_drawn_by_type():
    short = ["env.episode_length_s=0.1", "terrain.num_rows=2", "terrain.num_cols=10", "terrain.max_init_terrain_level=1"]
    arguments = ["--task", "anymal_c", "--sim_device", "cpu", "--num_envs", "20", "--max_iterations", "2"]
    assert train.main([*arguments, *TINY_TRAINING, *short]) == 0
    (folder,) = run_folders()
    page = write_report(folder).read_text()
    found = page.partition('aria-label="mean terrain level by type"')[2].partition("</svg>")[0]
    assert {"stairs up", "stairs down", "slope up"} <= set(re.findall(r'data-name="([^"]+)"', found))
    assert "always promoted" in found


def test_the_table_has_the_numbers_of_the_log():
    folder = tiny_run("env.episode_length_s=0.1", iterations=25)
    table = over_training(read_record(folder))
    assert table.head[:5] == ["iteration", "steps", "time [s]", "return", "standard deviation of the return"]
    iterations = [row[0].value for row in table.rows]
    assert (len(iterations), iterations[0], iterations[-1]) == (10, 1.0, 25.0)
    assert [row[1].value for row in table.rows] == [32.0 * iteration for iteration in iterations]
    scalars = read_scalars(folder)
    loop = scalars["Perf/collection_time"][1] + scalars["Perf/learning_time"][1]
    assert table.rows[-1][2].value == pytest.approx(float(loop.sum()))
    error = table.head.index("velocity error [m/s]")
    wanted = smooth(scalars["Metrics/lin_vel_rmse"][1])
    assert [row[error].value for row in table.rows] == pytest.approx([wanted[int(i) - 1] for i in iterations])
    assert np.isfinite([row[4].value for row in table.rows[1:]]).all()
    resumed = tiny_run("--resume", "--load_run", folder.name, iterations=30)
    table = over_training(read_record(resumed))
    assert table.head[2] == "time since it was resumed [s]"
    assert table.rows[0][0].value == 26.0


def test_a_training_that_raises_leaves_a_report_that_says_so(monkeypatch):
    log = CapturedRunner._log

    def fail(self, made):
        if made.iteration == 1:
            raise RuntimeError("no <good>")
        log(self, made)

    monkeypatch.setattr(CapturedRunner, "_log", fail)
    with pytest.raises(RuntimeError, match="good"):
        train.main([*FLAGS, *REPORTED, "--max_iterations", "3"])
    wait_for_reports()
    (folder,) = run_folders()
    assert '<span class="badge crashed">' in read(folder)
    assert "after 1 of 3 iterations: RuntimeError: no &lt;good&gt;" in read(folder)


def test_a_run_that_wrote_no_end_gets_its_report_later(capsys):
    """As after kill -9, or on a disk that was full."""
    folder = tiny_run(iterations=2)
    (folder / TIMING_FILE).unlink()
    (folder / "model_1.pt").unlink()
    (log,) = folder.glob("events.out.tfevents.*")
    log.write_bytes(log.read_bytes()[:-7])  # it was writing
    os.utime(log.rename(folder / "events.out.tfevents.1.elsewhere.9.0"), (0, 0))
    assert report.main([str(folder)]) == 0
    assert capsys.readouterr().out == f"written: {folder / 'report.html'}\n"
    assert '<span class="badge killed">' in read(folder)
    assert "velocity error [m/s]" in read(folder)


def test_a_report_that_cannot_be_started_spoils_no_run(monkeypatch, capsys):
    def fail(*_, **__):
        raise OSError("no such program")

    monkeypatch.setattr(processes, "Popen", fail)
    assert train.main([*FLAGS, *REPORTED, "--max_iterations", "1"]) == 0
    (folder,) = run_folders()
    assert capsys.readouterr().err == f"warning: {folder}: no report: no such program\n"
    assert (folder / "model_0.pt").is_file()


def test_a_training_that_wants_none_has_none():
    assert not list(tiny_run().glob("report*"))


def test_what_was_evaluated_is_in_it():
    """The shipped policy of the flat task: heat maps of its grid in each engine, and the numbers of the file."""
    shutil.copytree(POLICY, "run")
    result = json.loads((POLICY / "evaluation_mujoco.json").read_text())
    page = write_report(Path("run")).read_text()
    assert f"{result['rmse_lin']['mean']:.3f}" in page
    assert "velocity RMSE [m/s], C MuJoCo" in page
    mean = np.mean([cell["rmse_lin"] for cell in result["cells"] if cell["command"][:2] == result["cells"][0]["command"][:2]])
    maps = page.partition('aria-label="velocity RMSE [m/s], C MuJoCo"')[2].partition("</svg>")[0]
    assert f">{mean:.2f}</text>" in maps
    assert "None yet" not in page


@pytest.mark.parametrize("task", ["anymal_c", "humanoid"])
def test_success_and_episodes_are_in_it(task):
    folder = POLICY.with_name(task)
    shutil.copytree(folder, "run")
    page = write_report(Path("run")).read_text()
    if task == "humanoid":
        episodes = json.loads((folder / "evaluation_mujoco.json").read_text())["episodes"]
        assert f">{episodes['return']['mean']:.1f}</td>" in page
    else:
        found = page.partition('aria-label="success: stairs"')[2].partition("</svg>")[0]
        assert {"stairs up, C MuJoCo", "stairs down, mujoco-warp"} <= set(re.findall(r'data-name="([^"]+)"', found))
        assert "hardest of training" in found


def test_an_evaluation_that_lacks_its_cells_is_left_out_of_the_maps():
    shutil.copytree(POLICY, "run")
    path = Path("run/evaluation_mujoco.json")
    result = json.loads(path.read_text())
    path.write_text(json.dumps({**result, "cells": [{}]}))
    page = write_report(Path("run")).read_text()
    assert "velocity RMSE [m/s], C MuJoCo" not in page
    assert f"{result['rmse_lin']['mean']:.3f}" in page


# ---- film ------------------------------------------------------------------------------------------------------------


class Started:
    """A process that has not ended: waiting for it would fail."""

    pid = 0

    def __init__(self, command, **options):
        self.command, self.options = command, options


@pytest.mark.parametrize("film", [True, False])
def test_a_report_is_asked_of_another_process(film, monkeypatch, capsys):
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setattr(processes, "Popen", Started)
    monkeypatch.setattr(os, "setpriority", lambda *given: niceness.append(given))
    niceness = []
    more = ["train.runner.report=true", f"train.runner.film={film}"]
    Path("mine.py").write_text("")
    assert train.main([*FLAGS, "--max_iterations", "1", "--import", "mine.py", *more]) == 0
    (folder,), asked = run_folders(), STARTED.pop()
    assert asked.command[1:] == ["-m", "legged", "runs", "report", str(folder), *["--film"] * film, "--import", "mine.py"]
    assert (asked.options["env"]["CUDA_VISIBLE_DEVICES"], "RANK" in asked.options["env"]) == ("", False)
    assert asked.options["start_new_session"]  # Ctrl-C and a terminal that closes are none of its business
    assert niceness == [(os.PRIO_PROCESS, 0, NICENESS)]
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == f"report follows: {folder}/report.html (report.log says why if it does not)"


def test_the_other_process_writes_why_there_is_no_film_and_leaves_the_report_whole(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    folder = tiny_run("train.runner.report=true", iterations=1)
    assert read(folder, LOG).startswith(f"written: {folder}/report.html\nno film: cannot render here")
    assert read(folder).rstrip().endswith("</html>")
    assert not list(folder.glob(".*"))


def test_a_run_that_is_deleted_before_it_is_filmed_stays_deleted(monkeypatch, capsys):
    def film(policy, side):
        shutil.rmtree(folder)
        return [np.zeros((32, 32, 3), dtype=np.uint8)]

    folder = tiny_run(iterations=1)
    monkeypatch.setattr("legged.cli.runs.film", film)
    assert report.main([str(folder), "--film"]) == 0
    assert "no film: the run folder was removed\n" in capsys.readouterr().out
    assert not folder.exists()


def test_the_command_films(monkeypatch, capsys):
    frames = [np.full((32, 32, 3), shade, dtype=np.uint8) for shade in (0, 90, 180)]

    def film(policy, side):
        assert read(folder).rstrip().endswith("</html>"), "a film that ends the process leaves no report"
        return frames

    monkeypatch.setattr("legged.cli.runs.film", film)
    folder = tiny_run(iterations=1)
    assert report.main([str(folder), "--film"]) == 0
    assert f"written: {folder / 'film.gif'}" in capsys.readouterr().out
    assert "data:image/gif" in read(folder)

    def fail(policy, side):
        raise RunError("nothing can be rendered here")

    monkeypatch.setattr("legged.cli.runs.film", fail)
    assert report.main([str(folder), "--film"]) == 0
    assert "no film: nothing can be rendered here\n" in capsys.readouterr().out


def test_what_is_no_number_is_left_out_and_does_not_spread():
    """As a training that diverged leaves it, and one with a learning rate of 0."""
    tags = ("Train/mean_reward", "Metrics/lin_vel_rmse", "Episode/rew_a", "Episode/rew_b", "Loss/learning_rate")
    pages = []
    for name, values in (("some", [1.0, np.nan, 3.0, np.inf, 2.0]), ("none", [np.nan] * 5), ("zero", [0.0] * 5)):
        folder = Path("logs") / TASK / name
        folder.mkdir(parents=True)
        shutil.copy(POLICY / "config.yaml", folder)
        with SummaryWriter(str(folder)) as writer:
            for step, value in enumerate(values):
                for tag in tags:
                    writer.add_scalar(tag, value, step)
        pages.append(write_report(folder).read_text())
        text = read(folder, "report.md")
        drawings = re.findall(r'(?:points|data-v|data-sort)="([^"]*)"', pages[-1])
        assert drawings
        assert not [one for one in drawings if "nan" in one or "inf" in one]
        assert "| nan |" not in text
        assert "| inf |" not in text
    assert " | - | 2.50 | 2.500 |\n\n" in read(Path("logs") / TASK / "some", "report.md")  # of 3, inf and 2
    assert " | - | - | - |\n\n" in read(Path("logs") / TASK / "none", "report.md")


# ---- tasks of one's own ----------------------------------------------------------------------------------------------


@pytest.fixture
def forgotten(monkeypatch):
    """forgotten(): lets go of tasks that were registered, as another process knows none of them."""
    monkeypatch.setattr(registry, "_REGISTERED", {})
    return registry._REGISTERED.clear


def test_a_run_of_somebodys_own_task_says_how_it_is_found_again(forgotten, capsys):
    Path("my own.d").mkdir()
    Path("my own.d/mine.yaml").write_text(f"extends: {TASK}\n")
    named = ["--task", "my own.d/mine.yaml", "train.runner.experiment_name=elsewhere"]
    folder = tiny_run(*named, *REPORTED, "rewards.scales.torques=-3e-4", iterations=1)
    assert "| `rewards.scales.torques` | `-0.0003` | `-1.0e-05` |" in read(folder, "report.md")
    found = re.search(r"None yet: `legged evaluate (.*)`", read(folder, "report.md"))
    forgotten()
    small = ["--vx=0", "--vy=0", "--yaw=0", "--robots", "1", "--sim-device", "cpu"]
    assert call(grid.main, [*shlex.split(found[1]), *small]) == 0  # the words as they stand there
    forgotten()
    assert report.main([str(folder)]) == 0
    text = read(folder, "report.md")
    command = f"legged runs report --import 'my own.d/mine.yaml' {folder}"
    assert f"There is no task 'mine' here to compare with. Where it exists, `{command}`" in text
    assert "| `rewards.scales.torques` | `-0.0003` |" in text
    assert table.main(["--out", "all"]) == 0
    assert "sim.physics mujoco, sim.threads 1, runner.num_steps_per_env 4" in read(Path("all"), "experiments.md").replace(
        "\\", ""
    )
    assert report.main(["--import", "my own.d/mine.yaml", str(folder)]) == 0
    assert "| `rewards.scales.torques` | `-0.0003` | `-1.0e-05` |" in read(folder, "report.md")
    capsys.readouterr()


def test_a_resumed_run_keeps_what_was_set_before():
    first = tiny_run("rewards.scales.torques=-3e-4", "env.episode_length_s=0.1", iterations=1)
    again = tiny_run("--resume", "env.episode_length_s=0.2", iterations=2)
    changes = read_record(again).given.changes
    assert (changes["rewards.scales.torques"], changes["env.episode_length_s"]) == (-3e-4, 0.2)
    (first / INVOCATION_FILE).write_text('{"task": 3}')
    assert read_record(first).given is None
    assert any(INVOCATION_FILE in text for text in read_record(first).problems)


def test_a_task_without_commands_is_told_the_command_that_films_it(forgotten, capsys):
    """The task of a YAML file and of a module is found by it, and the run that it films is this one."""
    Path("mine.yaml").write_text("extends: half_cheetah\n", encoding="utf-8")
    Path("my tasks.py").write_text("", encoding="utf-8")
    folder = tiny_run("--import", "my tasks.py", "--task", "mine.yaml", iterations=1)
    forgotten()
    told = ["--import", "my tasks.py,mine.yaml"]
    film = ["legged", "play", *told, str(folder)]
    assert report.main([*told, "mine", "--film"]) == 0
    out = capsys.readouterr().out
    assert "no film: 'mine' has no velocity commands" in out
    assert f"film it with `{shlex.join([*film, '--gif'])}`\n" in out

    plain = tiny_run("--task", "half_cheetah", iterations=1)
    assert report.main([str(plain), "--film"]) == 0
    assert f"film it with `legged play {plain} --gif`\n" in capsys.readouterr().out


# ---- command line ----------------------------------------------------------------------------------------------------


def test_runs_are_named_as_in_other_tools(capsys):
    tiny_run("train.runner.run_name=a", iterations=1)
    older = tiny_run("train.runner.run_name=b", iterations=1)
    newest = tiny_run("train.runner.run_name=c", iterations=1)
    assert report.main([TASK]) == 0
    assert report.main([f"{TASK}/{older.name}", "--note", "the\nolder one"]) == 0
    assert [folder.name for folder in run_folders() if (folder / "report.html").is_file()] == [older.name, newest.name]
    assert read(older, "note.txt") == "the older one\n"
    assert "the older one" in read(older)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "error: RUN: there is no task and no run 'nowhere'"),
        (["anymal_cc"], "error: RUN: there is no task and no run 'anymal_cc'; did you mean 'anymal_c'?"),
        ([TASK], f"error: RUN: '{TASK}' has no run in logs/"),
        (["x", "--checkpoint", "5"], "error: --checkpoint: 5: has no effect without --film"),
        (["RUN", "--note", " "], "error: --note: expected a sentence of at most 1000 letters, got 0"),
    ],
)
def test_a_wrong_command_line_is_one_line(arguments, words, capsys):
    if "RUN" in arguments:
        arguments = [str(tiny_run(iterations=1)), *arguments[1:]]
    with contextlib.redirect_stdout(io.StringIO()):
        assert call(report.main, arguments) == 2
    err = capsys.readouterr().err
    assert err.startswith(words)
    assert len(err.splitlines()) == 1
