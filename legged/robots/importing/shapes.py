"""Collision shapes in the form that engines need: primitives with unique names."""

import re

import mujoco
import numpy as np

from legged.robots.importing.meshes import MeshProblem, check_length, fitted
from legged.robots.importing.tree import Shape, Tree
from legged.robots.reserved_names import RESERVED

THINNEST = 0.02
"""Smallest half length of a guessed trunk box, as a share of the largest half length allowed."""


def fit_meshes(tree: Tree) -> None:
    """Replace the collision meshes of a tree by primitives, in place. If no shape collides, collision copies of the visual
    shapes are added first.
    """
    if not tree.shapes:
        _let_the_drawn_collide(tree)
    for link in tree.links:
        shapes: list[Shape] = []
        for shape in link.shapes:
            if not shape.collides or shape.mesh is None:
                shapes.append(shape)
                continue
            try:
                shapes.append(fitted(shape))
                check_length(tree.source, shape, shapes[-1].points)
            except MeshProblem as problem:
                tree.say("collision meshes are left out", f"of {shape.link}, {problem}")
        link.shapes = shapes


def count_fitted(tree: Tree) -> None:
    """Report the primitives that have replaced collision meshes."""
    kinds = [shape.kind for shape in tree.shapes if shape.points is not None]
    if kinds:
        counted = ", ".join(f"{kinds.count(kind)} {kind}" for kind in sorted(set(kinds)))
        tree.say(f"{len(kinds)} collision meshes become primitives around them: {counted}")


def _let_the_drawn_collide(tree: Tree) -> None:
    """Add a collision copy of each visual shape."""
    tree.say("no shape collides, so copies of the visual shapes do")
    for link in tree.links:
        link.shapes += [
            Shape(s.kind, s.size.copy(), s.pos.copy(), s.quat.copy(), True, s.link, s.name, s.mesh, friction=s.friction)
            for s in link.shapes
        ]


def give_trunk(tree: Tree, widest: float) -> None:
    """Add to the base a collision box with the base's inertia. The box's half lengths are at most `widest` [m]."""
    base = tree.links[0]
    moments, axes = np.linalg.eigh(base.inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    # a box has I_x = m (b^2 + c^2) / 3, with half lengths b and c
    half = np.sqrt(np.maximum(1.5 * (moments.sum() - 2.0 * moments) / base.mass, 0.0))
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    size = np.clip(half, THINNEST * widest, widest)
    base.shapes.append(Shape("box", size, base.com.copy(), quat, True, base.name))
    tree.say("guess: the trunk has no collision shapes, so a box with the base's inertia is added")


def name_shapes(tree: Tree) -> None:
    """Give each collision shape a unique name that is not reserved for the scene: its own name, else the name of its link."""
    taken: set[str] = set()
    shapes = sorted(tree.shapes, key=lambda shape: not shape.name)  # named shapes come first and keep their names
    for shape in shapes:
        wanted = re.sub(r"[\s/]+", "_", shape.name or shape.link) or "shape"
        if re.fullmatch(RESERVED["geom"], wanted):
            tree.say("shapes with names that the scene needs are named after their links", f"{wanted} -> {shape.link}")
            wanted = shape.link
        shape.name = free_name(wanted, taken)
        taken.add(shape.name)


def free_name(wanted: str, taken: set[str]) -> str:
    """Return `wanted`, or the first of `wanted_2`, `wanted_3`, ... that is not in use."""
    number, name = 1, wanted
    while name in taken or re.fullmatch(RESERVED["geom"], name):
        number += 1
        name = f"{wanted}_{number}"
    return name
