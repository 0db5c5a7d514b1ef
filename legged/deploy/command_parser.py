"""Argument parser of every command, with paragraphs and examples in its help and a suggestion for a wrong option."""

import argparse
import math
import re
import textwrap
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

from legged.deploy.errors import ConfigError, suggest

Argument = Callable[[argparse.ArgumentParser], object]
"""A function that adds an argument to a parser."""

NEGATIVE_NUMBER = re.compile(r"-(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$", re.IGNORECASE)
"""Pattern of negative numbers, which look like options. Before Python 3.14 argparse takes -1e-1 for an option."""


class CommandParser(argparse.ArgumentParser):
    """Parser of one command's arguments. Its help ends with examples."""

    def __init__(self, prog: str, description: str | None, *examples: str, arguments: Iterable[Argument] = ()) -> None:
        """Build the parser. `prog` is the words that call the command; `examples` are two or more complete command lines."""
        self.examples = examples
        """Command lines that this parser can parse."""
        shown = "\n".join(["examples:", *(f"  {example}" for example in examples)])
        super().__init__(prog=prog, description=description, epilog=shown, formatter_class=Paragraphs, allow_abbrev=False)
        self._negative_number_matcher = NEGATIVE_NUMBER
        for add in arguments:
            add(self)

    def error(self, message: str) -> NoReturn:
        """End the program with exit code 2. For an unknown option, suggest the nearest one."""
        unknown = re.search(r"unrecognized arguments: (?:.* )?(--[\w-]+)", message)
        if unknown:
            message += suggest(unknown[1], [name for name in self._option_string_actions if name.startswith("--")], "options")
        super().error(message)


def argument(*names: str, **options: Any) -> Argument:
    """Return an argument. Names and options are those of argparse's `add_argument`."""
    return lambda parser: parser.add_argument(*names, **options)


def check_number(flag: str, value: float | None, least: float, most: float = math.inf, above: bool = False) -> None:
    """Check that a number of the command line, if it is given, is from `least` to `most`. `above` excludes `least` itself.

    Raises:
        ConfigError: the number is outside this range.
    """
    if value is None or (least < value <= most) or (value == least and not above):
        return
    limit = f"at most {most:,}" if value > most else f"above {least:,}" if above else f"at least {least:,}"
    raise ConfigError(f"{flag}: must be {limit}, got {value:,}")


def check_between(flag: str, value: float | None, least: float, most: float, unit: str = "") -> None:
    """Check that a number of the command line, if it is given, is from `least` to `most`, both in `unit`.

    Raises:
        ConfigError: the number is outside this range.
    """
    if value is not None and not least <= value <= most:
        raise ConfigError(f"{flag}: must be between {least:g} and {most:g}{unit and ' '}{unit}, got {value:g}")


class Paragraphs(argparse.HelpFormatter):
    """Help formatter that fills each paragraph separately, and keeps paragraphs with indented lines unchanged."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        filled = []
        for paragraph in textwrap.dedent(text).strip().split("\n\n"):
            kept = any(line.startswith("  ") for line in paragraph.splitlines())
            filled.append(textwrap.indent(paragraph, indent) if kept else super()._fill_text(paragraph, width, indent))
        return "\n\n".join(filled)
