"""Robot folders written from a Tree: MJCF, meshes, robot.yaml, PROVENANCE.md, and a task for training."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from legged.config.yaml_files import dump
from legged.process.paths import make_folder, write_text
from legged.robots.importing import meshes
from legged.robots.importing.mjcf_writer import mjcf_of
from legged.robots.importing.repair import plain
from legged.robots.importing.shapes import free_name
from legged.robots.importing.tree import Mesh, Tree

ACTION_SCALE = 0.5
"""Action scale of joints without a wheel, for a robot that has wheels [rad]."""


@dataclass
class Guesses:
    """Entries of robot.yaml that are not in the model."""

    base: str
    spawn_height: float
    """Height of the base above the ground after a reset [m]."""
    angles: dict[str, float]
    """Angles of the driven hinges in the default pose [rad]."""
    angles_from: str
    """Source of `angles`, for a comment in robot.yaml."""
    passive: Sequence[str]
    """Hinges without a motor."""
    feet: Sequence[str]
    penalized: Sequence[str]
    terminating: Sequence[str]
    stiffness: dict[str, float]
    damping: dict[str, float]
    velocity: dict[str, float]
    legs: int
    wheels: dict[str, float] = field(default_factory=dict)
    """Hinges of wheels -> scale of their actions [rad/s]."""


def called(legs: int, wheels: bool = False) -> str:
    """Return words for a robot with this number of legs, such as "quadruped on wheels"."""
    return {2: "biped", 4: "quadruped"}.get(legs, f"robot with {legs} legs") + (" on wheels" if wheels else "")


def write_folder(folder: Path, tree: Tree, guesses: Guesses, source: str, licence: str) -> float:
    """Write model, meshes, robot.yaml and PROVENANCE.md; return the size of the meshes [MiB].

    Raises:
        ConfigError: `folder` is a file.
        RunError: the folder can't be written.
    """
    make_folder(folder)
    files = _write_meshes(folder / "meshes", tree)
    remarks = [f"Written by legged robot add from {source}: see PROVENANCE.md. Metres, kilograms, radians."]
    names = {name: path.relative_to(folder) for name, path in files.items()}
    write_text(folder / f"{tree.name}.xml", mjcf_of(tree, names, guesses.spawn_height, remarks))
    write_text(folder / "robot.yaml", robot_yaml(tree, guesses))
    write_text(folder / "PROVENANCE.md", _provenance(tree, source, licence))
    return sum(path.stat().st_size for path in files.values()) / 2**20


def _write_meshes(folder: Path, tree: Tree) -> dict[str, Path]:
    """Give the visual meshes unique names and write their files; return name -> file."""
    known: dict[object, Mesh] = {}
    taken: set[str] = set()
    for link in tree.links:
        for i, shape in enumerate(link.shapes):
            if shape.collides or shape.mesh is None:
                continue
            mesh = shape.mesh
            key = (mesh.file, tuple(mesh.scale)) if mesh.file else id(mesh.vertices)
            if key not in known:
                known[key] = replace(mesh, name=free_name(plain(mesh.name), taken))
                taken.add(known[key].name)
            link.shapes[i] = replace(shape, mesh=known[key])
    files: dict[str, Path] = {}
    if known:
        make_folder(folder)
    for mesh in known.values():
        ending = mesh.file.suffix.lower() if mesh.file else ".stl"
        files[mesh.name] = folder / f"{mesh.name}{ending}"
        if mesh.file:
            shutil.copyfile(mesh.file, files[mesh.name])
        else:
            meshes.write_stl(files[mesh.name], mesh)
    return files


def robot_yaml(tree: Tree, guesses: Guesses) -> str:
    """Return the text of robot.yaml, with comments that mark guesses."""
    g = guesses
    lines = [
        f"# {tree.name}: how the task uses {tree.name}.xml. Written by legged robot add; sources: PROVENANCE.md.",
        "# Lines marked 'guess' were not in the file: look at them. Patterns are parts of names; the longest match wins.",
        *(f"# {' '.join(line.split())}" for line in tree.said),
        f"model: {_name(f'{tree.name}.xml')}",
        f"base: {_name(g.base)}",
        f"spawn_height: {g.spawn_height:g}  # m; guess: the lowest point of the default pose, and a little more",
        *([f"passive_joints: {_list(g.passive)}  # no motor; springs and loops place them"] if g.passive else []),
        f"default_joint_angles:  # rad; {g.angles_from}",
        *(f"  {_name(name)}: {angle:g}" for name, angle in _compact(g.angles).items()),
    ]
    if g.stiffness:
        lines += _table("stiffness", g.stiffness, "N m/rad")
        lines += _table("damping", g.damping, "N m s/rad")
    else:
        lines.append("# stiffness and damping are not in the file: a rule chooses them by the inertia that a joint sees")
    if g.wheels:
        lines.append(f"wheels: {_list(list(g.wheels))}  # guess: round shapes on hinges without limits")
    if g.velocity:
        lines += _table("velocity_limit", g.velocity, "rad/s; torque limits are the motors' forcerange in the model")
    lines += [
        f"feet: {_list(g.feet)}  # guess: shapes at the ends of the legs",
        f"penalize_contacts_on: {_list(g.penalized)}  # guess: thighs, shanks, hands",
        f"terminate_after_contacts_on: {_list(g.terminating)}  # guess: base and trunk",
    ]
    return "\n".join([*lines, ""])


def _table(key: str, values: dict[str, float], unit: str) -> list[str]:
    return [f"{key}:  # {unit}", *(f"  {_name(name)}: {value:.6g}" for name, value in _compact(values).items())]


def _compact(values: dict[str, Any]) -> dict[str, Any]:
    """Return `values` (joint name -> value) with shorter keys: names without the part before the first underscore. If a joint
    would get a wrong value from the shorter keys, return `values` unchanged.
    """
    parts = {name: name.partition("_")[2] or name for name in values}
    table = {parts[name]: value for name, value in values.items()}
    for name, value in values.items():
        matching = [part for part in table if part in name]
        if table[max(matching, key=len)] != value:
            return values
    return table


def _name(text: str) -> str:
    """Return a text as YAML, in quotes if YAML would read it as something else."""
    if "\n" in text:
        return json.dumps(text)
    return dump([text], default_flow_style=True, width=10_000, allow_unicode=True).strip()[1:-1]


def _map(values: dict[str, Any]) -> str:
    return "{" + ", ".join(f"{_name(name)}: {value}" for name, value in _compact(values).items()) + "}"


def _list(names: Sequence[str]) -> str:
    return "[" + ", ".join(_name(name) for name in names) + "]"


def _provenance(tree: Tree, source: str, licence: str) -> str:
    """Return the text of PROVENANCE.md."""
    mass = sum(link.mass for link in tree.links)
    return "\n".join(
        [
            f"# Where the numbers of {tree.name} come from",
            "",
            f"`{tree.name}.xml` and the meshes were written by `legged robot add` from `{source}`.",
            f"Licence: {licence}. Changes to the numbers:",
            "",
            *(f"- {line}" for line in tree.said),
            "",
            f"The links of the source weigh {tree.mass:.6g} kg together, those of the model {mass:.6g} kg.",
            "",
        ]
    )


def task_yaml(name: str, robot: str, extends: str, symmetric: bool, guesses: Guesses) -> str:
    """Return the text of a task on flat ground; `robot` is a name, or a path relative to the task's file."""
    lines = [
        f"# {name} follows velocity commands on flat ground. Written by legged robot add.",
        f"extends: {_name(extends)}",
        f"robot: {_name(robot)}",
    ]
    if guesses.wheels:
        laws = {name: "V" if name in guesses.wheels else "P" for name in guesses.angles}
        scales = {name: guesses.wheels.get(name, ACTION_SCALE) for name in guesses.angles}
        lines += ["# Actions are angles of joints [rad], and speeds of wheels [rad/s].", "control:"]
        lines += [f"  {key}: {_map(table)}" for key, table in (("control_type", laws), ("action_scale", scales))]
    if not symmetric:
        lines += ["# The left and right sides of the robot are not mirror images.", "train: {algorithm: {symmetry: false}}"]
    return "\n".join([*lines, ""])
