"""Physics engines behind one interface. A new one is a file here and a line in `make_physics`."""

from collections.abc import Collection
from importlib.util import find_spec
from pathlib import Path

import torch

from legged.config.schema import SimConfig
from legged.errors import ConfigError
from legged.physics.base import Physics, RandomizedField, RobotState
from legged.process.startup import importing
from legged.robots.robot import Robot
from legged.terrain import Terrain

__all__ = ["Physics", "RandomizedField", "RobotState", "engine_name", "kernel_cache", "make_physics", "resolve_physics"]


def resolve_physics(name: str, device: torch.device, where: str = "sim.physics") -> str:
    """The back-end that `auto` means on a device: mujoco_warp on a GPU, the C engine without one. `where` says who asks.

    Raises:
        ConfigError: the C engine was asked for on a GPU, or an engine that is not installed.
    """
    if name == "auto":
        return "mujoco_warp" if device.type == "cuda" else "mujoco"
    if name == "mujoco" and device.type != "cpu":
        raise ConfigError(f"{where}: 'mujoco' is the C engine and runs on the CPU; add --sim_device cpu (got {device})")
    if name == "newton" and find_spec("newton") is None:
        raise ConfigError(f"{where}: 'newton' needs the package newton, which is not installed here: pip install newton")
    return name


def engine_name(sim: SimConfig, device: torch.device, where: str = "sim.physics") -> str:
    """What files and tables call the engine: mujoco, mujoco_warp, or newton_<solver>. Raises as `resolve_physics`."""
    engine = resolve_physics(sim.physics, device, where)
    return f"newton_{sim.solver}" if engine == "newton" else engine


def make_physics(
    robot: Robot,
    sim: SimConfig,
    num_envs: int,
    device: torch.device,
    terrain: Terrain | None = None,
    randomized: Collection[RandomizedField] = (),
) -> Physics:
    """The back-end that `sim.physics` names, on a plane or on `terrain`. Engines are imported here, so that none is needed
    but the one used. What is `randomized` next may be compiled together with the rest; other fields take their time.
    """
    engine = resolve_physics(sim.physics, device)
    if engine == "newton":
        with importing():
            import legged.physics.warp.physics  # noqa: F401  (settings of Warp, before Newton declares its kernels)
            from legged.physics.newton.physics import NewtonPhysics

        return NewtonPhysics(robot, sim, num_envs, device, terrain)
    if engine == "mujoco_warp":
        with importing():
            from legged.physics.warp.mujoco_warp import MujocoWarpPhysics

        return MujocoWarpPhysics(robot, sim, num_envs, device, terrain, randomized)
    from legged.physics.mujoco import MujocoPhysics

    return MujocoPhysics(robot, sim, num_envs, device, terrain)


def kernel_cache() -> Path:
    """The folder in which Warp keeps compiled kernels."""
    from legged.physics.warp.compile import cache_folder

    return cache_folder()
