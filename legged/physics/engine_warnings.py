"""Handling of MuJoCo's warnings: each kind is printed once on standard error, and MUJOCO_LOG.TXT is not written."""

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import mujoco


def warning_printer() -> Callable[[str], None]:
    """Return a handler that prints each kind of warning once."""
    printed: set[str] = set()

    def print_warning(text: str) -> None:
        text = text.partition(" Time =")[0]
        kind = re.sub(r"\d+", "#", text)
        if kind not in printed:
            printed.add(kind)
            sys.stderr.write(f"warning: MuJoCo: {text}\n")  # one call of write, because the engine warns from several threads

    return print_warning


@contextmanager
def each_warning_once() -> Iterator[None]:
    """Print each kind of warning once within the block. Afterwards, restore the previous handler."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warning_printer())
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def keep_out_of_files() -> None:
    """If no handler is installed, install one that prints each kind of warning once. Without a handler, MuJoCo would write
    MUJOCO_LOG.TXT.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(warning_printer())
