"""The web page: viser's server with its scene, plots and controls."""

import contextlib
import io
import queue
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from legged.errors import ConfigError
from legged.learning.run_folder import BEST
from legged.play.live.history import AXES, UNITS
from legged.play.live.plots import LivePlots
from legged.play.live.session import FASTEST, HARDEST_PUSH, SLOWEST, Session
from legged.play.live.source import NEWEST

INSTALL = "pip install 'legged[watch]'"
PICTURES_S, PLOTS_S, LOOK_S = 1.0 / 30.0, 0.25, 1.0
"""Time between two pictures, two updates of the plots, and two checks for a newer checkpoint [s]."""
IDLE_S = 0.1
"""Time between two checks for visitors while the page has none and the simulation rests [s]."""
SLOW = 0.9
"""The page warns when the pace is below this."""
STEPS = (0.1, 0.1, 0.2)
"""Change of vx, vy [m/s] and yaw rate [rad/s] by one key press."""
KEYS = (("I", 0, 1), ("K", 0, -1), ("U", 1, 1), ("O", 1, -1), ("J", 2, 1), ("L", 2, -1))
"""Letter keys that change the command -> axis and direction. Viser's camera uses other letters and the arrows."""
DIRECTIONS = {"forwards": 0.0, "left": 90.0, "backwards": 180.0, "right": -90.0}
"""Directions of a push, from the robot's heading to the left [degrees]."""


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
    """A web page that shows and controls a session. Viser calls callbacks from its own threads; they only queue actions,
    which `run` and `do_what_was_asked` execute in the thread of their caller.
    """

    def __init__(self, session: Session, host: str, port: int) -> None:
        """Start the server; `legged.play.live.address.free_port` finds a free port."""
        viser = load_viser()
        from legged.play.live.drawing import Drawing  # imports trimesh, which comes with viser

        self.session = session
        self._asked: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
            self.server: Any = viser.ViserServer(host=host, port=port, label=session.cfg.task, verbose=False)
        # Viser lets any visitor publish the page through a public tunnel; that is switched off.
        self.server.request_share_url = lambda verbose=True: None
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self.drawing = Drawing(self.server, session)
        self.sliders: list[tuple[int, Any]] = []
        """Axis of the command and its slider."""
        self._add_controls()
        self._add_plots()
        self._add_keys()
        self.refresh()

    @property
    def port(self) -> int:
        """Return the port of the server."""
        return int(self.server.get_port())

    @property
    def visitors(self) -> int:
        """Return the number of connected browsers."""
        return len(self.server.get_clients())

    def close(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    # ---- controls ----------------------------------------------------------------------------------------------------

    def _later(self, what: Callable[[], object]) -> None:
        """Queue an action for `run`."""
        self._asked.put(what)

    def _add_controls(self) -> None:
        gui, session = self.server.gui, self.session
        self.status = gui.add_markdown("")
        self.choice = gui.add_dropdown("checkpoint", (NEWEST, BEST), initial_value=session.follower.choice, visible=False)
        self.choice.on_update(lambda _: self._later(lambda: session.follow(str(self.choice.value))))
        if session.has_commands:
            with gui.add_folder("Command"):
                self._add_command()
        with gui.add_folder("Time"):
            self._add_time()
        with gui.add_folder("Camera"):
            follow = gui.add_checkbox("follow a robot", True)
            follow.on_update(lambda _: setattr(self.drawing, "follows", bool(follow.value)))
            if session.task.num_envs > 1:
                self.robot = gui.add_slider("robot", min=1, max=session.task.num_envs, step=1, initial_value=1)
                self.robot.on_update(lambda _: self._later(lambda: session.select(int(self.robot.value) - 1)))
        if len(session.grounds) > 1:
            with gui.add_folder("Terrain"):
                self._add_terrain()
        if session.can_be_pushed:
            with gui.add_folder("Push"):
                self._add_push()

    def _add_command(self) -> None:
        gui, session = self.server.gui, self.session
        for axis, (name, unit, (low, high)) in enumerate(zip(AXES, UNITS, session.ranges, strict=True)):
            low, high = round(low, 3), round(high, 3)
            start = min(max(session.command[axis], low), high)
            if low == high:
                continue
            slider = gui.add_slider(f"{name} [{unit}]", min=low, max=high, step=0.01, initial_value=start)
            slider.on_update(lambda event, axis=axis: self._later(lambda: session.ask(axis, float(event.target.value))))
            self.sliders.append((axis, slider))
        stand = gui.add_button("stand still" if session.clipped([0.0] * 3) == [0.0] * 3 else "slowest")
        stand.on_click(lambda _: self._later(self._stand))

    def _stand(self) -> None:
        self.session.stand()
        self._show_command()

    def _show_command(self) -> None:
        """Move the sliders to the present command."""
        for axis, slider in self.sliders:
            slider.value = round(self.session.command[axis], 3)

    def _add_time(self) -> None:
        gui, session = self.server.gui, self.session
        buttons = gui.add_button_group("", ("pause", "step", "reset"))
        self.buttons = buttons
        buttons.on_click(lambda _: self._later(lambda: self._time(str(buttons.value))))
        self.speed = gui.add_slider("speed", min=SLOWEST, max=FASTEST, step=0.1, initial_value=1.0)
        self.speed.on_update(lambda _: self._later(lambda: session.set_speed(float(self.speed.value))))

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

    def _add_terrain(self) -> None:
        gui, session = self.server.gui, self.session
        kind = gui.add_dropdown("type", tuple(session.grounds), initial_value=session.ground.kind)
        difficulty = 0.5 if session.ground.difficulty is None else session.ground.difficulty
        slider = gui.add_slider("difficulty", min=0.0, max=1.0, step=0.05, initial_value=difficulty)
        button = gui.add_button("put the robots there")
        button.on_click(lambda _: self._later(lambda: session.go_to(str(kind.value), float(slider.value))))

    def _add_push(self) -> None:
        gui, session = self.server.gui, self.session
        direction = gui.add_dropdown("towards", tuple(DIRECTIONS), initial_value="left")
        strength = gui.add_slider("by [m/s]", min=0.1, max=HARDEST_PUSH, step=0.1, initial_value=0.5)
        everybody = gui.add_checkbox("all robots", False) if session.task.num_envs > 1 else None

        def push() -> None:
            all_of_them = everybody is not None and bool(everybody.value)
            session.push(DIRECTIONS[str(direction.value)], float(strength.value), all_of_them)

        gui.add_button("push").on_click(lambda _: self._later(push))

    def _add_keys(self) -> None:
        """Add keys for the buttons' actions; viser lists them in its palette."""
        gui, session = self.server.gui, self.session

        def key(letter: str, name: str, what: Callable[[], object]) -> None:
            gui.add_command(name, hotkey=letter).on_trigger(lambda _: self._later(what))

        key("P", "pause or go on", lambda: self._time("pause"))
        key("N", "one step", lambda: self._time("step"))
        key("R", "reset", lambda: self._time("reset"))
        if not session.has_commands:
            return

        def change(axis: int, sign: int) -> None:
            session.ask(axis, round(session.command[axis] + sign * STEPS[axis], 3))
            self._show_command()

        for letter, axis, sign in KEYS:
            name = f"{AXES[axis]} {'+' if sign > 0 else '-'}{STEPS[axis]:g} {UNITS[axis]}"
            key(letter, name, partial(change, axis, sign))
        key("space", "stand still", self._stand)

    # ---- display ----------------------------------------------------------------------------------------------------

    def _add_plots(self) -> None:
        gui = self.server.gui
        panel = gui.add_panel()
        with panel.add_tab("Live"):
            self.plots = LivePlots(self.server, self.session.history, self.session.has_commands)
        panel.dock_right()
        panel.set_width(360)
        gui.main_panel.dock_left()
        gui.main_panel.set_width(300)

    def refresh(self) -> None:
        """Update the status text and the plots."""
        session = self.session
        lines = [f"**{session.title()}**"]
        place = session.place()
        state = f"{session.time:.1f}\u00a0s" if session.running else f"paused at {session.time:.1f}\u00a0s"
        slow = f"too slow: {session.pace:.0%} of the time that should pass" if session.running and session.pace < SLOW else ""
        lines.append(" · ".join(text for text in (f"robot {session.followed + 1}", place, state, slow) if text))
        if session.problem:
            lines.append(f"⚠ {session.problem}")
        text = "\n\n".join(lines)
        if text != self.status.content:
            self.status.content = text
        if self.choice.visible != session.follower.has_best:
            self.choice.visible = session.follower.has_best
        self.plots.update(session.history)

    def do_what_was_asked(self) -> None:
        """Execute the actions that visitors requested since the last call."""
        while True:
            try:
                what = self._asked.get_nowait()
            except queue.Empty:
                return
            what()

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Simulate in real time while the page has visitors; end when `until` returns True, or at Ctrl-C."""
        last = drawn = plotted = looked = time.perf_counter()
        while not until():
            self.do_what_was_asked()
            now = time.perf_counter()
            if self.visitors == 0:
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
