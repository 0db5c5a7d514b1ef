"""Choice of the library with which MuJoCo draws on a Linux machine without a display. This module is imported before MuJoCo,
which reads MUJOCO_GL at import.
"""

import ctypes
import ctypes.util
import os
import re
import socket
import sys
from contextlib import suppress
from importlib import import_module

from legged.errors import ConfigError, suggest
from legged.process.startup import command_of_ours

NO_PICTURES = ""
"""Reason why this process cannot draw, if the library that MUJOCO_GL names does not work; else empty."""
ANSWER_S = 0.5
"""Time after which a display that does not answer counts as missing [s]."""
OFF = ("disable", "disabled", "off", "false", "0")
ALLOWED = ("egl", "osmesa", "glfw", "glx") if sys.platform == "linux" else ("cgl", "glfw", "wgl")
"""Values of MUJOCO_GL; `OFF` and `ON` are allowed too."""
CONTEXT = "mujoco.rendering.classic.gl_context"
"""MuJoCo's module that imports the library for drawing."""
ON = ("", "enable", "enabled", "on", "true", "1")


def display_answers() -> bool:
    """Return True if a display accepts connections. DISPLAY may name a display that no longer exists."""
    if sys.platform != "linux":
        return True
    wayland = os.environ.get("WAYLAND_DISPLAY")
    if wayland and _connects(os.path.join(os.environ.get("XDG_RUNTIME_DIR", ""), wayland)):
        return True
    # DISPLAY has the form host:number.screen. An empty host and 'unix' mean this machine.
    match = re.fullmatch(r"(?:[a-z]+/)?(.*):(\d+)(?:\.\d+)?", os.environ.get("DISPLAY", ""))
    if match is None:
        return False
    host, number = match[1], int(match[2])
    if host in ("", "unix"):
        path = f"/tmp/.X11-unix/X{number}"
        return _connects("\0" + path) or _connects(path)
    return number < 2**16 - 6000 and _connects((host.strip("[]"), 6000 + number))


def _connects(address: str | tuple[str, int]) -> bool:
    """Return True if a server accepts a connection at a socket's path, or at host and port."""
    try:
        if isinstance(address, tuple):
            socket.create_connection(address, timeout=ANSWER_S).close()
            return True
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as end:
            end.settimeout(ANSWER_S)
            end.connect(address)
    except (OSError, ValueError):
        return False
    return True


def off_screen_library() -> str | None:
    """Return the value of MUJOCO_GL that works on this machine: 'egl' or 'osmesa'; None if neither does.

    MuJoCo fails at import if MUJOCO_GL names a missing library. So the variable must stay unset if neither library works.
    """
    for name, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        path = ctypes.util.find_library(library)
        with suppress(OSError):
            if path is not None and ctypes.CDLL(path):
                return name
    return None


def choose() -> None:
    """Set MUJOCO_GL on a machine without a display. If the user has set the variable, check its value instead. If the library
    that it names does not work, switch off pictures and print a warning. Then MuJoCo can still be imported for commands that
    draw nothing.

    Raises:
        ConfigError: MuJoCo does not know the value of MUJOCO_GL.
    """
    global NO_PICTURES
    given = os.environ.get("MUJOCO_GL")
    if given is None:
        if HEADLESS and (found := off_screen_library()):
            os.environ["MUJOCO_GL"] = found
        return
    value = given.lower().strip()
    if value not in (*ALLOWED, *ON, *OFF):
        raise ConfigError(f"MUJOCO_GL: unknown value '{given}'{suggest(value, (*ALLOWED, 'off'))}")
    try:
        context = import_module(CONTEXT)
        if value not in OFF and context.GLContext.__module__ == CONTEXT:
            context.GLContext()  # for a missing library, MuJoCo has a placeholder that raises an error
    except Exception as error:  # each library fails in its own way
        if isinstance(error, ModuleNotFoundError) and error.name == "mujoco":
            return  # nothing is drawn without MuJoCo, e.g. on a robot's computer
        works = off_screen_library()
        instead = f"{works} may work" if works and works != value else "no other library for drawing was found"
        why = " ".join(str(error).split())
        NO_PICTURES = f"MUJOCO_GL: '{given}' does not work on this machine ({why}); {instead}"
        os.environ["MUJOCO_GL"] = OFF[0]
        print(f"warning: {NO_PICTURES}; going on without pictures", file=sys.stderr, flush=True)


HEADLESS = not display_answers()
"""True if no window can be opened."""

try:
    choose()
except ConfigError as mistake:
    if not command_of_ours():
        raise
    print(f"error: {mistake}", file=sys.stderr)
    sys.exit(2)
