"""Guesses about a robot: its forward direction, its feet, and its legs."""

import re
from dataclasses import dataclass

import mujoco
import numpy as np

from legged.errors import ConfigError
from legged.robots.importing.meshes import refitted, rounded
from legged.robots.importing.mjcf_writer import model_of
from legged.robots.importing.repair import half_lengths
from legged.robots.importing.tree import IDENTITY, Shape, Tree, Vector, matrix, quat_about, rotate

FOOT = re.compile(r"foot|feet|toe|sole|heel|ankle|shank|calf|tarsus|lower_?leg|wheel", re.IGNORECASE)
"""Pattern in the names of links and shapes that may be the end of a leg."""
TIP = re.compile(r"foot|feet|toe|sole|heel|contact|wheel|rail", re.IGNORECASE)
"""Pattern in the names of shapes that touch the ground."""
HAND = re.compile(r"hand|wrist|finger|thumb|gripper|elbow|arm|shoulder|head|neck|camera|tail|palm", re.IGNORECASE)
LEFT = ("l", "left", "fl", "hl", "bl", "lf", "lh", "lb")
RIGHT = ("r", "right", "fr", "hr", "br", "rf", "rh", "rb")
ANKLE = 4
"""A leg with at least this number of hinges has an ankle and a sole."""
SAMPLES = 300
NEARLY = 0.7
"""A chain is a leg if its end can reach at least this share of the largest depth below the base that any end can reach."""


@dataclass
class Leg:
    """A chain of hinges that ends in a foot."""

    links: list[int]
    """Indices of the links from the base's child to the foot."""
    hinges: list[str]
    """Names of the hinges of `links`, except the hinge of a wheel at the end."""
    tip: Vector
    """(3,) point of the leg that stands on the ground, in the frame of the last link [m]: the mean position of `feet`."""
    feet: list[Shape]
    """Shapes of the last link that touch the ground."""

    @property
    def end(self) -> int:
        return self.links[-1]

    def touch(self, shapes: list[Shape]) -> None:
        """Set `feet` to `shapes`, which belong to the last link, and `tip` to the mean of their positions."""
        self.feet, self.tip = shapes, np.mean([shape.pos for shape in shapes], axis=0)


class Poser:
    """Poses of a tree at given joint angles, with the base level at the origin."""

    def __init__(self, tree: Tree) -> None:
        """Compile the tree.

        Raises:
            ConfigError: MuJoCo refuses it.
        """
        self.tree = tree
        self.model = model_of(tree)
        self.data = mujoco.MjData(self.model)
        self.places = {hinge.name: int(self.model.joint(hinge.name).qposadr[0]) for hinge in tree.hinges}
        self.ids = [int(self.model.body(link.name).id) for link in tree.links]

    def pose(self, angles: dict[str, float]) -> mujoco.MjData:
        """Return MuJoCo's data at joint `angles` [rad]. Missing angles are 0. Coupled hinges follow their leaders."""
        self.data.qpos[:] = 0.0
        self.data.qpos[3] = 1.0
        for name, angle in self.tree.followed(angles).items():
            self.data.qpos[self.places[name]] = angle
        mujoco.mj_kinematics(self.model, self.data)
        return self.data

    def point(self, link: int, point: Vector) -> Vector:
        """Return the position (3,) of a point in the base's frame [m]; `point` (3,) is its position in the link's frame."""
        body = self.ids[link]
        return self.data.xpos[body] + self.data.xmat[body].reshape(3, 3) @ point

    def limits(self, name: str) -> tuple[float, float]:
        """Return the range of a hinge [rad]; -pi to pi for one without limits."""
        hinge = next(hinge for hinge in self.tree.hinges if hinge.name == name)
        return hinge.range or (-np.pi, np.pi)


def face_forward(tree: Tree) -> None:
    """Turn a robot upright along z, with its left side towards +y. The vertical axis is guessed from the ends of the legs,
    and the left side from their names.
    """
    poser = Poser(tree)
    poser.pose({})
    ends = [i for i, link in enumerate(tree.links) if not tree.children(i) and not HAND.search(link.name)]
    tips = np.array([poser.point(i, _tip(tree, i)) for i in ends])
    if len(tips) >= 2:
        mean = tips.mean(axis=0)
        axis = int(np.abs(mean).argmax())
        if axis == 1 and abs(mean[1]) > 3.0 * abs(mean[2]):  # the robot stands along y
            turn = quat_about(np.array([1.0, 0.0, 0.0]), -np.sign(mean[1]) * np.pi / 2.0)
            tree.turn(turn)
            tree.say("the file's vertical axis is y: the robot is turned upright")
            tips = rotate(turn, tips)
    sides = np.array([side_of(tree.links[i].name) for i in ends])
    if (sides > 0).any() and (sides < 0).any():
        left = tips[sides > 0].mean(axis=0) - tips[sides < 0].mean(axis=0)
        quarters = round(float(np.arctan2(left[1], left[0]) / (np.pi / 2.0)))
        if np.hypot(left[0], left[1]) > 0.02 and quarters % 4 != 1:
            tree.turn(quat_about(np.array([0.0, 0.0, 1.0]), (1 - quarters) * np.pi / 2.0))
            tree.say(f"by the names, the left side is not at +y: the robot is turned by {(1 - quarters) * 90 % 360} degrees")


def side_of(name: str) -> int:
    """Return 1 if a name says left, -1 for right, 0 if it says neither or both."""
    words = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]
    joined = name.lower()
    left = "left" in joined or any(word in LEFT for word in words)
    right = "right" in joined or any(word in RIGHT for word in words)
    return int(left) - int(right)


def find_legs(tree: Tree) -> list[Leg]:
    """Return the legs in the order of the file. A leg is a chain of links whose end reaches low enough (see `NEARLY`). The
    names of feet, arms and heads tell which chains are considered.

    Raises:
        ConfigError: no chain, or only one, reaches below the base.
    """
    poser = Poser(tree)
    ends = [i for i in range(1, len(tree.links)) if not tree.children(i)]
    chains = {i: _chain(tree, i) for i in ends}
    names = {i: " ".join([tree.links[i].name, *(s.link + " " + s.name for s in tree.links[i].shapes)]) for i in ends}
    reach = _reach(poser, ends)
    named = [i for i in ends if FOOT.search(names[i]) and not HAND.search(tree.links[i].name)]
    if len(named) < 2 or len(named) % 2:
        named = [i for i in ends if not any(HAND.search(tree.links[j].name) for j in chains[i])] or ends
    lowest = max(reach[i] for i in named)
    if lowest <= 0.0:
        raise ConfigError(f"{tree.source}: no chain of hinges reaches below the base, link '{tree.links[0].name}'")
    found = [i for i in named if reach[i] >= NEARLY * lowest]
    if len(found) < 2:
        end = tree.links[found[0]].name
        why = f"only one chain of hinges reaches down, to link '{end}'; a robot that walks has two legs or more"
        raise ConfigError(f"{tree.source}: {why}")
    legs = []
    for i in found:
        hinges = [hinge for j in chains[i] for hinge in tree.links[j].hinges]
        bending = [hinge.name for hinge in hinges if not hinge.rolls] or [hinge.name for hinge in hinges]
        legs.append(Leg(chains[i], bending, _tip(tree, i), []))
    for leg in legs:
        shapes = len(tree.links[leg.end].shapes)
        leg.touch(_feet(tree, leg, flat=len(legs) == 2 and len(leg.hinges) >= ANKLE))
        if len(tree.links[leg.end].shapes) == shapes:  # no ball was added as a foot
            _uncover(tree, leg)
    return legs


def _chain(tree: Tree, end: int) -> list[int]:
    """Return the indices of the links from the base's child to `end`."""
    chain = [end]
    while tree.links[chain[0]].parent > 0:
        chain.insert(0, tree.links[chain[0]].parent)
    return chain


def _reach(poser: Poser, ends: list[int]) -> dict[int, float]:
    """Return end -> largest depth [m] below the base in random poses within the joints' limits."""
    random = np.random.default_rng(0)
    lows, highs = np.array([poser.limits(name) for name in poser.places]).T
    deepest = dict.fromkeys(ends, -np.inf)
    tips = {i: _tip(poser.tree, i) for i in ends}
    for k in range(SAMPLES):
        angles = np.clip(0.0, lows, highs) if k == 0 else random.uniform(lows, highs)
        poser.pose(dict(zip(poser.places, angles, strict=True)))
        for i in ends:
            deepest[i] = max(deepest[i], -float(poser.point(i, tips[i])[2]))
    return deepest


def _tip(tree: Tree, i: int) -> Vector:
    """Return the tip (3,) of a link in its own frame [m]: the point farthest from the hinge among the ends of the collision
    shapes (see `_ends`). A link without collision shapes has its tip at its centre of mass.
    """
    link = tree.links[i]
    anchor = link.hinges[0].anchor if link.hinges else np.zeros(3)
    shapes = [shape for shape in link.shapes if shape.collides]
    tips = [shape for shape in shapes if TIP.search(f"{shape.link} {shape.name}")]
    points = [end for shape in tips or shapes for end in _ends(shape)]
    return max(points, key=lambda point: float(np.linalg.norm(point - anchor)), default=link.com)


def _ends(shape: Shape) -> list[Vector]:
    """Return the centre of a shape; for a long shape, the centres of its two ends."""
    half = half_lengths(shape)
    if half is None or shape.kind == "sphere":
        return [shape.pos]
    axis = int(half.argmax())
    thick = float(np.sort(half)[1])
    along = matrix(shape.quat)[:, axis] * max(0.0, float(half[axis]) - thick)
    return [shape.pos + along, shape.pos - along]


def _feet(tree: Tree, leg: Leg, flat: bool) -> list[Shape]:
    """Return the shapes of the last link that touch the ground: soles if `flat`, else balls. If no shape fits, add a ball."""
    link = tree.links[leg.end]
    shapes = [shape for shape in link.shapes if shape.collides]
    if any(hinge.rolls for hinge in link.hinges):
        return shapes
    for i, shape in enumerate(link.shapes):
        if flat and shape.fits and _is_low(shape, leg, shapes):
            link.shapes[i] = refitted(shape, "box")  # robots with two feet stand on their soles
        elif shape.fits and TIP.search(f"{shape.link} {shape.name}"):
            link.shapes[i] = rounded(shape)
    shapes = [shape for shape in link.shapes if shape.collides]
    named = [shape for shape in shapes if TIP.search(f"{shape.link} {shape.name}")]
    balls = [shape for shape in named if shape.kind == "sphere"]
    if named and (len(named) < len(shapes) or len(named) == 1 or flat):
        return balls if balls and not flat else named
    low = [shape for shape in shapes if _is_low(shape, leg, shapes)]
    balls = [shape for shape in low if shape.kind == "sphere"]
    if balls or (flat and low):
        return low if flat else balls
    return [_add_ball(tree, leg, low)]


def _uncover(tree: Tree, leg: Leg) -> None:
    """Shorten a shape whose mesh includes both shank and foot, so that the ball at the foot touches the ground first. The
    shape then ends half its width above the ball's centre, which lets the leg lean by 45 degrees.
    """
    if len(leg.feet) != 1 or leg.feet[0].kind != "sphere":
        return
    for shape in tree.links[leg.end].shapes:
        half = half_lengths(shape)
        if shape is leg.feet[0] or not shape.collides or not shape.fits or half is None or shape.kind == "sphere":
            continue
        down, slot = _long_side(shape, leg.tip)
        excess = float(down @ (shape.pos - leg.tip)) + float(half.max()) + float(np.sort(half)[1])
        if 0.0 < excess < shape.size[slot]:  # more than half of the shape remains
            _draw_back(shape, leg.tip, excess)
            shape.fits = {}
            tree.say("shapes fitted to a mesh that includes the foot are shortened to end above the foot", shape.link)


def _long_side(shape: Shape, tip: Vector) -> tuple[Vector, int]:
    """Return the direction (3,) of a shape's longest side, towards `tip` (3,), and the index of this side in `shape.size`.
    For a capsule, this entry of `size` is half the length of the straight part.
    """
    half = half_lengths(shape)
    assert half is not None
    axis = int(half.argmax())
    along = matrix(shape.quat)[:, axis]
    return along * (np.sign(along @ (tip - shape.pos)) or 1.0), 1 if shape.kind in ("capsule", "cylinder") else axis


def _draw_back(shape: Shape, tip: Vector, length: float) -> None:
    """Shorten a shape in place by `length` [m], at the end that is nearer to the point `tip` (3,) of its link."""
    along, slot = _long_side(shape, tip)
    shape.size = shape.size.copy()
    shape.size[slot] -= length / 2.0
    shape.pos = shape.pos - along * length / 2.0


def _is_low(shape: Shape, leg: Leg, shapes: list[Shape]) -> bool:
    """Return True if a shape is at most 3 cm farther from the tip of a leg than the nearest of `shapes`."""
    nearest = min(float(np.linalg.norm(point - leg.tip)) for other in shapes for point in _ends(other))
    own = min(float(np.linalg.norm(point - leg.tip)) for point in _ends(shape))
    return own <= nearest + 0.03


def _add_ball(tree: Tree, leg: Leg, shapes: list[Shape]) -> Shape:
    """Add a ball as the foot at the tip of a leg, and shorten the rods `shapes` that end there by the ball's radius."""
    link = tree.links[leg.end]
    radius = 0.02 * float(np.linalg.norm(leg.tip)) + 1e-3
    for shape in shapes:
        half = half_lengths(shape)
        if half is None:
            continue
        radius = float(np.sort(half)[1])
        if half.max() > 2.0 * radius and shape.kind in ("box", "capsule", "cylinder"):
            _draw_back(shape, leg.tip, radius)
    ball = Shape("sphere", np.array([radius, 0.0, 0.0]), leg.tip.copy(), np.array(IDENTITY), True, link.name)
    ball.name = f"{FOOT.sub('', link.name).strip('_-. ') or link.name}_foot"
    link.shapes.append(ball)
    what = "rods" if shapes else "links without collision shapes"
    tree.say(f"legs end in {what}, so a ball is added as the foot", link.name)
    return ball
