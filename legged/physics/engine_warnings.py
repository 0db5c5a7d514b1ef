"""MuJoCo's warnings: each kind once on standard error, and none in a file in the working directory."""

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import mujoco


def teller() -> Callable[[str], None]:
    """Make a handler of warnings that tells each kind of them once."""
    told: set[str] = set()

    def tell(text: str) -> None:
        text = text.partition(" Time =")[0]
        kind = re.sub(r"\d+", "#", text)
        if kind not in told:
            told.add(kind)
            sys.stderr.write(f"warning: MuJoCo: {text}\n")  # at once: the engine warns from several threads

    return tell


@contextmanager
def told_once() -> Iterator[None]:
    """Tell each kind of warning once in the block, a command; what took warnings before does so again afterwards."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(teller())
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def keep_out_of_files() -> None:
    """Tell each kind of warning once from now on, where nobody else takes them: MuJoCo would write MUJOCO_LOG.TXT."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(teller())
