"""A robot between files: links that hang on hinges, with masses, shapes and motors, whatever it was read from."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

Vector = np.ndarray
IDENTITY = (1.0, 0.0, 0.0, 0.0)
MOST_NAMED = 12
"""Names in a line to the user."""


@dataclass
class Mesh:
    """A triangle mesh: a file that MuJoCo reads, or vertices and faces from one that it does not."""

    name: str
    file: Path | None = None
    scale: Vector = field(default_factory=lambda: np.ones(3))
    vertices: Vector | None = None
    """(V, 3) [m], scaled already."""
    faces: Vector | None = None
    """(T, 3) indices of vertices."""


@dataclass
class Shape:
    """A shape on a link, which collides or is only drawn. Poses are in the frame of the link."""

    kind: str
    """sphere, capsule, cylinder, box, ellipsoid or mesh."""
    size: Vector
    """(3,) as MuJoCo has it: radius; radius and half length; half lengths [m]."""
    pos: Vector
    quat: Vector
    collides: bool
    link: str
    """The link that it was given to in the file, which may have been merged into another one since."""
    name: str = ""
    mesh: Mesh | None = None
    rgba: Vector | None = None
    friction: Vector | None = None
    fits: dict[str, tuple[Vector, Vector, Vector]] = field(default_factory=dict)
    """What else a primitive in place of a mesh could be: size, position and orientation by its kind."""

    def move(self, pos: Vector, quat: Vector) -> None:
        """Take the shape into another frame, in which its own is at `pos` (3,) [m], turned by `quat` (4,)."""
        self.pos, self.quat = pos + rotate(quat, self.pos), quat_product(quat, self.quat)
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
    """[rad]; None turns without end."""
    effort: float | None = None
    """Torque limit of its motor [N m]; None if the file has none."""
    velocity: float | None = None
    """[rad/s]"""
    driven: bool = True
    """Whether it has a motor."""
    stiffness: float | None = None
    """P gain of a position actuator [N m/rad]."""
    damping: float | None = None
    """D gain of its actuators [N m s/rad]."""
    passive: dict[str, float] = field(default_factory=dict)
    """MJCF attributes of the joint itself: damping, armature, frictionloss, stiffness, springref."""


@dataclass
class Link:
    """A rigid body. Poses are in the frame of the parent, at joint angles 0; mass and inertia in its own."""

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
    """None: it is fixed to its parent, or it is the base."""
    shapes: list[Shape] = field(default_factory=list)


@dataclass
class Tree:
    """A robot. Links come after their parents; the first one is the base, which floats."""

    name: str
    source: Path
    links: list[Link]
    mass: float
    """What the file says that the whole robot weighs [kg]."""
    home: dict[str, float] | None = None
    """Joint angles of a keyframe [rad]."""
    home_name: str = ""
    """Its name."""
    loops: list[dict[str, str]] = field(default_factory=list)
    """Equality constraints: their kind, as `tag`, and their MJCF attributes; a `connect` has `anchor2` too, which is where
    `anchor` is tied to, in the frame of body2 [m].
    """
    _said: dict[str, list[str]] = field(default_factory=dict)

    def say(self, line: str, about: str = "") -> None:
        """Note what the user has to know; what is said `about` several things becomes one line that names them all."""
        names = self._said.setdefault(line, [])
        if about and about not in names:
            names.append(about)

    @property
    def said(self) -> list[str]:
        """What was changed, left out or guessed, a line each."""
        return [f"{line}: {listed(names)}" if names else line for line, names in self._said.items()]

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
        """Let constraints on the link `old` act on `new`, in whose frame it is at `pos` (3,) [m], turned by `quat` (4,)."""
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
        """All shapes that collide, in the order of the links."""
        return [shape for link in self.links for shape in link.shapes if shape.collides]

    def children(self, parent: int) -> list[int]:
        """Return the links that hang on `parent`."""
        return [i for i, link in enumerate(self.links) if link.parent == parent]


def turn_link(link: Link, hinge: Hinge, angle: float) -> None:
    """Let a link be drawn where `hinge` has turned it by `angle` [rad]; hinges that it has before that one, which are in the
    frame of the link, stay where they are.
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
    """Return names as a list that is not endless."""
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
    """Add a body of `mass` [kg], centre `com` (3,) [m] and `inertia` (3, 3) about it, all in the frame of `link`, to it."""
    total = link.mass + mass
    if total <= 0.0:
        return
    centre = (link.mass * link.com + mass * np.asarray(com)) / total
    link.inertia = (
        link.inertia + inertia + _point(link.mass, link.com - centre) + _point(mass, np.asarray(com) - centre)
    )  # the parallel-axis theorem
    link.mass, link.com = total, centre


def _point(mass: float, at: Vector) -> Vector:
    """Return the inertia (3, 3) of a point at `at` (3,) about the origin."""
    return mass * (at @ at * np.eye(3) - np.outer(at, at))
