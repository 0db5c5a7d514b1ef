"""What play shows and writes where something is in its way: long control steps, full disks, displays that refuse."""

import errno
import weakref
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import imageio_ffmpeg
import numpy as np
import pytest
from helpers import POLICY, TASK, call, small_config, small_task, stand
from PIL import Image

import legged.policies.restore
from legged.cli.play import play
from legged.envs import LeggedRobot
from legged.errors import RunError
from legged.play import demonstrations, films
from legged.policies.actor import Actor
from legged.policies.export import export
from legged.process.paths import DISK_FULL

pytestmark = pytest.mark.usefixtures("workplace")

HERE = ["--task", TASK, "--load_run", str(POLICY), "--sim_device", "cpu", "sim.threads=1", "sim.physics=mujoco"]


class FakeCamera:
    """Takes black pictures."""

    def __init__(self, task, count):
        self.followed = 0

    def picture(self, _caption):
        return np.zeros((18, 32, 3), dtype=np.uint8)

    def close(self): ...


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(demonstrations, "SCHEDULE", ((0.2, (0.5, 0.0, 0.0)),))
    monkeypatch.setattr(films, "camera_of", FakeCamera)


@pytest.mark.slow
def test_a_command_that_is_over_before_it_is_measured_has_no_error(short):
    """One control step lasts 1.25 s, the command 0.2 s: one step, in whose first second nothing is measured."""
    task = small_task(("control.decimation", 250), num_envs=2)
    with films.Video(task, 1, Path("film")) as film:
        table = demonstrations.follow_schedule(task, stand, film)
    assert list(table.columns[1].cells) == ["-"]
    assert film.fps == pytest.approx(1 / task.dt)
    assert Path("film/play.mp4").stat().st_size > 0


@pytest.mark.slow
def test_a_robot_that_fell_is_not_measured_until_it_has_settled_again(short, monkeypatch):
    """It falls every 60 steps of 20 ms: of 150 steps, measured are 9 before the first fall, which begin at 1 s or later, 10
    before the second one, which end at 1 s of their episode or later, and none of the rest.
    """

    class Falling(LeggedRobot):
        def _terminate_contact(self):
            return self.episode_length_buf >= 60

    kept = []

    class Kept(demonstrations.TrackingErrors):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            kept.append(self)

    monkeypatch.setattr(demonstrations, "SCHEDULE", ((3.0, (0.5, 0.0, 0.0)),))
    monkeypatch.setattr(demonstrations, "TrackingErrors", Kept)
    task = Falling(small_config(num_envs=2))
    demonstrations.follow_schedule(task, stand, films.Video(task, 1, None))
    assert kept[0].falls.tolist() == [2.0, 2.0]
    assert kept[0].steps.tolist() == [19.0, 19.0]


@pytest.mark.slow
@pytest.mark.parametrize("first", ["exec < /dev/null", "cat > /dev/null"])  # it ends at once, and after all pictures
def test_a_film_that_does_not_fit_costs_no_table(first, short, monkeypatch, capsys):
    encoder_that(monkeypatch, f"{first}; echo Error writing trailer: No space left on device >&2; exit 228")
    assert call(play.main, [*HERE, "--headless", "--num_envs", "1", "--out", "out"]) == 1
    out, err = capsys.readouterr()
    assert "following commands" in out
    assert err == f"error: out/play.mp4: {DISK_FULL}\n"
    assert [path.name for path in Path("out").iterdir()] == ["exported"]


def encoder_that(monkeypatch, script: str) -> None:
    """Replace ffmpeg by a shell script."""
    path = Path("ffmpeg").absolute()
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: str(path))


class Pictures:
    """Makes noisy pictures, and counts those that exist."""

    def __init__(self):
        self.random, self.made, self.most = np.random.default_rng(0), [], 0

    def make(self) -> np.ndarray:
        picture = self.random.integers(0, 255, (180, 320, 3), dtype=np.uint8)
        self.made.append(weakref.ref(picture))
        self.most = max(self.most, sum(made() is not None for made in self.made))
        return picture


def frames_in(path: Path) -> int:
    return imageio_ffmpeg.count_frames_and_secs(str(path))[0]


def test_a_film_keeps_no_pictures():
    pictures = Pictures()
    with films.mp4(Path("a.mp4"), 25.0, 320, 180) as append:
        for _ in range(60):
            append(pictures.make())
    assert pictures.most == 1
    assert frames_in(Path("a.mp4")) == 60


@pytest.mark.parametrize("gif", [False, True])
def test_a_film_of_play_keeps_no_pictures(gif, monkeypatch):
    """A GIF keeps its own, which are small and few."""
    pictures = Pictures()

    class Camera(FakeCamera):
        def picture(self, _caption):
            return pictures.make()

    monkeypatch.setattr(films, "camera_of", Camera)
    with films.Video(SimpleNamespace(dt=0.02), 1, Path("film"), gif) as film:
        taken = [film.take("") for step in range(100) if film.due(step)]
    assert pictures.most == 1
    assert frames_in(Path("film/play.mp4")) == len(taken) == film.count == 50
    assert sorted(path.name for path in Path("film").iterdir()) == ["play.gif", "play.mp4"][not gif :]
    if gif:
        assert Image.open("film/play.gif").n_frames == 17  # every third one of 50


def test_a_film_that_is_broken_off_leaves_the_earlier_one():
    def break_off() -> None:
        with films.mp4(Path("film/a.mp4"), 25.0, 32, 18) as append:
            append(np.zeros((18, 32, 3), dtype=np.uint8))
            raise KeyboardInterrupt

    leaves_the_earlier_film(break_off, Path("film/a.mp4"))


def test_a_film_of_play_that_is_broken_off_leaves_the_earlier_one(monkeypatch):
    def break_off() -> None:
        with films.Video(SimpleNamespace(dt=0.02), 1, Path("film"), gif=True) as film:
            film.take("")
            raise KeyboardInterrupt

    monkeypatch.setattr(films, "camera_of", FakeCamera)
    leaves_the_earlier_film(break_off, Path("film/play.mp4"))


def leaves_the_earlier_film(break_off: Callable[[], None], path: Path) -> None:
    path.parent.mkdir()
    path.write_text("earlier")
    with pytest.raises(KeyboardInterrupt):
        break_off()
    assert path.read_text() == "earlier"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.slow
def test_where_nothing_can_be_drawn_commands_are_followed_all_the_same(short, monkeypatch, capsys):
    def fail(*_):
        raise RunError("cannot render here")

    monkeypatch.setattr(films, "camera_of", fail)
    assert call(play.main, [*HERE, "--headless", "--num_envs", "1", "--out", "out"]) == 1
    out, err = capsys.readouterr()
    assert "following commands" in out
    assert err == "error: cannot render here, or play with --no-video\n"


@pytest.mark.slow
def test_a_window_that_does_not_open_is_told_and_a_film_is_made(short, monkeypatch, capsys):
    monkeypatch.setattr("legged.cli.play.HEADLESS", False)
    monkeypatch.setattr("legged.cli.play.window_opens", lambda: False)
    monkeypatch.setattr("legged.cli.play.view", lambda *_: pytest.fail("opened"))
    assert call(play.main, [*HERE, "--num_envs", "1", "--out", "out"]) == 0
    assert "no window opens on this display: recording only" in capsys.readouterr().out
    assert Path("out/play.mp4").is_file()


@pytest.mark.slow
def test_a_folder_that_cannot_be_written_is_found_before_anything_is_built(monkeypatch, capsys):
    Path("file").write_text("mine")
    monkeypatch.setattr(legged.policies.restore, "make_task", lambda *_: pytest.fail("built"))
    assert call(play.main, [*HERE, "--out", "file/below"]) == 2
    assert "file/below: cannot make the folder: file is a file" in capsys.readouterr().err


@pytest.mark.slow
def test_an_export_onto_a_full_disk_is_one_line(monkeypatch):
    """Torch would abort the process; so it never writes to the disk itself."""
    task = small_task(num_envs=2)
    policy = Actor(task, "cpu").network

    def full(self, _data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(RunError, match=r"out/policy\.pt: no space left on the disk"):
        export(task, policy, Path("out"))
    assert not list(Path("out").iterdir())
