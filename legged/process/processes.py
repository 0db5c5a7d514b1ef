"""Processes that this one starts."""

import os
from pathlib import Path

from legged.process.startup import STAGES_FILE

INSTALLED = ("site-packages", "dist-packages")
"""What the folders are called in which packages are installed."""


def child_environment() -> dict[str, str]:
    """Return the environment in which another Python finds this package where this one did, and in which its start is not
    taken for this one's.
    """
    environment = {name: value for name, value in os.environ.items() if name != STAGES_FILE}
    top = Path(__file__).resolve().parents[2]
    if top.name not in INSTALLED:
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(top), os.environ.get("PYTHONPATH"))))
    return environment
