"""Pages that consist of parts. A page is a self-contained HTML file, and a Markdown file with pictures in separate files."""

import base64
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from legged.evaluation.reports import render
from legged.evaluation.reports.charts import sheet
from legged.process.paths import write_text
from legged.tables import markdown_table

SHORT = 32
"""A cell with at most this many letters is kept on one line."""
KINDS = {".gif": "image/gif", ".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp", ".mp4": "video/mp4"}


class Mono(str):
    """A text that is a name in the code; it is set in monospaced letters."""

    __slots__ = ()


class Link(NamedTuple):
    """A text that is a link to another file."""

    text: str
    href: str


class Number(NamedTuple):
    """A number: the text that is shown, and the value by which rows are sorted."""

    text: str
    value: float | None


Cell = str | Mono | Link | Number


class Heading(NamedTuple):
    """The title of the parts that follow."""

    text: str


class Paragraph(NamedTuple):
    """Sentences with code between backticks, and optionally a short `badge` before them."""

    text: str
    badge: str = ""


class Table(NamedTuple):
    """Rows under a head. In HTML a `wide` table can be sorted by its columns and filtered by words."""

    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    wide: bool = False

    @property
    def numeric(self) -> list[bool]:
        """A flag for each column: True if it has rows and all its cells are numbers."""
        return [bool(self.rows) and all(isinstance(row[i], Number) for row in self.rows) for i in range(len(self.head))]


class Figures(NamedTuple):
    """Drawings (SVG), side by side where there is room. For Markdown they are one file, whose name ends in _<name>.svg."""

    name: str
    drawings: Sequence[str]
    alt: str


class Picture(NamedTuple):
    """A picture or film in a file."""

    path: Path
    alt: str

    @property
    def mime(self) -> str:
        """Media type of the file, by its ending."""
        return KINDS[self.path.suffix.lower()]

    @property
    def data(self) -> str:
        """The file's contents as a data URL."""
        return f"data:{self.mime};base64,{base64.b64encode(self.path.read_bytes()).decode('ascii')}"


class Listing(NamedTuple):
    """Lines of a program or a diff. HTML shows them after a click; Markdown has a link to `file` instead."""

    title: str
    text: str
    file: str


Part = Heading | Paragraph | Table | Figures | Picture | Listing


def number(value: float | None, form: str = ".3f") -> Number:
    """Return a number as a cell. None and values that are not finite become a dash, which is sorted last."""
    return Number("-", None) if value is None or not math.isfinite(value) else Number(f"{value:{form}}", value)


def between(interval: tuple[float, float], factor: float = 1.0, form: str = ".1f") -> str:
    """Return an interval as text: '1.0 to 2.0'."""
    return f"{factor * interval[0]:{form}} to {factor * interval[1]:{form}}"


def write_pages(stem: Path, title: str, parts: Sequence[Part]) -> Path:
    """Write a page as <stem>.html and <stem>.md, and its drawings as <stem>_<name>.svg; return the path of the HTML file.

    Raises:
        RunError: a file can't be written.
    """
    page = stem.with_name(f"{stem.name}.html")
    write_text(page, to_html(title, parts))
    for part in parts:
        if isinstance(part, Figures):
            write_text(stem.with_name(f"{stem.name}_{part.name}.svg"), sheet(part.drawings))
    write_text(stem.with_name(f"{stem.name}.md"), to_markdown(title, parts, stem.name))
    return page


# ---- HTML ------------------------------------------------------------------------------------------------------------


def to_html(title: str, parts: Sequence[Part]) -> str:
    """Return a whole HTML page, which contains its pictures."""
    kinds = {"kind_of": lambda one: type(one).__name__, "pieces": _pieces, "SHORT": SHORT}
    return render("document.html", title=title, parts=parts, **kinds)


def _pieces(text: str) -> list[str]:
    """Split a text at its backticks; every second piece is code."""
    return re.split(r"(`[^`]+`)", text)


# ---- Markdown --------------------------------------------------------------------------------------------------------


def to_markdown(title: str, parts: Sequence[Part], pictures: str) -> str:
    """Return the page as Markdown, with figures in files <pictures>_<name>.svg."""
    return "\n\n".join([f"# {_plain(title)}", *(_markdown(part, pictures) for part in parts)]) + "\n"


def _markdown(part: Part, pictures: str) -> str:
    match part:
        case Heading(text):
            return f"## {_plain(text)}"
        case Paragraph(text, badge):
            pieces = _pieces(" ".join(text.split()))
            return f"**{_plain(badge)}**: " * bool(badge) + "".join(
                piece if i % 2 else _escaped(piece) for i, piece in enumerate(pieces)
            )
        case Table(head, rows, wide):
            heads = [
                _plain(text) + (_room(text, [row[i] for row in rows]) if wide and not part.numeric[i] else "")
                for i, text in enumerate(head)
            ]
            left = [i for i, numeric in enumerate(part.numeric) if not numeric]
            return markdown_table(heads, [[_markdown_cell(cell) for cell in row] for row in rows], left)
        case Figures(name, _, alt):
            return f"![{_plain(alt)}]({pictures}_{name}.svg)"
        case Picture(path, alt):
            return f"{'!' if part.mime.startswith('image') else ''}[{_plain(alt)}]({path.name})"
        case Listing(title, _, file):
            return f"{_plain(title)}: see [{_plain(file)}]({file})"


def text_of(cell: Cell) -> str:
    """Return the text of a cell."""
    return cell.text if isinstance(cell, Link | Number) else cell


def _room(head: str, cells: Sequence[Cell]) -> str:
    """Return non-breaking spaces that widen the head of a column of texts. If a table is wider than the page, viewers of
    Markdown break texts after every word, but keep a column as wide as its head. Two spaces are as wide as a letter.
    """
    longest = max((len(text) for text in map(text_of, cells) if " " in text), default=0)
    return "&nbsp;" * (2 * (min(longest, SHORT) - len(head)))


def _markdown_cell(cell: Cell) -> str:
    if isinstance(cell, Mono):
        fence = "``" if "`" in cell else "`"
        return f"{fence}{cell}{fence}" if cell.strip() else ""
    text = _plain(text_of(cell))
    return f"[{text}]({cell.href})" if isinstance(cell, Link) else text


def _plain(text: str) -> str:
    """Return a text on one line, escaped for Markdown. In tables vertical bars are escaped too, by `markdown_table`."""
    return _escaped(" ".join(text.split()))


def _escaped(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>#])", r"\\\1", text)
