"""Robot, ground, sensors and solver options -> one MjModel that every MuJoCo back-end runs."""

from typing import Literal

import mujoco

from legged.config.schema import SimConfig
from legged.physics.terrain_geoms import add_height_field, add_terrain
from legged.robot import Robot
from legged.terrain import Terrain

FLOOR = "floor"
"""The ground's geom, where it is a plane or stands for a height map that mujoco-warp does not collide with itself."""
UNTOUCHED = 1 << 30
"""A collision type that nothing collides with, of a shape that is no mere decoration."""
GroundShapes = Literal["exact", "height_field", "none"]


def robot_spec(robot: Robot, self_collisions: bool) -> mujoco.MjSpec:
    """The robot alone; with `self_collisions` its shapes touch each other, except those of neighbouring bodies."""
    spec = mujoco.MjSpec.from_file(str(robot.model_path))
    if self_collisions:
        for geom in spec.geoms:
            if geom.name in robot.contact_names:
                geom.conaffinity |= geom.contype
    return spec


def build_model(
    robot: Robot,
    sim: SimConfig,
    terrain: Terrain | None = None,
    ground: GroundShapes = "exact",
    contact_sensors: bool = False,
) -> mujoco.MjModel:
    """The scene of one world, on a plane or on `terrain`.

    A terrain is made of height fields and boxes that are exactly its height map (`exact`), of one height field whose
    steps are ramps (`height_field`), or of a placeholder for a collider of our own (`none`).

    The integrator is semi-implicit Euler: with torques from an explicit PD law it needs nothing better, and it is what
    makes a step split exactly into torque and dynamics. With `contact_sensors`, every tracked shape gets a sensor
    `contact_<shape>`, the net force that the shape exerts, world frame [N].
    """
    spec = robot_spec(robot, sim.self_collisions)
    spec.compiler.discardvisual = True  # pictures have a model of their own
    option = spec.option
    option.timestep = sim.dt
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.cone = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}[sim.cone]
    option.impratio = sim.impratio
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations = sim.iterations
    option.ls_iterations = sim.ls_iterations
    # Contacts with the ground need no condim above the robot's own 3; friction is the robot's (its shapes have priority).
    if terrain is None or ground == "none":
        touches = terrain is None
        spec.worldbody.add_geom(
            name=FLOOR,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 1],
            contype=2 if touches else UNTOUCHED,
            conaffinity=1 if touches else 0,
            group=0,
        )
    elif ground == "height_field":
        add_height_field(spec, terrain.height_map)
    else:
        add_terrain(spec, terrain)
    for name in robot.contact_names if contact_sensors else ():
        spec.add_sensor(
            name=f"contact_{name}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname=name,
            intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1],  # data: force, reduce: netforce, num: 1
        )
    return spec.compile()


def contact_sensor_columns(model: mujoco.MjModel, robot: Robot) -> tuple[int, int]:
    """First and past-the-last column of the contact sensors in sensordata; they lie side by side, 3 a shape."""
    start = int(model.sensor(f"contact_{robot.contact_names[0]}").adr[0])
    return start, start + 3 * len(robot.contact_names)
