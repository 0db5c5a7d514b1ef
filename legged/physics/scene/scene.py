"""What one world consists of, before any engine: a robot on a ground, or a model from a file that brings its own floor."""

from abc import ABC, abstractmethod
from typing import Literal

import mujoco
import numpy as np

from legged.config.schema import SimConfig
from legged.robots.robot import Robot
from legged.terrain import Terrain

GroundShapes = Literal["exact", "height_field", "none"]


class Scene(ABC):
    """What one world consists of."""

    name: str
    """How errors call it: a folder or a file."""
    robot: Robot | None = None
    """The robot with a floating base and feet, where there is one."""
    terrain: Terrain | None = None
    """The ground, where it is no plane."""

    @abstractmethod
    def model(self, sim: SimConfig, ground: GroundShapes = "exact", contact_sensors: bool = False) -> mujoco.MjModel:
        """Return the world as one MuJoCo model, with the solver options of `sim`.

        A terrain is made of height fields and boxes that are exactly its height map (`exact`), of one height field whose
        steps are ramps (`height_field`), or of a placeholder for a collider of our own (`none`). With `contact_sensors`,
        every collision shape of the robot gets a sensor `contact_<shape>`, the net force that the shape exerts, world frame
        [N].

        Raises:
            ConfigError: there is no such model, or it is none that the engines can simulate.
        """

    @abstractmethod
    def shapes(self, model: mujoco.MjModel) -> np.ndarray:
        """Return the geoms of `model` whose friction can be randomised, (S,)."""


def set_options(option: mujoco.MjOption, sim: SimConfig) -> None:
    """Lay the solver options of `sim` over those of a model.

    The integrator is semi-implicit Euler: with torques from an explicit PD law it needs nothing better, and it is what
    makes a step split exactly into torque and dynamics.
    """
    option.timestep = sim.dt
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.cone = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}[sim.cone]
    option.impratio = sim.impratio
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations = sim.iterations
    option.ls_iterations = sim.ls_iterations
