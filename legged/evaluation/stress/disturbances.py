"""The stress test's table of disturbances, and a task whose robots have these disturbances."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from legged.config import LeggedConfig, override
from legged.envs import LeggedRobot
from legged.math import quat_rotate
from legged.mdp.height_map_errors import HeightMapErrors, is_exact
from legged.mdp.random_pool import RandomPool
from legged.mdp.sensors.height_scan import HeightScan
from legged.physics import FIELDS, Scene
from legged.registry import task_class
from legged.robots.similarity import Size, grown
from legged.terrain import Terrain

WRITTEN_FOR = "anymal_c"
"""Robot for which the numbers of the table are written. For other robots these numbers are scaled."""

PUSH_INTERVAL = 5.0
"""Time between two pushes of a robot [s]."""


def _told(text: str, unit: str = "", default: float | None = 0.0) -> Any:
    """Return a dataclass field. `text` describes its value, with `{}` in place of the value. A value with a `unit` is scaled
    to the robot's size. Delays, angles and shares are not scaled, so they have no `unit`.
    """
    return field(default=default, metadata={"text": text, "unit": unit})


@dataclass(frozen=True)
class Disturbance:
    """Disturbances of one robot, its sensors and its motors. In the fields, "either way" means that the sign is random."""

    name: str
    payload: float = _told("{:g} kg on the base", "kg")
    """Mass added to the base, at its centre of mass [kg]."""
    friction: float | None = _told("friction {:g}", default=None)
    """Coefficient of sliding friction of all contacts of the robot [1]. None keeps the nominal friction."""
    motors: float = _told("motors at {:.0%}", default=1.0)
    """Factor on every motor's torque and torque limit [1]."""
    delay: float = _told("targets {:g} s late")
    """Delay of the targets on the way to the motors [s]."""
    push: float = _told(f"velocity set to up to {{:g}} m/s every {PUSH_INTERVAL:g} s", "m/s")
    """Largest velocity that a push gives the base along the world's x and y, either way [m/s]. The velocity is random."""
    zero_offset: float = _told("encoders up to {:g} rad off")
    """Largest random error of the encoders, either way [rad]. Policy and motors both use the wrong angles."""
    tilt: float = _told("inertial sensor askew by {:g} rad")
    """Tilt of the inertial sensor about a random horizontal axis [rad]."""
    map_height: float = _told("height map {:g} m too high or low", "m")
    """Vertical error of the height map, either way [m]."""
    map_shift: float = _told("height map shifted by {:g} m", "m")
    """Horizontal error of the height map, in a random direction [m]."""
    map_holes: float = _told("{:.0%} of the height map missing")
    """Share of the height map's points that are missing [1]. Missing points read 0, like level ground."""

    @property
    def changes(self) -> dict[str, float]:
        """Return name of a field -> its value, for the fields that do not have their default value."""
        return {one.name: getattr(self, one.name) for one in fields(self)[1:] if getattr(self, one.name) != one.default}

    @property
    def text(self) -> str:
        """Return the disturbances as text, in physical units."""
        told = {one.name: one.metadata["text"] for one in fields(self)[1:]}
        return ", ".join(told[name].format(value) for name, value in self.changes.items()) or "nothing"


GIVEN = ("friction", "added_base_mass", "motor_strength", "joint_offset")
"""Properties in domain_rand.ranges that the disturbances set."""
MOST = ("push", "map_height", "map_shift", "map_holes")
"""Disturbances whose largest value over all robots is set in the task's configuration."""
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
"""Single disturbances, with numbers for an ANYmal C."""
TOGETHER = ("payload", "friction", "weak motors", "delay 20 ms")
"""Disturbances that the line `together` combines. They are common on hardware."""
WORST = ("delay 40 ms", "no map")
"""Disturbances that the line `everything` leaves out. This line has weaker disturbances of the same kinds."""

NAMES = (NOMINAL.name, *(one.name for one in ALONE), "together", "everything")
"""Names of all lines of the table."""


def table(robot: Size, anymal: Size, payload: float | None = None) -> tuple[Disturbance, ...]:
    """Return all lines of the table for a robot of the size `robot`: no disturbance, each of ALONE, `together`, `everything`.
    Numbers are scaled from the size `anymal` and rounded to two digits. A `payload` [kg] replaces the payload in ALONE.
    """
    alone = [scaled(one, robot, anymal) for one in ALONE]
    if payload is not None:
        alone = [replace(one, payload=payload) if one.payload else one for one in alone]
    all_but = [one for one in alone if one.name not in WORST]
    together = combined("together", [one for one in alone if one.name in TOGETHER])
    return NOMINAL, *alone, together, combined("everything", all_but)


def scaled(one: Disturbance, robot: Size, anymal: Size) -> Disturbance:
    """Return the disturbance `one`, scaled from the size `anymal` to the size `robot`."""
    grow: dict[str, Any] = {
        of.name: float(f"{getattr(one, of.name) * grown(of.metadata['unit'], anymal, robot):.2g}")
        for of in fields(one)[1:]
        if of.metadata["unit"]
    }
    return replace(one, **grow)


def combined(name: str, parts: Sequence[Disturbance]) -> Disturbance:
    """Return the disturbance `name` with the changed fields of all `parts`. Two parts must not change the same field."""
    return Disturbance(name, **{key: value for part in parts for key, value in part.changes.items()})


# ---- the task --------------------------------------------------------------------------------------------------------


def declared(rows: Sequence[Disturbance]) -> list[tuple[str, Any]]:
    """Return overrides that enable the disturbances of all `rows` in a task. `StressedTask` then gives each robot its own
    values.
    """
    given = {"friction": True, "added_base_mass": True}
    given |= {"motor_strength": any(row.motors != 1.0 for row in rows), "joint_offset": any(row.zero_offset for row in rows)}
    push, offset, shift, holes = (max(getattr(row, name) for row in rows) for name in MOST)
    none = {"drift": 0.0, "shift_drift": 0.0, "lost": 0.0}
    changes: list[tuple[str, Any]] = [
        ("domain_rand.ranges", {name: [FIELDS[name].neutral] * 2 for name, wanted in given.items() if wanted}),
        ("observations.height_map", {"offset": offset, "shift": shift, "holes": holes, **none}),
    ]
    if push > 0.0:
        changes += [
            ("domain_rand.push_robots", True),
            ("domain_rand.push_interval_s", PUSH_INTERVAL),
            ("domain_rand.max_push_vel_xy", push),
        ]
    return changes


def late(rows: Sequence[Disturbance], cfg: LeggedConfig) -> list[tuple[str, Any]]:
    """Return overrides that make the delay buffer of a task long enough for all `rows` and keep each delay constant."""
    most = max(cfg.control.actuator.delay[1], *(round(row.delay / cfg.sim.dt) for row in rows))
    return [("control.actuator.delay", [most] * 2), ("control.actuator.delay_varies", False)] if most else []


def make_stressed(
    rows: Sequence[Disturbance], cfg: LeggedConfig, device: torch.device, graph: bool, terrain: Terrain | None
) -> "StressedTask":
    """Build the task of `cfg` with N robots. Robot i has the disturbance rows[i]."""
    kind: Any = task_class(cfg.task)
    own = {"rows": tuple(rows), "own_delay": cfg.control.actuator.delay, "__module__": __name__}
    stressed: Any = type(f"Stressed{kind.__name__}", (StressedTask, kind), own)
    other_ground = {} if terrain is None else {"terrain": terrain}  # a user-defined task may lack this argument
    return stressed(override(cfg, late(rows, cfg)), device, graph, **other_ground)  # type: ignore[no-any-return]


class GivenMap(HeightMapErrors):
    """Errors of a height map. Their values are given instead of random, and are the same in every episode."""

    given: tuple[Tensor, Tensor]
    """Given values of `error` and `holes`."""

    def advance(self, begun: Tensor) -> None:
        for own, given in zip((self.error, self.holes), self.given, strict=True):
            own.copy_(given[:, : own.shape[1]])


class StressedTask(LeggedRobot):
    """A mix-in that gives each robot its own disturbance. The mix-in is the first base class, before the task's class. The
    disturbances' random numbers come from a separate generator, so the task's other random numbers stay the same.
    """

    rows: tuple[Disturbance, ...] = ()
    """Disturbance of each of the N robots."""
    own_delay: tuple[int, int] = (0, 0)
    """The task's range of delays [physics steps], for robots whose row has no delay."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Build the task, then set the disturbed properties of each robot in the control and in the physics."""
        super().__init__(*args, **kwargs)
        given = {"added_base_mass": self._per_robot("payload"), "motor_strength": self._per_robot("motors")}
        given |= {"friction": self._frictions(), "joint_offset": self.zero_offset}
        given = {name: values for name, values in given.items() if name in self.cfg.domain_rand.ranges}
        self.control.vary(given)
        for name, values in given.items():
            if FIELDS[name].changes:
                self.physics.randomize(name, values)
        self.reset()

    def _per_robot(self, name: str) -> Tensor:
        values = [float(getattr(row, name)) for row in self.rows]
        return torch.tensor(values, dtype=torch.float32, device=torch.device(self.device))

    def make_scene(self) -> Scene:
        self._scene = super().make_scene()
        return self._scene

    def _frictions(self) -> Tensor:
        """Return the friction of each robot (N,), or of each shape (N, shapes) if shapes differ in their nominal friction."""
        model = self.physics.model
        own = [float(value) for value in model.geom_friction[FIELDS["friction"].rows(self._scene, model), 0]]
        shapes = own[:1] if len(set(own)) == 1 else own
        values = [[value if row.friction is None else row.friction for value in shapes] for row in self.rows]
        return torch.tensor(values, dtype=torch.float32, device=torch.device(self.device)).squeeze(1)

    def _init_buffers(self) -> None:
        super()._init_buffers()
        n, device = self.num_envs, torch.device(self.device)
        random = torch.Generator().manual_seed(self.cfg.env.seed)

        def draw(*shape: int) -> Tensor:
            """Return uniform random numbers from -1 to 1, (N, *shape), which are the same on every device."""
            return (2.0 * torch.rand(n, *shape, generator=random) - 1.0).to(device)

        self._pushed = self._per_robot("push") > 0.0
        self.zero_offset = self._per_robot("zero_offset").unsqueeze(1) * draw(self.robot.num_dof)
        """(N, D) error of the encoders [rad]."""
        half, axis = 0.5 * self._per_robot("tilt"), torch.pi * draw()
        level = (half.sin() * axis.cos(), half.sin() * axis.sin())
        self._mounting = torch.stack([half.cos(), *level, torch.zeros_like(half)], dim=1)
        direction, sign = torch.pi * draw(), torch.where(draw() < 0.0, -1.0, 1.0)
        shift = self._per_robot("map_shift")
        self._map_error = torch.stack(
            [shift * direction.cos(), shift * direction.sin(), sign * self._per_robot("map_height")], dim=1
        )
        points = self.measured_heights.shape[1]
        self._map_holes = 0.5 * (draw(points) + 1.0) < self._per_robot("map_holes").unsqueeze(1)
        if self.control.actuator is not None and self.control.actuator.line.longest:
            steps = (self._per_robot("delay") / self.cfg.sim.dt).round()
            low, high = self.own_delay
            own = (low + 0.5 * (draw() + 1.0) * (high + 1 - low)).floor().clamp_(max=high)
            self.control.actuator.delay.copy_(torch.where(steps > 0.0, steps, own))

    def make_height_map(self) -> HeightMapErrors | None:
        """Return the height map's errors for the robots' disturbances, or None if the height map is exact."""
        cfg, n, pose = self.cfg.observations.height_map, self.num_envs, (self.base_pos, self.base_quat)
        if is_exact(cfg):
            return None
        scan = self.height_scan
        if cfg.shift:
            scan = HeightScan(self.cfg.terrain, self.terrain, pose, self.kernels)
        numbers = RandomPool(n, torch.device(self.device))
        found = GivenMap(cfg, scan, pose, self.heights_seen, self.dt, numbers)
        found.given = self._map_error, self._map_holes
        return found

    def disturb(self, mask: Tensor) -> None:
        super().disturb(mask & self._pushed)

    def _obs_projected_gravity(self) -> Tensor:
        return quat_rotate(self._mounting, super()._obs_projected_gravity())

    def _obs_base_ang_vel(self) -> Tensor:
        return quat_rotate(self._mounting, super()._obs_base_ang_vel())
