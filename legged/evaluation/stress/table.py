"""The table of disturbances: what each is, for a robot of any size."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from legged.robots.similarity import Size, grown

WRITTEN_FOR = "anymal_c"
"""The robot whose numbers those below are; others have them as they are as large."""


@dataclass(frozen=True)
class Disturbance:
    """What is wrong with one robot, its sensors and its motors. Where it says "either way", a robot has the number or its
    opposite; what a robot has, it keeps.
    """

    name: str
    payload: float = 0.0
    """Mass added to the base, at its centre of mass [kg]."""
    friction: float | None = None
    """Sliding friction of all contacts of the robot, in place of its own [1]."""
    motors: float = 1.0
    """Factor on the torque of every motor, and so on its limit [1]."""
    delay: float = 0.0
    """Time by which targets reach the motors late [s]."""
    push: float = 0.0
    """Every PUSH_INTERVAL the base's velocity along the world's x and y is set to one drawn up to this, either way [m/s]."""
    zero_offset: float = 0.0
    """What encoders report too much is drawn for each joint up to this, either way; policy and motors both believe it
    [rad]."""
    tilt: float = 0.0
    """By how much the inertial sensor is mounted askew, about a level axis of any direction [rad]."""
    map_height: float = 0.0
    """By how much the height map lies too high or too low, either way [m]."""
    map_shift: float = 0.0
    """By how much the height map is shifted to a side, in a direction of its own [m]."""
    map_holes: float = 0.0
    """Share of the points of the height map that no sensor sees: they read 0, as level ground does [1]."""

    @property
    def changes(self) -> dict[str, float]:
        """Return field -> its number, of those that are not as they should be."""
        return {one.name: getattr(self, one.name) for one in fields(self)[1:] if getattr(self, one.name) != one.default}

    @property
    def text(self) -> str:
        """Return what is wrong, in words and physical units."""
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
"""Field -> what its number means."""
UNITS = {"payload": "kg", "push": "m/s", "map_height": "m", "map_shift": "m"}
"""Fields that grow with the robot, and the units by which they do. A computer's delay does not, nor do angles and shares."""
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
"""One thing wrong at a time, of an ANYmal C."""
TOGETHER = ("payload", "friction", "weak motors", "delay 20 ms")
"""What is wrong in the line `together`: what hardware differs in by itself."""
WORST = ("delay 40 ms", "no map")
"""What the line `everything` does not have, for it has a smaller disturbance of the same kind."""

NAMES = (NOMINAL.name, *(one.name for one in ALONE), "together", "everything")
"""Of all lines."""


def table(robot: Size, anymal: Size, payload: float | None = None) -> tuple[Disturbance, ...]:
    """Return all lines for a robot of that size: nothing, each alone, some together, everything. `anymal` is the size of the
    robot that they are written for; numbers that grow have two digits. A `payload` [kg] takes the place of the table's.
    """
    alone = [scaled(one, robot, anymal) for one in ALONE]
    if payload is not None:
        alone = [replace(one, payload=payload) if one.payload else one for one in alone]
    all_but = [one for one in alone if one.name not in WORST]
    together = combined("together", [one for one in alone if one.name in TOGETHER])
    return NOMINAL, *alone, together, combined("everything", all_but)


def scaled(one: Disturbance, robot: Size, anymal: Size) -> Disturbance:
    """Return a disturbance that is for one robot what `one` is for the robot that it is written for."""
    grow: dict[str, Any] = {
        name: float(f"{getattr(one, name) * grown(unit, anymal, robot):.2g}") for name, unit in UNITS.items()
    }
    return replace(one, **grow)


def combined(name: str, parts: Sequence[Disturbance]) -> Disturbance:
    """Return all that is wrong in any of `parts`, of which no two change the same."""
    return Disturbance(name, **{field: value for part in parts for field, value in part.changes.items()})
