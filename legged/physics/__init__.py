"""Physics engines behind one interface. A new one is a file here and a line in `make_physics`."""

from importlib.util import find_spec

import torch

from legged.config.loader import ConfigError
from legged.config.schema import SimConfig
from legged.physics.base import Physics, RandomizedField, RobotState
from legged.robot import Robot
from legged.terrain import Terrain

__all__ = ["Physics", "RandomizedField", "RobotState", "engine_name", "make_physics", "resolve_physics"]


def resolve_physics(name: str, device: torch.device) -> str:
    """The back-end that `auto` means on a device: mujoco_warp on a GPU, the C engine without one.

    Raises:
        ConfigError: the C engine was asked for on a GPU, or an engine that is not installed.
    """
    if name == "auto":
        return "mujoco_warp" if device.type == "cuda" else "mujoco"
    if name == "mujoco" and device.type != "cpu":
        raise ConfigError(f"sim.physics: 'mujoco' is the C engine and runs on the CPU; add --sim_device cpu (got {device})")
    if name == "newton" and find_spec("newton") is None:
        raise ConfigError("sim.physics: 'newton' needs the package newton, which is not installed here: pip install newton")
    return name


def engine_name(sim: SimConfig, device: torch.device) -> str:
    """What files and tables call the engine: mujoco, mujoco_warp, or newton_<solver>."""
    engine = resolve_physics(sim.physics, device)
    return f"newton_{sim.solver}" if engine == "newton" else engine


def make_physics(
    robot: Robot, sim: SimConfig, num_envs: int, device: torch.device, terrain: Terrain | None = None
) -> Physics:
    """The back-end that `sim.physics` names, on a plane or on `terrain`. Engines are imported here, so that none is needed
    but the one used.
    """
    engine = resolve_physics(sim.physics, device)
    if engine == "newton":
        import legged.physics.warp_physics  # noqa: F401  (settings of Warp, before Newton declares its kernels)
        from legged.physics.newton import NewtonPhysics

        return NewtonPhysics(robot, sim, num_envs, device, terrain)
    if engine == "mujoco_warp":
        from legged.physics.mujoco_warp import MujocoWarpPhysics

        return MujocoWarpPhysics(robot, sim, num_envs, device, terrain)
    from legged.physics.mujoco import MujocoPhysics

    return MujocoPhysics(robot, sim, num_envs, device, terrain)
