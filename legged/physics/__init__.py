"""Physics engines behind one interface. A new one is a file here and a line in `make_physics`."""

from collections.abc import Callable, Collection
from importlib.util import find_spec
from pathlib import Path

import torch

from legged.config.schema import SimConfig
from legged.errors import ConfigError, suggest
from legged.physics.base import Physics
from legged.physics.fields import FIELDS, check_ranges
from legged.physics.quantities import check_quantities
from legged.physics.robot_state import RobotState
from legged.physics.scene import ModelScene, RobotScene, Scene
from legged.process.startup import importing

__all__ = [
    "FIELDS",
    "ModelScene",
    "Physics",
    "RobotScene",
    "RobotState",
    "Scene",
    "check_engine",
    "check_ranges",
    "engine_name",
    "kernel_cache",
    "make_physics",
    "resolve_physics",
]


def resolve_physics(name: str, device: torch.device, where: str = "sim.physics") -> str:
    """Return the engine that `auto` means on a device: mujoco_warp on a GPU, the C engine without one. `where` says who asks.

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


NEWTONS_FIELDS = ("friction", "added_base_mass")
"""What can be randomised in newton: its model has names and arrays of its own."""


def check_engine(
    scene: Scene,
    sim: SimConfig,
    device: torch.device,
    where: Callable[[str], str] = str,
    randomized: Collection[str] = (),
    quantities: Collection[str] = (),
) -> None:
    """Check that the engine of `sim.physics` can simulate a scene, randomise those fields and compute those quantities.
    `where` says who set a dotted path of the configuration.

    Raises:
        ConfigError: it cannot, or it is not installed, or not for this device.
        ValueError: there is no such field or quantity.
    """
    for field in randomized:
        if field not in FIELDS:
            raise ValueError(f"there is no field '{field}' to randomise{suggest(field, FIELDS, 'fields')}")
    check_quantities(quantities)
    if resolve_physics(sim.physics, device, where("sim.physics")) != "newton":
        return
    others = "sim.physics=mujoco_warp or mujoco"
    if not isinstance(scene, RobotScene):
        raise ConfigError(
            f"{where('sim.physics')}: newton simulates robots with a floating base, not {scene.name}; {others} take any"
        )
    if scene.robot.passive is not None:
        raise ConfigError(
            f"{where('sim.physics')}: newton does not simulate the joints of '{scene.robot.name}' that no motor drives"
            f" (passive_joints), and their loops; {others} do"
        )
    for field in randomized:
        if field not in NEWTONS_FIELDS:
            can = suggest(field, NEWTONS_FIELDS, "newton can")
            raise ConfigError(f"{where(f'domain_rand.ranges.{field}')}: newton cannot randomise it{can}; {others} can")
    if quantities:
        names = ", ".join(quantities)
        raise ConfigError(f"{where('sim.physics')}: newton does not compute {names} for the task; {others} does")


def make_physics(
    scene: Scene,
    sim: SimConfig,
    num_envs: int,
    device: torch.device,
    randomized: Collection[str] = (),
    quantities: Collection[str] = (),
    where: Callable[[str], str] = str,
) -> Physics:
    """Return `num_envs` worlds of `scene` in the engine that `sim.physics` names. Engines are imported here, so that none
    is needed but the one used.

    Args:
        scene: what a world consists of.
        sim: engine and solver.
        num_envs: number of worlds.
        device: where all tensors live.
        randomized: fields (`fields.FIELDS`) that `Physics.randomize` will be given.
        quantities: arrays of MuJoCo's data that `Physics.quantity` will be asked for.
        where: makes of a dotted path of the configuration how an error about it begins.

    Raises:
        ConfigError, ValueError: as `check_engine`.
    """
    check_engine(scene, sim, device, where, randomized, quantities)
    engine = resolve_physics(sim.physics, device)
    if engine == "newton":
        with importing():
            from legged.physics.newton.physics import NewtonPhysics

        assert isinstance(scene, RobotScene)
        return NewtonPhysics(scene, sim, num_envs, device, randomized)
    if engine == "mujoco_warp":
        with importing():
            from legged.physics.warp.mujoco_warp import MujocoWarpPhysics

        return MujocoWarpPhysics(scene, sim, num_envs, device, randomized, quantities)
    from legged.physics.mujoco import MujocoPhysics

    return MujocoPhysics(scene, sim, num_envs, device, randomized, quantities)


def kernel_cache() -> Path:
    """The folder in which Warp keeps compiled kernels."""
    from legged.physics.warp.compile import cache_folder

    return cache_folder()
