"""Environment of child processes."""

import os
from pathlib import Path

from legged.process.startup import STAGES_FILE

INSTALLED = ("site-packages", "dist-packages")
"""Names of folders with installed packages."""


def child_environment() -> dict[str, str]:
    """Return an environment in which a child Python finds this package where this process did. The child's start-up stages
    are not reported as this one's.
    """
    environment = {name: value for name, value in os.environ.items() if name != STAGES_FILE}
    top = Path(__file__).resolve().parents[2]
    if top.name not in INSTALLED:
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(top), os.environ.get("PYTHONPATH"))))
    return environment
