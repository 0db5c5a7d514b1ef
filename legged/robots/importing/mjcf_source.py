"""Parsing of MJCF files with any suffix. Settings that this version of MuJoCo does not know are left out."""

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco

from legged.errors import ConfigError
from legged.robots.importing.meshes import ignoring_case

SETTINGS = ("option", "flag", "compiler", "size", "statistic", "global", "quality", "headlight", "map", "scale", "rgba")
"""Elements whose unknown attributes are left out, because the task has settings of its own."""
UNKNOWN = re.compile(r"unrecognized attribute: '([^']+)'\s+Element '([^']+)'")
"""MuJoCo's error about an unknown attribute. Its groups are the names of the attribute and of the element."""

Said = list[tuple[str, str]]
"""Messages about changes, each with the name of the thing that was changed."""


def read_spec(path: Path) -> tuple[mujoco.MjSpec, Said]:
    """Parse an MJCF file. Return the spec, and messages about changes that were made so that MuJoCo accepts the file.

    Raises:
        ConfigError: MuJoCo refuses the file.
    """
    said: Said = []
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except Exception as error:  # MuJoCo's errors have no class of their own
        if path.suffix == ".xml" and not UNKNOWN.search(str(error)):
            raise _refused(path, error) from error
        spec = _from_text(path, said)
    folder = path.parent / (spec.meshdir or "")
    for mesh in (mesh for mesh in spec.meshes if mesh.file and not (folder / mesh.file).is_file()):
        found = ignoring_case(folder / mesh.file)
        if found is not None and found.is_file():
            said.append(("mesh files are found under names with other upper and lower case", f"{mesh.file} -> {found.name}"))
            mesh.name, mesh.file = mesh.name or Path(mesh.file).stem, os.path.relpath(found, folder)
    return spec, said


def _refused(path: Path, error: Exception) -> ConfigError:
    return ConfigError(f"{path}: MuJoCo refuses it: {' '.join(str(error).split())}")


def _from_text(path: Path, said: Said) -> mujoco.MjSpec:
    """Parse the text of a file, without the unknown attributes of settings.

    Raises:
        ConfigError: MuJoCo refuses it.
    """
    try:
        root = ET.fromstring(path.read_bytes())
        _include(root, path.parent)
    except (ET.ParseError, OSError, RecursionError) as error:
        raise _refused(path, error) from error
    while True:
        try:
            spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
        except Exception as error:
            found = UNKNOWN.search(str(error))
            name, tag = found.groups() if found else ("", "")
            having = [element for element in root.iter(tag) if name in element.attrib] if tag in SETTINGS else []
            if not having:
                raise _refused(path, error) from error
            for element in having:
                del element.attrib[name]
            said.append(("settings that this MuJoCo does not know are left out", f"{name} of <{tag}>"))
        else:
            spec.modelfiledir = str(path.parent)
            return spec


def _include(root: ET.Element, folder: Path) -> None:
    """Replace <include> elements by the contents of the files that they name."""
    for parent in list(root.iter()):
        for i, element in reversed(list(enumerate(parent))):
            if element.tag == "include":
                inner = ET.fromstring((folder / element.get("file", "")).read_bytes())
                _include(inner, folder)
                parent[i : i + 1] = list(inner)
