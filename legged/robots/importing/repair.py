"""Repair of a Tree before it becomes a model: welded links are merged, impossible masses and inertias are corrected."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from legged.errors import ConfigError, suggest
from legged.robots.importing.tree import (
    Hinge,
    Link,
    Shape,
    Tree,
    Vector,
    add_mass,
    matrix,
    quat_product,
    turn_link,
)

LEAST_SHARE = 0.01
"""Mass that a massless link is given, as a share of the mass of its heaviest child."""
LEAST_MOMENT = 1e-3
"""Principal moments of inertia that are not above 0 are raised to this share of the largest one."""
LARGEST = 1e6
"""Largest mass [kg], inertia [kg m^2] and length [m]; a larger number is a mistake in the file."""
FINGERS = re.compile(r"hand|finger|thumb|index|middle|ring|pinky|little|gripper|palm|eye|ear|jaw|antenna", re.IGNORECASE)
"""Pattern in the names of joints and links that walking does not need."""
ROUNDING = 1e-6
"""Margin A + B - C of repaired principal moments A <= B <= C, as a share of C."""
TINY = 1e-12
"""Principal moments [kg m^2] and masses [kg] below this count as zero."""


def repair(tree: Tree, hold: Sequence[str] = (), light: float = 0.0) -> None:
    """Repair a tree in place: hold joints, merge welded links, give massless links a mass, correct inertias.

    A held joint is fixed at its rest angle. Joints are held if their names contain a pattern of `hold`, or if they belong to
    fingers and move less than the share `light` of the mass.

    Raises:
        ConfigError: a pattern of `hold` matches no joint, or there is no mass.
    """
    _check_numbers(tree)
    at = tree.followed({hinge.name: rest_angle(tree, hinge) for hinge in tree.hinges})
    _hold(tree, hold)
    _hold_what_is_light(tree, light, at)
    _hold_followers(tree, at)
    merge_welded(tree)
    if len(tree.links) == 1:
        raise ConfigError(f"{tree.source}: no joint is a hinge that moves a mass")
    _give_mass(tree)
    for link in tree.links:
        _mend_inertia(link, tree)


def _check_numbers(tree: Tree) -> None:
    """Check that masses, inertias, lengths and positions are finite and at most `LARGEST`."""
    for link in tree.links:
        values = np.hstack([link.mass, link.com, link.inertia.ravel(), link.pos, link.quat])
        sizes = [np.hstack([shape.size, shape.pos, shape.quat]) for shape in link.shapes]
        numbers = np.abs(np.hstack([values, *sizes]))
        if not (numbers <= LARGEST).all():
            raise ConfigError(f"{tree.source}: link '{link.name}': its numbers must be finite and at most {LARGEST:g}")


def _hold(tree: Tree, hold: Sequence[str]) -> None:
    names = [hinge.name for hinge in tree.hinges]
    for pattern in hold:
        if not any(pattern in name for name in names):
            raise ConfigError(f"--hold: '{pattern}' is in no joint's name{suggest(pattern, names, 'joints')}")
    for link in tree.links:
        for hinge in [hinge for hinge in link.hinges if any(pattern in hinge.name for pattern in hold)]:
            angle = rest_angle(tree, hinge)
            fix(link, hinge, angle)
            tree.say("joints are held because of --hold", f"{hinge.name} at {angle:.3g} rad")


def fix(link: Link, hinge: Hinge, angle: float) -> None:
    """Remove a hinge from its link, which stays turned by `angle` [rad]."""
    turn_link(link, hinge, angle)
    link.hinges = [other for other in link.hinges if other is not hinge]


def _hold_what_is_light(tree: Tree, light: float, at: Mapping[str, float]) -> None:
    """Hold joints that move no mass, joints of fingers, and joints that mimic others. Fingers are recognised by their names
    and their mass. Mimicking joints are held at the angles `at` [rad], if they are light or if `light` is 0.
    """
    moved = [link.mass for link in tree.links]
    for i in reversed(range(1, len(tree.links))):
        moved[tree.links[i].parent] += moved[i]
    for i, link in enumerate(tree.links):
        for hinge in list(link.hinges):
            if moved[i] <= TINY:
                tree.say("joints that move no mass are held", hinge.name)
                fix(link, hinge, 0.0)
            elif hinge.mimics and (light == 0.0 or moved[i] < light * moved[0]):
                tree.say("joints that mimic others are held", f"{hinge.name} ({at[hinge.name]:.5g} rad)")
                fix(link, hinge, at[hinge.name])
            elif moved[i] < light * moved[0] and FINGERS.search(f"{link.name} {hinge.name}"):
                angle = rest_angle(tree, hinge)
                tree.say("fingers and the like are held", f"{hinge.name} at {angle:.3g} rad")
                fix(link, hinge, angle)


def _hold_followers(tree: Tree, at: Mapping[str, float]) -> None:
    """Hold hinges without a motor if the hinge that they follow is held. They stay at the angles `at` [rad]."""
    names = {hinge.name for hinge in tree.hinges}
    coupled = [loop for loop in tree.loops if loop["tag"] == "joint" and "joint2" in loop]
    followers = {loop["joint1"] for loop in coupled if loop["joint2"] not in names}
    for link in tree.links:
        for hinge in [hinge for hinge in link.hinges if hinge.name in followers and not hinge.driven]:
            tree.say("joints that follow a held one are held too", f"{hinge.name} at {at[hinge.name]:.3g} rad")
            fix(link, hinge, at[hinge.name])


def rest_angle(tree: Tree, hinge: Hinge) -> float:
    """Return the angle [rad] at which a joint is held: its angle in the keyframe, else 0, clipped to its range."""
    return float(np.clip((tree.home or {}).get(hinge.name, 0.0), *(hinge.range or (-np.inf, np.inf))))


def merge_welded(tree: Tree) -> None:
    """Merge every link without a hinge into its parent: mass, centre of mass, inertia and shapes. The field `link` of a shape
    stays as in the file.
    """
    merged = 0
    for i in reversed(range(1, len(tree.links))):
        link = tree.links[i]
        if link.hinges:
            continue
        parent, turn = tree.links[link.parent], matrix(link.quat)
        add_mass(parent, link.mass, link.pos + turn @ link.com, turn @ link.inertia @ turn.T)
        for shape in link.shapes:
            shape.move(link.pos, link.quat)
        parent.shapes += link.shapes
        for child in tree.links:
            if child.parent == i:
                child.pos, child.quat = link.pos + turn @ child.pos, quat_product(link.quat, child.quat)
                child.parent = link.parent
        tree.move_loops(link.name, parent.name, link.pos, link.quat)
        tree.apart = {pair for pair in (_with(pair, link.name, parent.name) for pair in tree.apart) if len(set(pair)) == 2}
        del tree.links[i]
        for child in tree.links:
            child.parent -= child.parent > i
        merged += 1
    if merged:
        tree.say(f"{merged} welded links are merged into the links that carry them, with their masses")
    _drop_loops(tree)
    _parents_first(tree)


def _with(pair: tuple[str, str], old: str, new: str) -> tuple[str, str]:
    """Return the pair with the name `old` replaced by `new`."""
    first, second = (new if name == old else name for name in pair)
    return first, second


def _drop_loops(tree: Tree) -> None:
    """Remove constraints of held hinges, and constraints between two links that were merged."""
    hinges = {hinge.name for hinge in tree.hinges}
    for loop in list(tree.loops):
        ends = [loop[key] for key in ("body1", "body2", "joint1", "joint2") if key in loop]
        if loop["tag"] == "connect" and len(set(ends)) == 1:
            tree.say("constraints between links that are welded to each other are left out", ends[0])
        elif loop["tag"] == "joint" and not set(ends) <= hinges:
            tree.say("constraints of held joints are left out", " and ".join(ends))
        else:
            continue
        tree.loops.remove(loop)


def _parents_first(tree: Tree) -> None:
    """Order the links depth first, parents before children."""
    order: list[int] = []

    def visit(i: int) -> None:
        order.append(i)
        for child in tree.children(i):
            visit(child)

    visit(0)
    places = {old: new for new, old in enumerate(order)}
    tree.links = [tree.links[i] for i in order]
    for link in tree.links:
        link.parent = places.get(link.parent, -1)


def _give_mass(tree: Tree) -> None:
    """Move a share of the heaviest child's mass to each link without mass. The total mass stays the same."""
    for i in reversed(range(1, len(tree.links))):
        link = tree.links[i]
        if link.mass > TINY:
            continue
        child = max((tree.links[j] for j in tree.children(i)), key=lambda other: other.mass)
        mass, inertia = LEAST_SHARE * child.mass, LEAST_SHARE * np.eye(3) * np.trace(child.inertia) / 3.0
        what = f"moving links that have no mass are given {LEAST_SHARE:.0%} of the next link's mass"
        tree.say(what, f"{link.name} {mass:.3g} kg of {child.name}")
        add_mass(link, mass, child.pos, inertia)
        child.mass, child.inertia = child.mass - mass, (1.0 - LEAST_SHARE) * child.inertia
    base = tree.links[0]
    if base.mass <= TINY:
        raise ConfigError(f"{tree.source}: the base, link '{base.name}', and the links that are welded to it have no mass")


def _mend_inertia(link: Link, tree: Tree) -> None:
    """Correct a link's principal moments: as in any real body, each must be positive and at most the sum of the other two."""
    if np.abs(link.inertia).max() < TINY * max(1.0, link.mass):
        sides = _extent([shape for shape in link.shapes if shape.collides] or link.shapes)
        if sides is None:
            link.inertia = 0.4 * link.mass * _radius(link.mass) ** 2 * np.eye(3)
        else:
            link.inertia = link.mass / 12.0 * np.diag((sides**2).sum() - sides**2)
        what = "box around their shapes" if sides is not None else "ball of water"
        tree.say(f"links with a mass but no inertia are given the inertia of a {what} with this mass", link.name)
        return
    moments, axes = np.linalg.eigh((link.inertia + link.inertia.T) / 2.0)
    wanted = np.maximum(moments, LEAST_MOMENT * np.abs(moments).max())
    excess = max(0.0, wanted[2] - wanted[0] - wanted[1])
    if moments[0] > 0.0 and wanted[0] + wanted[1] >= wanted[2] * (1.0 + ROUNDING):
        return
    if excess < ROUNDING * wanted[2] and moments[0] > 0.0:  # rounding of a flat body's moments may break A + B >= C
        link.inertia = axes @ np.diag(wanted + np.array([1.0, 1.0, 0.0]) * ROUNDING * wanted[2]) @ axes.T
        return
    said = ", ".join(f"{moment:.3g}" for moment in moments)
    why = "has a moment that is not above 0" if moments[0] <= 0.0 else f"breaks A + B >= C by {excess / wanted[2]:.1%}"
    wanted[:2] += excess / 2.0 + ROUNDING * wanted[2]
    link.inertia = axes @ np.diag(wanted) @ axes.T
    now = ", ".join(f"{moment:.3g}" for moment in wanted)
    tree.say("impossible inertias, whose smaller principal moments are raised", f"{link.name} {why} ({said} -> {now} kg m^2)")


def _radius(mass: float) -> float:
    """Return the radius [m] of a ball of water that has the mass `mass` [kg]."""
    return float((3.0 * mass / (4000.0 * np.pi)) ** (1 / 3))


def _extent(shapes: Sequence[Shape]) -> Vector | None:
    """Return the sides (3,) of the box around shapes in the frame of their link [m]; None if they have no size."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for shape in shapes:
        half = half_lengths(shape)
        if half is not None:
            reach = np.abs(matrix(shape.quat)) @ half
            low, high = np.minimum(low, shape.pos - reach), np.maximum(high, shape.pos + reach)
    return high - low if (high > low).all() else None


def half_lengths(shape: Shape) -> Vector | None:
    """Return half the sides (3,) of the box around a primitive, in the primitive's frame [m]; None for a mesh."""
    a, b, _ = shape.size
    boxes = {"sphere": [a, a, a], "capsule": [a, a, a + b], "cylinder": [a, a, b], "mesh": None}
    half = boxes.get(shape.kind, shape.size)
    return None if half is None else np.asarray(half, dtype=float)


def plain(name: str) -> str:
    """Return a name in which characters other than ASCII letters, digits, `_`, `.` and `-` are replaced by `_`."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", name).strip("_") or "unnamed"
