"""Argument parser of every command, with paragraphs and examples in its help and a suggestion for a wrong option."""

import argparse
import math
import re
import sys
import textwrap
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

from legged.errors import ConfigError, suggest

Argument = Callable[[argparse.ArgumentParser], object]
"""A function that adds an argument to a parser."""

NEGATIVE_NUMBER = re.compile(r"-(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$", re.IGNORECASE)
"""Pattern of negative numbers, which look like options. Before Python 3.14 argparse takes -1e-1 for an option."""
OF_LEGGED_GYM = re.compile(r"--(num_envs|load_run|experiment_name|run_name|max_iterations|sim_device|rl_device)(?==|$)")
"""Pattern of options that exist in legged_gym too. They may be written with underscores, as in legged_gym."""


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

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Parse as argparse does, after replacing underscores in legged_gym's options by hyphens."""
        words = sys.argv[1:] if args is None else args
        hyphened = [OF_LEGGED_GYM.sub(lambda option: option[0].replace("_", "-"), word) for word in words]
        return super().parse_known_args(hyphened, namespace)

    def error(self, message: str) -> NoReturn:
        """End the program with exit code 2. For an unknown option, suggest the nearest one."""
        unknown = re.search(r"unrecognized arguments: (?:.* )?(--[\w-]+)", message)
        if unknown:
            message += suggest(unknown[1], [name for name in self._option_string_actions if name.startswith("--")], "options")
        super().error(message)


class Once(argparse.Action):
    """Option that may be given once. If it were given twice, argparse would silently use the last value."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: Any = None
    ) -> None:
        """Store the value, or end the program if the option was given before."""
        before = getattr(namespace, self.dest)
        if before is not None:
            parser.error(f"{option}: is given twice, {before} and {values}; write {option} {before},{values}")
        setattr(namespace, self.dest, values)


def argument(*names: str, **options: Any) -> Argument:
    """Return an argument. Names and options are those of argparse's `add_argument`."""
    return lambda parser: parser.add_argument(*names, **options)


IMPORT = argument(
    "--import", dest="module", action=Once, help="module, .py or YAML file with user-defined tasks; join several by commas"
)
"""The option `--import`, for files and modules with user-defined tasks. `args.module` holds its value."""


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
