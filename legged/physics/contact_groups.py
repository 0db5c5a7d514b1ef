"""Groups of collision shapes between which contact forces are measured."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from legged.errors import ConfigError
from legged.robots.robot import Robot
from legged.robots.shapes import match_shapes

GROUND = "ground"
"""Name of the ground in a group of shapes."""


class ContactGroups(NamedTuple):
    """Two groups of shapes. A contact counts if one of its shapes is in the first group and the other is in the second."""

    first: tuple[str, ...]
    """Names of the robot's shapes and of the ground (`GROUND`). `second` likewise."""
    second: tuple[str, ...]
    steps: int
    """Number K of physics steps whose forces are kept."""

    @classmethod
    def of(
        cls, robot: Robot, groups: Iterable[Sequence[str]], steps: int, self_collisions: bool, where: str
    ) -> "ContactGroups":
        """Return two groups, each given as patterns of shapes (docs/robots.md) and `GROUND`.

        Raises:
            ConfigError: a group is empty, a pattern matches no colliding shape, or no contact counts without
                `sim.self_collisions`. `where` is the place of the groups.
        """
        shapes = robot.colliding(self_collisions)
        names, bodies = tuple(shapes), tuple(shapes.values())
        found = []
        for group in groups:
            on_ground = (GROUND,) if GROUND in group else ()
            patterns = [pattern for pattern in group if pattern != GROUND]
            found.append((*(names[i] for i in match_shapes(patterns, names, bodies, where)), *on_ground))
        first, second = found
        if not first or not second:
            raise ConfigError(f"{where}: a group is empty; it needs patterns of shapes, or '{GROUND}'")
        if not self_collisions and GROUND not in first + second:
            raise ConfigError(f"{where}: contacts between shapes of the robot need sim.self_collisions=true, got false")
        return cls(first, second, steps)

    def bits(self, shapes: Iterable[str]) -> np.ndarray:
        """Return a number for each of an engine's shapes, (S,): 1 for a shape of the first group plus 2 for a shape of the
        second. `shapes` are names; that of the ground is `GROUND`.
        """
        return np.array([(name in self.first) + 2 * (name in self.second) for name in shapes], dtype=np.int32)

    def add_sensors(self, spec: mujoco.MjSpec, robot: Robot, self_collisions: bool, name: str) -> None:
        """Add sensors of C MuJoCo that together measure the largest force between the groups (`sensor_columns`)."""
        kinds, names = mujoco.mjtObj, set(robot.colliding(self_collisions))

        def things(group: tuple[str, ...]) -> list[tuple[mujoco.mjtObj, str]]:
            of_robot = [(kinds.mjOBJ_GEOM, shape) for shape in group if shape != GROUND]
            if names <= set(group):
                of_robot = [(kinds.mjOBJ_XBODY, robot.file.base)]  # one sensor for the whole robot
            return [*of_robot, *([(kinds.mjOBJ_BODY, "world")] if GROUND in group else [])]

        for i, (kind, thing) in enumerate(things(self.first)):
            for k, (other_kind, other) in enumerate(things(self.second)):
                spec.add_sensor(
                    name=f"contact_of:{i}:{k}:{name}",
                    type=mujoco.mjtSensor.mjSENS_CONTACT,
                    objtype=kind,
                    objname=thing,
                    reftype=other_kind,
                    refname=other,
                    intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 2, 1],  # data: force, reduce: maxforce, num: 1
                )


def sensor_columns(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return the columns in sensordata of the sensors of two groups, (sensors, 3)."""
    sensors = [model.sensor(k) for k in range(model.nsensor)]
    return np.array([s.adr[0] + np.arange(3) for s in sensors if s.name.split(":", 3)[3:] == [name]])


def geom_names(model: mujoco.MjModel) -> list[str]:
    """Return the name of each geom, or `GROUND` if it is fixed to the world."""
    return [model.geom(i).name if model.geom_bodyid[i] else GROUND for i in range(model.ngeom)]


def zero_forces(groups: Mapping[str, ContactGroups], num_envs: int, device: torch.device) -> dict[str, Tensor]:
    """Return zeroed tensors for `Physics.group_forces`."""
    return {name: torch.zeros(num_envs, of.steps, device=device) for name, of in groups.items()}
