"""How MuJoCo is told to render: a display may be missing, gone or deaf, and MUJOCO_GL may say nonsense."""

import os
import socket
import subprocess
import sys
import threading

import pytest

from legged.errors import ConfigError
from legged.process import headless

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


def test_a_library_that_is_not_there_is_named(monkeypatch):
    def fail(_name):
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")

    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr(headless, "import_module", fail)
    monkeypatch.setattr(headless, "off_screen_library", lambda: "egl")
    with pytest.raises(ConfigError, match=r"MUJOCO_GL: 'osmesa' does not work on this machine \('NoneType.*; egl would"):
        headless.choose()


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


def test_a_display_that_refuses_opens_no_window_and_pictures_are_drawn_all_the_same(displays):
    """The server hangs up on whoever connects, as one without permission does."""
    if headless.off_screen_library() is None:
        pytest.skip("nothing draws off screen here")
    number = 50_000 + os.getpid() % 10_000
    code = (
        "import legged, mujoco\n"
        "from legged.rendering import make_renderer, window_opens\n"
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
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.split("\n")[:2] == ["False False", "(48, 64, 3)"], done.stderr
