"""The errors that end a command with one line instead of a traceback, and the hint at the nearest valid name."""

import difflib
from collections.abc import Iterable

LONGEST = 2000
"""Letters of an error's text; what users give may be longer."""


def one_line(text: str) -> str:
    """Write a text on one line that ends: line breaks and the like, in names that users give, are spelled out."""
    line = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"


class ConfigError(ValueError):
    """A wrong input by the user; its text says where, what was given and what is allowed. A command ends with code 2."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


class RunError(RuntimeError):
    """A command could not go on for a reason that lies outside its input: a full disk, a closed output, numbers that went on
    being non-finite. It ends with code 1.
    """

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


class TermError(RuntimeError):
    """A `_reward_*` or `_obs_*` method failed; the text names it."""


def suggest(name: str, allowed: Iterable[str], what: str = "allowed") -> str:
    """' did you mean ...?' with the nearest of `allowed`, followed by all of them."""
    options = sorted(allowed)
    near = difflib.get_close_matches(name, options, n=1, cutoff=0.5)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"{hint} ({what}: {', '.join(options) or 'none'})"
