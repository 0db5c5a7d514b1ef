"""Newton model of N worlds, and the indices of the robot's parts in it."""

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np

from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.physics.newton.solvers import SolverSetup
from legged.physics.scene.robot_scene import robot_source
from legged.physics.scene.terrain_geoms import DEPTH, lattice_heights
from legged.robots.reserved_names import FLOOR
from legged.robots.robot import Robot
from legged.terrain import Terrain


@dataclass(frozen=True)
class Layout:
    """Counts and indices in one world. Newton names bodies, joints and shapes by MJCF path, and has its own order of them."""

    bodies: int
    coords: int
    dofs: int
    num_shapes: int
    base: int
    """Index of the floating body."""
    shapes: np.ndarray
    """(S,) indices of the collision shapes, in the robot's order."""
    root_q: int
    """Index of the free joint's first coordinate. The joint has a position, then an orientation (x, y, z, w)."""
    root_qd: int
    """Index of the free joint's first velocity. The joint has the linear velocity of the base's centre of mass, then the
    angular velocity, both in the world frame."""
    dof_q: np.ndarray
    """(D,) indices of the joints' coordinates, in the robot's order."""
    dof_qd: np.ndarray
    """(D,) indices of the joints' velocities."""

    @classmethod
    def of(cls, world: newton.ModelBuilder, robot: Robot) -> "Layout":
        """Return the layout of a builder that holds one robot and nothing else."""
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
    """Return a model of N robots from the robot's MJCF, and its layout. All robots share one ground: a plane, or the height
    map as one height field whose steps are ramps one cell wide. With the height-map collider (`uses_cell_collider`), the
    ground is only a placeholder, a plane far below. `device` is a Warp device.

    Raises:
        ConfigError: the robot has meshes, and a package that Newton needs to read them is not installed.
    """
    world = _builder(setup)
    # Newton reads collision types from the MJCF. `robot_source` returns an MJCF that contains them.
    source = robot_source(robot, sim.self_collisions)
    try:
        world.add_mjcf(source, enable_self_collisions=sim.self_collisions, parse_visuals=False, parse_sites=False)
    except ModuleNotFoundError as error:
        needs = f"newton needs the package {error.name} to read the robot's meshes, but it is not installed here"
        raise ConfigError(f"{robot.model_path}: {needs}; run `pip install {error.name}`") from error
    for shape in range(world.shape_count):
        world.shape_gap[shape] = setup.gap
        if setup.springs is not None:
            world.shape_material_ke[shape], world.shape_material_kd[shape], world.shape_material_kf[shape] = setup.springs
    layout = Layout.of(world, robot)
    scene = _builder(setup)
    scene.replicate(world, num_envs)
    # The ground belongs to no world, because without self-collisions, shapes of the same world do not collide.
    ground = newton.ModelBuilder.ShapeConfig(gap=setup.gap, mu=0.0 if setup.averages_friction else 1.0)
    if setup.springs is not None:
        ground.ke, ground.kd, ground.kf = setup.springs
    if terrain is None:
        scene.add_ground_plane(cfg=ground, label=FLOOR)
    elif uses_cell_collider(setup, sim):
        scene.add_ground_plane(height=float(terrain.height_map.corners.min()) - DEPTH, cfg=ground, label=FLOOR)
    else:
        _add_height_field(scene, terrain, ground)
    model = scene.finalize(device)
    friction = model.shape_material_mu.numpy()
    model.shape_material_mu.assign(friction * setup.friction_factor)
    return model, layout


def uses_cell_collider(setup: SolverSetup, sim: SimConfig) -> bool:
    """Return True if the height-map collider, which appends to mujoco-warp's contacts, replaces Newton's height field."""
    return setup.own_contacts and sim.terrain_collider == "cells"


def _builder(setup: SolverSetup) -> newton.ModelBuilder:
    """Return an empty builder with the solver's attributes, and with MuJoCo's attributes, which the MJCF sets."""
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    if setup.register is not None:
        setup.register(builder)
    return builder


def _add_height_field(scene: newton.ModelBuilder, terrain: Terrain, cfg: newton.ModelBuilder.ShapeConfig) -> None:
    ground = terrain.height_map
    heights = lattice_heights(ground).T  # the row index counts along y
    half = [0.5 * (n - 1) * ground.cell for n in heights.shape]
    field = newton.Heightfield(heights, *heights.shape, hx=half[1], hy=half[0])
    middle = (ground.origin[0] + half[1], ground.origin[1] + half[0], 0.0)
    scene.add_shape_heightfield(heightfield=field, xform=(*middle, 0.0, 0.0, 0.0, 1.0), cfg=cfg, label=FLOOR)
