"""Plain English: patterns of sentences that have to be read twice do not come back."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CODE = sorted([*(ROOT / "legged").rglob("*.py"), *(ROOT / "docs" / "make").glob("*.py")])
HEADERS = sorted(path for ending in ("h", "hpp") for path in (ROOT / "legged").rglob(f"*.{ending}"))
YAML = sorted([*(ROOT / "cfg").rglob("*.yaml"), *(ROOT / "resources" / "robots").glob("*/robot.yaml")])
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "make").glob("*.md")])
BEGINS = re.compile(r"(What|Who|Whose|Whether|Of|By|In what|How) [a-z]")
"""A docstring or a comment that begins so names its subject by a relative clause."""
ANYWHERE = re.compile(
    r"\b(is none|are none|is no number|to the bit|(?:have|has) (?:their|its) turn|is drawn again|so is NaN not|by now|"
    r"of (?:a|the) user's own|(?:somebody|nobody)|[Ww]ho (?:is|has|was|are|asks|wants|have) )"
)
"""Idioms that name no thing, or not by its name."""


def docstrings(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of all docstrings, those of attributes too."""
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            value = getattr(statement, "value", None)
            if isinstance(statement, ast.Expr) and isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield statement.lineno, value.value


def comments(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of all comments."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("#: ")


def prose(path: Path) -> list[tuple[int, str, bool]]:
    """Return line, text, and whether a sentence begins there, of all that a file says to its readers."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        before = -1
        found = [(line, said, True) for line, said in docstrings(text)]
        for line, said in comments(text):
            found.append((line, said, line != before + 1))
            before = line
        return found
    if path.suffix == ".md":
        text = re.sub(r"^```.*?^```$", lambda block: "\n" * block[0].count("\n"), text, flags=re.DOTALL | re.MULTILINE)
        return [(number, line, False) for number, line in enumerate(text.splitlines(), 1)]
    mark = "//" if path.suffix in (".h", ".hpp") else "#"
    lines = enumerate(text.splitlines(), 1)
    return [(number, line.partition(mark)[2].strip(), False) for number, line in lines if mark in line]


@pytest.mark.slow
@pytest.mark.parametrize("path", [*CODE, *HEADERS, *YAML, *PAGES], ids=lambda path: path.relative_to(ROOT).as_posix())
def test_sentences_name_their_subject(path):
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text.strip()[:100]}"
        for line, text, begins in prose(path)
        if ANYWHERE.search(text) or (begins and BEGINS.match(text.strip()))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('"""What a robot does."""\n', 1),
        ("x = 1\n# so is NaN not\n", 2),
        ('class A:\n    x = 1\n    """Whether it walks."""\n', 3),
    ],
)
def test_the_patterns_are_found(text, line, tmp_path):
    path = tmp_path / "x.py"
    path.write_text(text)
    ((number, said, begins),) = prose(path)
    assert number == line
    assert ANYWHERE.search(said) or (begins and BEGINS.match(said))
