"""`legged robot`: make robots from URDF or MJCF files, and show robots."""

import argparse
import contextlib
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from legged.commandline.command import sub_command
from legged.config.checks import PLAIN, is_plain_name, shown
from legged.deploy.command_parser import argument
from legged.errors import ConfigError, suggest
from legged.physics.standing import height_under_gains
from legged.process.paths import data_folder, exists, make_folder, ready_to_write, relative, write_text
from legged.registry import register_file, task_config
from legged.robots.importing.actuation import growth
from legged.robots.importing.folder import Guesses, called, task_yaml, write_folder
from legged.robots.importing.infer import make_ready, read_robot
from legged.robots.importing.menagerie import PREFIX, menagerie_model
from legged.robots.importing.repair import plain
from legged.robots.importing.tree import Tree
from legged.robots.robot import Robot, load_robot

SINKS, STANDS = 0.8, 0.85
"""Fractions of the default base height. If the base sinks below `SINKS`, gains are raised until it stays above `STANDS`."""
RAISED = (1.25, 1.5, 2.0, 2.5, 3.0, 4.0)
"""Factors by which P gains that a rule chose may be raised. D gains are multiplied by the square root of the factor."""
ROOM_MB = 100.0
"""Disk space that must be free before the robot's files are written [MiB]."""


@sub_command(
    "legged robot add path/to/my_robot.urdf --out mine",
    "legged robot add menagerie:unitree_go2 --name my_go2",
    arguments=(
        argument("source", metavar="SOURCE", help="a URDF or MJCF file, or menagerie:NAME for a model of MuJoCo Menagerie"),
        argument("--name", help="name of the robot; by default the name of the file"),
        argument("--out", type=Path, help="folder for robot and task; by default resources/robots and cfg of a clone"),
        argument("--extends", metavar="TASK", help="task that the new task extends; by default one of those in cfg/base"),
        argument("--hold", metavar="PATTERN", action="append", default=[], help="joints to hold still; may be repeated"),
        argument("--packages", type=Path, action="append", default=[], help="folder in which to look for package:// files"),
        argument("--stiffness", type=float, help="P gain of all joints [N m/rad]; by default from the file, or from a rule"),
        argument("--damping", type=float, help="D gain of all joints [N m s/rad]"),
        argument("--force", action="store_true", help="overwrite an existing robot of the same name"),
    ),
)
def add(args: argparse.Namespace) -> int:
    """Turn a URDF or MJCF file into a robot and a task: `legged robot add my_robot.urdf`.

    The command writes a robot folder (MJCF, meshes, robot.yaml, PROVENANCE.md) and a task, on flat ground by default. Values
    that the file lacks, such as the spawn height, are guessed and printed.
    """
    gains = _gains(args)
    path, source, licence = _source(args.source)
    name = args.name or plain(Path(args.source.removeprefix(PREFIX)).stem).lower()
    if not is_plain_name(name):
        raise ConfigError(f"--name: the name of a robot must be {PLAIN}; got {shown(name)}")
    folder, task = _places(name, args.out, args.extends)
    _check_apart(path, folder)
    if not args.force and (exists(folder) or exists(task)):
        taken = folder if exists(folder) else task
        raise ConfigError(f"--name: {relative(taken)} exists already; give another name, or --force to write over it")
    if args.extends is not None:
        _check_task(args.extends, task)
    ready_to_write(folder, ROOM_MB)
    tree = read_robot(path, [root.resolve() for root in args.packages])
    for mesh in (shape.mesh for link in tree.links for shape in link.shapes):
        if mesh is not None and mesh.file is not None:
            _check_apart(mesh.file, folder)
    tree.name = name
    guesses = make_ready(tree, args.hold, gains)
    with _nothing_left(folder, task):
        megabytes = write_folder(folder, tree, guesses, source, licence)
        if _make_stand(load_robot(str(folder)), tree, guesses):
            write_folder(folder, tree, guesses, source, licence)
        robot = load_robot(str(folder))
        where = name if folder.parent == data_folder("resources") / "robots" else f"./{name}"
        kind = "wheeled" if guesses.wheels else "biped" if guesses.legs == 2 else "quadruped"
        extends = args.extends or f"base/{kind}_flat"
        make_folder(task.parent)
        symmetric = robot.mirror is not None and robot.mirror.uneven_joint(robot.default_dof_pos) is None
        write_text(task, task_yaml(name, where, extends, symmetric, guesses))
        task_config(register_file(str(task)), on_cpu=True)
    _report(tree, guesses, folder, task, megabytes)
    own = task.parent == data_folder("cfg")
    print(f"train it: legged train {shlex.quote(str(task.stem if own else relative(task)))}")
    return 0


@contextlib.contextmanager
def _nothing_left(folder: Path, task: Path) -> Iterator[None]:
    """If the `with` block raises a ConfigError, remove the robot folder and the task's file, unless they existed before."""
    new = [path for path in (folder, task, folder.parent) if not exists(path)]
    try:
        yield
    except ConfigError:
        for path in new:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
        raise


def _make_stand(robot: Robot, tree: Tree, guesses: Guesses) -> bool:
    """Return True if the robot sinks with its P and D gains, and add a line about this to the report. If a rule chose the
    gains, they are raised until the robot stands, but not beyond the stability limit of an explicit control law.
    """
    height = height_under_gains(robot, robot.stiffness, robot.damping)
    if height >= SINKS * robot.height:
        return False
    sinks = f"in C MuJoCo the base sinks from {robot.height:.3g} to {height:.3g} m in the default pose"
    bends = np.where(robot.wheels, 0.0, 1.0)
    for factor in RAISED if not guesses.stiffness else ():
        p, d = (gains * (1.0 + bends * (by - 1.0)) for gains, by in ((robot.stiffness, factor), (robot.damping, factor**0.5)))
        raised = [dict(zip(robot.joint_names, map(float, gains), strict=True)) for gains in (p, d)]
        if growth(tree, guesses.angles, *raised) > 1.0:
            break
        higher = height_under_gains(robot, p, d)
        if higher >= STANDS * robot.height:
            guesses.stiffness, guesses.damping = raised
            tree.say(
                f"guess: P gains are {factor:g} times the rule's. With the rule's gains, {sinks}. With the raised gains, the"
                f" base sinks to {higher:.3g} m"
            )
            return True
    tree.say(f"{sinks}: check the gains and the rotors' inertia (armature), or give --stiffness and --damping")
    return True


def _gains(args: argparse.Namespace) -> tuple[float, float] | None:
    if (args.stiffness is None) != (args.damping is None):
        raise ConfigError("--stiffness and --damping: give both or neither")
    for flag in ("stiffness", "damping"):
        value = getattr(args, flag)
        if value is not None and not 0.0 <= value <= 1e6:
            raise ConfigError(f"--{flag}: must be between 0 and 1e6, got {value:g}")
    return None if args.stiffness is None else (args.stiffness, args.damping)


def _source(given: str) -> tuple[Path, str, str]:
    """Return the file that SOURCE names, and two texts for PROVENANCE.md: the origin of the file, and its licence."""
    if given.startswith(PREFIX):
        path, licence = menagerie_model(given.removeprefix(PREFIX))
        return path, f"MuJoCo Menagerie, {given.removeprefix(PREFIX)}/{path.name}", licence
    path = Path(given)
    if not exists(path) or not path.is_file():
        raise ConfigError(f"{shown(given)}: there is no such file; give a URDF, an MJCF file, or {PREFIX}NAME")
    beside = [other.name for folder in (path.parent, path.parent.parent) for other in sorted(folder.glob("LICENSE*"))]
    return path.absolute(), path.name, f"see {beside[0]} beside the source" if beside else "that of the source; look it up"


def _check_apart(source: Path, folder: Path) -> None:
    """Check that a source file is not in the robot's new folder, because it could be overwritten there."""
    if source.resolve().is_relative_to(folder.resolve()):
        raise ConfigError(
            f"{relative(source)}: is in {relative(folder)}, which the new robot would overwrite; give another --name or --out"
        )


def _check_task(name: str, beside: Path) -> None:
    """Check that the task `name` exists in cfg, or in the folder of the new task's file `beside`."""
    folders = (data_folder("cfg"), beside.parent)
    if not any(exists(folder / f"{name.removesuffix('.yaml')}.yaml") for folder in folders):
        names = {path.relative_to(folders[0]).with_suffix("").as_posix() for path in folders[0].rglob("*.yaml")}
        raise ConfigError(f"--extends: there is no task {shown(name)}{suggest(name[:100], names, 'tasks')}")


def _places(name: str, out: Path | None, extends: str | None) -> tuple[Path, Path]:
    """Return the robot's folder and the task's file. The task has the robot's name. If `extends` ends in `_flat` or
    `_real`, this ending is appended to the name. Without `extends` the ending `_flat` is appended.
    """
    like = "_flat" if extends is None else extends.removesuffix(".yaml")
    file = name + next((ending for ending in ("_flat", "_real") if like.endswith(ending)), "") + ".yaml"
    if out is not None:
        return out / name, out / file
    robots, tasks = data_folder("resources") / "robots", data_folder("cfg")
    if robots.resolve().is_relative_to(Path(sys.modules["legged"].__file__ or ".").resolve().parent):
        return Path(name), Path(file)  # robots are not written into an installed package
    return robots / name, tasks / file


def _report(tree: Tree, guesses: Guesses, folder: Path, task: Path, megabytes: float) -> None:
    driven = sum(hinge.driven for hinge in tree.hinges)
    mass = sum(link.mass for link in tree.links)
    counts = f"{len(tree.hinges)} hinges, {driven} motors, {len(tree.shapes)} shapes"
    print(f"{tree.name}: a {called(guesses.legs, bool(guesses.wheels))} of {mass:.4g} kg, {counts}")
    for line in tree.said:
        print(f"  {line}")
    for title, names in (("is penalised", guesses.penalized), ("ends an episode", guesses.terminating)):
        print(f"  guess: contact that {title}: {', '.join(names) or 'none'}")
    print(f"  guess: spawn height {guesses.spawn_height:g} m")
    angles = ", ".join(f"{name} {angle:g}" for name, angle in guesses.angles.items() if angle)
    print(f"  default pose [rad]: {angles or 'all 0'}")
    meshes = f", {megabytes:.1f} MiB of meshes" if megabytes else ""
    print(f"written: {relative(folder)}/ ({tree.name}.xml, robot.yaml, PROVENANCE.md{meshes}) and {relative(task)}")


@sub_command(
    "legged robot show go2",
    "legged robot show mine/my_robot",
    arguments=[argument("robot", metavar="ROBOT", help="name of a robot, or its folder")],
)
def show(args: argparse.Namespace) -> int:
    """Print joints, limits, gains and feet of a robot: `legged robot show go2`.

    The numbers come from the robot's folder. A task with this robot uses the same numbers, unless the task replaces them.
    """
    robot = load_robot(args.robot, "ROBOT")
    print(f"{robot.name}: {robot.mass:.4g} kg, {robot.height:.3g} m high, {robot.num_dof} joints, {relative(robot.folder)}")
    table = Table(
        *(
            "joint",
            "default [rad]",
            "range [rad]",
            "velocity [rad/s]",
            "torque [N m]",
            "stiffness",
            "damping",
            "rotor [kg m^2]",
        )
    )
    for i, name in enumerate(robot.joint_names):
        low, high = robot.dof_pos_limits[i]
        numbers = (robot.dof_vel_limits, robot.torque_limits, robot.stiffness, robot.damping, robot.armature)
        values = [f"{values[i]:.4g}" if np.isfinite(values[i]) else "-" for values in numbers]
        table.add_row(name, f"{robot.default_dof_pos[i]:.4g}", f"{low:.4g} to {high:.4g}", *values)
    Console(width=130).print(table)
    for what, names in (
        ("feet", robot.feet_names),
        ("contact is penalised", [robot.contact_names[i] for i in robot.penalised_indices]),
        ("contact ends an episode", [robot.contact_names[i] for i in robot.termination_indices]),
    ):
        print(f"{what}: {', '.join(names) or 'none'}")
    return 0
