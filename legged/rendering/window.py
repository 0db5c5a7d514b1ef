"""Whether windows open here, and what draws where they don't."""

import functools
import os
import sys
import warnings
from importlib import import_module

from mujoco.rendering.classic import gl_context

from legged.process.headless import HEADLESS, off_screen_library


@functools.cache
def window_opens() -> bool:
    """Whether GLFW can open windows here: a display may take connections and refuse ours. MuJoCo's viewer would wait for ever
    for a window that does not open.
    """
    if HEADLESS:
        return False
    try:
        import glfw
    except ImportError:
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        opens = bool(glfw.init())
    if opens:
        glfw.terminate()  # the viewer wants to do that in a thread of its own
    return opens


def draw_without_window() -> None:
    """Let MuJoCo draw off screen where it would ask GLFW and no window opens; to be called before its first renderer:
    one that comes after a failure aborts.
    """
    library = off_screen_library()
    if sys.platform != "linux" or "MUJOCO_GL" in os.environ or library is None or window_opens():
        return
    os.environ["MUJOCO_GL"] = library
    gl_context.GLContext = import_module(f"mujoco.{library}").GLContext
