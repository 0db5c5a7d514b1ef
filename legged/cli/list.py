"""`legged list`: tasks and robots of this installation."""

import argparse
from itertools import takewhile
from pathlib import Path

from legged.cli.main import print_rows
from legged.commandline.command import sub_command
from legged.deploy.command_parser import argument
from legged.process.paths import data_folder


@sub_command(
    "legged list",
    "legged list robots",
    arguments=[
        argument("what", nargs="?", choices=("tasks", "robots"), help="one of the two lists; both by default"),
    ],
)
def list_(args: argparse.Namespace) -> int:
    """List tasks and robots of this installation: `legged list`.

    The descriptions come from the comments at the head of the YAML files of tasks and robots.
    """
    if args.what != "robots":
        print_rows("tasks, each for `legged train TASK`", tasks())
    if args.what != "tasks":
        print_rows("robots, each for `robot: NAME` in a task's file", robots())
    return 0


def tasks() -> dict[str, str]:
    """Return task -> the first sentence of the comment at the head of its file."""
    return {path.stem: _comment(path).partition(". ")[0].rstrip(".") for path in sorted(data_folder("cfg").glob("*.yaml"))}


def robots() -> dict[str, str]:
    """Return robot -> the name of its model, from the comment at the head of its robot.yaml; empty without a comment."""
    files = sorted((data_folder("resources") / "robots").glob("*/robot.yaml"))
    return {path.parent.name: _comment(path).partition(": ")[0].partition(". ")[0] for path in files}


def _comment(path: Path) -> str:
    lines = takewhile(lambda line: line.startswith("#"), path.read_text(encoding="utf-8").splitlines())
    return " ".join(line.lstrip("# ") for line in lines)
