"""A page in a real browser: it asks nothing of the network, and one cursor moves picture and plots."""

import base64
import io
import shutil
import time

import numpy as np
import pytest
from handmade import DT, made_by_hand
from helpers import HANG_S
from PIL import Image

from legged.episodes.page import write_page
from legged.episodes.ranking import figures_of

sync_api = pytest.importorskip("playwright.sync_api")
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="there is no Chromium here")
STEPS, EVERY = 120, 3


def grey(frame: int) -> int:
    """The brightness of a picture says which one it is."""
    return 20 + 5 * frame


def film_of_greys() -> dict:
    pictures = []
    for frame in range(-(-STEPS // EVERY)):
        written = io.BytesIO()
        Image.new("RGB", (64, 36), (grey(frame),) * 3).save(written, "JPEG", quality=90)
        pictures.append(base64.b64encode(written.getvalue()).decode())
    return {"every": EVERY, "width": 64, "height": 36, "pictures": pictures}


def stick_figure() -> dict:
    places = np.zeros((-(-STEPS // EVERY), 3, 3))
    places[:, 1, 2], places[:, 2, 0] = -0.3, 0.4
    return {"every": EVERY, "why": "cannot render <b>here</b>", "parents": [-1, 0, 0], "places": places.tolist()}


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture
def opened(browser, tmp_path):
    """A function that writes and opens a page; what it said and asked for is looked at in the end."""
    said, asked = [], []

    def run(film: dict, width: int = 1600):
        episodes = made_by_hand(5, STEPS)
        steps = np.arange(STEPS)
        episodes["base_lin_vel"][episodes.rows(1), 0] = steps
        episodes["feet_contact"][episodes.rows(1), 0] = (steps // 10) % 2
        episodes["reward_parts"][episodes.rows(1)] = [0.02, -0.01]
        write_page(tmp_path, episodes, figures_of(episodes), 1, film)
        page = browser.new_page(viewport={"width": width, "height": 900})
        page.set_default_timeout(1000.0 * HANG_S)
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto((tmp_path / "episode_001.html").as_uri())
        wait(page, "episode.state().picture === 0")
        return page

    yield run
    assert said == []
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []


def wait(page, condition: str, seconds: float = HANG_S) -> None:
    """Wait until something holds: the page's own rules forbid what playwright would wait with."""
    end = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(10)


def pixel(page) -> int:
    return page.evaluate("document.getElementById('picture').getContext('2d').getImageData(30, 20, 1, 1).data[0]")


def settled(page, frame: int) -> dict:
    """The state of the page once the picture of that number is drawn."""
    wait(page, f"episode.state().picture === {frame}")
    return page.evaluate("episode.state()")


@pytest.mark.slow
def test_hovering_over_a_plot_moves_the_picture_and_all_plots(opened):
    page = opened(film_of_greys())
    plot = page.locator(".plot").first.bounding_box()
    left, inner = 50, plot["width"] - 58  # the axis, and what is between it and the edge
    page.mouse.move(plot["x"] + left + inner * 75 / (STEPS - 1), plot["y"] + 40)
    state = settled(page, 25)
    assert state["row"] == 75
    assert set(state["cursors"]) == {75}
    assert len(state["cursors"]) >= 8
    assert state["clock"].startswith(f"{76 * DT:.2f} of")
    assert state["values"][0][1] == "75.0"  # the velocity that was written there
    assert abs(pixel(page) - grey(25)) <= 2


@pytest.mark.slow
def test_keys_step_and_the_slider_drags(opened):
    page = opened(film_of_greys())
    for key, row in (("ArrowRight", 1), ("Shift+ArrowRight", 11), ("ArrowLeft", 10), ("End", STEPS - 1), ("Home", 0)):
        page.keyboard.press(key)
        assert page.evaluate("episode.state().row") == row
    page.evaluate("slider.value = 60; slider.dispatchEvent(new Event('input'))")
    assert set(settled(page, 20)["cursors"]) == {60}
    assert abs(pixel(page) - grey(20)) <= 2


@pytest.mark.slow
def test_playing_moves_the_cursor_until_the_end(opened):
    page = opened(film_of_greys())
    page.select_option("#speed", "2")
    page.click("#play")
    wait(page, "episode.state().row > 20")
    state = page.evaluate("episode.state()")
    assert state["playing"]
    assert set(state["cursors"]) == {state["row"]}
    wait(page, "!episode.state().playing")
    assert settled(page, (STEPS - 1) // EVERY)["row"] == STEPS - 1
    assert abs(pixel(page) - grey((STEPS - 1) // EVERY)) <= 2


@pytest.mark.slow
def test_plots_show_a_part_of_the_time_that_follows_the_cursor(opened):
    page = opened(film_of_greys())
    page.select_option("#span", "1")
    page.evaluate("episode.show(70)")
    first, last = page.evaluate("episode.state().shown")
    assert last - first == round(1.0 / DT)
    assert first <= 70 <= last
    assert set(page.evaluate("episode.state().cursors")) == {70}
    page.evaluate(f"episode.show({STEPS - 1})")
    assert page.evaluate("episode.state().shown")[1] == STEPS - 1


@pytest.mark.slow
@pytest.mark.parametrize("width", [1600, 420])
def test_a_page_fits_the_screen(opened, width):
    page = opened(film_of_greys(), width)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.locator("details").first.click()
    wait(page, "episode.state().cursors.length > 8")


@pytest.mark.slow
def test_a_stick_figure_stands_in_for_the_film(opened):
    page = opened(stick_figure())
    assert "cannot render <b>here</b>" in page.locator("#facts").inner_text()
    page.evaluate("episode.show(30)")
    assert settled(page, 10)["row"] == 30
    blue = page.evaluate(
        "[...document.getElementById('picture').getContext('2d').getImageData(0, 0, 640, 360).data]"
        ".filter((v, i, all) => i % 4 === 0 && v === 0 && all[i + 1] === 0x72 && all[i + 2] === 0xb2).length"
    )
    assert blue > 100
