"""Collision shapes as engines like them: primitives, each of which has a name of its own."""

import re

import mujoco
import numpy as np

from legged.robots.importing.meshes import MeshProblem, fitted
from legged.robots.importing.tree import Shape, Tree
from legged.robots.robot_model import TAKEN

THINNEST = 0.02
"""Smallest half length of a trunk that was guessed, in the largest one allowed."""


def fit_meshes(tree: Tree) -> None:
    """Replace the collision meshes of a tree by primitives, in place. Where nothing collides, what is drawn does."""
    if not tree.shapes:
        _let_the_drawn_collide(tree)
    kinds: list[str] = []
    for link in tree.links:
        shapes: list[Shape] = []
        for shape in link.shapes:
            if not shape.collides or shape.mesh is None:
                shapes.append(shape)
                continue
            try:
                shapes.append(fitted(shape))
                kinds.append(shapes[-1].kind)
            except MeshProblem as problem:
                tree.say("collision meshes are left out", f"of {shape.link}, {problem}")
        link.shapes = shapes
    if kinds:
        counted = ", ".join(f"{kinds.count(kind)} {kind}" for kind in sorted(set(kinds)))
        tree.say(f"{len(kinds)} collision meshes become the primitives that MuJoCo fits to their bounds: {counted}")


def _let_the_drawn_collide(tree: Tree) -> None:
    """Let a copy of each shape that is drawn collide."""
    tree.say("no shape collides: those that are drawn do")
    for link in tree.links:
        link.shapes += [
            Shape(s.kind, s.size.copy(), s.pos.copy(), s.quat.copy(), True, s.link, s.name, s.mesh, friction=s.friction)
            for s in link.shapes
        ]


def give_trunk(tree: Tree, widest: float) -> None:
    """Let the box that has the inertia of the base stand for its shape, with half lengths of at most `widest` [m]."""
    base = tree.links[0]
    moments, axes = np.linalg.eigh(base.inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    half = np.sqrt(np.maximum(1.5 * (moments.sum() - 2.0 * moments) / base.mass, 0.0))  # of a box I_x = m (b^2 + c^2) / 3
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    size = np.clip(half, THINNEST * widest, widest)
    base.shapes.append(Shape("box", size, base.com.copy(), quat, True, base.name))
    tree.say("guess: nothing of the trunk collides, so the box that has the base's inertia does")


def name_shapes(tree: Tree) -> None:
    """Give each colliding shape a name that no other one has and that the scene does not take: its own, else its link's."""
    taken: set[str] = set()
    shapes = sorted(tree.shapes, key=lambda shape: not shape.name)  # those with a name keep it
    for shape in shapes:
        wanted = re.sub(r"[\s/]+", "_", shape.name or shape.link) or "shape"
        if re.fullmatch(TAKEN["geom"], wanted):
            tree.say("shapes whose names the scene needs are called as their links", f"{wanted} -> {shape.link}")
            wanted = shape.link
        shape.name = free_name(wanted, taken)
        taken.add(shape.name)


def free_name(wanted: str, taken: set[str]) -> str:
    """Return `wanted`, or the first of `wanted_2`, `wanted_3`, ... that is not taken."""
    number, name = 1, wanted
    while name in taken or re.fullmatch(TAKEN["geom"], name):
        number += 1
        name = f"{wanted}_{number}"
    return name
