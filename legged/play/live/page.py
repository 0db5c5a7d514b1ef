"""The web page: its address, and viser's server with its scene, plots and controls."""

import contextlib
import io
import ipaddress
import queue
import socket
import time
from collections.abc import Callable, Iterator
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from legged.errors import ConfigError
from legged.learning.run_folder import BEST
from legged.play.live.plots import AXES, UNITS, LivePlots
from legged.play.live.session import FASTEST, HARDEST_PUSH, NEWEST, SLOWEST, Session
from legged.play.viewer import STEP

HOST, PORT = "127.0.0.1", 8470
"""Default host, which is reached from this machine only, and the first port that is tried."""
TRIES = 50
"""Number of ports that are tried."""
INSTALL = "pip install 'legged[watch]'"
PICTURES_S, PLOTS_S, LOOK_S = 1.0 / 30.0, 0.25, 1.0
"""Time between two pictures, two updates of the plots, and two checks for a newer checkpoint [s]."""
IDLE_S = 0.1
"""Time between two checks for visitors while the page has no visitors; the simulation rests meanwhile [s]."""
SLOW = 0.9
"""Share of the chosen speed below which the page shows a warning."""
KEYS = (("I", 0, 1), ("K", 0, -1), ("U", 1, 1), ("O", 1, -1), ("J", 2, 1), ("L", 2, -1))
"""Keys that change the command: letter, axis and sign of the change. Viser's camera uses other letters and the arrow keys."""
DIRECTIONS = {"forwards": 0.0, "left": 90.0, "backwards": 180.0, "right": -90.0}
"""Name of a push's direction -> angle from the robot's heading, positive to the left [degrees]."""


def free_port(host: str, port: int | None) -> int:
    """Return `port` (--port) if it is free on `host`. For 0, return any free port. For None, return the first free port of
    the TRIES ports from PORT on, or any free port if all of these are taken.

    Raises:
        ConfigError: the host is not an address of this machine, or the port does not exist or is taken.
    """
    if port is not None and not 0 <= port <= 65535:
        raise ConfigError(f"--port: must be from 0 to 65535, got {port}")
    try:
        family = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][0]
    except (OSError, UnicodeError) as error:
        raise ConfigError(
            f"--host: '{host}' is no address of this machine ({error}); {HOST} serves the page to this machine only"
        ) from error
    reason = ""
    for number in [port] if port is not None else [*range(PORT, PORT + TRIES), 0]:
        try:
            with socket.create_server((host, number), family=family) as probe:
                return int(probe.getsockname()[1])
        except OSError as error:
            reason = error.strerror or str(error)
    if port is None:
        raise ConfigError(f"--host: no page can be served at '{host}' ({reason}); {HOST} serves it to this machine only")
    raise ConfigError(f"--port: {port} can't be used at '{host}' ({reason}); leave it out, and a free port is chosen")


def is_loopback(host: str) -> bool:
    """Return whether a host is reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def url(host: str, port: int) -> str:
    """Return the URL of the page for a browser on this machine."""
    shown = {"0.0.0.0": HOST, "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return f"http://{shown}:{port}"


def is_own(served: str, host: str | None, origin: str | None) -> bool:
    """Return whether a request is from a page at `served` (--host), by its headers Host and Origin. Another website can lead
    its own name to this machine, so Host must be an address, `served`, or a name of this machine. Origin must be the same
    place as Host; programs other than browsers send no Origin.
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
        own = name in {served.lower(), "localhost", socket.gethostname().lower()} or bool(ipaddress.ip_address(name))
    except ValueError:
        own = False
    return own and (origin is None or origin.partition("://")[2] == host)


@contextlib.contextmanager
def refusing_other_sites(served: str) -> Iterator[None]:
    """Make every server of `websockets` that starts in the block refuse requests that are not `is_own`. Viser has no setting
    for this.
    """
    from websockets.asyncio import server

    serve: Any = server.serve

    def guarded(*args: Any, process_request: Any = None, **settings: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            host, origins = request.headers.get("Host"), request.headers.get_all("Origin")
            if len(origins) < 2 and is_own(served, host, *(origins or [None])):
                return process_request(connection, request) if process_request is not None else None
            text = f"{host!r} is not this page: use the machine's address, or start `legged watch` with --host NAME\n"
            return connection.respond(HTTPStatus.FORBIDDEN, text)

        return serve(*args, process_request=check, **settings)

    server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]


def load_viser() -> Any:
    """Return the module viser.

    Raises:
        ConfigError: viser is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise ConfigError(f"watch: needs the package {error.name}, which is not installed here: {INSTALL}") from error
    return viser


class Page:
    """A web page that shows and controls a session. Viser runs callbacks in its own threads, so they only queue actions.
    `run` and `do_what_was_asked` execute the actions in the thread that calls them.
    """

    def __init__(self, session: Session, host: str, port: int) -> None:
        """Start the server at `host` and at a `port` that `free_port` has returned."""
        viser = load_viser()
        from legged.play.live.drawing import Drawing  # imported here, because it needs trimesh, which comes with viser

        self.session = session
        self._asked: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        with contextlib.redirect_stdout(io.StringIO()), refusing_other_sites(host):  # viser prints a banner
            self.server: Any = viser.ViserServer(host=host, port=port, label=session.task.cfg.task, verbose=False)
        self.port = int(self.server.get_port())
        # Viser would let any visitor publish the page through a public tunnel. This is switched off here.
        self.server.request_share_url = lambda verbose=True: None
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self.drawing = Drawing(self.server, session)
        self.sliders: list[tuple[int, Any]] = []
        """Pairs of an axis of the command and its slider."""
        self._add_controls()
        self._add_keys()
        gui = self.server.gui
        panel = gui.add_panel()
        with panel.add_tab("Live"):
            self.plots = LivePlots(self.server, session.history, session.has_commands)
        panel.dock_right()
        panel.set_width(360)
        gui.main_panel.dock_left()
        gui.main_panel.set_width(300)
        self.refresh()

    def close(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    # ---- controls ----------------------------------------------------------------------------------------------------

    def _do(self, event: Callable[[Any], object], action: Callable[[], object]) -> None:
        """Queue an action at each event of a control. `event` is the control's on_click, on_update or on_trigger."""
        event(lambda _: self._asked.put(action))

    def _add_controls(self) -> None:
        gui, session = self.server.gui, self.session
        self.status = gui.add_markdown("")
        self.choice = gui.add_dropdown("checkpoint", (NEWEST, BEST), initial_value=session.watched.choice, visible=False)
        self._do(self.choice.on_update, lambda: session.follow(str(self.choice.value)))
        if session.has_commands:
            with gui.add_folder("Command"):
                for axis, (name, unit, limits) in enumerate(zip(AXES, UNITS, session.ranges, strict=True)):
                    low, high = (round(limit, 3) for limit in limits)
                    if low == high:
                        continue
                    start = min(max(session.command[axis], low), high)
                    slider = gui.add_slider(f"{name} [{unit}]", min=low, max=high, step=0.01, initial_value=start)
                    self._do(slider.on_update, partial(lambda axis, own: session.ask(axis, float(own.value)), axis, slider))
                    self.sliders.append((axis, slider))
                stand = gui.add_button("stand still" if session.clipped([0.0] * 3) == [0.0] * 3 else "slowest")
                self._do(stand.on_click, lambda: self._steer(session.stand))
        with gui.add_folder("Time"):
            buttons = gui.add_button_group("", ("pause", "step", "reset"))
            self._do(buttons.on_click, lambda: self._time(str(buttons.value)))
            speed = gui.add_slider("speed", min=SLOWEST, max=FASTEST, step=0.1, initial_value=1.0)
            self._do(speed.on_update, lambda: session.set_speed(float(speed.value)))
        with gui.add_folder("Camera"):
            follow = gui.add_checkbox("follow a robot", True)
            follow.on_update(lambda _: setattr(self.drawing, "follows", bool(follow.value)))
            if session.task.num_envs > 1:
                robot = gui.add_slider("robot", min=1, max=session.task.num_envs, step=1, initial_value=1)
                self._do(robot.on_update, lambda: session.select(int(robot.value) - 1))
        if len(session.grounds) > 1:
            with gui.add_folder("Terrain"):
                kind = gui.add_dropdown("type", tuple(session.grounds), initial_value=session.kind)
                present = 0.5 if session.difficulty is None else session.difficulty
                difficulty = gui.add_slider("difficulty", min=0.0, max=1.0, step=0.05, initial_value=present)
                button = gui.add_button("put the robots there")
                self._do(button.on_click, lambda: session.go_to(str(kind.value), float(difficulty.value)))
        if session.can_be_pushed:
            with gui.add_folder("Push"):
                direction = gui.add_dropdown("towards", tuple(DIRECTIONS), initial_value="left")
                strength = gui.add_slider("by [m/s]", min=0.1, max=HARDEST_PUSH, step=0.1, initial_value=0.5)
                everybody = gui.add_checkbox("all robots", False, visible=session.task.num_envs > 1)
                push = gui.add_button("push")

            def all_or_one() -> None:
                session.push(DIRECTIONS[str(direction.value)], float(strength.value), bool(everybody.value))

            self._do(push.on_click, all_or_one)

    def _steer(self, change: Callable[[], object]) -> None:
        change()
        for axis, slider in self.sliders:
            slider.value = round(self.session.command[axis], 3)

    def _time(self, what: str) -> None:
        session = self.session
        if what == "pause":
            session.running = not session.running
        elif what == "step":
            session.running = False
            session.step()
        else:
            session.reset()
        self.refresh()

    def _add_keys(self) -> None:
        """Add keys for pause, single step, reset and the velocity command. Viser's command palette lists them."""
        session = self.session

        def press(axis: int, change: float) -> None:
            self._steer(lambda: session.ask(axis, round(session.command[axis] + change, 3)))

        keys: list[tuple[str, str, Callable[[], object]]] = [
            ("P", "pause or go on", lambda: self._time("pause")),
            ("N", "one step", lambda: self._time("step")),
            ("R", "reset", lambda: self._time("reset")),
        ]
        if session.has_commands:
            for letter, axis, sign in KEYS:
                name = f"{AXES[axis]} {'+' if sign > 0 else '-'}{STEP[axis]:g} {UNITS[axis]}"
                keys.append((letter, name, partial(press, axis, sign * STEP[axis])))
            keys.append(("space", "stand still", lambda: self._steer(session.stand)))
        for letter, name, action in keys:
            self._do(self.server.gui.add_command(name, hotkey=letter).on_trigger, action)

    def refresh(self) -> None:
        """Update the status text and the plots."""
        session = self.session
        state = f"{session.time:.1f}\u00a0s" if session.running else f"paused at {session.time:.1f}\u00a0s"
        slow = f"too slow: {session.pace:.0%} of the chosen speed" if session.running and session.pace < SLOW else ""
        details = " · ".join(text for text in (f"robot {session.followed + 1}", session.place(), state, slow) if text)
        text = "\n\n".join([f"**{session.title()}**", details, *([f"⚠ {session.problem}"] if session.problem else [])])
        if text != self.status.content:
            self.status.content = text
        if self.choice.visible != session.watched.has_best:
            self.choice.visible = session.watched.has_best
        self.plots.update(session.history)

    def do_what_was_asked(self) -> None:
        """Execute all actions that visitors have requested since the last call."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._asked.get_nowait()()

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Simulate in real time while the page has visitors; end when `until` returns True, or at Ctrl-C."""
        last = drawn = plotted = looked = time.perf_counter()
        while not until():
            self.do_what_was_asked()
            now = time.perf_counter()
            if not self.server.get_clients():
                time.sleep(IDLE_S)
                last = time.perf_counter()
                continue
            if now - looked > LOOK_S:
                looked = now
                self.session.look()
            self.session.pass_time(now - last)
            last = now
            if now - drawn > PICTURES_S:
                drawn = now
                self.drawing.draw()
            if now - plotted > PLOTS_S:
                plotted = now
                self.refresh()
            rest = min(self.session.task.dt, PICTURES_S) - (time.perf_counter() - now)
            time.sleep(max(rest, 0.002))
