"""`legged deploy`: runs a simulated robot that communicates over UDP, without or with the program of the real robot."""

import argparse
import json
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch

from legged.commandline.arguments import IMPORT, POLICY_HELP, import_given
from legged.commandline.command import EXIT_WRONG_INPUT, sub_command
from legged.config import follows_velocities, has_robot, parse_override
from legged.config.robot import TerrainConfig
from legged.config.world import SimConfig
from legged.deploy.__main__ import PROGRAM, limits_of
from legged.deploy.command_parser import argument, check_between
from legged.deploy.contract import SCANS, Contract, read_contract
from legged.deploy.pace import take_priority
from legged.errors import ConfigError, RunError
from legged.learning.run_folder import CONFIG_FILE, checkpoints, run_config
from legged.mdp.actuators.motor_curve import with_rotors
from legged.play.films import mp4
from legged.policies.export import EXPORTED, export
from legged.policies.restore import policy_of, restore, undisturbed
from legged.process.paths import exists, make_folder, ready_to_write, relative, replacing, write_text
from legged.process.startup import INTERRUPTED, in_main_thread
from legged.rendering.camera import Camera, Follower, caption, size_of
from legged.rendering.scene import display_model
from legged.robots.robot import Robot, load_robot
from legged.simulated_robot.robot import Motors, SimulatedRobot, motors_config
from legged.simulated_robot.server import Server
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec, terrain_type

LISTENING = "listening at "
"""Beginning of the line in which `legged deploy robot` prints its address."""
REPORT, POSES = "report.json", "poses.npy"
"""Files that the simulated robot writes into the folder of --out."""
PRIORITY = 10
"""Real-time priority of the simulated robot (Linux allows 1 to 99). The robot's program has a higher priority."""
BORDER = 10.0
"""Width of the level ground around the tile [m]."""
ROOM_MB = 16.0
"""Disk space for the exported policy and the log [MiB]."""
END_S = 20.0
"""Longest time that a process may take to end [s]."""
DID_NOT_RUN = (EXIT_WRONG_INPUT, INTERRUPTED)
"""Exit codes of a program that did not move the robot."""
FILM = "film.mp4"
SIZE = (640, 360)
"""Width and height of the film [pixels]."""
AWAY = 3.45
"""Distance between camera and robot, as a multiple of the robot's largest dimension."""
SIMULATED = ("terrain", "size", "cell", "sim_dt", "latency", "loss", "seed")
PASSED_ON = ("input", "gamepad", "commands", "seconds", "stand_seconds", "max_tilt", "max_age", "max_missed")
SIMULATION = (
    argument("--terrain", metavar="TYPE", help="type of tile on which the robot starts, e.g. stairs_up; by default a plane"),
    argument("--size", type=float, help="size for the type of tile, e.g. step height [m] or slope angle [degrees]"),
    argument("--cell", type=float, default=0.1, help="side of a cell [m]; stair treads are cut to whole cells; default 0.1"),
    argument("--sim-dt", type=float, default=0.002, help="physics step [s]; default 0.002"),
    argument("--latency", type=float, default=0.0, help="delay of packets in each direction [s]; default 0"),
    argument("--loss", type=float, default=0.0, help="share of packets lost, in each direction; default 0"),
    argument("--seed", type=int, default=1, help="random seed of packet loss, motor delay and terrain; default 1"),
    argument("--ideal-motors", action="store_true", help="simulate ideal motors, even if the training used a motor model"),
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
        argument("--contract", type=Path, help="policy.json that defines motors and height map; default: ideal motors"),
        argument(
            "--out",
            type=Path,
            help=f"folder for {REPORT}, and for {POSES} with the poses of the first 30 s at 25 Hz",
        ),
        argument("--seconds", type=float, default=3600.0, help="end after this time [s]; default 3600"),
    ),
)
def robot(args: argparse.Namespace) -> int:
    """Serve a simulated robot over UDP: `legged deploy robot anymal_c --terrain stairs_up`.

    C MuJoCo simulates the robot in real time, with the time step --sim-dt. With --latency and --loss, the simulated network
    delays and loses packets. The command prints the port at which it listens. To run a policy on the simulated robot, call
    `python -m legged.deploy exported --robot udp:127.0.0.1:PORT`.
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
    take_priority(PRIORITY)  # other processes must not delay the simulated robot
    print(f"{LISTENING}127.0.0.1:{server.port}", flush=True)
    report = server.run(args.seconds)
    if args.out is not None:
        with replacing(args.out / POSES) as part:
            np.save(part, np.array(server.poses))
        write_text(args.out / REPORT, json.dumps(report, indent=1))
    print(json.dumps(report), flush=True)
    return 0


def check_simulation(args: argparse.Namespace) -> None:
    """Check the values of the simulation's options.

    Raises:
        ConfigError: a number is out of bounds, the terrain is unknown, or --size is given for a plane.
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
    """Return the robot and its motors. The robot includes the inertia of the motors' rotors. By default rotors and motors
    are those with which the policy in `contract` was trained. Options of the command change these settings.

    Raises:
        ConfigError: a setting of the motors is wrong; see `motors_config`.
    """
    changes = [parse_override(text) for text in args.overrides]
    cfg, counted = motors_config(robot, contract, args.ideal_motors, changes, args.sim_dt)
    return with_rotors(robot, cfg), Motors(robot, cfg, args.sim_dt, counted, args.seed)


def scan_of(contract: Contract | None) -> str:
    """Return the rule (terrain.scan) by which the policy in `contract` measures heights; without a contract, `SCANS[0]`."""
    term = None if contract is None else contract.sources.get("heights")
    return SCANS[0] if term is None else term.scan


def terrain_of(args: argparse.Namespace) -> Terrain | None:
    """Return the terrain that the options choose: one tile with level ground around it; None for a plane."""
    if args.terrain is None:
        return None
    cfg = TerrainConfig(mesh_type="height_map", border_size=BORDER, horizontal_scale=args.cell)
    size = TERRAIN_TYPES[args.terrain].sized(0.5, cfg.scale) if args.size is None else args.size
    return Terrain.of_tiles([[TileSpec(args.terrain, size)]], cfg, np.random.default_rng(args.seed))


@sub_command(
    "legged deploy sim anymal_c_proprio",
    "legged deploy sim anymal_c_proprio --terrain stairs_up --size 0.17 --film",
    "legged deploy sim anymal_c_proprio 'control.actuator.delay=[4, 4]'",
    arguments=(
        argument("policy", metavar="POLICY", help=f"folder of an exported policy, its ONNX file, {POLICY_HELP}"),
        IMPORT,
        argument("--robot", metavar="ROBOT", help="name or folder of the robot; by default the robot of the policy"),
        *SIMULATION,
        *PROGRAM,
        argument("--out", type=Path, help="folder for log.npz and report.json; logs/deploy/<task> by default"),
        argument("--film", action="store_true", help="write a film of the first 30 s to film.mp4"),
    ),
)
def sim(args: argparse.Namespace) -> int:
    """Run the robot's program against a simulated robot: `legged deploy sim anymal_c_proprio`.

    The command exports the policy if necessary. It starts the simulated robot in one process and the program of the real
    robot (`python -m legged.deploy`) in another process. The two processes communicate over UDP. At the end the command
    prints how far the robot moved, and whether it fell.
    """
    limits_of(args)
    check_simulation(args)
    if args.commands is not None and not exists(args.commands):
        raise ConfigError(f"--commands: there is no file {args.commands}")
    import_given(args)
    exported = _exported(args.policy)
    contract = read_contract(exported / "policy.json")
    robot = _simulated(args.robot, exported, contract)
    motors_of(args, robot, contract)
    folder = args.out or Path("logs") / "deploy" / contract.task
    ready_to_write(folder, ROOM_MB)
    folder.mkdir(parents=True, exist_ok=True)
    code, report = _run_both(args, exported, str(robot.folder), folder)
    if report is None:
        return code
    lost = 100.0 * report["lost"] / max(1, report["sent"] + report["received"])
    print(
        f"{relative(folder / REPORT)}: {'fell' if report['fell'] else 'did not fall'}, {report['time']:.1f} s,"
        f" {report['distance']:.2f} m away, {report['climbed']:+.2f} m higher, largest lean {report['largest_lean']:.2f} rad,"
        f" {lost:.1f} % of packets lost"
    )
    if args.film:
        make_film(robot, terrain_of(args), folder)
    return code


def _exported(name: str) -> Path:
    """Return the folder of the exported policy `name`. A shipped policy, or a run whose newest checkpoint was not exported,
    is exported first.
    """
    given = Path(name).parent if name.endswith(".onnx") else Path(name)
    if exists(given / "policy.onnx"):
        return given
    inside = given / EXPORTED / "policy.onnx"
    if exists(inside):
        saved = checkpoints(given)
        if not saved or saved[max(saved)].stat().st_mtime <= inside.stat().st_mtime:
            return given / EXPORTED
    policy = policy_of(name)
    if not follows_velocities(policy.cfg):
        raise ConfigError(f"POLICY: '{policy.cfg.task}' follows no commands; give a policy that follows velocity commands")
    folder = policy.output("deploy") / EXPORTED
    changes = [*undisturbed(policy.cfg, 1), ("sim.physics", "mujoco")]
    task, act = restore(policy, changes, torch.device("cpu"), graph=False)
    export(task, act.network, folder, trained=policy.cfg)
    print(f"exported {relative(folder / 'policy.onnx')}")
    return folder


def _simulated(given: str | None, exported: Path, contract: Contract) -> Robot:
    """Return the robot to simulate: the robot `given`, or by default the robot of the policy. The contract states only the
    robot's name. The folder of a user-defined robot is in the configuration of the run whose folder contains `exported`.
    """
    if given is not None:
        return load_robot(given, "--robot")
    for folder in exported.absolute().parents[:2]:  # the run folder is one or two levels above `exported`
        if exists(folder / CONFIG_FILE):
            cfg = run_config(folder)
            if has_robot(cfg) and Path(cfg.robot).name == contract.robot:
                return load_robot(cfg.robot, "--robot")
    try:
        return load_robot(contract.robot)
    except ConfigError as error:
        said = f"{relative(contract.path)}: robot: '{contract.robot}' does not come with this package"
        raise ConfigError(f"{said}; give its folder with --robot FOLDER") from error


def _run_both(args: argparse.Namespace, exported: Path, robot: str, folder: Path) -> tuple[int, dict[str, Any] | None]:
    """Run the simulated robot and the program until both end; return the program's exit code and the robot's report. The
    report is None if the program did not run.

    Raises:
        RunError: the simulated robot does not start, fails, or does not end.
    """
    report = folder / REPORT
    report.unlink(missing_ok=True)  # remove the report of an earlier run
    simulated = [sys.executable, "-m", "legged", "deploy", "robot", robot, "--out", str(folder)]
    simulated += [*(["--ideal-motors"] if args.ideal_motors else []), "--contract", str(exported / "policy.json")]
    simulator = subprocess.Popen(
        [*simulated, *_flags(args, SIMULATED), *args.overrides],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C must reach only the program, which stops the robot safely
    )
    program = None
    if in_main_thread():  # SIGTERM must also end the two child processes
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        assert simulator.stdout is not None
        line = simulator.stdout.readline()
        if not line.startswith(LISTENING):
            raise RunError(f"the simulated robot did not start (exit code {simulator.wait(END_S)})")
        udp = f"udp:{line.removeprefix(LISTENING).strip()}"
        command = [sys.executable, "-m", "legged.deploy", str(exported), "--robot", udp, "--log", str(folder / "log.npz")]
        program = subprocess.Popen([*command, *_flags(args, PASSED_ON)])
        code = _wait(program)
        if code in DID_NOT_RUN:  # the program has printed the reason
            return code, None
        try:
            simulator.communicate(timeout=END_S)
        except subprocess.TimeoutExpired as error:
            raise RunError("the robot's program ended, but the simulated robot did not end") from error
        if simulator.returncode:
            raise RunError(f"the simulated robot failed (exit code {simulator.returncode}): there is no report of this run")
    finally:
        try:
            if program is not None and program.poll() is None:
                program.terminate()
                program.wait(END_S)
        finally:
            simulator.kill()
            simulator.wait()
    return code, json.loads(report.read_text(encoding="utf-8"))


def _wait(program: subprocess.Popen) -> int:
    """Wait for the program; return its exit code. Ctrl-C is ignored, because the terminal also sends it to the program."""
    while True:
        try:
            return program.wait()
        except KeyboardInterrupt:
            continue


def _flags(args: argparse.Namespace, names: tuple[str, ...]) -> list[str]:
    """Return the options `names` with their values, as words of a command line."""
    given = {f"--{name.replace('_', '-')}": getattr(args, name) for name in names}
    return [word for flag, value in given.items() if value is not None for word in (flag, str(value))]


def make_film(robot: Robot, terrain: Terrain | None, folder: Path) -> None:
    """Film the poses in `folder`, with the program's states from log.npz as captions. Fewer than two poses give no film.

    Raises:
        RunError: this machine cannot render, or the film cannot be written.
    """
    poses = np.load(folder / POSES)
    log = np.load(folder / "log.npz")
    if len(poses) < 2 or "times" not in log:
        (folder / FILM).unlink(missing_ok=True)  # remove the film of an earlier run
        print(f"{folder}: no film, because the run was too short")
        return
    camera = Camera(display_model(robot, 1, *SIZE, terrain), *SIZE)
    fps = (len(poses) - 1) / max(poses[-1, 0] - poses[0, 0], 1e-3)
    follower = Follower(camera.view, AWAY * size_of(robot).max(), None if terrain is None else terrain.height_map)
    with closing(camera), mp4(folder / FILM, fps, *SIZE) as append:
        for time, *qpos in poses:
            camera.data.qpos[:] = qpos
            base = np.array(qpos[:3])
            follower.update(base)
            camera.update()
            place = min(int(np.searchsorted(log["times"], time)), len(log["times"]) - 1)
            state = log["states"][log["state"][place]]
            append(caption(camera.render(), [f"{robot.name}: {state}", f"{time:.1f} s, {base[0]:+.1f} m forward"]))
