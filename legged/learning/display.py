"""What is seen of a training: a compact live table, or plain lines where there is no terminal."""

import sys
from dataclasses import dataclass
from datetime import timedelta

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

PLAIN_LINES_EVERY_S = 2.0


@dataclass(frozen=True)
class Progress:
    """One finished iteration."""

    iteration: int
    total: int
    elapsed_s: float
    eta_s: float
    steps_per_s: float
    collect_s: float
    learn_s: float
    reward: float
    """Mean return of the last 100 episodes."""
    action_std: float
    values: dict[str, float]
    """The task's log: `rew_<term>` per second of a full episode, `Metrics/...`."""

    def metric(self, name: str) -> float:
        """A metric of the task, NaN if it has none."""
        return self.values.get(f"Metrics/{name}", float("nan"))

    def text(self, name: str, spec: str, unit: str, factor: float = 1.0) -> str:
        """A metric with its unit, a dash while it has no value."""
        value = factor * self.metric(name)
        return f"{value:{spec}} {unit}" if value == value else "-"

    def line(self) -> str:
        """The iteration on one line."""
        return (
            f"it {self.iteration}/{self.total}  {_time(self.elapsed_s)} < {_time(self.eta_s)}  "
            f"{self.steps_per_s:,.0f} steps/s ({self.collect_s:.2f}+{self.learn_s:.2f} s)  reward {self.reward:.2f}  "
            f"error {self.text('lin_vel_rmse', '.3f', 'm/s')} {self.text('ang_vel_rmse', '.3f', 'rad/s')}  "
            f"falls {self.text('falls', '.1f', '%', 100)}  episode {self.text('episode_length', '.0f', 'steps')}  "
            f"std {self.action_std:.2f}" + self.level() + self.warnings()
        )

    def level(self) -> str:
        """The mean terrain level, if there is one."""
        return f"  level {self.values['Terrain/level']:.2f}" if "Terrain/level" in self.values else ""

    def levels(self) -> dict[str, str]:
        """Terrain type -> mean level, and shares of episodes that moved up and down."""
        found = {}
        for key, level in self.values.items():
            name = key.removeprefix("Terrain/level_")
            if name != key:
                up, down = (self.values.get(f"Terrain/{what}_{name}", float("nan")) for what in ("promoted", "demoted"))
                found[name] = f"level {level:.2f}  +{100 * up:.0f} % -{100 * down:.0f} %"
        return found

    def warnings(self) -> str:
        """What should never happen, if it did."""
        text = ""
        if self.metric("non_finite_worlds") > 0:
            text += f"  ! {self.metric('non_finite_worlds'):.0f} robots reset after numbers overflowed"
        if self.metric("contact_overflows") > 0:
            text += f"  ! contacts lost in {self.metric('contact_overflows'):.0f} robot steps: raise sim.nconmax, sim.njmax"
        return text

    def table(self, title: str) -> Table:
        """The iteration as a table, reward terms beside the state of training."""
        left = {
            "iteration": f"{self.iteration} / {self.total}",
            "elapsed, to go": f"{_time(self.elapsed_s)}, {_time(self.eta_s)}",
            "steps/s": f"{self.steps_per_s:,.0f}",
            "collect + learn": f"{self.collect_s:.2f} + {self.learn_s:.2f} s",
            "mean return": f"{self.reward:.2f}",
            "velocity error": self.text("lin_vel_rmse", ".3f", "m/s"),
            "yaw rate error": self.text("ang_vel_rmse", ".3f", "rad/s"),
            "falls": self.text("falls", ".1f", "% of episodes", 100),
            "episode length": self.text("episode_length", ".0f", "steps"),
            "action std": f"{self.action_std:.2f}",
        }
        known = ("lin_vel_rmse", "ang_vel_rmse", "falls", "episode_length", "non_finite_worlds", "contact_overflows")
        other = {k.removeprefix("Metrics/"): v for k, v in self.values.items() if k.startswith("Metrics/")}
        left.update({k.replace("_", " "): f"{v:.2f}" for k, v in other.items() if k not in known})
        if "Terrain/level" in self.values:
            left["terrain level"] = f"{self.values['Terrain/level']:.2f}"
        right = {k.removeprefix("rew_"): f"{v:+.4f}" for k, v in self.values.items() if k.startswith("rew_")}
        right.update(self.levels())
        table = Table(title=escape(title), caption=escape(self.warnings()) or None, title_justify="left")
        for name, justify in (("training", "left"), ("", "right"), ("reward per second", "left"), (" ", "right")):
            table.add_column(name, justify=justify)  # type: ignore[arg-type]
        left_rows, right_rows = list(left.items()), list(right.items())
        for i in range(max(len(left_rows), len(right_rows))):
            a = left_rows[i] if i < len(left_rows) else ("", "")
            b = right_rows[i] if i < len(right_rows) else ("", "")
            table.add_row(*(escape(text) for text in (*a, *b)))
        return table


class Display:
    """Shows the progress of one training on the console. Use as a context."""

    def __init__(self, title: str) -> None:
        """`title` heads the live table."""
        self.title = title
        console = Console()
        live = sys.stdout.isatty() and not console.is_dumb_terminal  # of a dumb one no line can be drawn anew
        self._live = Live(console=console, refresh_per_second=4) if live else None
        self._last_line_s = -PLAIN_LINES_EVERY_S

    def __enter__(self) -> "Display":
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def show(self, progress: Progress) -> None:
        """Show an iteration. Plain lines come at most every two seconds; the first and the last always do."""
        if self._live:
            self._live.update(progress.table(self.title))
            return
        due = progress.elapsed_s - self._last_line_s >= PLAIN_LINES_EVERY_S
        if due or progress.iteration == progress.total:
            self._last_line_s = progress.elapsed_s
            print(progress.line(), flush=True)


def _time(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds))).removeprefix("0:")
