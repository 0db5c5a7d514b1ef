"""The parser that every command has: its help keeps the paragraphs of the description and ends with examples."""

import argparse
import re
import shlex
import textwrap
from typing import Any

LEAST_EXAMPLES = 2
NEGATIVE_NUMBER = re.compile(r"-(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$", re.IGNORECASE)
"""What is a value though it begins like a flag. Before Python 3.14 argparse knew no -1e-1."""


class CommandParser(argparse.ArgumentParser):
    """A parser of a command line whose help shows how the command is called."""

    def __init__(self, prog: str, description: str | None, *examples: str, **options: Any) -> None:
        """Take the command's name, what it does, and whole command lines as somebody would type them.

        Raises:
            ValueError: fewer than two examples.
        """
        if len(examples) < LEAST_EXAMPLES:
            raise ValueError(f"{prog}: the help of a command shows at least {LEAST_EXAMPLES} examples, got {len(examples)}")
        self.examples = examples
        """Command lines, each of which this parser can read."""
        shown = "\n".join(["examples:", *(f"  {example}" for example in examples)])
        super().__init__(prog=prog, description=description, epilog=shown, formatter_class=Paragraphs, **options)
        self._negative_number_matcher = NEGATIVE_NUMBER

    @staticmethod
    def arguments_of(example: str) -> list[str]:
        """Return an example's words without the program it calls (`python x.py`, `python -m module` or an installed command)
        and without what the shell does with its output.
        """
        words = shlex.split(example)
        end = next((i for i, word in enumerate(words) if word in (">", "|")), len(words))
        return words[1 if words[0] != "python" else 3 if words[1] == "-m" else 2 : end]


class Once(argparse.Action):
    """A flag that may be given once: a second one would silently take the place of the first."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: Any = None
    ) -> None:
        """Keep the value, or end the program."""
        before = getattr(namespace, self.dest)
        if before is not None:
            parser.error(f"{option}: is given twice, {before} and {values}; let one of them import the other")
        setattr(namespace, self.dest, values)


def add_import_argument(parser: argparse.ArgumentParser) -> None:
    """Add the flag that names tasks of a user's own, which all commands spell alike; `args.module` has it."""
    parser.add_argument("--import", dest="module", action=Once, help="module, or .py or YAML file, with tasks of your own")


class Paragraphs(argparse.HelpFormatter):
    """A layout of help that fills each paragraph by itself, and leaves those with indented lines as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        filled = []
        for paragraph in textwrap.dedent(text).strip().split("\n\n"):
            kept = any(line.startswith("  ") for line in paragraph.splitlines())
            filled.append(textwrap.indent(paragraph, indent) if kept else super()._fill_text(paragraph, width, indent))
        return "\n\n".join(filled)
