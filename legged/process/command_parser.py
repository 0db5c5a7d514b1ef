"""The argument parser of every command: paragraphs and examples in its help, and the nearest option for a wrong one."""

import argparse
import re
import shlex
import sys
import textwrap
from typing import Any, NoReturn

from legged.errors import suggest

LEAST_EXAMPLES = 2
NEGATIVE_NUMBER = re.compile(r"-(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$", re.IGNORECASE)
"""A value that begins like an option. Before Python 3.14 argparse does not know -1e-1."""
OF_LEGGED_GYM = re.compile(r"--(num_envs|load_run|experiment_name|run_name|max_iterations|sim_device|rl_device)(?==|$)")
"""legged_gym's own options, which are also read with their underscores."""


class CommandParser(argparse.ArgumentParser):
    """A parser of one command's arguments, whose help ends with examples."""

    def __init__(self, prog: str, description: str | None, *examples: str, **options: Any) -> None:
        """Take the words that call the command, its description, and whole command lines as a user types them.

        Raises:
            ValueError: fewer than two examples.
        """
        if len(examples) < LEAST_EXAMPLES:
            raise ValueError(f"{prog}: the help of a command shows at least {LEAST_EXAMPLES} examples, got {len(examples)}")
        self.examples = examples
        """Command lines, each of which this parser can read."""
        shown = "\n".join(["examples:", *(f"  {example}" for example in examples)])
        super().__init__(
            prog=prog, description=description, epilog=shown, formatter_class=Paragraphs, allow_abbrev=False, **options
        )
        self._negative_number_matcher = NEGATIVE_NUMBER

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Parse as argparse does, with hyphens in place of the underscores of legged_gym's options."""
        words = sys.argv[1:] if args is None else args
        hyphened = [OF_LEGGED_GYM.sub(lambda option: option[0].replace("_", "-"), word) for word in words]
        return super().parse_known_args(hyphened, namespace)

    def error(self, message: str) -> NoReturn:
        """End the program with exit code 2, and with the nearest option if an unknown one was given."""
        unknown = re.search(r"unrecognized arguments: (?:.* )?(--[\w-]+)", message)
        if unknown:
            message += suggest(unknown[1], [name for name in self._option_string_actions if name.startswith("--")], "options")
        super().error(message)

    def arguments_of(self, example: str) -> list[str]:
        """Return an example's words without those that call the command and without what the shell does with its output."""
        words = shlex.split(example)
        end = next((i for i, word in enumerate(words) if word in (">", "|")), len(words))
        return words[len(self.prog.split()) : end]


class Once(argparse.Action):
    """An option that may be given once: a second one would silently take the place of the first."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: Any = None
    ) -> None:
        """Keep the value, or end the program."""
        before = getattr(namespace, self.dest)
        if before is not None:
            parser.error(f"{option}: is given twice, {before} and {values}; let one of them import the other")
        setattr(namespace, self.dest, values)


def add_import_argument(parser: argparse.ArgumentParser) -> None:
    """Add --import, which names user-defined tasks; `args.module` holds it."""
    parser.add_argument("--import", dest="module", action=Once, help="module, .py or YAML file with user-defined tasks; several with commas")


class Paragraphs(argparse.HelpFormatter):
    """A layout of help that fills each paragraph by itself and keeps paragraphs with indented lines as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        filled = []
        for paragraph in textwrap.dedent(text).strip().split("\n\n"):
            kept = any(line.startswith("  ") for line in paragraph.splitlines())
            filled.append(textwrap.indent(paragraph, indent) if kept else super()._fill_text(paragraph, width, indent))
        return "\n\n".join(filled)
