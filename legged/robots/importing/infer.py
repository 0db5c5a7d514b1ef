"""Completion of a robot that was read from a file into a Tree: repairs, names, default pose, feet and gains, as robot.yaml
needs them. Values that the file does not state are inferred, and reported as guesses.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from legged.errors import ConfigError
from legged.robots.importing.actuation import GRAVITY, give_rotors, guess_efforts, rule_gains, speed_limits, take_gains
from legged.robots.importing.folder import Guesses, called
from legged.robots.importing.inverse_kinematics import GOOD, standing_angles
from legged.robots.importing.legs import Leg, Poser, face_forward, find_legs
from legged.robots.importing.meshes import check_length, vertices
from legged.robots.importing.mjcf import read_mjcf
from legged.robots.importing.mjcf_writer import model_of
from legged.robots.importing.repair import repair
from legged.robots.importing.shapes import count_fitted, fit_meshes, free_name, give_trunk, name_shapes
from legged.robots.importing.tree import Shape, Tree
from legged.robots.importing.urdf import read_urdf
from legged.robots.importing.wheels import find_wheels
from legged.robots.stance import lowest_point, standing_height

LIGHT = 0.005
"""A finger's joint is held at one angle if the mass that it moves is less than this share of the robot's mass."""
MIDDLE = 0.01
"""Largest distance of the origin of a trunk's link from the xz plane of the base [m]."""
SOLE = re.compile(r"foot|feet|toe|sole|heel", re.IGNORECASE)
"""Pattern in the names of the shapes that stand on the ground behind a toe."""
ABOVE = 1.03
"""Spawn height as a multiple of the height of the standing base."""
WIDEST = 0.8
"""Largest half length of a guessed trunk box, as a share of the distance from the base to the farthest foot."""
LOST_FOOT = 0.25
"""Largest distance of a foot from its goal in a stance, as a share of the leg's length. Links farther away are not feet."""
LEVEL = 0.01
"""Largest height of a foot above the lowest point of its leg, as a share of that point's depth below the base."""
ANKLE_HEIGHT = 0.3
"""Largest height of an ankle hinge above the ground, as a share of the height of the standing base."""
LOST = 1e-6
"""Largest share of a robot's mass that rounding may lose."""


def read_robot(path: Path, roots: Sequence[Path] = (), drawn: bool = True) -> Tree:
    """Return the robot of a URDF or MJCF file; nothing is repaired yet. For `roots` and `drawn` see `read_urdf`.

    Raises:
        ConfigError: the file is neither URDF nor MJCF, or holds no robot.
    """
    if path.suffix.lower() == ".urdf":
        return read_urdf(path, roots, drawn)
    if path.suffix.lower() in (".xml", ".mjcf"):
        head = path.read_bytes()[:20_000]
        return read_urdf(path, roots, drawn) if b"<robot" in head and b"<mujoco" not in head else read_mjcf(path, drawn)
    if path.suffix.lower() == ".xacro":
        plain = f"{path.name.split('.')[0]}.plain.urdf"
        raise ConfigError(f"{path}: is a xacro file; write the URDF first with `xacro {path.name} > {plain}`")
    raise ConfigError(f"{path}: expected a URDF (.urdf) or an MJCF file (.xml, .mjcf)")


def make_ready(tree: Tree, hold: Sequence[str] = (), gains: tuple[float, float] | None = None) -> Guesses:
    """Repair a tree in place and infer the values that its file does not state. `gains` are P [N m/rad] and
    D [N m s/rad]. They replace the gains in the file for all joints but wheels.

    Raises:
        ConfigError: the tree has no robot with legs, or mass was lost.
    """
    fit_meshes(tree)
    repair(tree, hold, LIGHT)
    find_wheels(tree)
    face_forward(tree)
    legs = find_legs(tree)
    if not any(shape.collides for i in _trunk(tree, legs) for shape in tree.links[i].shapes):
        give_trunk(tree, WIDEST * _reach(tree, legs))
    name_shapes(tree)
    _name_passive(tree, legs)
    angles, origin = _default_pose(tree, legs)
    if _stand_on_all(tree, legs, angles):
        angles, origin = _default_pose(tree, legs)
    _name_feet(tree, legs)
    _draw_what_is_bare(tree)
    for shape in (shape for link in tree.links for shape in link.shapes):
        check_length(tree.source, shape, vertices(shape.mesh) if shape.mesh is not None else None)
    count_fitted(tree)
    poser = Poser(tree)
    height = standing_height(poser.model, tree.links[0].name, poser.pose(angles).qpos)
    guess_efforts(tree, legs, height)
    give_rotors(tree, angles)
    feet = [shape.name for leg in legs for shape in leg.feet]
    if gains is None:
        stiffness, damping = take_gains(tree, angles, feet, height)
    else:
        rules = rule_gains(tree, angles, feet, height)
        given = [hinge.name for hinge in tree.hinges if hinge.driven and not hinge.rolls]
        stiffness, damping = (rule | dict.fromkeys(given, gain) for rule, gain in zip(rules, gains, strict=True))
    _check_mass(tree)
    wheels = _wheels(tree, legs, height)
    tree.say(f"guess: a {called(len(legs), bool(wheels))} with feet", ", ".join(feet))
    ending, penalized = (_named_apart(tree, role) for role in _roles(tree, legs, feet, _soles(tree, legs, angles, height)))
    return Guesses(
        base=tree.links[0].name,
        spawn_height=round(ABOVE * height, 3),
        angles={hinge.name: angles[hinge.name] for hinge in tree.hinges if hinge.driven},
        angles_from=origin,
        passive=[hinge.name for hinge in tree.hinges if not hinge.driven],
        feet=_exact(tree, feet),
        penalized=_exact(tree, penalized),
        terminating=_exact(tree, ending),
        stiffness=stiffness,
        damping=damping,
        velocity=speed_limits(tree),
        legs=len(legs),
        wheels=wheels,
    )


def _wheels(tree: Tree, legs: list[Leg], height: float) -> dict[str, float]:
    """Return hinge -> action scale [rad/s] for the driven wheels on which legs stand. If the action of all wheels is 1, the
    robot drives at 0.5 sqrt(g h) [m/s], where h is the base's `height` [m].
    """
    found = {}
    for leg in legs:
        for hinge in (hinge for hinge in tree.links[leg.end].hinges if hinge.rolls and hinge.driven):
            found[hinge.name] = float(f"{0.5 * np.sqrt(GRAVITY * height) / max(s.size[0] for s in leg.feet):.2g}")
            tree.say("guess: hinges that turn wheels (actions are speeds, and angles are not observed)", hinge.name)
    return found


def _stand_on_all(tree: Tree, legs: list[Leg], angles: dict[str, float]) -> bool:
    """Add shapes of each leg's last link to its feet, if they are about as low as the link's lowest shape in the pose at
    `angles` [rad]. Return True if any leg has more feet now.
    """
    poser = Poser(tree)
    data = poser.pose(angles)
    lowest = {shape.name: lowest_point(poser.model, data, int(poser.model.geom(shape.name).id)) for shape in tree.shapes}
    more = False
    for leg in legs:
        shapes = [shape for shape in tree.links[leg.end].shapes if shape.collides]
        ground = min(lowest[shape.name] for shape in shapes)
        known = {shape.name for shape in leg.feet}
        feet = [shape for shape in shapes if shape.name in known or lowest[shape.name] < ground * (1.0 - LEVEL)]
        if len(feet) > len(leg.feet):
            leg.touch(feet)
            more = True
    return more


def _soles(tree: Tree, legs: list[Leg], angles: dict[str, float], height: float) -> set[str]:
    """Return the names of all shapes of feet, including shapes that do not touch the ground. A foot is a link of the file
    that was merged into a leg's last link and touches the ground. The last link itself is a foot only if its hinge is near
    the ground, like an ankle, in the pose at `angles` [rad] with the base at `height` [m].
    """
    poser = Poser(tree)
    data = poser.pose(angles)
    found = set()
    for leg in legs:
        link = tree.links[leg.end]
        low = data.xanchor[poser.model.joint(link.hinges[-1].name).id, 2] < (ANKLE_HEIGHT - 1.0) * height
        own = {shape.link for shape in leg.feet if low or shape.link != link.name}
        found |= {shape.name for shape in link.shapes if shape.collides and shape.link in own}
    return found


def _name_feet(tree: Tree, legs: list[Leg]) -> None:
    """Rename feet whose names are part of another shape's name. A pattern for the foot would match both."""
    for leg in legs:
        for shape in leg.feet:
            others = {other.name for other in tree.shapes if other is not shape}
            if any(shape.name in name for name in others - {s.name for s in leg.feet}):
                shape.name = free_name(f"{shape.name}_foot", others)


def _name_passive(tree: Tree, legs: list[Leg]) -> None:
    """Rename hinges without a motor whose names are part of a driven hinge's name (see `_name_feet`)."""
    driven = [hinge.name for hinge in tree.hinges if hinge.driven]
    for hinge in tree.hinges:
        if hinge.driven or not any(hinge.name in name for name in driven):
            continue
        old, hinge.name = hinge.name, free_name(f"{hinge.name}_passive", {other.name for other in tree.hinges})
        tree.say("hinges without a motor are renamed if other hinges' names contain their names", f"{old} -> {hinge.name}")
        for leg in legs:
            leg.hinges = [hinge.name if name == old else name for name in leg.hinges]
        for loop in tree.loops:
            loop.update({key: hinge.name for key in ("joint1", "joint2") if loop.get(key) == old})
        if tree.home is not None and old in tree.home:
            tree.home[hinge.name] = tree.home.pop(old)


def _named_apart(tree: Tree, role: Sequence[str]) -> list[str]:
    """Rename each shape of `role` (names) if its name is part of the name of a shape outside `role`. Return the new names."""
    named = {shape.name: shape for shape in tree.shapes}
    shapes = [named[name] for name in role]
    for shape in shapes:
        others = [other.name for other in tree.shapes if all(other is not own for own in shapes)]
        if any(shape.name in name for name in others):
            taken = {other.name for other in tree.shapes}
            old, shape.name = shape.name, free_name(f"{shape.name}_itself", taken)
            tree.say("shapes are renamed if other shapes' names contain their names", f"{old} -> {shape.name}")
    return [shape.name for shape in shapes]


def _exact(tree: Tree, names: Sequence[str]) -> list[str]:
    """Return patterns that match the shapes `names` and no other shapes: one word, such as "foot", if it is in all of `names`
    and in no other shape's name. Otherwise, return names. No name of another shape may contain one of `names`.
    """
    others = [shape.name for shape in tree.shapes if shape.name not in names]
    for word in ("foot", "FOOT", "Foot", "toe", "calf", "shank"):
        if names and all(word in name for name in names) and not any(word in name for name in others):
            return [word]
    kept: list[str] = []
    for name in sorted(names, key=len):
        if not any(name in other for other in others) and not any(short in name for short in kept):
            kept.append(name)
    return [name for name in names if name in kept]


def _roles(tree: Tree, legs: list[Leg], feet: Sequence[str], of_feet: set[str]) -> tuple[list[str], list[str]]:
    """Return two lists of shapes: those whose contact ends an episode, and those whose contact is penalised.

    The first list is the shapes of the base and of the links that carry arms and a head. The second is thighs, shanks and the
    ends of arms. Hips are in neither, because they hardly touch the ground. The shapes `of_feet` and heels are in neither,
    because the robot stands on them.
    """
    of_legs = {i for leg in legs for i in leg.links}
    # If a leg ends in a toe, its second-last link has the heel.
    before = {i for leg in legs for i in leg.links[-2:-1]}
    soles = {shape.name for i in before for shape in tree.links[i].shapes if SOLE.search(f"{shape.link} {shape.name}")}
    in_the_middle = _trunk(tree, legs)
    ends = [i for i in range(1, len(tree.links)) if not tree.children(i) and i not in of_legs and i not in in_the_middle]
    limbs = [i for leg in legs for i in (leg.links[1:] if len(leg.links) > 2 else leg.links)[-3:]]
    found = []
    for links in (in_the_middle, limbs + ends):
        shapes = [shape for i in dict.fromkeys(links) for shape in tree.links[i].shapes if shape.collides]
        found.append([shape.name for shape in shapes if shape.name not in soles.union(feet, of_feet)])
    ending, penalized = found
    return ending, penalized


def _trunk(tree: Tree, legs: list[Leg]) -> list[int]:
    """Return the indices of the trunk's links: the base, and the links in the middle of the robot that belong to no leg."""
    poser = Poser(tree)
    poser.pose({})
    of_legs = {i for leg in legs for i in leg.links}
    return [i for i in range(len(tree.links)) if i not in of_legs and abs(poser.point(i, np.zeros(3))[1]) < MIDDLE]


def _reach(tree: Tree, legs: list[Leg]) -> float:
    """Return the distance [m] from the base to the farthest foot, with all joint angles at 0."""
    poser = Poser(tree)
    poser.pose({})
    return max(float(np.linalg.norm(poser.point(leg.end, leg.tip))) for leg in legs)


def _draw_what_is_bare(tree: Tree) -> None:
    """Add visual copies of the collision shapes to links without visual shapes, if other links have visual shapes."""
    if not any(not shape.collides for link in tree.links for shape in link.shapes):
        return
    for link in tree.links:
        if all(shape.collides for shape in link.shapes):
            link.shapes += [Shape(s.kind, s.size.copy(), s.pos.copy(), s.quat.copy(), False, s.link) for s in link.shapes]


def _default_pose(tree: Tree, legs: list[Leg]) -> tuple[dict[str, float], str]:
    """Return the joint angles of the default pose, and a text that says where they come from.

    Raises:
        ConfigError: the robot does not stand on its legs in that pose.
    """
    if tree.home is not None:
        angles = {hinge.name: tree.home.get(hinge.name, 0.0) for hinge in tree.hinges}
        within = all(h.range is None or h.range[0] - 1e-6 <= angles[h.name] <= h.range[1] + 1e-6 for h in tree.hinges)
        poser = Poser(tree)
        poser.pose(angles)
        low = [float(poser.point(leg.end, leg.tip)[2]) for leg in legs]
        if within and max(low) < 0.0 and max(low) - min(low) < GOOD * -min(low):
            origin = f"of the keyframe '{tree.home_name}'"
            tree.say(f"the default pose is that of the keyframe '{tree.home_name}'")
            return {name: round(angle, 4) + 0.0 for name, angle in angles.items()}, origin
        tree.say(f"the keyframe '{tree.home_name}' is no stance (the feet are not level, or a joint is beyond its range)")
    angles, miss = standing_angles(tree, legs)
    tree.say("guess: the default pose is a stance by inverse kinematics: base level, feet under the hips, knees bent")
    if miss > LOST_FOOT:
        feet = ", ".join(tree.links[leg.end].name for leg in legs)
        raise ConfigError(
            f"{tree.source}: the robot can't stand on {feet}: with the base level, one of these links stays {miss:.0%} of a"
            f" leg's length away from its place under the hip. If a link is no foot, --hold can fix its joints"
        )
    if miss > GOOD:
        tree.say(f"guess: look at the default pose: a foot is {miss:.0%} of a leg's length away from its place under the hip")
    return angles, "guess: a stance by inverse kinematics"


def _check_mass(tree: Tree) -> None:
    """Compare the mass of the model with the mass in the file.

    Raises:
        ConfigError: they differ.
    """
    mass = float(model_of(tree).body_mass.sum())
    if abs(mass - tree.mass) > LOST * max(1.0, tree.mass):
        raise ConfigError(
            f"{tree.source}: the links weigh {tree.mass:.6g} kg, but the model weighs {mass:.6g} kg: the import lost mass"
        )
    tree.say(f"mass: {tree.mass:.9g} kg in the links of the file, {mass:.9g} kg in the model")
