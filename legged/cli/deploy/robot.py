"""`legged deploy robot`: a simulated robot behind UDP."""

import argparse
import json
from pathlib import Path

import numpy as np

from legged.commandline.command import sub_command
from legged.config import parse_override
from legged.config.schema import SimConfig, TerrainConfig
from legged.deploy.contract import SCANS, Contract, read_contract
from legged.deploy.pace import take_priority
from legged.errors import ConfigError
from legged.mdp.actuator import with_rotors
from legged.process.command_parser import argument, check_between
from legged.process.paths import make_folder, ready_to_write, replacing, write_text
from legged.robots.robot import Robot, load_robot
from legged.simulated_robot.robot import Motors, SimulatedRobot, motors_config
from legged.simulated_robot.server import Server
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec, terrain_type

LISTENING = "listening at "
"""Beginning of the line with the address."""
REPORT, POSES = "report.json", "poses.npy"
"""Files in the folder of a run."""
PRIORITY = 10
"""Real-time priority (1 to 99). The program's priority is higher."""
BORDER = 10.0
"""Width of the level ground around the tile [m]."""


SIMULATION = (
    argument("--terrain", metavar="TYPE", help="type of the tile it starts on, e.g. stairs_up; a plane by default"),
    argument("--size", type=float, help="size of the tile, in the unit of its type, e.g. the height of a step [m]"),
    argument("--cell", type=float, default=0.1, help="edge of the tile's cells [m]; treads are whole cells; default 0.1"),
    argument("--sim-dt", type=float, default=0.002, help="physics step [s]; default 0.002"),
    argument("--latency", type=float, default=0.0, help="delay of packets in each direction [s]; default 0"),
    argument("--loss", type=float, default=0.0, help="share of packets lost, in each direction; default 0"),
    argument("--seed", type=int, default=1, help="seed of the loss of packets and of the motors' delay; default 1"),
    argument("--ideal-motors", action="store_true", help="ideal motors, whatever the policy was trained with"),
    argument(
        "overrides", nargs="*", metavar="key=value", help="settings of control.actuator, e.g. control.actuator.model=ideal"
    ),
)
"""Arguments of the simulation."""


@sub_command(
    "legged deploy robot anymal_c",
    "legged deploy robot go2 --terrain stairs_up --size 0.12 --latency 0.01 --loss 0.01",
    "legged deploy robot go2 control.actuator.model=dc_motor 'control.actuator.delay=[5, 10]'",
    arguments=(
        argument("robot", metavar="ROBOT", help="name of a robot, or its folder"),
        *SIMULATION,
        argument("--contract", type=Path, help="policy.json that defines motors and height map; ideal motors without it"),
        argument(
            "--out",
            type=Path,
            help=f"folder for {REPORT} and {POSES}, the poses of the first 30 s at 25 Hz",
        ),
        argument("--seconds", type=float, default=3600.0, help="end after this time [s]; default 3600"),
    ),
)
def robot(args: argparse.Namespace) -> int:
    """Serve a simulated robot over UDP: `legged deploy robot anymal_c --terrain stairs_up`.

    C MuJoCo simulates the robot in real time on this machine, with its own time step, and a simulated network may delay and
    lose packets. The command prints the port at which it listens.
    `python -m legged.deploy exported --robot udp:127.0.0.1:PORT` runs a policy on the robot.
    """
    check_simulation(args)
    if not args.seconds > 0.0:
        raise ConfigError(f"--seconds: must be above 0, got {args.seconds:g}")
    if args.out is not None:
        ready_to_write(args.out)
        make_folder(args.out)
    loaded = load_robot(args.robot, "ROBOT")
    sim = SimConfig(dt=args.sim_dt, iterations=100, ls_iterations=50)
    contract = None if args.contract is None else read_contract(args.contract)
    (rotored, motors), scan = motors_of(args, loaded, contract), scan_of(contract)
    server = Server(SimulatedRobot(rotored, terrain_of(args), sim, motors, scan), args.latency, args.loss, args.seed)
    take_priority(PRIORITY)  # a real robot's motors and sensors do not wait for other processes
    print(f"{LISTENING}127.0.0.1:{server.port}", flush=True)
    report = server.run(args.seconds)
    if args.out is not None:
        with replacing(args.out / POSES) as part:
            np.save(part, np.array(server.poses))
        write_text(args.out / REPORT, json.dumps(report, indent=1))
    print(json.dumps(report), flush=True)
    return 0


def check_simulation(args: argparse.Namespace) -> None:
    """Check the numbers of the simulation's flags.

    Raises:
        ConfigError: a number is out of bounds.
    """
    largest = 0.0
    if args.terrain is not None:
        largest = terrain_type(args.terrain, "--terrain").largest
    elif args.size is not None:
        raise ConfigError("--size: a plane has no size; name a type of tiles with --terrain")
    check_between("--size", args.size, 0.0, largest)
    check_between("--cell", args.cell, 0.02, 1.0)
    check_between("--sim-dt", args.sim_dt, 1e-4, 0.02)
    check_between("--latency", args.latency, 0.0, 1.0)
    check_between("--loss", args.loss, 0.0, 0.9)


def motors_of(args: argparse.Namespace, robot: Robot, contract: Contract | None) -> tuple[Robot, Motors]:
    """Return the robot with the motors, rotors and control laws that the flags choose; by default those with which the
    policy in `contract` was trained.

    Raises:
        ConfigError: as `motors_config`.
    """
    changes = [parse_override(text) for text in args.overrides]
    cfg, counted = motors_config(robot, contract, args.ideal_motors, changes, args.sim_dt)
    return with_rotors(robot, cfg), Motors(robot, cfg, args.sim_dt, counted, args.seed)


def scan_of(contract: Contract | None) -> str:
    """Return the rule of height measurements (terrain.scan) for the policy in `contract`."""
    term = None if contract is None else contract.sources.get("heights")
    return SCANS[0] if term is None else term.scan


def terrain_of(args: argparse.Namespace) -> Terrain | None:
    """Return the terrain that the flags choose: one tile with level ground around it; None for a plane."""
    if args.terrain is None:
        return None
    cfg = TerrainConfig(mesh_type="height_map", border_size=BORDER, horizontal_scale=args.cell)
    size = TERRAIN_TYPES[args.terrain].sized(0.5, cfg.scale) if args.size is None else args.size
    return Terrain.of_tiles([[TileSpec(args.terrain, size)]], cfg, np.random.default_rng(args.seed))
