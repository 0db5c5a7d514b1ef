"""Reader of URDF files into a Tree. MuJoCo's own reader is not used, because it welds the base to the world and so loses the
base's mass, and because it does not know packages.
"""

import math
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from legged.config.checks import shown
from legged.errors import ConfigError, suggest
from legged.robots.importing import meshes
from legged.robots.importing.meshes import MeshMissing, MeshProblem
from legged.robots.importing.tree import Hinge, Link, Shape, Tree, Vector, matrix, quat_of_rpy

MOST_TURNS = 1e3
"""Limits larger than this in both directions count as no limits [rad]."""
HINGES = ("revolute", "continuous")
NO_HINGES = {"prismatic": "slide", "planar": "slide in a plane", "floating": "float"}
PARTS = ("parent", "child", "origin", "axis", "limit", "dynamics", "mimic")
"""Elements of a joint that are read."""
KINDS = (*HINGES, *NO_HINGES, "fixed")


def read_urdf(path: Path, roots: Sequence[Path] = (), drawn: bool = True) -> Tree:
    """Return the robot of a URDF file, with its visual shapes if `drawn`. Packages may also be in the folders `roots`. A link
    on a fixed joint becomes a link without hinges.

    Raises:
        ConfigError: the file is not a URDF, or does not describe exactly one robot.
    """
    root = _parsed(path)
    tree = Tree(root.get("name") or path.stem, path, [], 0.0)
    for kind in ("link", "joint"):
        names = [element.get("name", "") for element in root.findall(kind)]
        twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
        if twice is not None:
            raise ConfigError(f"{path}: {kind} '{twice}' comes twice; each {kind} needs a name of its own")
    elements = {link.get("name", ""): link for link in root.findall("link")}
    joints = [_Joint(element, path, elements) for element in root.findall("joint")]
    top, above = _top(elements, joints, path)
    named = {
        material.get("name", ""): _colour(material)
        for material in root.iter("material")
        if material.find("color") is not None
    }
    colours = {name: colour for name, colour in named.items() if colour is not None}
    _say_dont_collapse(tree, joints)
    waiting: list[tuple[str, int, _Joint | None]] = [(top, -1, None)]
    while waiting:  # depth first, in the order of the file
        name, parent, joint = waiting.pop(0)
        here = len(tree.links)
        link = Link(name, parent, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        if joint is not None:
            joint.place(link, tree)
        _inertial(elements[name], link, tree)
        link.shapes = _Shapes(path, roots, colours, tree, drawn).of(elements[name])
        tree.links.append(link)
        waiting[:0] = [(other.child, here, other) for other in joints if other.parent == name]
    if len(tree.links) < len(elements):
        missing = sorted(set(elements) - {link.name for link in tree.links})
        raise ConfigError(f"{path}: joints form a closed loop; links not connected to '{top}': {', '.join(missing)[:200]}")
    tree.mass = sum(link.mass for link in tree.links)
    leaders = {joint.name for joint in joints}
    for loop in (loop for loop in tree.loops if loop["joint2"] not in leaders):
        known = suggest(loop["joint2"], leaders, "joints")
        raise ConfigError(f"{path}: joint '{loop['joint1']}': mimic: there is no joint '{loop['joint2']}'{known}")
    _check_degrees(tree)
    _pass_over(tree, above)
    _say_what_is_unknown(tree, root)
    return tree


def _parsed(path: Path) -> ET.Element:
    """Return the root element of the file."""
    try:
        text = path.read_bytes().lstrip(b"\xef\xbb\xbf \t\r\n")  # some files have blanks before the XML declaration
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise ConfigError(f"{path}: is not well-formed XML: {error}") from error
    except (OSError, ValueError, LookupError) as error:
        raise ConfigError(f"{path}: can't be read: {error}") from error
    if root.tag != "robot":
        raise ConfigError(f"{path}: expected a URDF with <robot> at the top, found <{root.tag}>")
    if any("ros.org/wiki/xacro" in str(element.tag) for element in root.iter()) or any(
        "${" in value for element in root.iter() for value in element.attrib.values()
    ):
        plain = f"{path.name.split('.')[0]}.plain.urdf"
        raise ConfigError(f"{path}: is a xacro file; write the URDF first with `xacro {path.name} > {plain}`")
    if root.find("link") is None:
        raise ConfigError(f"{path}: has no links")
    return root


def _top(elements: dict[str, ET.Element], joints: list["_Joint"], path: Path) -> tuple[str, list["_Joint"]]:
    """Return the base link, and the joints above it.

    The base is the link that is no joint's child. If this link is empty, like `world` or `base_footprint`, and carries one
    link on a fixed or floating joint, the empty link and the joint are removed. The carried link is then the base.
    """
    children = [joint.child for joint in joints]
    twice = next((name for name in children if children.count(name) > 1), None)
    if twice is not None:
        raise ConfigError(f"{path}: link '{twice}' is the child of several joints")
    tops = [name for name in elements if name not in children]
    if len(tops) != 1:
        named = ", ".join(tops) or "none"
        raise ConfigError(f"{path}: expected one link that is no joint's child, found {len(tops)}: {named[:200]}")
    top, above = tops[0], []
    while len(elements[top]) == 0:
        below = [joint for joint in joints if joint.parent == top]
        if len(below) != 1 or (below[0].kind not in ("fixed", "floating") and top != "world"):
            break
        del elements[top]
        joints.remove(below[0])
        above.append(below[0])
        top = below[0].child
    return top, above


def _pass_over(tree: Tree, above: Sequence["_Joint"]) -> None:
    """Apply to the robot the rotations of the joints above its base, and report that links above the base are left out."""
    for joint in reversed(above):
        tree.turn(_origin(joint.element, joint.path)[1])
        if joint.kind == "fixed" and joint.parent != "world":
            what = f"guess: the base is link '{tree.links[0].name}', and empty links above it on fixed joints are passed over"
            tree.say(what, joint.parent)


def _check_degrees(tree: Tree) -> None:
    """Check that limits are in radians.

    Raises:
        ConfigError: a joint's range is more than a turn away from 0, or most joints can turn farther than two turns.
    """
    limited = [hinge for hinge in tree.hinges if hinge.range is not None]
    far = [h for h in limited if h.range and (min(h.range) > 2.0 * math.pi or max(h.range) < -2.0 * math.pi)]
    wide = [h for h in limited if h.range and max(map(abs, h.range)) > 4.0 * math.pi]
    if far or 2 * len(wide) > len(limited):
        hinge = (far or wide)[0]
        low, high = hinge.range or (0.0, 0.0)
        raise ConfigError(
            f"{tree.source}: joint '{hinge.name}': limits of {low:g} and {high:g} look like degrees; a URDF has radians"
            f" ({math.radians(low):.4g} and {math.radians(high):.4g})"
        )
    for hinge in wide:
        tree.say("limits of more than two turns; are they in degrees? A URDF has radians", f"{hinge.name} {hinge.range}")


def _say_what_is_unknown(tree: Tree, root: ET.Element) -> None:
    """Report which elements of the robot and which elements of its joints are left out."""
    left_out = [element.tag for element in root if element.tag not in ("link", "joint", "material")]
    left_out += [part.tag for joint in root.findall("joint") for part in joint if part.tag not in PARTS]
    for tag in dict.fromkeys(tag for tag in left_out if isinstance(tag, str)):
        tree.say("elements that are left out", f"{left_out.count(tag)} <{tag}>")


def _say_dont_collapse(tree: Tree, joints: list["_Joint"]) -> None:
    kept = [joint.child for joint in joints if joint.kind == "fixed" and joint.element.get("dont_collapse") == "true"]
    if kept:
        what = "links on joints that say dont_collapse are merged like the others, and their shapes keep their names"
        for name in kept:
            tree.say(what, name)


class _Joint:
    """A joint element of a URDF."""

    def __init__(self, element: ET.Element, path: Path, links: dict[str, ET.Element]) -> None:
        self.element, self.path = element, path
        self.name, self.kind = element.get("name", ""), element.get("type", "")
        where = f"{path}: joint '{self.name}'"
        if self.kind not in KINDS:
            raise ConfigError(f"{where}: there is no type '{self.kind}'{suggest(self.kind, KINDS)}")
        ends = []
        for tag in ("parent", "child"):
            end = element.find(tag)
            name = "" if end is None else end.get("link", "")
            if name not in links:
                raise ConfigError(f"{where}: {tag}: there is no link '{name}'{suggest(name, links, 'links')}")
            ends.append(name)
        self.parent, self.child = ends

    def place(self, link: Link, tree: Tree) -> None:
        """Set the pose of `link` in its parent's frame, and add its hinge."""
        link.pos, link.quat = _origin(self.element, self.path)
        if self.kind == "fixed":
            return
        if self.kind in NO_HINGES:
            tree.say(f"joints that {NO_HINGES[self.kind]} are no hinges; they are held at position 0", self.name)
            return
        axes = self.element.findall("axis")
        if len(axes) > 1:
            tree.say("joints with several axes; only the first is used", self.name)
        axis = _numbers(axes[0], "xyz", 3, self.path) if axes else np.array([1.0, 0.0, 0.0])
        if not np.linalg.norm(axis) > 1e-9:
            raise ConfigError(f"{self.path}: joint '{self.name}': axis: must have a length, got 0 0 0")
        axis = axis / np.linalg.norm(axis)
        link.hinges = [self._hinge(axis, tree)]
        mimic = self.element.find("mimic")
        if mimic is not None:
            link.hinges[0].driven, link.hinges[0].mimics = False, True
            factors = (_number(mimic, "offset", self.path, 0.0), _number(mimic, "multiplier", self.path, 1.0))
            tree.couple(self.name, mimic.get("joint", ""), factors)

    def _hinge(self, axis: Vector, tree: Tree) -> Hinge:
        hinge = Hinge(self.name, axis)
        limit = self.element.find("limit")
        if limit is not None:
            effort = _number(limit, "effort", self.path, 0.0)
            velocity = _number(limit, "velocity", self.path, 0.0)
            hinge.effort = effort if effort and 0.0 < effort < 1e5 else None
            hinge.velocity = velocity if velocity and 0.0 < velocity < 1e3 else None
        if self.kind == "revolute":
            low, high = (0.0 if limit is None else _number(limit, key, self.path, 0.0) for key in ("lower", "upper"))
            if low > high:
                raise ConfigError(f"{self.path}: joint '{self.name}': limit: lower {low:g} is above upper {high:g}")
            if low < high and not (low < -MOST_TURNS and high > MOST_TURNS):
                hinge.range = (max(low, -MOST_TURNS), min(high, MOST_TURNS))
            else:
                tree.say("joints whose limits are not a valid range become joints without limits", self.name)
        dynamics = self.element.find("dynamics")
        if dynamics is not None:
            given = {"damping": "damping", "frictionloss": "friction"}
            values = {key: _number(dynamics, name, self.path, 0.0) for key, name in given.items()}
            hinge.passive = {key: value for key, value in values.items() if value > 0.0}
        return hinge


def _inertial(element: ET.Element, link: Link, tree: Tree) -> None:
    """Set the mass and inertia of `link`."""
    inertial = element.find("inertial")
    if inertial is None:
        return
    mass = inertial.find("mass")
    link.mass = 0.0 if mass is None else _number(mass, "value", tree.source, 0.0)
    if link.mass < 0.0:
        raise ConfigError(f"{tree.source}: link '{link.name}': mass: must not be below 0, got {link.mass:g}")
    link.com, quat = _origin(inertial, tree.source)
    given = inertial.find("inertia")
    if given is not None and link.mass > 0.0:
        xx, xy, xz, yy, yz, zz = (_number(given, f"i{k}", tree.source, 0.0) for k in ("xx", "xy", "xz", "yy", "yz", "zz"))
        turn = matrix(quat)
        if not np.isfinite([xx, xy, xz, yy, yz, zz]).all():
            raise ConfigError(f"{tree.source}: link '{link.name}': inertia: expected finite numbers")
        link.inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T


class _Shapes:
    """Reader of the shapes of links."""

    def __init__(self, path: Path, roots: Sequence[Path], colours: dict[str, Vector], tree: Tree, drawn: bool) -> None:
        self.path, self.roots, self.colours, self.tree, self.drawn = path, roots, colours, tree, drawn

    def of(self, link: ET.Element) -> list[Shape]:
        """Return the shapes of a link element."""
        found: list[Shape] = []
        for tag in ("collision", "visual") if self.drawn else ("collision",):
            for element in link.findall(tag):
                found += self._shapes(element, link.get("name", ""), tag == "collision")
        return found

    def _shapes(self, element: ET.Element, link: str, collides: bool) -> list[Shape]:
        pos, quat = _origin(element, self.path)
        geometry = element.find("geometry")
        given = None if geometry is None or not len(geometry) else geometry[0]
        if given is None:
            return []
        material = element.find("material")
        rgba = None
        if material is not None and not collides:
            rgba = _colour(material)
            rgba = self.colours.get(material.get("name", "")) if rgba is None else rgba
        if given.tag == "mesh":
            return self._meshes(given, link, pos, quat, collides, rgba)
        kind, size = given.tag, np.zeros(3)
        if kind == "box":
            size = _numbers(given, "size", 3, self.path) / 2.0
        elif kind in ("sphere", "cylinder", "capsule"):
            size[0] = _number(given, "radius", self.path)
            if kind != "sphere":
                size[1] = _number(given, "length", self.path) / 2.0
        else:
            self.tree.say(f"a {kind} is not a shape of URDF and is left out, on link", link)
            return []
        if not (size[: 1 if kind == "sphere" else 3 if kind == "box" else 2] > 0.0).all():
            self.tree.say("shapes without a size are left out, of links", link)
            return []
        if collides and kind == "cylinder" and size[1] > size[0]:
            kind, size = "capsule", np.array([size[0], size[1] - size[0], 0.0])
            self.tree.say("collision cylinders that are longer than thick become capsules of the same length")
        return [Shape(kind, size, pos, quat, collides, link, rgba=rgba)]

    def _meshes(
        self, given: ET.Element, link: str, pos: Vector, quat: Vector, collides: bool, rgba: Vector | None
    ) -> list[Shape]:
        name = given.get("filename", "")
        scale = _numbers(given, "scale", 3, self.path) if given.get("scale") else np.ones(3)
        kind = "collision" if collides else "visual"
        try:
            parts = meshes.read(self._file(name), scale)
        except MeshMissing:
            self.tree.say(f"{kind} meshes that are not found in the folders around the file are left out", name)
            return []
        except (MeshProblem, OSError) as problem:
            self.tree.say(f"{kind} meshes are left out", str(problem))
            return []
        return [
            Shape("mesh", np.zeros(3), pos, quat, collides, link, mesh=mesh, rgba=rgba if colour is None else colour)
            for mesh, colour in parts
        ]

    def _file(self, name: str) -> Path:
        """Return the mesh file that the URDF names, else the only file nearby with the same file name."""
        folder = self.path.parent.resolve()
        try:
            return meshes.find(name, folder, self.roots)
        except MeshMissing:
            found = meshes.find_by_name(name, folder)
        self.tree.say("meshes are not where the file says, but in", os.path.relpath(found.parent, folder) + "/")
        return found


def _origin(element: ET.Element, path: Path) -> tuple[Vector, Vector]:
    """Return position (3,) and orientation (4,) of an element."""
    origin = element.find("origin")
    if origin is None:
        return np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    pos = _numbers(origin, "xyz", 3, path) if origin.get("xyz") else np.zeros(3)
    rpy = _numbers(origin, "rpy", 3, path) if origin.get("rpy") else np.zeros(3)
    return pos, quat_of_rpy(*rpy)


def _colour(material: ET.Element) -> Vector | None:
    colour = material.find("color")
    try:
        rgba = np.array([float(x) for x in colour.get("rgba", "").split()]) if colour is not None else np.zeros(0)
    except ValueError:
        return None
    return np.clip(rgba, 0.0, 1.0) if rgba.shape == (4,) else None


def _numbers(element: ET.Element, key: str, count: int, path: Path) -> Vector:
    """Return the `count` numbers of an attribute. One number is enough for a `scale`."""
    text = element.get(key, "")
    try:
        values = np.array([float(x) for x in re.split(r"[\s,]+", text.strip()) if x])
    except ValueError:
        values = np.zeros(0)
    if len(values) == 1 and count == 3 and key == "scale":
        values = np.repeat(values, 3)
    if len(values) != count or not np.isfinite(values).all():
        raise ConfigError(f"{path}: <{element.tag}>: {key}: expected {count} numbers, got '{text[:80]}'")
    return values


def _number(element: ET.Element, key: str, path: Path, default: float | None = None) -> float:
    """Return the number of an attribute, which may be infinite, or `default` if the attribute is missing."""
    text = element.get(key)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise ConfigError(f"{path}: <{element.tag}>: {key}: expected a number, got {shown(text)}")
    return value
