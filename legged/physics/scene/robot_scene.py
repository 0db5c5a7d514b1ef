"""A robot on a plane or a terrain: its shapes, the ground, and contact sensors."""

from collections.abc import Mapping

import mujoco
import numpy as np

from legged.config.world import SimConfig
from legged.physics.contact_groups import ContactGroups
from legged.physics.scene.scene import GroundShapes, Scene, set_options
from legged.physics.scene.terrain_geoms import add_height_field, add_terrain
from legged.robots.importing.convert import is_plain_file, robot_spec_of
from legged.robots.reserved_names import FLOOR
from legged.robots.robot import Robot
from legged.terrain import Terrain

UNTOUCHED = 1 << 30
"""Collision type of a geom that collides with nothing. Without a collision type, MuJoCo would discard the geom as visual."""
ROBOT, GROUND = 1, 2
"""Collision types: one bit each in MuJoCo's contype and conaffinity."""


def robot_spec(robot: Robot, self_collisions: bool) -> mujoco.MjSpec:
    """Return the robot's model without a ground. It differs from the robot's file as follows. Shapes collide with the ground;
    with `self_collisions`, they also collide with each other unless their bodies are neighbours. Contacts with the ground use
    the friction of the robot's shapes, because this friction can be randomised. Joints have the rotor inertias of `robot`.
    """
    spec = robot_spec_of(robot.model_path)
    for name, armature in zip(robot.joint_names, robot.armature, strict=True):
        spec.joint(name).armature = armature
    shapes = robot.colliding(self_collisions)
    for geom in spec.geoms:
        if geom.name in shapes:
            geom.contype, geom.conaffinity = ROBOT, GROUND | ROBOT if self_collisions else GROUND
            if geom.priority < 1:  # without priority, MuJoCo takes the larger friction of the two shapes
                geom.priority, geom.condim = 1, max(geom.condim, 3)
    if not self_collisions:
        for pair in list(spec.pairs):  # explicit pairs collide whatever their collision types are
            spec.delete(pair)
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    return spec


def robot_source(robot: Robot, self_collisions: bool) -> str:
    """Return the robot for an engine that parses MJCF: the path of the robot's file, or an MJCF text if the file alone does
    not describe the robot as `robot_spec` does.
    """
    own = robot_spec_of(robot.model_path)
    before = _settings(own, robot)
    spec = robot_spec(robot, self_collisions)
    same = before == _settings(spec, robot) and len(own.pairs) == len(spec.pairs)
    if same and is_plain_file(robot.model_path):
        return str(robot.model_path)
    for folder in ("meshdir", "texturedir"):
        setattr(spec, folder, str((robot.model_path.parent / getattr(spec, folder)).resolve()))
    return str(spec.to_xml())


def body_names(robot: Robot) -> list[str]:
    """Return the names of a robot's bodies as in its model."""
    return [body.name for body in robot_spec_of(robot.model_path).bodies if body.name and body.name != "world"]


def _settings(spec: mujoco.MjSpec, robot: Robot) -> tuple[dict[str, tuple[int, int, int, int]], list[float]]:
    shapes = {geom.name: (geom.contype, geom.conaffinity, geom.priority, geom.condim) for geom in spec.geoms}
    return shapes, [float(spec.joint(name).armature) for name in robot.joint_names]


def contact_sensor_columns(model: mujoco.MjModel, robot: Robot) -> tuple[int, int]:
    """Return the first column of the contact sensors in sensordata, and the column after the last. A shape has 3 columns."""
    start = int(model.sensor(f"contact_{robot.shape_names[0]}").adr[0])
    return start, start + 3 * len(robot.shape_names)


class RobotScene(Scene):
    """A robot with a floating base on a plane, or on a terrain."""

    robot: Robot

    def __init__(
        self, robot: Robot, terrain: Terrain | None = None, contact_groups: Mapping[str, ContactGroups] | None = None
    ) -> None:
        """Put `robot` on `terrain`, or on a horizontal plane. Forces between `contact_groups` are measured."""
        self.robot, self.terrain, self.name = robot, terrain, str(robot.folder)
        self.contact_groups = contact_groups or {}

    def model(self, sim: SimConfig, ground: GroundShapes = "exact", contact_sensors: bool = False) -> mujoco.MjModel:
        robot, terrain = self.robot, self.terrain
        spec = robot_spec(robot, sim.self_collisions)
        spec.compiler.discardvisual = True  # pictures are rendered from another model
        set_options(spec.option, sim)
        # The ground keeps the default condim and friction. Contacts take both from the robot's shapes, which have priority.
        if terrain is None or ground == "none":
            touches = terrain is None
            spec.worldbody.add_geom(
                name=FLOOR,
                type=mujoco.mjtGeom.mjGEOM_PLANE,
                size=[0, 0, 1],
                contype=GROUND if touches else UNTOUCHED,
                conaffinity=ROBOT if touches else 0,
                group=0,
            )
        elif ground == "height_field":
            add_height_field(spec, terrain.height_map)
        else:
            add_terrain(spec, terrain)
        for name in robot.shape_names if contact_sensors else ():
            spec.add_sensor(
                name=f"contact_{name}",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname=name,
                intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1],  # data: force, reduce: netforce, num: 1
            )
        for name, groups in self.contact_groups.items() if contact_sensors else ():
            groups.add_sensors(spec, robot, sim.self_collisions, name)
        return spec.compile()

    def shapes(self, model: mujoco.MjModel) -> np.ndarray:
        """Return the robot's collision shapes (S,), in the robot's order. Contacts with the ground use their friction."""
        return np.array([model.geom(name).id for name in self.robot.shape_names])
