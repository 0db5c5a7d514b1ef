"""Commands without heavy imports: help and lists."""

import sys
from collections.abc import Callable, Mapping

from legged.commandline.output import forgiving_output
from legged.errors import ConfigError

FAILED, WRONG_INPUT = 1, 2
"""Exit codes, as in `legged.commandline.command`, which imports torch."""


def answer(say: Callable[[], None]) -> int:
    """Call `say`, which prints the answer; return the exit code."""
    with forgiving_output() as output:
        try:
            say()
        except ConfigError as error:
            print(f"error: {error}", file=sys.stderr)
            return WRONG_INPUT
        output.flush()
        if output.lost is not None:
            print(f"error: {output.lost}", file=sys.stderr)
    return 0 if output.lost is None else FAILED


def print_rows(title: str, rows: Mapping[str, str], width: int = 0) -> None:
    """Print a title and two columns, names and texts; the first column has at least `width` letters."""
    width = max([width, *map(len, rows)])
    print(f"{title}:")
    for name, summary in rows.items():
        print(f"  {name:{width}}  {summary}".rstrip())
