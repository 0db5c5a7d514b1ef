"""`python -m legged` lists tasks, robots and commands."""

import sys
from collections.abc import Mapping

from legged.commandline.listing import robots, tasks, tools
from legged.commandline.output import forgiving_output
from legged.errors import ConfigError

FAILED, WRONG_INPUT = 1, 2
"""Exit codes, as `run_main` has them."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code. It is no command of `run_main`, which would import torch."""
    with forgiving_output() as output:
        try:
            _list(sys.argv[1:] if argv is None else argv)
        except ConfigError as error:
            print(f"error: {error}", file=sys.stderr)
            return WRONG_INPUT
        output.flush()
        if output.lost is not None:
            print(f"error: {output.lost}", file=sys.stderr)
    return 0 if output.lost is None else FAILED


def _list(given: list[str]) -> None:
    if given and given not in (["--help"], ["-h"]):
        wanted = [name for name in tools() if name.rpartition(".")[2] == given[0]]
        raise ConfigError(
            f"python -m legged: takes no arguments, got '{given[0]}'"
            + (f"; did you mean python -m {wanted[0]}?" if wanted else "; without any it lists tasks, robots and commands")
        )
    _print("tasks, each for `python train.py --task NAME`", tasks())
    _print("robots, each for `robot:` in a task's file", robots())
    _print("commands, each with --help", {f"python -m {name}": summary for name, summary in tools().items()})


def _print(title: str, rows: Mapping[str, str]) -> None:
    """Print a title, and names with what they are."""
    width = max(map(len, rows), default=0)
    print(f"{title}:")
    for name, summary in rows.items():
        print(f"  {name:{width}}  {summary}".rstrip())


if __name__ == "__main__":
    sys.exit(main())
