"""Robot and ground -> a Newton model of N worlds, and where the robot's parts are in it."""

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np

from legged.config.schema import SimConfig
from legged.errors import ConfigError
from legged.physics.newton.solvers import SolverSetup
from legged.physics.scene.robot_scene import robot_source
from legged.physics.scene.terrain_geoms import DEPTH, lattice_heights
from legged.robots.robot import Robot
from legged.robots.robot_model import FLOOR
from legged.terrain import Terrain


@dataclass(frozen=True)
class Layout:
    """Indices within one world. Newton names bodies, joints and shapes by their path in the MJCF, in its own order."""

    bodies: int
    coords: int
    dofs: int
    num_shapes: int
    base: int
    """The floating body."""
    shapes: np.ndarray
    """(S,) collision shapes, in the robot's order."""
    root_q: int
    """First of the free joint's coordinates: position, then orientation (x, y, z, w)."""
    root_qd: int
    """First of its velocities: of the base's centre of mass, then angular, both in the world frame."""
    dof_q: np.ndarray
    """(D,) coordinates of the joints, in the robot's order."""
    dof_qd: np.ndarray
    """(D,) velocities of the joints."""

    @classmethod
    def of(cls, world: newton.ModelBuilder, robot: Robot) -> "Layout":
        """The layout of a builder that holds one robot and nothing else."""
        bodies, joints, shapes = (
            {label.rpartition("/")[2]: i for i, label in enumerate(labels)}
            for labels in (world.body_label, world.joint_label, world.shape_label)
        )
        root = world.joint_type.index(newton.JointType.FREE)
        hinges = [joints[name] for name in robot.joint_names]
        return cls(
            bodies=world.body_count,
            coords=world.joint_coord_count,
            dofs=world.joint_dof_count,
            num_shapes=world.shape_count,
            base=bodies[robot.file.base],
            shapes=np.array([shapes[name] for name in robot.shape_names]),
            root_q=world.joint_q_start[root],
            root_qd=world.joint_qd_start[root],
            dof_q=np.array([world.joint_q_start[i] for i in hinges]),
            dof_qd=np.array([world.joint_qd_start[i] for i in hinges]),
        )


def build_newton_model(
    robot: Robot, setup: SolverSetup, sim: SimConfig, num_envs: int, terrain: Terrain | None, device: Any
) -> tuple[newton.Model, Layout]:
    """N robots from the robot's MJCF on one ground that all of them share: a plane, or the height map as one field of
    points, where steps are ramps one cell wide. Where our collider takes its place (`meets_cells`), a plane far below
    stands for it. `device` is Warp's.

    Raises:
        ConfigError: the robot has meshes, which Newton cannot read here.
    """
    world = _builder(setup)
    # Which shapes may touch is written in the model, and Newton reads it when it reads the model.
    source = robot_source(robot, sim.self_collisions)
    try:
        world.add_mjcf(source, enable_self_collisions=sim.self_collisions, parse_visuals=False, parse_sites=False)
    except ModuleNotFoundError as error:
        needs = f"to read its meshes newton needs the package {error.name}, which is not installed here"
        raise ConfigError(f"{robot.model_path}: {needs}: pip install {error.name}") from error
    for shape in range(world.shape_count):
        world.shape_gap[shape] = setup.gap
        if setup.springs is not None:
            world.shape_material_ke[shape], world.shape_material_kd[shape], world.shape_material_kf[shape] = setup.springs
    layout = Layout.of(world, robot)
    scene = _builder(setup)
    scene.replicate(world, num_envs)
    # The ground is no part of a world: within one MJCF without self-collisions nothing would touch it.
    ground = newton.ModelBuilder.ShapeConfig(gap=setup.gap, mu=0.0 if setup.averages_friction else 1.0)
    if setup.springs is not None:
        ground.ke, ground.kd, ground.kf = setup.springs
    if terrain is None:
        scene.add_ground_plane(cfg=ground, label=FLOOR)
    elif meets_cells(setup, sim):
        scene.add_ground_plane(height=float(terrain.height_map.corners.min()) - DEPTH, cfg=ground, label=FLOOR)
    else:
        _add_height_field(scene, terrain, ground)
    model = scene.finalize(device)
    friction = model.shape_material_mu.numpy()
    model.shape_material_mu.assign(friction * setup.friction_factor)
    return model, layout


def meets_cells(setup: SolverSetup, sim: SimConfig) -> bool:
    """Whether a height map is met by our own collider, which appends to mujoco-warp's contacts."""
    return setup.own_contacts and sim.terrain_collider == "cells"


def _builder(setup: SolverSetup) -> newton.ModelBuilder:
    """An empty builder that knows the solver's own attributes, and MuJoCo's, which the MJCF fills."""
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    if setup.register is not None:
        setup.register(builder)
    return builder


def _add_height_field(scene: newton.ModelBuilder, terrain: Terrain, cfg: newton.ModelBuilder.ShapeConfig) -> None:
    ground = terrain.height_map
    heights = lattice_heights(ground).T  # rows lie along y
    half = [0.5 * (n - 1) * ground.cell for n in heights.shape]
    field = newton.Heightfield(heights, *heights.shape, hx=half[1], hy=half[0])
    middle = (ground.origin[0] + half[1], ground.origin[1] + half[0], 0.0)
    scene.add_shape_heightfield(heightfield=field, xform=(*middle, 0.0, 0.0, 0.0, 1.0), cfg=cfg, label=FLOOR)
