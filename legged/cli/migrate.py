"""`legged migrate`: a task from a configuration of legged_gym."""

import argparse
import os
import shlex
from pathlib import Path
from typing import Any

from legged.commandline.command import sub_command
from legged.config.checks import PLAIN, is_plain_name, shown
from legged.config.yaml_files import read_yaml
from legged.deploy.command_parser import argument
from legged.errors import ConfigError
from legged.migration.mapping import map_settings
from legged.migration.reading import read_fork
from legged.migration.robot_entries import asset_of, map_robot, names_of
from legged.migration.translation import Translation
from legged.migration.writer import robot_yaml, task_yaml
from legged.process.paths import data_folder, exists, make_folder, ready_to_write, relative, write_text
from legged.registry import register_file, task_config
from legged.robots.robot import Robot, load_robot

FIRST = ("rewards", "observations", "robot")
"""Subjects with which the report begins."""


@sub_command(
    "legged migrate legged_gym/envs/go2/go2_config.py --robot go2 --run",
    "legged migrate legged_gym/envs/__init__.py --task go2 --out tasks --run",
    arguments=(
        argument("file", metavar="FILE", type=Path, help="a Python file with configuration classes"),
        argument("--run", action="store_true", help="allow the command to run FILE and the modules that it imports"),
        argument("--task", help="class or registered task to migrate; if FILE has only one, the name of the new task"),
        argument("--robot", help="robot under resources/robots/, or a folder; by default the robot with the asset's name"),
        argument("--out", type=Path, default=Path("."), help="folder for the files that are written"),
        argument("--force", action="store_true", help="write over existing files"),
    ),
)
def migrate(args: argparse.Namespace) -> int:
    """Translate a configuration of legged_gym or of a fork into a task: `legged migrate go2_config.py --robot go2 --run`.

    The command imports the file in a child process, which needs neither Isaac Gym nor similar libraries. The settings that
    differ from the defaults of this package are written to <task>.yaml. If pose or contact bodies differ from those of the
    robot, robots/<task>/robot.yaml is written too. Comments in <task>.yaml list, with file and line, the rewards whose
    formulas are not legged_gym's, and the settings that have no counterpart in this package.
    """
    if not (exists(args.file) and args.file.is_file()):
        raise ConfigError(f"file: there is no file {shown(str(args.file))}")
    if args.file.suffix != ".py":
        raise ConfigError(f"file: expected a Python file with configuration classes, got {shown(str(args.file))}")
    if not args.run:
        raise ConfigError(
            f"--run: `legged migrate` runs {relative(args.file)} and the modules that it imports; allow this with --run"
        )
    fork = read_fork(args.file, args.task)
    task = _task_name(fork.task)
    result = map_settings(fork)
    robot = _robot(args.robot, result)
    entries = map_robot(result, robot)
    path, folder = args.out / f"{task}.yaml", args.out / "robots" / task
    with_folder = robot is not None and bool(entries)
    for file in (path, *([folder / "robot.yaml"] if with_folder else [])):
        if exists(file) and not args.force:
            raise ConfigError(f"--out: {relative(file)} exists already; --force writes over it")
    ready_to_write(args.out)
    make_folder(args.out)
    result.settings["robot"] = _robot_setting(robot, with_folder, task, result)
    if robot is not None and with_folder:
        make_folder(folder)
        write_text(folder / "robot.yaml", _robot_text(robot, entries, folder, args.file))
    head = [f"Written by `legged migrate` from {relative(args.file)}, {fork.described}."]
    head += [f"{subject}: {line}" for subject, lines in result.notes.items() for line in lines]
    if robot is None:
        result.note("robot", f"this package has no such robot yet: {asset_of(result) or 'the configuration names no file'}")
        head += ["This package does not have the task's robot yet. The configuration has these entries for a robot.yaml:"]
        head += [f"  {line}" for line in robot_yaml([], entries).splitlines()]
    minor = [f"without effect on a task: {', '.join(result.minor)}"] if result.minor else []
    write_text(path, task_yaml(head, result.settings, result.comments, [*map(str, result.lost), *minor]))
    _report(args, path, result, robot)
    return 0


def _task_name(name: str) -> str:
    """Return the name of the new task: `name`, with the prefix my_ if this package already has a task `name`."""
    if not is_plain_name(name):
        raise ConfigError(f"--task: the name of a task must be {PLAIN}; got {shown(name)}")
    return f"my_{name}" if exists(data_folder("cfg") / f"{name}.yaml") else name


def _robot(asked: str | None, result: Translation) -> Robot | None:
    """Return the robot `asked`. If it is None, return the robot of this package that has the asset's name, or None."""
    if asked is not None:
        return load_robot(asked, "--robot")
    robots = data_folder("resources") / "robots"
    names = (name for name in names_of(result) if is_plain_name(name) and exists(robots / name / "robot.yaml"))
    return next((load_robot(name, "asset.name") for name in names), None)


def _robot_setting(robot: Robot | None, with_folder: bool, task: str, result: Translation) -> str:
    if with_folder:
        return f"robots/{task}"
    if robot is None:
        return f"robots/{next(filter(is_plain_name, names_of(result)), task)}"
    ours = data_folder("resources") / "robots" / robot.name
    return robot.name if ours.resolve() == robot.folder else str(robot.folder)


def _robot_text(robot: Robot, entries: dict[str, Any], folder: Path, source: Path) -> str:
    """Return the text of a robot.yaml in `folder`: the file of `robot` with changed `entries` and the same model."""
    data = read_yaml(robot.folder / "robot.yaml") | entries
    data["model"] = os.path.relpath(robot.model_path, folder.resolve())
    changed = ", ".join(entries)
    return robot_yaml([f"The robot {robot.name}, with these entries from {relative(source)}: {changed}."], data)


def _asset(file: Path, result: Translation) -> str:
    """Return the path of the robot's model file. If no folder above `file` contains this file, return the configured path."""
    asset = asset_of(result)
    found = (relative(folder / asset) for folder in file.resolve().parents if asset and exists(folder / asset))
    return next(found, asset or "FILE.urdf")


def _report(args: argparse.Namespace, path: Path, result: Translation, robot: Robot | None) -> None:
    """Print the path of the new task, the notes, the changed and lost settings, and the next commands."""
    print(f"written: {relative(path)}, {len(result.settings)} settings that differ from the defaults")
    for subject in sorted(result.notes, key=lambda subject: (*FIRST, subject).index(subject)):
        print(*(f"{subject}: {line}" for line in result.notes[subject]), sep="\n")
    for name in filter(result.settings.__contains__, result.comments):
        print(f"changed: {name} = {shown(result.settings[name])}: {result.comments[name]}")
    for entry in filter(lambda entry: entry.reason, result.lost):
        alike = [other for other in result.lost if other.reason == entry.reason]
        if entry is alike[0]:
            also = ", ".join(other.setting for other in alike[1:])
            print(f"not mapped: {entry}{f'; not mapped for the same reason: {also}' if also else ''}")
    if not all(entry.reason for entry in result.lost):
        plain = ", ".join(entry.setting for entry in result.lost if not entry.reason)
        print(f"not mapped, without counterpart (file and line are in {path.name}): {plain}")
    if result.minor:
        print(
            f"not mapped, without effect: {len(result.minor)} settings of the simulator, of drawing and of the command line"
        )
    if robot is None:
        folder = args.out / result.settings["robot"]
        add = ["robot", "add", _asset(args.file, result), "--name", folder.name, "--out", str(folder.parent)]
        again = ["migrate", str(args.file), "--robot", str(folder), "--out", str(args.out), "--force", "--run"]
        again += ["--task", args.task] if args.task else []
        print("add the missing robot, then migrate:", *(f"  legged {shlex.join(words)}" for words in (add, again)), sep="\n")
        return
    try:
        task_config(register_file(str(path)))
    except ConfigError as error:
        print(f"the task does not load yet: {error}")
        return
    print(f"show the whole configuration: legged train {relative(path)} --show")
