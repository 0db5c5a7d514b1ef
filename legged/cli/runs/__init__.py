"""The sub-commands of `legged runs`, and the arguments that they share."""

import argparse
from pathlib import Path

from legged.learning.run_folder import own_run
from legged.process.command_parser import CommandParser, add_import_argument
from legged.registry import import_tasks


def runs_parser(command: str, description: str | None, *examples: str) -> CommandParser:
    """Return a parser with the runs and --import."""
    parser = CommandParser(f"legged runs {command}", description, *examples)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="runs or their folders, or tasks, whose newest runs count")
    add_import_argument(parser)
    return parser


def folders_of(args: argparse.Namespace) -> list[Path]:
    """Return the folders of the runs on a command line, after the import of its user-defined tasks.

    Raises:
        ConfigError: there is no such run or module.
    """
    if args.module:
        import_tasks(args.module)
    return [own_run(name, "RUN") for name in args.runs]
