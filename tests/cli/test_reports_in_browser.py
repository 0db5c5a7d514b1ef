"""Reports in a real browser: nothing fails or is loaded, nothing is wider than a telephone, and tables sort and filter."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers import HANG_S, POLICY, TASK, kept_global_state, tiny_run

from legged.cli.runs import compare
from legged.cli.runs import runs as table
from legged.evaluation.reports.run_report import write_report

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser: pip install playwright")
BROWSER = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
pytestmark = [pytest.mark.slow, pytest.mark.skipif(BROWSER is None, reason="there is no Chromium here")]

WIDE, NARROW = 1600, 420
"""Widths of windows [pixels]."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> Iterator[Path]:
    """Two runs with reports, one of them with an evaluation, their table and their comparison."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("browser"))
    with kept_global_state():
        short = ["env.episode_length_s=0.1", "--note", "a <b>sentence</b> about it, which is as long as such a thing may get"]
        runs = [tiny_run(*short, f"train.runner.run_name={name}", iterations=2) for name in ("first", "second")]
        for path in POLICY.glob("evaluation_*.json"):
            shutil.copy(path, runs[0])
        shutil.copy(POLICY / "play.gif", runs[0] / "film.gif")
        for run in runs:
            write_report(run)
        assert table.main([]) == 0
        assert compare.main([*map(str, runs)]) == 0
        yield Path("logs").resolve()
    os.chdir(before)


@pytest.fixture(scope="module")
def browser() -> Iterator:
    with sync_api.sync_playwright() as playwright:
        window = playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield window
        window.close()


@pytest.fixture
def open_page(browser, logs):
    """Open a page below logs/ at a width; give it, and a list of what it complained of or asked for."""
    pages = []

    def opened(name: str, width: int):
        (path,) = logs.glob(name)
        page = browser.new_page(viewport={"width": width, "height": 900})
        page.set_default_timeout(1000.0 * HANG_S)
        pages.append(page)
        heard: list[str] = []

        def asked(url: str) -> None:
            if url != path.as_uri() and not url.startswith("data:"):
                heard.append(url)

        page.on("console", lambda message: heard.append(message.text))
        page.on("pageerror", lambda error: heard.append(str(error)))
        page.on("request", lambda request: asked(request.url))
        page.goto(path.as_uri())
        return page, heard

    yield opened
    for page in pages:
        page.close()


PAGES = (f"{TASK}/*_first/report.html", "experiments.html", "comparison.html")


@pytest.mark.slow
@pytest.mark.parametrize("name", PAGES)
@pytest.mark.parametrize("width", [WIDE, NARROW])
def test_a_page_is_whole_on_any_screen(name, width, open_page):
    page, heard = open_page(name, width)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.locator("h1").inner_text()
    assert page.locator("main b").count() == 0  # somebody's note
    assert heard == []


def test_drawings_stand_side_by_side_where_there_is_room(open_page):
    def columns(width: int) -> int:
        page, _ = open_page(PAGES[0], width)
        return len({round(box["x"]) for box in (figure.bounding_box() for figure in page.locator("figure").all())})

    assert columns(WIDE) == 3
    assert columns(NARROW) == 1


def test_a_pointer_on_a_curve_shows_its_values(open_page):
    page, heard = open_page(PAGES[0], WIDE)
    drawing = page.locator('svg[aria-label="velocity error [m/s]"]')
    drawing.scroll_into_view_if_needed()
    box = drawing.bounding_box()
    page.mouse.move(box["x"] + 0.96 * box["width"], box["y"] + 0.5 * box["height"])
    value = drawing.locator("polyline").get_attribute("data-v").split()[-1]
    tip = page.locator("#tip")
    assert tip.is_visible()
    assert tip.inner_text() == f"iteration 2\nvelocity error [m/s] {value}"
    page.mouse.move(2, 2)
    assert not tip.is_visible()
    assert heard == []


def test_a_click_on_a_head_sorts_and_another_turns_it_round(open_page):
    page, heard = open_page("experiments.html", WIDE)
    heads = page.locator("table.wide thead th").all_inner_texts()

    def column(name: str) -> list[str]:
        return page.locator(f"table.wide tbody tr td:nth-child({heads.index(name) + 1})").all_inner_texts()

    assert all("-" in (first, second) for first, second in [column("RMSE [m/s]")])  # one was evaluated
    for _ in range(2):
        page.get_by_role("button", name="RMSE [m/s]").click()
        assert column("RMSE [m/s]")[1] == "-"  # what has no number is last, whichever way
    speeds = [float(text.replace(",", "")) for text in column("loop [s]")]
    page.get_by_role("button", name="loop [s]").click()
    assert [float(text) for text in column("loop [s]")] == sorted(speeds, reverse=True)
    page.get_by_role("button", name="loop [s]").click()
    assert [float(text) for text in column("loop [s]")] == sorted(speeds)
    assert page.locator("th[aria-sort=ascending]").inner_text().startswith("loop [s]")
    page.get_by_role("button", name="began").click()
    assert column("began") == sorted(column("began"))
    assert heard == []


def test_words_filter_the_rows(open_page):
    page, heard = open_page("experiments.html", NARROW)
    rows, search = page.locator("table.wide tbody tr:visible"), page.get_by_label("filter the rows")
    assert rows.count() == 2
    search.fill("SENTENCE finished")
    assert rows.count() == 2
    search.fill("sentence nowhere")
    assert rows.count() == 0
    assert page.locator(".count").inner_text() == "0 of 2"
    search.fill("")
    assert page.locator(".count").inner_text() == "2 of 2"
    assert heard == []
