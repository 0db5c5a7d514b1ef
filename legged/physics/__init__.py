"""Physics engines behind one interface. To add an engine, add a module here and a branch in `make_physics`."""

from collections.abc import Callable, Collection
from importlib.util import find_spec
from pathlib import Path

import torch

from legged.config.world import SimConfig
from legged.errors import ConfigError, suggest
from legged.physics.base import Physics
from legged.physics.contact_groups import GROUND, ContactGroups
from legged.physics.fields import FIELDS, NEWTONS_FIELDS, row_counts
from legged.physics.quantities import check_quantities
from legged.physics.randomized_model import check_ranges
from legged.physics.robot_state import RobotState
from legged.physics.scene import ModelScene, RobotScene, Scene
from legged.process.startup import importing

__all__ = [
    "FIELDS",
    "GROUND",
    "MANY_WORLDS",
    "ContactGroups",
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
    "row_counts",
]


MANY_WORLDS = 256
"""Smallest number of worlds for which `auto` chooses mujoco_warp on a CPU. With fewer worlds, mujoco_warp's faster steps save
less time than compiling its kernels takes."""


def resolve_physics(name: str, device: torch.device, where: str = "sim.physics", num_envs: int = 1) -> str:
    """Return the name of the engine that runs on a device. `auto` means mujoco_warp on a GPU, or on a CPU with at least
    `MANY_WORLDS` worlds; otherwise it means the C engine. Error messages begin with `where`, the setting's dotted path.

    On a CPU, only mujoco_warp's fused step is faster than the C engine. If the fused step does not support a model, `auto`
    makes `make_physics` return the C engine.

    Raises:
        ConfigError: the C engine was requested on a GPU, or the requested engine is not installed.
    """
    if name == "auto":
        return "mujoco_warp" if device.type == "cuda" or num_envs >= MANY_WORLDS else "mujoco"
    if name == "mujoco" and device.type != "cpu":
        raise ConfigError(f"{where}: 'mujoco' is the C engine and runs on the CPU; add --sim-device cpu (got {device})")
    if name == "newton" and find_spec("newton") is None:
        raise ConfigError(f"{where}: 'newton' needs the package newton, which is not installed here: pip install newton")
    return name


def engine_name(sim: SimConfig, device: torch.device, where: str = "sim.physics", num_envs: int = 1) -> str:
    """Return the name of the engine for files and tables: mujoco, mujoco_warp, or newton_<solver>.

    Raises:
        ConfigError: see `resolve_physics`.
    """
    engine = resolve_physics(sim.physics, device, where, num_envs)
    return f"newton_{sim.solver}" if engine == "newton" else engine


def check_engine(
    scene: Scene,
    sim: SimConfig,
    device: torch.device,
    where: Callable[[str], str] = str,
    randomized: Collection[str] = (),
    quantities: Collection[str] = (),
) -> None:
    """Check that the engine of `sim.physics` can simulate a scene, randomise the fields `randomized` and compute
    `quantities`. `where` maps a dotted path of the configuration to the beginning of an error message.

    Raises:
        ConfigError: the engine cannot do this, is not installed, or does not run on the device.
        ValueError: a quantity does not exist.
    """
    check_quantities(quantities)
    if resolve_physics(sim.physics, device, where("sim.physics")) != "newton":
        return
    others = "sim.physics=mujoco_warp or mujoco"
    if not isinstance(scene, RobotScene):
        raise ConfigError(
            f"{where('sim.physics')}: newton simulates robots with a floating base, not {scene.name}; use {others}"
        )
    if scene.robot.passive is not None:
        raise ConfigError(
            f"{where('sim.physics')}: newton does not simulate the joints of '{scene.robot.name}' that no motor drives"
            f" (passive_joints) or the loops that they close; use {others}"
        )
    for field in randomized:
        if sim.solver != "mujoco" and field not in NEWTONS_FIELDS:
            can = suggest(field, NEWTONS_FIELDS, "newton can")
            path = where(f"domain_rand.ranges.{field}")
            raise ConfigError(f"{path}: newton's {sim.solver} cannot randomise it{can}; use sim.solver=mujoco or {others}")
    if quantities:
        names = ", ".join(quantities)
        raise ConfigError(f"{where('sim.physics')}: newton does not compute {names} for the task; use {others}")


def make_physics(
    scene: Scene,
    sim: SimConfig,
    num_envs: int,
    device: torch.device,
    randomized: Collection[str] = (),
    quantities: Collection[str] = (),
    where: Callable[[str], str] = str,
    pushed: bool = False,
    launches: Collection[Callable[[], object]] = (),
) -> Physics:
    """Return `num_envs` worlds of `scene` in the engine that `sim.physics` names. Only the requested engine is imported.

    Args:
        scene: contents of one world.
        sim: engine, solver and their settings.
        num_envs: number of worlds.
        device: device of all tensors.
        randomized: fields (`fields.FIELDS`) that `Physics.randomize` will receive.
        quantities: arrays of MuJoCo's data that `Physics.quantity` will return.
        where: maps a dotted path of the configuration to the beginning of an error message.
        pushed: True if the task applies external forces to bodies (`Physics.forces`).
        launches: functions that launch the task's own kernels. Engines in Warp compile these kernels together with theirs.

    Raises:
        ConfigError, ValueError: see `check_engine`.
    """
    check_engine(scene, sim, device, where, randomized, quantities)
    engine = resolve_physics(sim.physics, device, num_envs=num_envs)
    why_c_engine = ""
    if engine == "newton":
        with importing():
            from legged.physics.newton.physics import NewtonPhysics

        assert isinstance(scene, RobotScene)
        return NewtonPhysics(scene, sim, num_envs, device, randomized, pushed, launches)
    if engine == "mujoco_warp":
        with importing():
            from legged.physics.warp.mujoco_warp import MujocoWarpPhysics, NoBlocks

        if sim.physics == "mujoco_warp" or device.type == "cuda":
            return MujocoWarpPhysics(scene, sim, num_envs, device, randomized, quantities, False, pushed, launches)
        try:
            return MujocoWarpPhysics(scene, sim, num_envs, device, randomized, quantities, True, pushed, launches)
        except (NoBlocks, ConfigError) as reason:
            why_c_engine = str(reason)
    from legged.physics.mujoco import MujocoPhysics

    physics = MujocoPhysics(scene, sim, num_envs, device, randomized, quantities, pushed)
    physics.why_c_engine = why_c_engine
    return physics


def kernel_cache() -> Path:
    """Return the folder in which Warp keeps compiled kernels."""
    from legged.physics.warp.compile import cache_folder

    return cache_folder()
