"""Completion of our commands in a shell: `python -m legged.tools.completion bash > ~/.legged-completion`.

Prints a script for bash or zsh, which completes tasks, flags, dotted keys of the configuration (`train.runner.<TAB>`) and
their values, after `python train.py`, `python play.py`, `python -m legged.tools.<name>`, `python -m legged.deploy`,
`legged-train` and `legged-play`. Source it from the shell's start-up file; write it anew when the package has been updated.
"""

import sys
from importlib import import_module

from legged.commandline.command import run_main
from legged.commandline.completion import SHELLS, keys_of, script, words_of
from legged.commandline.listing import module_of, robots, tools
from legged.commandline.parser import CommandParser
from legged.registry import CLASSES


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return what reads the command line."""
    parser = CommandParser(
        "completion",
        __doc__,
        "python -m legged.tools.completion bash > ~/.legged-completion",
        "python -m legged.tools.completion zsh > ~/.legged-completion",
    )
    parser.add_argument("shell", choices=SHELLS, help="the shell that reads the script")
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_args(argv)
    keys = keys_of(getattr(import_module(module), name) for name, module in CLASSES.items())
    keys |= {"robot": tuple(robots())}
    commands = {name: words_of(import_module(module_of(name)).build_parser(), keys) for name in tools()}
    print(script(args.shell, commands, keys), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
