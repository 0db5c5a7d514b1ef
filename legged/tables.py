"""Tables for Markdown and for the screen."""

from collections.abc import Collection, Sequence

from rich.markup import escape
from rich.table import Table


def markdown_table(heads: Sequence[object], rows: Sequence[Sequence[object]], left: Collection[int] = (0,)) -> str:
    """Return a Markdown table without a line break at its end. Columns in `left` are left-aligned, others right-aligned."""
    marks = ["---" if i in left else "---:" for i in range(len(heads))]
    lines = [[" ".join(str(cell).replace("|", "\\|").split()) for cell in line] for line in (heads, *rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in (lines[0], marks, *lines[1:]))


def screen_table(
    title: str, heads: Sequence[str], rows: Sequence[Sequence[str] | None], left: Collection[int] = (0,)
) -> Table:
    """Return a table for the screen. Columns in `left` are left-aligned, all others right-aligned. None in place of a row
    draws a line. A short row leaves its last cells empty.
    """
    table = Table(title=escape(title), title_justify="left")
    for i, head in enumerate(heads):
        table.add_column(escape(head), justify="left" if i in left else "right")
    for row in rows:
        if row is None:
            table.add_section()
        else:
            table.add_row(*map(escape, row))
    return table
