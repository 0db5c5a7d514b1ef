"""Pages as HTML and as Markdown: nothing in a text is taken for more than a text."""

import re
from html.parser import HTMLParser

import pytest
from PIL import Image

from legged.evaluation.reports.document import (
    Figures,
    Heading,
    Link,
    Listing,
    Mono,
    Number,
    Paragraph,
    Picture,
    Table,
    to_html,
    to_markdown,
)

EVIL = "<b onload=x>|*_`#[a](b)&\"'"


class Texts(HTMLParser):
    """Collects tags and texts."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags, self.texts = [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.texts.append(data)


def test_a_text_of_somebody_is_a_text_on_the_page():
    parts = [
        Heading(EVIL),
        Paragraph(EVIL.replace("`", "")),
        Table([EVIL], [[EVIL], [Mono(EVIL)], [Link(EVIL, EVIL)]]),
        Listing(EVIL, EVIL, "x"),
    ]
    page = Texts(to_html(EVIL, parts))
    assert "b" not in {tag for tag, _ in page.tags}
    assert "".join(page.texts).count(EVIL) == 9  # title, h1, h2, head, three cells, summary and lines of the listing


def test_a_page_loads_nothing():
    page = to_html("x", [Paragraph("y")])
    (policy,) = [attrs["content"] for tag, attrs in Texts(page).tags if attrs.get("http-equiv")]
    assert policy.startswith("default-src 'none'")
    assert not re.search(r"(?:src|href)=\"(?!data:)", page)


def test_numbers_are_sorted_by_what_they_are():
    page = to_html("x", [Table(["n"], [[Number("1,024", 1024.0)], [Number("-", None)]], wide=True)])
    cells = [attrs["data-sort"] for tag, attrs in Texts(page).tags if tag == "td"]
    assert cells == ["1024.0", ""]
    assert [tag for tag, _ in Texts(page).tags if tag in ("input", "button")] == ["input", "button"]


def test_a_table_of_facts_has_no_head():
    assert "<thead" not in to_html("x", [Table(["", ""], [["a", "b"]])])


def test_code_in_a_sentence():
    parts = [Paragraph("call `a_b --c` or `")]
    assert "call <code>a_b --c</code> or `" in to_html("x", parts)
    assert to_markdown("x", parts, "p").endswith("call `a_b --c` or \\`\n")


def test_markdown_keeps_its_tables_whole():
    table = Table(["a|b", "n"], [["x|y\nz", Number("3", 3.0)], [Mono("p|q"), Number("4", 4.0)]])
    lines = to_markdown("t", [table], "p").splitlines()[2:]
    assert lines == ["| a\\|b | n |", "| --- | ---: |", "| x\\|y z | 3 |", "| `p\\|q` | 4 |"]


def test_long_texts_of_a_wide_table_have_room():
    rows = [["go2_flat", "cheap torques", Number("1 000", 1000.0)], ["a1", "wide " * 20, Number("2", 2.0)]]
    plain, wide = (to_markdown("t", [Table(["task", "note", "n"], rows, wide=one)], "p").splitlines()[2] for one in (0, 1))
    assert plain == "| task | note | n |"
    assert wide == f"| task | note{'&nbsp;' * 56} | n |"


def test_pictures_are_inside_the_page_and_beside_the_markdown(tmp_path):
    film = tmp_path / "film.gif"
    Image.new("P", (4, 4)).save(film)
    parts = [Picture(film, "a film"), Figures("curves", ["<svg></svg>"], "all curves")]
    assert '<img class="film" src="data:image/gif;base64,R0lGOD' in to_html("x", parts)
    assert "<figure><svg></svg></figure>" in to_html("x", parts)
    assert to_markdown("x", parts, "report").splitlines()[2:] == [
        "![a film](film.gif)",
        "",
        "![all curves](report_curves.svg)",
    ]


@pytest.mark.parametrize("badge", ["finished", "crashed"])
def test_a_badge_stands_before_the_sentence(badge):
    assert f'<span class="badge {badge}">{badge}</span> after all' in to_html("x", [Paragraph("after all", badge)])
    assert to_markdown("x", [Paragraph("after all", badge)], "p").endswith(f"**{badge}**: after all\n")
