"""The page of a live view: its server, its controls, and what a browser makes of it. Needs the extra `watch`."""

import contextlib
import http.client
import io
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers import ENGINE, HANG_S, POLICY, POLICY_ITERATION, TASK, until, wait_for
from PIL import Image

from legged.learning.run_folder import run_config
from legged.play.live.page import HOST, Page, free_port, load_viser, refusing_other_sites, url
from legged.play.live.session import Session, Watched, changes_for, check_ground
from legged.registry import task_config
from legged.rendering.ghost import GHOST

pytest.importorskip("viser", reason="the extra `watch` is not installed")

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""WebGL without a GPU."""


def page_of(task: str, robots: int = 1) -> Page:
    """A page of a shipped policy."""
    folder = POLICY.parent / task
    cfg = run_config(folder)
    session = Session(Watched(cfg, folder), changes_for(cfg, robots, ENGINE), check_ground(cfg, None, None))
    return Page(session, HOST, free_port(HOST, 0))


@contextlib.contextmanager
def running(page: Page) -> Iterator[Page]:
    """Simulate in a thread; what goes wrong there fails the test."""
    ended, failures = threading.Event(), []

    def run() -> None:
        try:
            page.run(ended.is_set)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield page
    finally:
        ended.set()
        thread.join(timeout=HANG_S)
        page.close()
    assert not failures, failures[0]
    assert not thread.is_alive()


def labels(page: Page) -> list[str]:
    """What the controls of a page are called."""
    handles = page.server.gui._gui_input_handle_from_uuid.values()
    return [handle.label for handle in handles]


@pytest.mark.parametrize("served", [HOST, "0.0.0.0"])
def test_the_server_refuses_other_websites(served):
    with contextlib.redirect_stdout(io.StringIO()), refusing_other_sites(served):
        server = load_viser().ViserServer(host=served, port=free_port(served, 0), verbose=False)
    try:
        own = f"{HOST}:{server.get_port()}"
        upgrade = {
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec-WebSocket-Key": "a" * 22 + "==",
            "Sec-WebSocket-Version": "13",
        }
        for headers, status in [
            ({"Host": own}, 200),
            ({"Host": "evil.example"}, 403),
            ({"Host": own, "Origin": f"http://{own}", **upgrade}, 101),
            ({"Host": own, "Origin": "http://evil.example", **upgrade}, 403),
            ({"Host": "evil.example", "Origin": "http://evil.example", **upgrade}, 403),
        ]:
            connection = http.client.HTTPConnection(own, timeout=HANG_S)
            connection.request("GET", "/", headers=headers)
            assert connection.getresponse().status == status, headers
            connection.close()
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


@pytest.mark.slow
def test_controls_that_make_no_sense_are_not_there():
    quadruped, cheetah = page_of(TASK, 2), page_of("half_cheetah", 2)
    try:
        assert {"vx [m/s]", "vy [m/s]", "yaw rate [rad/s]", "type", "difficulty", "push", "robot"} <= set(labels(quadruped))
        assert set(labels(cheetah)) & {"vx [m/s]", "stand still", "type", "push"} == set()
        assert {"speed", "follow a robot", "robot"} <= set(labels(cheetah))
        assert [slider.max for _, slider in quadruped.sliders] == [1.1, 1.1, 1.3]
    finally:
        quadruped.close()
        cheetah.close()


@pytest.mark.slow
def test_while_nobody_looks_nothing_is_simulated():
    page = page_of(TASK)
    with running(page):
        cpu, wall = time.process_time(), time.monotonic()
        time.sleep(1.0)
        assert page.session.time == 0.0
        assert time.process_time() - cpu < 0.5 * (time.monotonic() - wall)


@pytest.mark.slow
def test_another_ground_is_drawn():
    page = page_of(TASK)
    try:
        nodes = page.drawing._handles
        page.session.go_to("stairs_up", 0.5)
        page.drawing.draw()
        assert not set(map(id, page.drawing._handles)) & set(map(id, nodes))
        middle = -np.array(page.drawing._world.position)
        assert middle == pytest.approx(page.session.task.base_pos[0].tolist(), abs=0.01)
        page.session.step()
        page.drawing.draw()
        base = page.drawing._nodes[0][0]
        assert base.position == pytest.approx(page.session.task.base_pos[0].tolist(), abs=1e-4)
        page.drawing.follows = False
        page.session.task.base_pos[0, 0] += 1.0
        page.drawing.draw()
        assert -np.array(page.drawing._world.position) == pytest.approx(middle, abs=0.05)
    finally:
        page.close()


def test_the_followed_tracker_has_its_reference_beside_it(tmp_path):
    cfg = task_config("g1_tracking", on_cpu=True)
    session = Session(Watched(cfg, tmp_path), changes_for(cfg, 2, ENGINE), check_ground(cfg, None, None))
    page = Page(session, HOST, free_port(HOST, 0))
    try:
        session.step()
        for robot in (0, 1):
            session.select(robot)
            page.drawing.draw()
            ghost, now = page.drawing._nodes[-1], session.task.motion.now
            assert len(ghost) == len(page.drawing._nodes[robot])
            assert {node.opacity for node in ghost} == {GHOST[3]}
            base = now.root_pos[robot].numpy() + page.drawing._offsets[robot]
            assert ghost[0].position == pytest.approx(base.tolist(), abs=1e-4)
            assert np.abs(ghost[0].wxyz @ now.root_quat[robot].numpy()) == pytest.approx(1.0)
    finally:
        page.close()


def test_nobody_can_ask_for_a_public_address():
    page = page_of("half_cheetah")
    try:
        assert page.server.request_share_url() is None
        assert page.server._share_tunnel is None
    finally:
        page.close()


def pixels(picture: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))


@pytest.mark.slow
def test_a_browser_draws_the_robot_and_moves_it():
    """Opens the page in headless Chromium, waits until something is drawn, and moves the first slider to its end."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip("there is no Chromium")
    with running(page_of(TASK)) as shown, api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        window = browser.new_page(viewport={"width": 900, "height": 420})
        window.set_default_timeout(1000.0 * HANG_S)
        wrong: list[str] = []
        window.on("pageerror", lambda error: wrong.append(str(error)))
        window.goto(url(HOST, shown.port))
        window.wait_for_selector(f"text=iteration {POLICY_ITERATION + 1}")
        slider = window.locator("[role=slider]").first
        slider.focus()
        window.keyboard.press("End")
        until(lambda: shown.session.command == [1.1, 0.0, 0.0])
        until(lambda: float(shown.session.task.commands[0, 0]) == pytest.approx(1.1))
        assert window.locator("text=reward terms [1/s]").count() == 1
        slider.blur()
        window.keyboard.press("p")  # a picture that stands still is drawn sooner
        until(lambda: not shown.session.running)

        def drawn() -> bool:
            middle = {"x": 330, "y": 100, "width": 180, "height": 220}  # between the panels
            return float(pixels(window.screenshot(clip=middle)).std(axis=(0, 1)).max()) > 8.0

        until(drawn)
        before = shown.session.time
        window.keyboard.press("n")
        until(lambda: shown.session.time == pytest.approx(before + 0.02))
        browser.close()
        until(lambda: not shown.server.get_clients())
    assert not wrong


@pytest.mark.slow
def test_ctrl_c_ends_it_as_it_ends_other_tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    command = [sys.executable, "-m", "legged", "watch", TASK, "--num-envs", "1", "--port", "0"]
    with Path("out.txt").open("w") as out, Path("err.txt").open("w") as err:
        process = subprocess.Popen(command, stdout=out, stderr=err)
        try:
            wait_for(lambda: "watch it at http://127.0.0.1:" in Path("out.txt").read_text(), process)
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=HANG_S) == 130
        finally:
            process.kill()
    assert Path("err.txt").read_text() == "interrupted\n"
    assert len(Path("out.txt").read_text().splitlines()) == 2
