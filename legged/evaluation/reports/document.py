"""A page in parts, written as one HTML file that needs nothing else, or as Markdown with pictures beside it."""

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from legged.evaluation.reports.page_parts import POLICY, SCRIPT, STYLE


class Mono(str):
    """A text that is a name in the code: it is set in a typewriter's letters."""

    __slots__ = ()


@dataclass(frozen=True)
class Link:
    """A text that leads to another file."""

    text: str
    href: str


@dataclass(frozen=True)
class Number:
    """A number as it is shown, and what it is sorted by."""

    text: str
    value: float | None


SHORT = 32
"""Letters of a cell that stay on one line."""

Cell = str | Mono | Link | Number


@dataclass(frozen=True)
class Heading:
    """The title of what follows."""

    text: str


@dataclass(frozen=True)
class Paragraph:
    """Sentences, in which code stands between backticks; a short `badge` may stand before them."""

    text: str
    badge: str = ""


@dataclass(frozen=True)
class Table:
    """Rows under a head. Where `wide` says so it can be sorted by a column and filtered by a text."""

    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    wide: bool = False


@dataclass(frozen=True)
class Figures:
    """Drawings (SVG), side by side where there is room; in Markdown one file of that `name`."""

    name: str
    drawings: Sequence[str]
    alt: str


@dataclass(frozen=True)
class Picture:
    """A picture or film in a file."""

    path: Path
    alt: str


@dataclass(frozen=True)
class Listing:
    """Lines of a program or a difference, closed in a page until somebody opens it; Markdown names their `file`."""

    title: str
    text: str
    file: str


Part = Heading | Paragraph | Table | Figures | Picture | Listing
KINDS = {".gif": "image/gif", ".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp", ".mp4": "video/mp4"}


# ---- HTML ------------------------------------------------------------------------------------------------------------


def to_html(title: str, parts: Sequence[Part]) -> str:
    """Return a whole page. It holds its pictures, style and script, and its policy lets it load nothing else."""
    body = "\n".join(_html(part) for part in parts)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{escape(title)}</title>\n'
        f"<style>{STYLE}</style>\n</head>\n<body>\n<main>\n<h1>{escape(title)}</h1>\n{body}\n</main>\n"
        f"<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


def _html(part: Part) -> str:
    match part:
        case Heading(text):
            return f"<h2>{escape(text)}</h2>"
        case Paragraph(text, badge):
            mark = f'<span class="badge {escape(badge.split()[0])}">{escape(badge)}</span> ' if badge else ""
            return f"<p>{mark}{_html_text(text)}</p>"
        case Table():
            return _html_table(part)
        case Figures(_, drawings, _):
            return '<div class="figures">' + "".join(f"<figure>{svg}</figure>" for svg in drawings) + "</div>"
        case Picture(path, alt):
            kind = KINDS[path.suffix.lower()]
            data = f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
            if kind.startswith("video"):
                return f'<video class="film" controls muted loop src="{data}" aria-label="{escape(alt)}"></video>'
            return f'<img class="film" src="{data}" alt="{escape(alt)}">'
        case Listing(title, text, _):
            return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"


def _html_text(text: str) -> str:
    """Return sentences with their code set as such; a backtick that closes nothing is one."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))


def _html_table(table: Table) -> str:
    numeric = [all(isinstance(row[i], Number) for row in table.rows) for i in range(len(table.head))]
    marks = [' class="n"' if one else "" for one in numeric]
    texts = [f'<button type="button">{escape(text)}</button>' if table.wide else escape(text) for text in table.head]
    head = "".join(f"<th{mark}>{text}</th>" for mark, text in zip(marks, texts, strict=True))
    head = f"<thead><tr>{head}</tr></thead>\n" if any(table.head) else ""
    rows = "\n".join("<tr>" + "".join(map(_html_cell, row)) + "</tr>" for row in table.rows)
    found = f"<table{' class=wide' if table.wide else ''}>\n{head}<tbody>\n{rows}\n</tbody>\n</table>"
    search = '<p><input type="search" placeholder="filter" aria-label="filter the rows"> <span class="count"></span></p>\n'
    return f'{search if table.wide else ""}<div class="scroll">{found}</div>'


def _html_cell(cell: Cell) -> str:
    match cell:
        case Number(text, value):
            return f'<td class="n" data-sort="{"" if value is None else repr(float(value))}">{escape(text)}</td>'
        case Link(text, href):
            return f'<td class="short"><a href="{escape(href)}">{escape(text)}</a></td>'
        case Mono():
            return f'<td class="{_width(cell)}"><code>{escape(cell)}</code></td>'
    return f'<td class="{_width(cell)}">{escape(cell)}</td>'


def _width(text: str) -> str:
    """Return how a cell may be laid out: a short text stays on its line, a long one has room to be read."""
    return "short" if len(text) <= SHORT else "long"


# ---- Markdown --------------------------------------------------------------------------------------------------------


def to_markdown(title: str, parts: Sequence[Part], pictures: str) -> str:
    """Return the page as Markdown. Figures are files called `pictures`_<name>.svg, beside it."""
    return "\n\n".join([f"# {_plain(title)}", *(_markdown(part, pictures) for part in parts)]) + "\n"


def _markdown(part: Part, pictures: str) -> str:
    match part:
        case Heading(text):
            return f"## {_plain(text)}"
        case Paragraph(text, badge):
            return f"**{_plain(badge)}**: {_markdown_text(text)}" if badge else _markdown_text(text)
        case Table(head, rows, wide):
            numeric = [bool(rows) and all(isinstance(row[i], Number) for row in rows) for i in range(len(head))]
            heads = [_plain(text) for text in head]
            if wide:
                heads = [
                    text if one else text + _room(text, [row[i] for row in rows])
                    for i, (text, one) in enumerate(zip(heads, numeric, strict=True))
                ]
            lines = [heads, ["---:" if one else "---" for one in numeric]]
            lines += [[_markdown_cell(cell) for cell in row] for row in rows]
            return "\n".join(f"| {' | '.join(line)} |" for line in lines)
        case Figures(name, _, alt):
            return f"![{_plain(alt)}]({pictures}_{name}.svg)"
        case Picture(path, alt):
            return f"{'!' if KINDS[path.suffix.lower()].startswith('image') else ''}[{_plain(alt)}]({path.name})"
        case Listing(title, _, file):
            return f"{_plain(title)}: see [{_plain(file)}]({file})"


def _room(head: str, cells: Sequence[Cell]) -> str:
    """Return spaces that do not break, which keep a column of texts wide enough to be read: viewers of Markdown squeeze the
    texts of a table that is wider than the page to a word a line, but not below the width of their head. Two spaces are as
    wide as a letter.
    """
    texts = [cell.text if isinstance(cell, Link | Number) else cell for cell in cells]
    longest = max((len(text) for text in texts if " " in text), default=0)
    return "&nbsp;" * (2 * (min(longest, SHORT) - len(head)))


def _markdown_cell(cell: Cell) -> str:
    match cell:
        case Number(text, _):
            return _plain(text)
        case Link(text, href):
            return f"[{_plain(text)}]({href})"
        case Mono():
            words = " ".join(cell.replace("|", "\\|").split())
            fence = "``" if "`" in words else "`"
            return f"{fence}{words}{fence}" if words else ""
    return _plain(cell)


def _markdown_text(text: str) -> str:
    """Return sentences in which nothing but their code means anything to Markdown."""
    pieces = re.split(r"(`[^`]+`)", " ".join(text.split()))
    return "".join(piece if i % 2 else _escaped(piece) for i, piece in enumerate(pieces))


def _plain(text: str) -> str:
    """Return a text on one line in which no letter means anything to Markdown."""
    return _escaped(" ".join(text.split()))


def _escaped(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>|#])", r"\\\1", text)
