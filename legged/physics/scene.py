"""Robot, ground, sensors and solver options -> one MjModel that every MuJoCo back-end runs."""

import mujoco

from legged.config.schema import SimConfig
from legged.robot import Robot

FLOOR = "floor"


def build_model(robot: Robot, sim: SimConfig, contact_sensors: bool = False) -> mujoco.MjModel:
    """The scene of one world.

    The integrator is semi-implicit Euler: with torques from an explicit PD law it needs nothing better, and it is what
    makes a step split exactly into torque and dynamics. With `contact_sensors`, every tracked shape gets a sensor
    `contact_<shape>`, the net force that the shape exerts, world frame [N].
    """
    spec = mujoco.MjSpec.from_file(str(robot.model_path))
    option = spec.option
    option.timestep = sim.dt
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.cone = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}[sim.cone]
    option.impratio = sim.impratio
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations = sim.iterations
    option.ls_iterations = sim.ls_iterations
    # Contacts with the ground need no condim above the robot's own 3; friction is the robot's (its shapes have priority).
    spec.worldbody.add_geom(
        name=FLOOR,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        contype=2,
        conaffinity=1,
        group=0,
    )
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
