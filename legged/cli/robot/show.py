"""Joints, limits, gains and feet of a robot: `legged robot show go2`.

The numbers are those of the robot's folder, as every task with this robot begins with them.
"""

import numpy as np
from rich.console import Console
from rich.table import Table

from legged.commandline.command import command
from legged.process.command_parser import CommandParser
from legged.process.paths import relative
from legged.robots.robot import Robot, load_robot


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser("legged robot show", __doc__, "legged robot show go2", "legged robot show mine/my_robot")
    parser.add_argument("robot", metavar="ROBOT", help="name of a robot, or its folder")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    robot = load_robot(build_parser().parse_args(argv).robot, "ROBOT")
    print(f"{robot.name}: {robot.mass:.4g} kg, {robot.height:.3g} m high, {robot.num_dof} joints, {relative(robot.folder)}")
    Console(width=130).print(joints_table(robot))
    for what, names in (
        ("feet", robot.feet_names),
        ("contact is penalised", [robot.contact_names[i] for i in robot.penalised_indices]),
        ("contact ends an episode", [robot.contact_names[i] for i in robot.termination_indices]),
    ):
        print(f"{what}: {', '.join(names) or 'none'}")
    return 0


def joints_table(robot: Robot) -> Table:
    """Return a row for each joint: default angle, limits, gains and rotor inertia."""
    heads = (
        "joint",
        "default [rad]",
        "range [rad]",
        "velocity [rad/s]",
        "torque [N m]",
        "stiffness",
        "damping",
        "rotor [kg m^2]",
    )
    table = Table(*heads)
    for i, name in enumerate(robot.joint_names):
        low, high = robot.dof_pos_limits[i]
        numbers = (robot.dof_vel_limits, robot.torque_limits, robot.stiffness, robot.damping, robot.armature)
        values = [f"{values[i]:.4g}" if np.isfinite(values[i]) else "-" for values in numbers]
        table.add_row(name, f"{robot.default_dof_pos[i]:.4g}", f"{low:.4g} to {high:.4g}", *values)
    return table
