"""Trackers beside TensorBoard: what they are given, and that a training does without them."""

import subprocess
import sys
import types
from pathlib import Path

import pytest
from helpers import HANG_S, TASK, TINY_TRAINING, call, run_folders, tiny_run
from rsl_rl.utils import wandb_log_writer
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import legged.cli.train
from legged.cli.train import train
from legged.learning.checkpoint import read_checkpoint

pytestmark = pytest.mark.usefixtures("workplace")

ARGUMENTS = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "2", *TINY_TRAINING]
OWN = """
from rsl_rl.utils.log_writer import LogWriter

class Lines(LogWriter):
    def __init__(self, log_dir):
        self.file = open("lines.txt", "a")
    def note(self, *words):
        print(*words, file=self.file, flush=True)
    def add_scalar(self, tag, scalar_value, global_step):
        self.note("scalar", tag, global_step)
        if global_step == FAILS_AT and tag == "Perf/total_fps":
            raise ConnectionError("the line is dead")
    def store_config(self, env_cfg, train_cfg):
        self.note("config", env_cfg.to_dict()["task"], train_cfg["algorithm"]["learning_rate"])
    def save_model(self, model_path, it):
        self.note("model", model_path.rpartition("/")[2], it)
    def save_file(self, path):
        self.note("file", path.rpartition("/")[2])
    def save_video(self, video, it):
        self.note("video", video.name, it)
    def stop(self):
        self.note("stop")

class Shut(Lines):
    def __init__(self, log_dir):
        raise PermissionError("nobody has logged in")
"""


class FakeWandb(types.ModuleType):
    """Weights & Biases, as far as rsl-rl's writer calls it."""

    def __init__(self):
        super().__init__("wandb")
        self.calls: list[tuple] = []
        self.config = types.SimpleNamespace(update=lambda values: self.calls.append(("config", values)))
        self.init = lambda **given: self.calls.append(("init", given))
        self.log = lambda values, step: self.calls.append(("log", dict(values), step))
        self.save = lambda path, base_path: self.calls.append(("save", Path(path).name))
        self.Video = lambda path, format: Path(path).name
        self.finish = lambda: self.calls.append(("finish",))

    def of(self, kind: str) -> list[tuple]:
        return [call[1:] for call in self.calls if call[0] == kind]


def own_tracker(fails_at: int = -1) -> str:
    """A module `lines_tracker` in the working directory; the settings that ask for it."""
    Path("lines_tracker.py").write_text(OWN.replace("FAILS_AT", str(fails_at)))
    sys.modules.pop("lines_tracker", None)
    return "train.runner.logger=lines_tracker:Lines"


@pytest.fixture(autouse=True)
def _not_found_by_python_itself(monkeypatch):
    """As for a program that is called by its path: the working directory is not where Python looks for modules."""
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder not in ("", ".")])


def scalars(folder: Path) -> dict[str, list[int]]:
    """What TensorBoard's file holds: name -> steps."""
    events = EventAccumulator(str(folder))
    events.Reload()
    return {name: [event.step for event in events.Scalars(name)] for name in events.Tags()["scalars"]}


def test_weights_and_biases_get_what_tensorboard_gets_and_the_files_of_the_run(monkeypatch):
    fake = FakeWandb()
    monkeypatch.setattr(wandb_log_writer, "wandb", fake)
    write_timing = legged.cli.train.write_timing

    def with_report(folder, timing):
        """A report and a video, written at the end of a run."""
        (folder / "report.html").write_text("<p>")
        (folder / "walk.mp4").write_bytes(b"")
        write_timing(folder, timing)

    monkeypatch.setattr(legged.cli.train, "write_timing", with_report)
    folder = tiny_run("train.runner.logger=wandb", "train.runner.logger_project=dogs", iterations=2)
    assert fake.of("init") == [
        ({"project": "dogs", "entity": None, "name": folder.name, "config": {"log_dir": str(folder)}},)
    ]
    settings = {name: value for (update,) in fake.of("config") for name, value in update.items()}
    assert settings["env_cfg"]["train"]["runner"]["logger_project"] == "dogs"
    assert settings["train_cfg"]["runner"]["max_iterations"] == 2
    logged = fake.of("log")
    steps = [step for _, step in logged]
    assert steps == sorted(steps), "Weights & Biases takes no step that is earlier than the last"
    here = scalars(folder)
    assert set(here) - {"Train/mean_reward/time", "Train/mean_episode_length/time"} == {
        name for values, _ in logged for name in values if name != "video"
    }
    assert here["Loss/value"] == [0, 1]
    saved = [name for (name,) in fake.of("save")]
    assert saved == ["model_0.pt", "model_1.pt", "config.yaml", "code.diff", "timing.json", "report.html"]
    assert logged[-1] == ({"video": "walk.mp4"}, 1)
    assert fake.calls[-1] == ("finish",)


@pytest.mark.slow
def test_a_writer_of_one_s_own_stands_beside_tensorboard():
    folder = tiny_run(own_tracker(), "train.runner.report=true", "train.runner.film=false", iterations=2)
    lines = Path("lines.txt").read_text().splitlines()
    assert lines[0].startswith(f"config {TASK} 0.001")
    assert "scalar Loss/value 1" in lines
    assert [line for line in lines if line.startswith("model")] == ["model model_0.pt 0", "model model_1.pt 1"]
    files = ["config.yaml", "code.diff", "timing.json", "report.html", "report.md"]
    assert lines[-6:] == [*(f"file {name}" for name in files), "stop"]
    assert scalars(folder)["Loss/value"] == [0, 1]


@pytest.mark.slow
def test_a_tracker_that_fails_ends_nothing_and_is_told_of_once(capsys):
    assert train.main([*ARGUMENTS, own_tracker(fails_at=1), "--max_iterations", "4"]) == 0
    (folder,) = run_folders()
    assert capsys.readouterr().err == "warning: the tracker has failed and is no longer used: the line is dead\n"
    assert scalars(folder)["Perf/total_fps"] == [0, 1, 2, 3]
    lines = Path("lines.txt").read_text().splitlines()
    assert lines[-1] == "scalar Perf/total_fps 1"


@pytest.mark.slow
def test_a_training_learns_the_same_with_a_tracker_and_without():
    plain, tracked = tiny_run(), tiny_run(own_tracker())
    a, b = (read_checkpoint(folder / "model_1.pt")["actor_state_dict"] for folder in (plain, tracked))
    assert all(a[name].equal(b[name]) for name in a)


@pytest.mark.parametrize(
    ("logger", "words"),
    [
        ("wandb", "train.runner.logger: 'wandb' needs the package wandb, which is not installed here: pip install wandb"),
        ("wandbb", "train.runner.logger: there is no tracker 'wandbb'; did you mean 'wandb'? (allowed: neptune, tensorboard"),
        ("lines_tracker:Linse", "'lines_tracker:Linse' can't be imported (AttributeError: "),
        ("pathlib:Path", "'pathlib:Path' does not extend rsl_rl.utils.log_writer.LogWriter"),
    ],
)
def test_a_tracker_that_is_not_there_is_one_line_before_anything_is_built(logger, words, monkeypatch, capsys):
    own_tracker()
    monkeypatch.setattr(wandb_log_writer, "wandb", None)
    monkeypatch.setattr(legged.cli.train, "make_task", lambda *_, **__: pytest.fail("built"))
    assert call(train.main, [*ARGUMENTS, f"train.runner.logger={logger}"]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert len(err.splitlines()) == 1


@pytest.mark.slow
def test_a_writer_beside_the_user_is_found_by_a_program_that_lies_elsewhere():
    """The module is imported: what is wrong with it is that it has no writer."""
    Path("my_lines.py").write_text("Nothing = 3")
    program = Path(legged.__file__).parents[1] / "train.py"
    arguments = [sys.executable, str(program), *ARGUMENTS, "train.runner.logger=my_lines:Nothing"]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=HANG_S, check=False)
    assert done.returncode == 2
    assert "'my_lines:Nothing' does not extend rsl_rl.utils.log_writer.LogWriter" in done.stderr


def test_a_tracker_that_does_not_start_leaves_no_folder(capsys):
    own_tracker()
    assert call(train.main, [*ARGUMENTS, "train.runner.logger=lines_tracker:Shut"]) == 1
    err = capsys.readouterr().err
    assert err == "error: train.runner.logger: lines_tracker:Shut does not start: nobody has logged in\n"
    assert run_folders() == []
