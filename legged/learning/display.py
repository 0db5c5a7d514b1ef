"""Console display of a training: a compact live table, or plain lines where there is no terminal."""

import sys
from dataclasses import dataclass
from datetime import timedelta
from itertools import zip_longest
from math import isnan, nan

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from legged.learning.estimator import SECTION as ESTIMATES
from legged.learning.evaluations import SECTION

PLAIN_LINES_EVERY_S = 2.0


@dataclass(frozen=True)
class Style:
    """Format of a metric. A metric without a Style is shown with its name and two decimals."""

    row: str
    """Label in the table."""
    word: str
    """Label on the plain line; empty if the value shares the previous metric's label."""
    spec: str
    unit: str
    factor: float = 1.0
    of: str = ""
    """Text after the unit in the table."""


STYLES = {
    "lin_vel_rmse": Style("velocity error", "error", ".3f", "m/s"),
    "ang_vel_rmse": Style("yaw rate error", "", ".3f", "rad/s"),
    "falls": Style("falls", "falls", ".1f", "%", 100.0, " of episodes"),
    "episode_length": Style("episode length", "episode", ".0f", "steps"),
}
"""Metrics that come first, in this order, if the task logs them."""
ON_THE_LINE = len(STYLES)
"""Number of metrics on a plain line. If a task lacks metrics of `STYLES`, other metrics of the task take their places."""
WARNINGS = {
    "non_finite_worlds": "{:.0f} robots reset because of NaN or infinite numbers (docs/training.md)",
    "contact_overflows": "contacts lost in {:.0f} robot steps: raise sim.nconmax, sim.njmax",
}
"""Metric of a fault -> warning, shown if the metric is above 0."""


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
    """Log entries of the task: rewards `rew_<term>` (sum over an episode, divided by the length of a full episode [s]),
    `Metrics/...` and other sections. An entry without a value so far is NaN."""
    behavior: float | None = None
    """Mean loss between the actions of a student and of its teacher; None without a teacher."""

    def metrics(self) -> dict[str, float]:
        """Return the task's metrics by name, those of `STYLES` first."""
        section = "Metrics/"
        found = {key.removeprefix(section): value for key, value in self.values.items() if key.startswith(section)}
        first = {name: found[name] for name in STYLES if name in found}
        return {**first, **{name: value for name, value in found.items() if name not in (*STYLES, *WARNINGS)}}

    def others(self) -> dict[str, float]:
        """Return 'section: name' -> value for the log entries that have no fixed place on the display."""
        found = {}
        for key, value in self.values.items():
            section, _, name = key.partition("/")
            if name and section not in ("Metrics", "Terrain"):
                found[f"{section.lower()}: {plain(name)}"] = value
        return found

    def line(self) -> str:
        """Return the iteration as one line of text."""
        shown = "".join(self._word(name, value) for name, value in [*self.metrics().items()][:ON_THE_LINE])
        loss = "" if self.behavior is None else f"  behaviour loss {self.behavior:.4f}"
        return (
            f"it {self.iteration}/{self.total}  {_time(self.elapsed_s)} < {_time(self.eta_s)}  "
            f"{self.steps_per_s:,.0f} steps/s ({self.collect_s:.2f}+{self.learn_s:.2f} s)  reward {self._reward()}"
            f"{loss}{shown}  std {self.action_std:.2f}" + self.level() + self.estimated() + self.evaluated() + self.warnings()
        )

    def _word(self, name: str, value: float) -> str:
        """Return a metric as text for the plain line, beginning with a space."""
        style = STYLES.get(name)
        if style is None:
            return f"  {plain(name)} {number(value):>8}"
        return (f"  {style.word} " if style.word else " ") + styled(value, style)

    def _reward(self) -> str:
        """Return the mean return as text; a dash before the first episode has ended."""
        return "-" if isnan(self.reward) else f"{self.reward:.2f}"

    def level(self) -> str:
        """Return the mean terrain level as text; empty if the task logs none."""
        level = self.values.get("Terrain/level", nan)
        return "" if isnan(level) else f"  level {level:.2f}"

    def evaluated(self) -> str:
        """Return the first figure of the last evaluation as text; empty before the first evaluation."""
        found = [(key, value) for key, value in self.values.items() if key.startswith(SECTION)]
        return "".join(f"  evaluated {plain(key.removeprefix(SECTION))} {value:.3f}" for key, value in found[:1])

    def estimated(self) -> str:
        """Return the errors of the estimates as text; empty without an estimator."""
        found = [(key.removeprefix(ESTIMATES), value) for key, value in self.values.items() if key.startswith(ESTIMATES)]
        return "".join(f"  estimated {plain(name)} {value:.3f}" for name, value in found)

    def levels(self) -> dict[str, str]:
        """Return terrain type -> text with its mean level and the shares of episodes after which a robot moved up or down."""
        found = {}
        for key, level in self.values.items():
            name = key.removeprefix("Terrain/level_")
            if name != key and not isnan(level):
                up, down = (self.values.get(f"Terrain/{what}_{name}", nan) for what in ("promoted", "demoted"))
                shares = "" if isnan(up + down) else f"  +{100 * up:.0f} % -{100 * down:.0f} %"
                found[name] = f"level {level:.2f}{shares}"
        return found

    def warnings(self) -> str:
        """Return the text of all faults that occurred."""
        counts = {text: self.values.get(f"Metrics/{name}", 0.0) for name, text in WARNINGS.items()}
        return "".join(f"  ! {text.format(count)}" for text, count in counts.items() if count > 0)

    def table(self, title: str) -> Table:
        """Return the iteration as a table with two halves: the state of training, and the reward terms."""
        left = {
            "iteration": f"{self.iteration} / {self.total}",
            "elapsed, to go": f"{_time(self.elapsed_s)}, {_time(self.eta_s)}",
            "steps/s": f"{self.steps_per_s:,.0f}",
            "collect + learn": f"{self.collect_s:.2f} + {self.learn_s:.2f} s",
            "mean return": self._reward(),
        }
        if self.behavior is not None:
            left["behaviour loss"] = f"{self.behavior:.4f}"
        metrics = self.metrics()
        for name, style in STYLES.items():
            if name in metrics:
                left[style.row] = styled(metrics[name], style) + ("" if isnan(metrics[name]) else style.of)
        left["action std"] = f"{self.action_std:.2f}"
        left.update({plain(name): number(value) for name, value in metrics.items() if name not in STYLES})
        if self.level():
            left["terrain level"] = f"{self.values['Terrain/level']:.2f}"
        left.update({name: number(value) for name, value in self.others().items()})
        rewards = {key.removeprefix("rew_"): value for key, value in self.values.items() if key.startswith("rew_")}
        right = {name: "-" if isnan(value) else f"{value:+.4f}" for name, value in rewards.items()}
        right.update(self.levels())
        table = Table(title=escape(title), caption=escape(self.warnings()) or None, title_justify="left")
        for name, justify in (("training", "left"), ("", "right"), ("reward per second", "left"), (" ", "right")):
            table.add_column(name, justify=justify)  # type: ignore[arg-type]
        for a, b in zip_longest(left.items(), right.items(), fillvalue=("", "")):
            table.add_row(*(escape(text) for text in (*a, *b)))
        return table


def plain(name: str) -> str:
    """Return a name as words: 'x_velocity' -> 'x velocity'."""
    return name.replace("_", " ")


def styled(value: float, style: Style) -> str:
    """Return a number with its unit, or a dash for NaN."""
    return "-" if isnan(value) else f"{style.factor * value:{style.spec}} {style.unit}"


def number(value: float) -> str:
    """Return a number of any size in at most nine characters, or a dash for NaN."""
    if isnan(value):
        return "-"
    return f"{value:.2f}" if value == 0.0 or 0.005 <= abs(value) < 1e5 else f"{value:.2e}"


class Display:
    """Context manager that shows the progress of one training on the console."""

    def __init__(self, title: str) -> None:
        """Take the `title` of the live table."""
        self.title = title
        console = Console()
        live = sys.stdout.isatty() and not console.is_dumb_terminal  # a dumb terminal can't redraw a line
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
        """Show an iteration. Plain lines appear at most every two seconds, except the last one, which always appears."""
        if self._live:
            self._live.update(progress.table(self.title))
            return
        due = progress.elapsed_s - self._last_line_s >= PLAIN_LINES_EVERY_S
        if due or progress.iteration == progress.total:
            self._last_line_s = progress.elapsed_s
            print(progress.line(), flush=True)


def _time(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds))).removeprefix("0:")
