"""Readable MJCF of a Tree, as the engines need it: one free base, one motor per driven hinge in the order of the hinges,
named collision shapes, separate visual shapes.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

from legged.errors import ConfigError
from legged.robots.importing.tree import IDENTITY, Hinge, Link, Mesh, Shape, Tree, Vector, quat_product, rotate, vector_of

DRAWN_GROUP, TOUCHED_GROUP = 2, 3
"""Groups of visual and of collision geoms. Pictures show only the visual ones."""
GREY = "0.7 0.7 0.72 1"
DRAWN_APART = 1e-6
"""A constraint needs sites if its two points are farther apart than this at zero joint angles [m]."""


def mjcf_of(tree: Tree, files: Mapping[str, Path] | None = None, height: float = 0.0, remarks: Sequence[str] = ()) -> str:
    """Return a tree as MJCF.

    `files` maps the names of visual meshes to their files; visual meshes without a file are left out. The base is at `height`
    [m]; `remarks` are comments at the top.
    """
    files = files or {}
    drawn = [s for link in tree.links for s in link.shapes if not s.collides and (s.mesh is None or s.mesh.name in files)]
    group = TOUCHED_GROUP if drawn else 0
    lines = [f"<mujoco model={quoteattr(tree.name)}>"]
    for remark in remarks:
        lines.append(f"  <!-- {remark.replace('--', '- -')} -->")
    lines += [
        '  <compiler angle="radian" autolimits="true"/>',
        "",
        "  <default>",
        '    <default class="collision">',
        f'      <geom group="{group}" contype="1" conaffinity="2" condim="3" priority="1"{_touched_colour(group)}/>',
        "    </default>",
        '    <default class="visual">',
        f'      <geom group="{DRAWN_GROUP}" contype="0" conaffinity="0" mass="0" rgba="{GREY}"/>',
        "    </default>",
        "  </default>",
        "",
    ]
    meshes = {shape.mesh.name: shape.mesh for shape in drawn if shape.mesh is not None}
    if meshes:
        lines += ["  <asset>", *(_mesh(mesh, files[name]) for name, mesh in meshes.items()), "  </asset>", ""]
    ends = _loop_ends(tree)
    lines.append("  <worldbody>")
    lines += _body(tree, 0, {id(shape) for shape in drawn}, ends, height)
    lines += [
        "  </worldbody>",
        "",
        "  <actuator>",
        *(_motor(hinge) for hinge in tree.hinges if hinge.driven),
        "  </actuator>",
    ]
    if tree.apart:
        pairs = [f"    <exclude body1={quoteattr(one)} body2={quoteattr(other)}/>" for one, other in sorted(tree.apart)]
        lines += ["", "  <contact>", *pairs, "  </contact>"]
    if tree.loops:
        lines += ["", "  <equality>", *(_loop(i, loop, ends) for i, loop in enumerate(tree.loops)), "  </equality>"]
    return "\n".join([*lines, "</mujoco>", ""])


def model_of(tree: Tree) -> mujoco.MjModel:
    """Return the compiled model of a tree; visual meshes are left out.

    Raises:
        ConfigError: MuJoCo refuses the model.
    """
    try:
        return mujoco.MjModel.from_xml_string(mjcf_of(tree))
    except ValueError as error:
        raise ConfigError(f"{tree.source}: MuJoCo refuses the converted model: {' '.join(str(error).split())}") from error


def numbers(values: Vector) -> str:
    """Return numbers as text of MJCF, with up to nine digits each."""
    return " ".join(f"{value:.9g}" for value in np.where(np.abs(values) < 1e-12, 0.0, values))


def _touched_colour(group: int) -> str:
    return ' rgba="0.9 0.6 0.2 0.5"' if group == TOUCHED_GROUP else f' rgba="{GREY}"'


def _mesh(mesh: Mesh, file: Path) -> str:
    scale = "" if mesh.file is None or np.allclose(mesh.scale, 1.0) else f' scale="{numbers(mesh.scale)}"'
    # inertia="shell" makes MuJoCo accept meshes without a volume. It changes no mass, because visual meshes are massless.
    return f'    <mesh name={quoteattr(mesh.name)} file={quoteattr(file.as_posix())}{scale} inertia="shell"/>'


def _loop_ends(tree: Tree) -> dict[str, list[tuple[str, str]]]:
    """Return link -> sites (name, position) of the constraints that need sites. MuJoCo assumes that the two points of a
    constraint coincide at zero joint angles. If they do not, the constraint needs a site on each link.
    """
    places: list[tuple[Vector, Vector]] = []
    for link in tree.links:
        pos, quat = (np.zeros(3), np.array(IDENTITY)) if link.parent < 0 else places[link.parent]
        root = link.parent < 0
        places.append((pos, quat) if root else (pos + rotate(quat, link.pos), quat_product(quat, link.quat)))
    at = {link.name: place for link, place in zip(tree.links, places, strict=True)}
    ends: dict[str, list[tuple[str, str]]] = {}
    for i, loop in enumerate(tree.loops):
        if loop["tag"] != "connect":
            continue
        both = [(loop["body1"], loop["anchor"]), (loop["body2"], loop["anchor2"])]
        first, second = (at[name][0] + rotate(at[name][1], vector_of(anchor)) for name, anchor in both)
        if np.abs(first - second).max() > DRAWN_APART:
            for k, (name, anchor) in enumerate(both):
                ends.setdefault(name, []).append((f"loop_{i}_{k}", anchor))
    return ends


def _body(
    tree: Tree, i: int, drawn: set[int], ends: Mapping[str, Sequence[tuple[str, str]]], height: float, depth: int = 2
) -> list[str]:
    link, pad = tree.links[i], "  " * depth
    pose = f' pos="0 0 {height:.9g}"' if i == 0 else _pose(link.pos, link.quat)
    lines = [f"{pad}<body name={quoteattr(link.name)}{pose}>"]
    if i == 0:
        lines.append(f'{pad}  <freejoint name="root"/>')
    lines.append(pad + "  " + _inertial(link))
    lines += [pad + "  " + _hinge(hinge) for hinge in link.hinges]
    lines += [pad + "  " + _geom(shape) for shape in link.shapes if shape.collides]
    lines += [pad + "  " + _geom(shape) for shape in link.shapes if id(shape) in drawn]
    lines += [f'{pad}  <site name="{name}" pos="{place}"/>' for name, place in ends.get(link.name, ())]
    for child in tree.children(i):
        lines += _body(tree, child, drawn, ends, height, depth + 1)
    return [*lines, f"{pad}</body>"]


def _pose(pos: Vector, quat: Vector) -> str:
    text = f' pos="{numbers(pos)}"' if np.abs(pos).max() > 1e-12 else ""
    same = np.allclose(np.abs(quat), IDENTITY, atol=1e-9)
    return text + ("" if same else f' quat="{numbers(quat)}"')


def _inertial(link: Link) -> str:
    i = link.inertia
    full = numbers(np.array([i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]))
    return f'<inertial pos="{numbers(link.com)}" mass="{link.mass:.9g}" fullinertia="{full}"/>'


def _hinge(hinge: Hinge) -> str:
    parts = [f'<joint name={quoteattr(hinge.name)} axis="{numbers(hinge.axis)}"']
    if np.abs(hinge.anchor).max() > 1e-12:
        parts.append(f'pos="{numbers(hinge.anchor)}"')
    if hinge.range is not None:
        parts.append(f'range="{numbers(np.array(hinge.range))}"')
    parts += [f'{key}="{value:.9g}"' for key, value in hinge.passive.items()]
    return " ".join(parts) + "/>"


def _geom(shape: Shape) -> str:
    parts = [f'<geom class="{"collision" if shape.collides else "visual"}"']
    if shape.collides:
        parts.append(f"name={quoteattr(shape.name)}")
    if shape.mesh is not None:
        parts.append(f'type="mesh" mesh={quoteattr(shape.mesh.name)}')
    else:
        count = {"sphere": 1, "capsule": 2, "cylinder": 2}.get(shape.kind, 3)
        parts.append(f'type="{shape.kind}" size="{numbers(shape.size[:count])}"')
    if shape.collides and shape.friction is not None:
        parts.append(f'friction="{numbers(shape.friction)}"')
    if not shape.collides and shape.rgba is not None:
        parts.append(f'rgba="{numbers(np.round(shape.rgba, 3))}"')
    return " ".join(parts) + _pose(shape.pos, shape.quat) + "/>"


def _motor(hinge: Hinge) -> str:
    name = quoteattr(hinge.name)
    if hinge.effort is None:
        return f"    <motor name={name} joint={name}/>"
    limit = f"-{hinge.effort:.9g} {hinge.effort:.9g}"
    return f'    <motor name={name} joint={name} ctrlrange="{limit}" forcerange="{limit}"/>'


def _loop(i: int, loop: Mapping[str, str], ends: Mapping[str, Sequence[tuple[str, str]]]) -> str:
    said = {key: value for key, value in loop.items() if key not in ("tag", "anchor2")}
    if any(name == f"loop_{i}_0" for sites in ends.values() for name, _ in sites):
        for key in ("body1", "body2", "anchor"):
            del said[key]
        said = {"site1": f"loop_{i}_0", "site2": f"loop_{i}_1", **said}
    return f"    <{loop['tag']} " + " ".join(f"{key}={quoteattr(value)}" for key, value in said.items()) + "/>"
