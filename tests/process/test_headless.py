"""How MuJoCo is told to render: a display may be missing, gone or deaf, and MUJOCO_GL may say nonsense."""

import os
import re
import socket
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import mujoco
import pytest
from helpers import POLICY

import legged
from legged.errors import ConfigError, RunError
from legged.process import headless
from legged.rendering.camera import make_renderer

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="displays of Linux")


@pytest.fixture
def displays(monkeypatch):
    """No display in the environment but those that a test sets."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "XDG_RUNTIME_DIR"):
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


@pytest.mark.parametrize("name", ["", ":98765", "nonsense", ":", "localhost:59999", "no.such.host.invalid:0", ":99999999"])
def test_a_display_that_nobody_serves_does_not_answer(name, displays):
    displays.setenv("DISPLAY", name)
    assert not headless.display_answers()


@pytest.mark.parametrize("screen", ["", ".0"])
def test_a_display_that_takes_connections_answers(screen, displays):
    number = 40_000 + os.getpid() % 10_000
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(f"\0/tmp/.X11-unix/X{number}")
        server.listen()
        displays.setenv("DISPLAY", f":{number}{screen}")
        assert headless.display_answers()
        displays.setenv("DISPLAY", f"unix:{number}{screen}")
        assert headless.display_answers()
    assert not headless.display_answers()


def test_a_wayland_display_answers(displays, tmp_path):
    displays.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    displays.setenv("WAYLAND_DISPLAY", "wayland-7")
    assert not headless.display_answers()
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "wayland-7"))
        server.listen()
        assert headless.display_answers()


def test_a_value_that_mujoco_would_refuse_is_named(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "egll")
    with pytest.raises(ConfigError, match=r"MUJOCO_GL: unknown value 'egll'; did you mean 'egl'\? \(allowed: egl, glfw"):
        headless.choose()


@pytest.fixture
def broken(monkeypatch):
    """broken(message): from now on no library for drawing can be imported; what it says is put back afterwards."""
    monkeypatch.setattr(headless, "NO_PICTURES", "")
    monkeypatch.setattr(headless, "off_screen_library", lambda: "egl")

    def fail(message):
        def import_module(_name):
            raise AttributeError(message)

        monkeypatch.setattr(headless, "import_module", import_module)

    return fail


def test_a_library_that_is_not_there_is_named_and_pictures_are_off(monkeypatch, broken, capsys):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    broken("'NoneType' object\nhas no attribute 'glGetError'")
    headless.choose()
    err = capsys.readouterr().err
    assert re.fullmatch(r"warning: MUJOCO_GL: 'osmesa' does .*'glGetError'\); egl may work; .* without pictures\n", err)
    assert os.environ["MUJOCO_GL"] == "disable"  # MuJoCo can be imported, here and in what this process starts
    with pytest.raises(RunError, match="cannot render here: MUJOCO_GL: 'osmesa' does not work"):
        make_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 64, 48)


def test_the_library_that_was_asked_for_is_not_what_may_work(monkeypatch, broken, capsys):
    monkeypatch.setenv("MUJOCO_GL", "EGL")
    broken("no device")
    headless.choose()
    assert "(no device); no other library for drawing was found" in capsys.readouterr().err


def test_mujocos_placeholder_for_a_library_says_what_is_missing(monkeypatch, capsys):
    class Missing:
        def __init__(self):
            raise ImportError("no PyOpenGL")

    Missing.__module__ = headless.CONTEXT
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(headless, "NO_PICTURES", "")
    monkeypatch.setattr(headless, "import_module", lambda _name: SimpleNamespace(GLContext=Missing))
    headless.choose()
    assert "(no PyOpenGL)" in capsys.readouterr().err


def test_a_robots_computer_without_mujoco_is_told_nothing(monkeypatch, capsys):
    def import_module(_name):
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(headless, "NO_PICTURES", "")
    monkeypatch.setattr(headless, "import_module", import_module)
    headless.choose()
    assert (capsys.readouterr().err, os.environ["MUJOCO_GL"]) == ("", "egl")


WITHOUT_OPENGL = """
import sys
sys.modules["OpenGL"] = None
sys.argv = {argv!r}
from legged.cli.{command} import {command}
sys.exit({command}.main())
"""
TOP = Path(legged.__file__).parents[1]


def ends(command, *arguments, folder, value):
    """The end of a command on a machine on which PyOpenGL can't be imported."""
    code = WITHOUT_OPENGL.format(command=command, argv=[str(TOP / f"{command}.py"), "--task", "anymal_c_flat", *arguments])
    environment = {**os.environ, "MUJOCO_GL": value}
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=folder, check=False
    )


@pytest.mark.slow
@pytest.mark.parametrize("value", ["egl", "osmesa"])
def test_a_training_needs_no_library_for_drawing(value, tmp_path):
    done = ends("train", "--show", folder=tmp_path, value=value)
    assert done.returncode == 0, done.stderr
    assert "task: anymal_c_flat" in done.stdout
    assert done.stderr.startswith(f"warning: MUJOCO_GL: '{value}' does not work on this machine (")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_playing_measures_and_exports_and_then_says_why_nothing_is_drawn(tmp_path):
    flags = ["--load_run", str(POLICY), "--sim_device", "cpu", "--num_envs", "1", "--headless", "--out", "out"]
    flags += ["sim.threads=1", "sim.physics=mujoco"]
    done = ends("play", *flags, folder=tmp_path, value="egl")
    assert "following commands" in done.stdout
    assert (tmp_path / "out/exported/policy.onnx").is_file()
    first, last = done.stderr.splitlines()
    assert first.startswith("warning: MUJOCO_GL: 'egl' does not work")
    assert last.startswith("error: cannot render here: MUJOCO_GL: 'egl' does not work")
    assert done.returncode == 1


def test_a_command_ends_with_one_line_and_an_import_with_an_exception():
    environment = {**os.environ, "MUJOCO_GL": "foo"}
    command = [sys.executable, "-m", "legged", "runs", "curves", "run"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert done.stderr.startswith("error: MUJOCO_GL: unknown value 'foo'")
    done = subprocess.run(
        [sys.executable, "-c", "import legged"], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "ConfigError: MUJOCO_GL" in done.stderr


@pytest.mark.slow
def test_a_display_that_refuses_opens_no_window_and_pictures_are_drawn_all_the_same(displays):
    """The server hangs up on whoever connects, as one without permission does."""
    if headless.off_screen_library() is None:
        pytest.skip("nothing draws off screen here")
    number = 50_000 + os.getpid() % 10_000
    code = (
        "import legged, mujoco\n"
        "from legged.rendering.camera import make_renderer, window_opens\n"
        "print(legged.HEADLESS, window_opens())\n"
        "model = mujoco.MjModel.from_xml_string('<mujoco/>')\n"
        "renderer = make_renderer(model, 64, 48)\n"
        "renderer.update_scene(mujoco.MjData(model))\n"
        "print(renderer.render().shape)\n"
    )
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(f"\0/tmp/.X11-unix/X{number}")
        server.listen()

        def hang_up():
            while True:
                try:
                    server.accept()[0].close()
                except OSError:
                    return

        threading.Thread(target=hang_up, daemon=True).start()
        environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
        environment["DISPLAY"] = f":{number}"
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split("\n")[:2] == ["False False", "(48, 64, 3)"], done.stderr
