"""The table of disturbances, for a robot of any size."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from legged.robots.similarity import Size, grown

WRITTEN_FOR = "anymal_c"
"""Robot for which the numbers below are written. They are scaled for other robots."""


@dataclass(frozen=True)
class Disturbance:
    """Disturbances of one robot, its sensors and its motors, constant over time. "Either way" means the number or its
    opposite.
    """

    name: str
    payload: float = 0.0
    """Mass added to the base, at its centre of mass [kg]."""
    friction: float | None = None
    """Sliding friction of all contacts of the robot, in place of its nominal one [1]."""
    motors: float = 1.0
    """Factor on the torque of every motor and on its limit [1]."""
    delay: float = 0.0
    """Delay of the targets on the way to the motors [s]."""
    push: float = 0.0
    """Every PUSH_INTERVAL the base's velocity along the world's x and y is set to random values up to this, either way [m/s].
    """
    zero_offset: float = 0.0
    """Largest random error of the encoders, either way; policy and motors both use the wrong angle [rad]."""
    tilt: float = 0.0
    """Tilt of the inertial sensor about a random horizontal axis [rad]."""
    map_height: float = 0.0
    """Vertical error of the height map, either way [m]."""
    map_shift: float = 0.0
    """Horizontal error of the height map, in a random direction [m]."""
    map_holes: float = 0.0
    """Share of the points of the height map that are missing and read 0, like level ground [1]."""

    @property
    def changes(self) -> dict[str, float]:
        """Return field -> number of the fields that differ from their defaults."""
        return {one.name: getattr(self, one.name) for one in fields(self)[1:] if getattr(self, one.name) != one.default}

    @property
    def text(self) -> str:
        """Return the disturbances as text, in physical units."""
        return ", ".join(TEXTS[name].format(value) for name, value in self.changes.items()) or "nothing"


PUSH_INTERVAL = 5.0
"""Time between two pushes of a robot [s]."""
TEXTS = {
    "payload": "{:g} kg on the base",
    "friction": "friction {:g}",
    "motors": "motors at {:.0%}",
    "delay": "targets {:g} s late",
    "push": f"velocity set to up to {{:g}} m/s every {PUSH_INTERVAL:g} s",
    "zero_offset": "encoders up to {:g} rad off",
    "tilt": "inertial sensor askew by {:g} rad",
    "map_height": "height map {:g} m too high or low",
    "map_shift": "height map shifted by {:g} m",
    "map_holes": "{:.0%} of the height map missing",
}
"""Field -> text of its number."""
UNITS = {"payload": "kg", "push": "m/s", "map_height": "m", "map_shift": "m"}
"""Fields that scale with the robot, and their units; delays, angles and shares do not scale."""
NOMINAL = Disturbance("nominal")
ALONE = (
    Disturbance("payload", payload=8.0),
    Disturbance("friction", friction=0.4),
    Disturbance("weak motors", motors=0.85),
    Disturbance("delay 20 ms", delay=0.02),
    Disturbance("delay 40 ms", delay=0.04),
    Disturbance("pushes", push=1.0),
    Disturbance("zero offsets", zero_offset=0.05),
    Disturbance("askew sensor", tilt=0.05),
    Disturbance("map offset", map_height=0.05, map_shift=0.1),
    Disturbance("map holes", map_holes=0.2),
    Disturbance("no map", map_holes=1.0),
)
"""Single disturbances, for an ANYmal C."""
TOGETHER = ("payload", "friction", "weak motors", "delay 20 ms")
"""Disturbances of the line `together`: common differences of hardware."""
WORST = ("delay 40 ms", "no map")
"""Disturbances that the line `everything` lacks, because it has a smaller one of the same kind."""

NAMES = (NOMINAL.name, *(one.name for one in ALONE), "together", "everything")
"""Names of all lines."""


def table(robot: Size, anymal: Size, payload: float | None = None) -> tuple[Disturbance, ...]:
    """Return all lines for a robot of that size: no disturbance, each alone, some together, all. `anymal` is the size of the
    robot for which the numbers are written; scaled numbers have two digits. A `payload` [kg] replaces that of the table.
    """
    alone = [scaled(one, robot, anymal) for one in ALONE]
    if payload is not None:
        alone = [replace(one, payload=payload) if one.payload else one for one in alone]
    all_but = [one for one in alone if one.name not in WORST]
    together = combined("together", [one for one in alone if one.name in TOGETHER])
    return NOMINAL, *alone, together, combined("everything", all_but)


def scaled(one: Disturbance, robot: Size, anymal: Size) -> Disturbance:
    """Return the disturbance `one`, scaled from the size `anymal` to `robot`."""
    grow: dict[str, Any] = {
        name: float(f"{getattr(one, name) * grown(unit, anymal, robot):.2g}") for name, unit in UNITS.items()
    }
    return replace(one, **grow)


def combined(name: str, parts: Sequence[Disturbance]) -> Disturbance:
    """Return the disturbances of all `parts`, which have no field in common."""
    return Disturbance(name, **{field: value for part in parts for field, value in part.changes.items()})
