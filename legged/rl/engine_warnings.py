"""MuJoCo's warnings: each kind once on standard error, and none in a file in the working directory."""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def told_once() -> Iterator[None]:
    """Tell each kind of warning once, and keep MuJoCo from writing MUJOCO_LOG.TXT; what took warnings before does so again
    afterwards.
    """
    told: set[str] = set()

    def tell(text: str) -> None:
        text = text.partition(" Time =")[0]
        kind = re.sub(r"\d+", "#", text)
        if kind not in told:
            told.add(kind)
            sys.stderr.write(f"warning: MuJoCo: {text}\n")  # at once: the engine warns from several threads

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(tell)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
