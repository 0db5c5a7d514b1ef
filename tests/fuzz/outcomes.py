"""What a case may end with: success, or one line."""

from collections.abc import Iterator
from contextlib import contextmanager

from legged.errors import ConfigError


@contextmanager
def refused_in_a_line(*words: str) -> Iterator[None]:
    """A context whose block may raise ConfigError, if that is one line that holds the words."""
    try:
        yield
    except ConfigError as error:
        text = str(error).strip()
        problems = [word for word in words if word not in text]
        problems += ["it is empty"] if not text else []
        problems += ["it is more than a line"] if "\n" in text else []
        problems += [f"it has {len(text)} characters"] if len(text) > 4000 else []
        if problems:
            raise AssertionError(f"{problems}: {text[:1000]}") from error
