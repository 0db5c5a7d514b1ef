"""Errors that end a command with one line instead of a traceback, and the hint at the nearest valid name."""

import difflib
from collections.abc import Iterable

LONGEST = 2000
"""Largest length of an error's text, in characters. A longer text, such as one that quotes a long input, loses its middle."""


def one_line(text: str) -> str:
    """Return a text as one line of limited length. Line breaks and other unprintable characters are written as escapes."""
    line = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"


class ConfigError(ValueError):
    """Wrong input by the user. The text names the place, the given value and the allowed values. A command then ends with
    exit code 2.
    """

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


class RunError(RuntimeError):
    """Failure of a command for a reason outside its input: a full disk, a closed output, numbers that stay non-finite. The
    command ends with exit code 1.
    """

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


def suggest(name: str, allowed: Iterable[str], what: str = "allowed") -> str:
    """Return the end of an error message. It proposes the name in `allowed` that is most like `name`, if one is similar. Then
    it lists all allowed names in brackets, after the word `what`.
    """
    options = sorted(allowed)
    near = difflib.get_close_matches(name, options, n=1, cutoff=0.5)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"{hint} ({what}: {', '.join(options) or 'none'})"
