"""A robot as a tree of links on hinges, with masses, shapes and motors. It does not depend on the format of the file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

Vector = np.ndarray
IDENTITY = (1.0, 0.0, 0.0, 0.0)
MOST_NAMED = 12
"""Largest number of names in a line to the user."""


@dataclass
class Mesh:
    """A triangle mesh: a file that MuJoCo reads, or vertices and faces."""

    name: str
    file: Path | None = None
    scale: Vector = field(default_factory=lambda: np.ones(3))
    vertices: Vector | None = None
    """(V, 3) [m], already scaled."""
    faces: Vector | None = None
    """(T, 3) indices of vertices."""


@dataclass
class Shape:
    """A shape on a link: a collision shape, or a visual one. Poses are in the frame of the link."""

    kind: str
    """sphere, capsule, cylinder, box, ellipsoid or mesh."""
    size: Vector
    """(3,) as in MuJoCo [m]: radius of a sphere, radius and half length of a capsule or cylinder, else three half lengths."""
    pos: Vector
    quat: Vector
    collides: bool
    link: str
    """Name of the shape's link in the file. This link may have been merged into another link since."""
    name: str = ""
    mesh: Mesh | None = None
    rgba: Vector | None = None
    friction: Vector | None = None
    fits: dict[str, tuple[Vector, Vector, Vector]] = field(default_factory=dict)
    """Primitives that were fitted to the mesh: kind -> size, position and orientation."""
    points: Vector | None = None
    """(V, 3) vertices of the mesh that a collision shape was fitted to [m]."""

    def move(self, pos: Vector, quat: Vector) -> None:
        """Express the shape in another frame, where its present frame is at `pos` (3,) [m] and is turned by `quat` (4,)."""
        self.pos, self.quat = pos + rotate(quat, self.pos), quat_product(quat, self.quat)
        self.points = None if self.points is None else pos + rotate(quat, self.points)
        self.fits = {
            kind: (size, pos + rotate(quat, at), quat_product(quat, turned)) for kind, (size, at, turned) in self.fits.items()
        }


@dataclass
class Hinge:
    """A hinge between a link and its parent, in the frame of the link."""

    name: str
    axis: Vector
    anchor: Vector = field(default_factory=lambda: np.zeros(3))
    range: tuple[float, float] | None = None
    """[rad]; None for a hinge without limits."""
    effort: float | None = None
    """Torque limit of the hinge's motor [N m]; None if the file states none."""
    velocity: float | None = None
    """Speed limit [rad/s]."""
    driven: bool = True
    """True if the hinge has a motor."""
    mimics: bool = False
    """True if the hinge follows another one by a `mimic` element of a URDF."""
    rolls: bool = False
    """True if the hinge carries a wheel, which turns without limits."""
    stiffness: float | None = None
    """P gain of a position actuator [N m/rad]."""
    damping: float | None = None
    """D gain of the hinge's actuators [N m s/rad]."""
    passive: dict[str, float] = field(default_factory=dict)
    """MJCF attributes of the joint itself: damping, armature, frictionloss, stiffness, springref."""


@dataclass
class Link:
    """A rigid body. Its pose is in the parent's frame at joint angles 0; `com` and `inertia` are in its own frame."""

    name: str
    parent: int
    """Index among the links; -1 for the base."""
    pos: Vector
    quat: Vector
    mass: float = 0.0
    com: Vector = field(default_factory=lambda: np.zeros(3))
    inertia: Vector = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) about the centre of mass [kg m^2]."""
    hinges: list[Hinge] = field(default_factory=list)
    """Hinges to the parent; empty for the base and for a link that is fixed to its parent."""
    shapes: list[Shape] = field(default_factory=list)


@dataclass
class Tree:
    """A robot. Links come after their parents; the first one is the base, which floats."""

    name: str
    source: Path
    links: list[Link]
    mass: float
    """Mass of the whole robot in the file [kg]."""
    home: dict[str, float] | None = None
    """Joint angles of a keyframe [rad]."""
    home_name: str = ""
    """Name of the keyframe with the angles `home`."""
    loops: list[dict[str, str]] = field(default_factory=list)
    """Equality constraints. Each has its kind as `tag`, and MJCF attributes. A `connect` also has `anchor2` [m]: the point in
    the frame of body2 to which `anchor` is tied.
    """
    apart: set[tuple[str, str]] = field(default_factory=set)
    """Pairs of links that never collide with each other."""
    _said: dict[str, list[str]] = field(default_factory=dict)

    def say(self, line: str, about: str = "") -> None:
        """Record a line for the user. Lines with the same text become one line, which lists all values of `about`."""
        names = self._said.setdefault(line, [])
        if about and about not in names:
            names.append(about)

    @property
    def said(self) -> list[str]:
        """Lines about changes, omissions and guesses."""
        return [f"{line}: {listed(names)}" if names else line for line, names in self._said.items()]

    def couple(self, follower: str, leader: str, factors: Sequence[float]) -> None:
        """Couple hinges: the follower's angle [rad] is a polynomial of the leader's; `factors` has the lowest power first."""
        polynomial = " ".join(f"{factor:.15g}" for factor in (*factors, 0.0, 0.0, 0.0, 0.0)[:5])
        self.loops.append({"tag": "joint", "joint1": follower, "joint2": leader, "polycoef": polynomial})

    def followed(self, angles: Mapping[str, float]) -> dict[str, float]:
        """Return `angles` [rad] with the angles of coupled hinges computed from those of their leaders."""
        found = dict(angles)
        for loop in self.loops:
            if loop["tag"] == "joint" and "joint2" in loop:
                polynomial = np.polynomial.Polynomial(vector_of(loop["polycoef"]))
                found[loop["joint1"]] = float(polynomial(found.get(loop["joint2"], 0.0)))
        return found

    def turn(self, quat: Vector) -> None:
        """Turn the robot in the frame of its base by `quat` (4,)."""
        base, turn = self.links[0], matrix(quat)
        base.com, base.inertia = turn @ base.com, turn @ base.inertia @ turn.T
        for shape in base.shapes:
            shape.move(np.zeros(3), quat)
        for child in self.children(0):
            link = self.links[child]
            link.pos, link.quat = turn @ link.pos, quat_product(quat, link.quat)
        self.move_loops(base.name, base.name, np.zeros(3), quat)

    def move_loops(self, old: str, new: str, pos: Vector, quat: Vector) -> None:
        """Move constraints from the link `old` to the link `new`, in whose frame `old` is at `pos` (3,) [m], turned by `quat`
        (4,).
        """
        for loop in self.loops:
            for body, anchor in (("body1", "anchor"), ("body2", "anchor2")):
                if loop.get(body) == old:
                    loop[body] = new
                    loop[anchor] = text_of(pos + rotate(quat, vector_of(loop[anchor])))

    @property
    def hinges(self) -> list[Hinge]:
        """All hinges, in the order of the links."""
        return [hinge for link in self.links for hinge in link.hinges]

    @property
    def shapes(self) -> list[Shape]:
        """All collision shapes, in the order of the links."""
        return [shape for link in self.links for shape in link.shapes if shape.collides]

    def children(self, parent: int) -> list[int]:
        """Return the indices of the children of `parent`."""
        return [i for i, link in enumerate(self.links) if link.parent == parent]


def turn_link(link: Link, hinge: Hinge, angle: float) -> None:
    """Turn a link by `angle` [rad] about one of its hinges. The turned pose becomes the link's pose at zero angles. Earlier
    hinges of the link do not move, but their axes and anchors are expressed in the turned frame.
    """
    turn = quat_about(hinge.axis, angle)
    shift, back = hinge.anchor - rotate(turn, hinge.anchor), inverse(turn)
    link.pos = link.pos + rotate(link.quat, shift)
    link.quat = quat_product(link.quat, turn)
    for other in link.hinges:
        if other is hinge:
            break
        other.axis, other.anchor = rotate(back, other.axis), rotate(back, other.anchor - shift)


def text_of(values: Vector) -> str:
    """Return numbers as an attribute of MJCF."""
    return " ".join(f"{value:.9g}" for value in values)


def vector_of(text: str) -> Vector:
    """Return the numbers of an attribute."""
    return np.array([float(value) for value in text.split()])


def listed(names: list[str]) -> str:
    """Return at most MOST_NAMED names, separated by commas, and the number of names left out."""
    return ", ".join(names[:MOST_NAMED]) + (f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else "")


def rotate(quat: Vector, vec: Vector) -> Vector:
    """Turn vectors (..., 3) by a quaternion (4,), w first."""
    return np.asarray(vec) @ matrix(quat).T


def matrix(quat: Vector) -> Vector:
    """Return the rotation matrix (3, 3) of a quaternion (4,), w first."""
    w, x, y, z = np.asarray(quat, dtype=float) / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_product(a: Vector, b: Vector) -> Vector:
    """Return the quaternion (4,) that turns by `b` first, and then by `a`."""
    (w, *u), (s, *v) = a, b
    return np.array([w * s - np.dot(u, v), *(w * np.array(v) + s * np.array(u) + np.cross(u, v))])


def quat_about(axis: Vector, angle: float) -> Vector:
    """Return the quaternion (4,) that turns by `angle` [rad] about `axis` (3,)."""
    axis = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)])


def quat_of_rpy(roll: float, pitch: float, yaw: float) -> Vector:
    """Return the quaternion (4,) of URDF's angles: about the fixed x, then y, then z [rad]."""
    about_x, about_y, about_z = (quat_about(axis, a) for axis, a in zip(np.eye(3), (roll, pitch, yaw), strict=True))
    return quat_product(about_z, quat_product(about_y, about_x))


def inverse(quat: Vector) -> Vector:
    """Return the quaternion (4,) of the opposite rotation."""
    return np.asarray(quat) * [1.0, -1.0, -1.0, -1.0]


def add_mass(link: Link, mass: float, com: Vector, inertia: Vector) -> None:
    """Add to `link` a `mass` [kg] at `com` (3,) [m] with `inertia` (3, 3) [kg m^2] about `com`, both in the link's frame."""
    total = link.mass + mass
    if total <= 0.0:
        return
    centre = (link.mass * link.com + mass * np.asarray(com)) / total
    link.inertia = (
        link.inertia + inertia + _point(link.mass, link.com - centre) + _point(mass, np.asarray(com) - centre)
    )  # the parallel-axis theorem
    link.mass, link.com = total, centre


def _point(mass: float, at: Vector) -> Vector:
    """Return the inertia (3, 3) of a point mass at `at` (3,), taken about the origin of the frame."""
    return mass * (at @ at * np.eye(3) - np.outer(at, at))
