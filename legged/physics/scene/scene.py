"""Contents of one world, independent of the engine: a robot on a ground, or a file's model with its own floor."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import mujoco
import numpy as np

from legged.config.world import SimConfig
from legged.physics.contact_groups import ContactGroups
from legged.robots.robot import Robot
from legged.terrain import Terrain

GroundShapes = Literal["exact", "height_field", "none"]


class Scene(ABC):
    """Contents of one world."""

    name: str
    """Robot's folder or model's file, for error messages."""
    robot: Robot | None = None
    """Robot with a floating base and feet; None if the scene has no such robot."""
    terrain: Terrain | None = None
    """Terrain; None for a plane."""
    contact_groups: Mapping[str, ContactGroups] = MappingProxyType({})
    """Name -> two groups of shapes between which the engine measures contact forces (`Physics.group_forces`)."""

    @abstractmethod
    def model(self, sim: SimConfig, ground: GroundShapes = "exact", contact_sensors: bool = False) -> mujoco.MjModel:
        """Return the world as one MuJoCo model, with the solver options of `sim`.

        `ground` chooses the geometry of a terrain: height fields and boxes that match its height map exactly (`exact`), one
        height field whose steps are ramps (`height_field`), or a placeholder for the height-map collider (`none`). With
        `contact_sensors`, every collision shape of the robot gets a sensor `contact_<shape>`: the net force that the shape
        exerts, world frame [N]. Sensors for `contact_groups` are then added, too.

        Raises:
            ConfigError: the model does not exist, or the engines cannot simulate it.
        """

    @abstractmethod
    def shapes(self, model: mujoco.MjModel) -> np.ndarray:
        """Return the geoms of `model` whose friction can be randomised, (S,)."""


def set_options(option: mujoco.MjOption, sim: SimConfig) -> None:
    """Overwrite the solver options of a model with those of `sim`.

    The integrator is semi-implicit Euler, which suffices for torques that depend only on the state at a step's start.
    """
    option.timestep = sim.dt
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.cone = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}[sim.cone]
    option.impratio = sim.impratio
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations = sim.iterations
    option.ls_iterations = sim.ls_iterations
