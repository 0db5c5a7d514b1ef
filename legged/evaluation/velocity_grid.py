"""The grid of velocity commands on which policies are measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from legged.config import LeggedConfig
from legged.config.legged import FASTEST
from legged.envs.legged_checks import MOST_VALUES, check_grid
from legged.errors import ConfigError

AXES = {"vx": "m/s", "vy": "m/s", "yaw": "rad/s"}
"""Names of the commands, which are the axes of the grid, and their units."""
AXIS = "-1:1:0.5"
"""Default range of an axis, low:high:step."""
MOST_ROBOTS = 2**20
"""Largest number of robots that are simulated at once."""


@dataclass(frozen=True)
class Grid:
    """Values of the commands vx, vy [m/s] and yaw rate [rad/s]. Each combination of values is a cell, that is one command."""

    vx: Sequence[float]
    vy: Sequence[float]
    yaw: Sequence[float]
    robots: int = 16
    """Number of robots that follow each command."""
    hold_s: float = 4.0
    """Time for which a command is held [s]."""
    settle_s: float = 1.0
    """Time at the start of a command in which errors are not measured [s]."""

    @property
    def cells(self) -> np.ndarray:
        """Return the commands (C, 3): vx, vy [m/s], yaw rate [rad/s]."""
        return np.array(list(product(self.vx, self.vy, self.yaw)), dtype=float)

    @property
    def num_cells(self) -> int:
        """Return the number C of commands."""
        return len(self.vx) * len(self.vy) * len(self.yaw)

    @property
    def num_envs(self) -> int:
        """Return the number of robots in all cells."""
        return self.num_cells * self.robots

    @property
    def axes(self) -> dict[str, list[float]]:
        """Return name of an axis -> its values."""
        return {name: list(getattr(self, name)) for name in AXES}

    @property
    def size_text(self) -> str:
        """Return the size of the grid as text: '125 commands x 16 robots'."""
        return f"{self.num_cells} commands x {self.robots} robots"


def axis_values(flag: str, text: str) -> list[float]:
    """Read the values of an axis: '-1:1:0.5' gives [-1, -0.5, 0, 0.5, 1], and a single number gives one value.

    Raises:
        ConfigError: the text does not have this form, or a command is too large.
    """
    given = low, high, _ = read_range(flag, text, f"{flag}=-1:1:0.5")
    if max(abs(low), abs(high)) > FASTEST:
        raise ConfigError(f"{flag}: '{text}' asks for more than {FASTEST:g} m/s or rad/s, the largest command")
    return spaced(flag, text, given)


def read_range(flag: str, text: str, example: str) -> tuple[float, float, float]:
    """Read (low, high, step) from 'low:high:step', or from a single number, which is both low and high.

    Raises:
        ConfigError: the text does not have this form.
    """
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        parts = []
    if len(parts) == 1:
        parts = [*parts, *parts, 1.0]
    if len(parts) != 3 or not np.isfinite(parts).all() or parts[2] <= 0 or parts[1] < parts[0]:
        raise ConfigError(f"{flag}: '{text}' is not of the form low:high:step, e.g. {example}")
    return parts[0], parts[1], parts[2]


def axes_of(cfg: LeggedConfig) -> dict[str, list[float]]:
    """Return name of an axis -> its values, for the grid in a task's configuration (`evaluation`).

    Raises:
        ConfigError: an axis is not a range, or has too many values.
    """
    check_grid(cfg)
    given = {axis: getattr(cfg.evaluation, axis) for axis in AXES}
    return {axis: spaced(f"evaluation.{axis}", str(list(values)), values) for axis, values in given.items()}


def spaced(where: str, text: str, given: Sequence[float], what: str = "values", most: int = MOST_VALUES) -> list[float]:
    """Return the values of the range `given` (low, high, step). `where`, `text` and `what` are words for error messages.

    Raises:
        ConfigError: the range has more than `most` values.
    """
    low, high, step = given
    count = (high - low) / step + 1.0
    if count > most:
        raise ConfigError(f"{where}: '{text}' makes {count:,.0f} {what}; at most {most:,} are possible")
    whole = int(count + 1e-9)  # 0:0.3:0.1 has three steps, although 0.3 / 0.1 < 3
    return [round(float(value), 6) for value in low + step * np.arange(whole)]


def check_size(grid: Grid) -> None:
    """Check that the robots of a grid can be simulated at the same time.

    Raises:
        ConfigError: there are no robots or too many.
    """
    if grid.robots < 1:
        raise ConfigError(f"--robots: must be at least 1, got {grid.robots}")
    if grid.num_envs > MOST_ROBOTS:
        raise ConfigError(
            f"--vx, --vy, --yaw, --robots: {grid.num_cells:,} cells x {grid.robots:,} robots are {grid.num_envs:,} robots; at"
            f" most {MOST_ROBOTS:,} are possible"
        )


def mean_and_worst(values: np.ndarray, cells: np.ndarray) -> dict[str, Any]:
    """Return the mean, the worst value and the worst cell of `values` (C,) over `cells` (C, 3). NaN values are left out. If
    all values are NaN, the three results are None.
    """
    if np.isnan(values).all():
        return {"mean": None, "worst": None, "worst_cell": None}
    worst = int(np.nanargmax(values))
    return {"mean": float(np.nanmean(values)), "worst": float(values[worst]), "worst_cell": cells[worst].tolist()}


def number_or_null(value: float) -> float | None:
    """Return a value for a JSON file: the number, or None (null) if it is not finite."""
    return float(value) if np.isfinite(value) else None
