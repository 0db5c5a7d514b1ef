"""Imported before MuJoCo: on a Linux machine without a display it must be told how to render, if it can at all."""

import ctypes
import ctypes.util
import os
import re
import socket
import sys
from importlib import import_module

from legged.errors import ConfigError, suggest
from legged.process.startup import command_of_ours

ANSWER_S = 0.5
"""A display that does not answer for so long is taken for gone [s]."""
OFF = ("disable", "disabled", "off", "false", "0")
ALLOWED = ("egl", "osmesa", "glfw", "glx") if sys.platform == "linux" else ("cgl", "glfw", "wgl")
"""Values of MUJOCO_GL; `OFF` and words for on are allowed too."""
ON = ("", "enable", "enabled", "on", "true", "1")


def display_answers() -> bool:
    """Return whether there is a display on this machine that takes connections; DISPLAY may name one that has gone."""
    if sys.platform != "linux":
        return True
    wayland = os.environ.get("WAYLAND_DISPLAY")
    if wayland:
        folder = os.environ.get("XDG_RUNTIME_DIR", "")
        if _connects(socket.AF_UNIX, os.path.join(folder, wayland)):
            return True
    return _x_answers(os.environ.get("DISPLAY", ""))


def _x_answers(name: str) -> bool:
    """Return whether an X server listens at a display's name, 'host:number.screen'; no host or 'unix' is this machine."""
    if name.startswith("/"):  # a socket by its path, as on macOS
        return _connects(socket.AF_UNIX, name) or _connects(socket.AF_UNIX, name.rpartition(".")[0])
    match = re.fullmatch(r"(?:[a-z]+/)?(.*):(\d+)(?:\.\d+)?", name)
    if match is None:
        return False
    host, number = match[1], int(match[2])
    if host in ("", "unix"):
        path = f"/tmp/.X11-unix/X{number}"
        return _connects(socket.AF_UNIX, "\0" + path) or _connects(socket.AF_UNIX, path)
    return number < 2**16 - 6000 and _connects(socket.AF_INET, (host.strip("[]"), 6000 + number))


def _connects(family: socket.AddressFamily, address: str | tuple[str, int]) -> bool:
    """Return whether something takes a connection there."""
    try:
        if isinstance(address, tuple):
            socket.create_connection(address, timeout=ANSWER_S).close()
            return True
        with socket.socket(family, socket.SOCK_STREAM) as end:
            end.settimeout(ANSWER_S)
            end.connect(address)
    except (OSError, ValueError):
        return False
    return True


def off_screen_library() -> str | None:
    """Return the value of MUJOCO_GL that works here: 'egl', 'osmesa' or none.

    MuJoCo fails at import if it names a library that is missing, so a machine that only trains must not set it.
    """
    for name, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        path = ctypes.util.find_library(library)
        if path is None:
            continue
        try:
            ctypes.CDLL(path)
        except OSError:
            continue
        return name
    return None


def choose() -> None:
    """Set MUJOCO_GL where there is no display, if the user has not; check it, if he has.

    Raises:
        ConfigError: MuJoCo could not be imported under the value that MUJOCO_GL has.
    """
    given = os.environ.get("MUJOCO_GL")
    if given is None:
        found = off_screen_library() if HEADLESS else None
        if found:
            os.environ["MUJOCO_GL"] = found
        return
    value = given.lower().strip()
    if value not in (*ALLOWED, *ON, *OFF):
        raise ConfigError(f"MUJOCO_GL: unknown value '{given}'{suggest(value, (*ALLOWED, 'off'))}")
    try:
        import_module("mujoco.rendering.classic.gl_context")
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        return  # a robot's computer, which draws nothing
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        works = off_screen_library()
        instead = f"{works} would" if works else "none of them is here; leave it out, and play with --no-video"
        raise ConfigError(f"MUJOCO_GL: '{given}' does not work on this machine ({error}); {instead}") from error


HEADLESS = not display_answers()
"""Whether no window can be opened."""

try:
    choose()
except ConfigError as mistake:
    if not command_of_ours():
        raise
    print(f"error: {mistake}", file=sys.stderr)
    sys.exit(2)
