"""Imported before MuJoCo: on a Linux machine without a display it must be told how to render, if it can at all."""

import ctypes
import ctypes.util
import os
import sys

HEADLESS = sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
"""Whether no window can be opened."""


def off_screen_library() -> str | None:
    """The value of MUJOCO_GL that works here: 'egl', 'osmesa' or none.

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


if HEADLESS and "MUJOCO_GL" not in os.environ:
    found = off_screen_library()
    if found:
        os.environ["MUJOCO_GL"] = found
