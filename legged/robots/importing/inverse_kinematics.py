"""A stance by inverse kinematics: base level, feet under the hips, knees bent, all joints within their limits, left and right
alike, and the centre of mass above the feet.
"""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from legged.robots.importing.legs import ANKLE, SAMPLES, Leg, Poser
from legged.robots.importing.tree import Tree, Vector

STRETCH, UPRIGHT = 0.8, 0.96
"""Distance from hip to foot as a share of the stretched leg's length, for robots with three legs or more and for bipeds."""
OUTWARD = 0.5
"""Largest sideways distance of a foot from its hip, as a share of the stretched leg's length."""
MARGIN = 0.05
"""Share of a joint's range that stays free at each end."""
TRIES, ROUNDS = 24, 60
STEP = 1e-5
"""Step of the finite differences [rad]."""
GOOD = 0.05
"""Largest distance of a foot from its goal in a good stance, as a share of the leg's length."""
KNEES = 0.002
"""Weight of the cost of knees on the wrong side of the hip. It is small, and decides only between stances of similar cost."""
LATERAL = 0.7
"""Least absolute y component of the axis of a hinge that bends a leg forward."""


@dataclass
class _Limb:
    """A leg and its partner on the other side."""

    leg: Leg
    partner: Leg | None
    signs: Vector
    """(hinges,) signs, 1 or -1. The partner's angles are the leg's angles times these signs."""
    ranges: Vector
    """(hinges, 2) ranges of the leg's angles [rad]. In these ranges, the partner's angles are within their limits too."""
    hip_name: str
    """First hinge that bends the leg forward."""
    hip: Vector
    """(3,) position of the hinge `hip_name` at zero angles [m]."""
    side: float
    """y coordinate of the foot's goal [m]: the foot's y at zero angles, but at most `OUTWARD * length` from the hip."""
    knee: int
    """Index of the link of the second hinge that bends the leg forward."""
    length: float
    """Distance from the hip to the foot of the stretched leg [m]."""
    level: Vector
    """(3,) direction in the foot's frame that points up at zero angles."""


def standing_angles(tree: Tree, legs: list[Leg]) -> tuple[dict[str, float], float]:
    """Return hinge -> angle [rad] of the stance, and the largest distance of a foot from its goal, as a share of the leg's
    length.
    """
    poser = Poser(tree)
    limbs = _limbs(tree, legs, poser)
    free = [(limb, k) for limb in limbs for k in range(len(limb.leg.hinges))]
    lows, highs = np.array([limb.ranges[k] for limb, k in free]).T
    rest = {hinge.name: float(np.clip(0.0, *_kept(poser, hinge.name))) for hinge in tree.hinges}
    biped = len(legs) == 2  # a robot with three legs stands like one with four
    stretch = UPRIGHT if biped else STRETCH
    ground = max(float(limb.hip[2]) - stretch * limb.length for limb in limbs)  # the shortest leg has to reach the ground

    def angles(x: Vector) -> dict[str, float]:
        found = dict(rest)
        for value, (limb, k) in zip(x, free, strict=True):
            found[limb.leg.hinges[k]] = float(value)
            if limb.partner is not None:
                found[limb.partner.hinges[k]] = float(value * limb.signs[k])
        return found

    middle = np.clip(0.0, lows, highs)

    def errors(x: Vector) -> Vector:
        poser.pose(angles(x))
        mujoco.mj_comPos(poser.model, poser.data)
        centre = poser.data.subtree_com[1]
        found, feet = [], []
        for limb in limbs:
            foot = poser.point(limb.leg.end, limb.leg.tip)
            feet.append(foot)
            goal = np.array([limb.hip[0], limb.side, ground])
            weights = np.array([0.1, 1.0, 3.0]) if biped else np.array([1.0, 1.0, 3.0])
            found += list(weights * (foot - goal) / limb.length)
            if len(limb.leg.hinges) >= ANKLE and biped:
                up = poser.data.xmat[poser.ids[limb.leg.end]].reshape(3, 3) @ limb.level
                found += list(up[:2])
        over = np.mean([foot[0] for foot in feet]) - centre[0]
        found.append((1.0 if biped else 0.2) * over / limbs[0].length)
        return np.array([*found, *(0.02 * (x - middle))])

    best, least = middle, np.inf
    random = np.random.default_rng(0)
    for k in range(TRIES):
        x = _solved(errors, middle if k == 0 else random.uniform(lows, highs), lows, highs)
        cost = float(np.sum(errors(x) ** 2)) + _wrong_knees(poser, limbs, forward=biped)
        if cost < least - 1e-9:
            best, least = x, cost
    found = {name: round(angle, 3) + 0.0 for name, angle in tree.followed(angles(best)).items()}
    poser.pose(found)
    miss = [_miss(poser, limb, ground) for limb in limbs]
    return found, max(miss)


def _miss(poser: Poser, limb: _Limb, ground: float) -> float:
    foot = poser.point(limb.leg.end, limb.leg.tip)
    goal = np.array([limb.side, ground])
    return float(np.linalg.norm(foot[1:] - goal) / limb.length)


def _solved(errors: Callable[[Vector], Vector], x: Vector, lows: Vector, highs: Vector) -> Vector:
    """Return angles (n,) near `x` at a minimum of the sum of squared errors, found by damped Gauss-Newton steps."""
    damping, before = 1e-2, errors(x)
    for _ in range(ROUNDS):
        slopes = np.stack([(errors(x + step) - before) / STEP for step in STEP * np.eye(len(x))], axis=1)
        normal = slopes.T @ slopes + damping * np.eye(len(x))
        tried = np.clip(x - np.linalg.solve(normal, slopes.T @ before), lows, highs)
        after = errors(tried)
        if after @ after < before @ before:
            done = before @ before - after @ after < 1e-10
            x, before, damping = tried, after, max(1e-6, damping / 3.0)
            if done:
                break
        else:
            damping *= 5.0
            if damping > 1e6:
                break
    return x


def _wrong_knees(poser: Poser, limbs: list[_Limb], forward: bool) -> float:
    """Return a cost for knees on the wrong side: behind the hip if knees should point `forward`, else in front of it."""
    cost = 0.0
    for limb in limbs:
        body = poser.ids[limb.knee]
        ahead = float(poser.data.xpos[body][0] - limb.hip[0]) / limb.length
        cost += KNEES * max(0.0, -ahead if forward else ahead)
    return cost


def _kept(poser: Poser, name: str) -> tuple[float, float]:
    low, high = poser.limits(name)
    margin = MARGIN * (high - low)
    return low + margin, high - margin


def _limbs(tree: Tree, legs: list[Leg], poser: Poser) -> list[_Limb]:
    """Return one limb for each pair of legs, with the mirrored leg as its partner, and one for each leg without partner."""
    poser.pose({})
    data = poser.data
    joints = {name: int(poser.model.joint(name).id) for name in poser.places}
    starts = [data.xanchor[joints[leg.hinges[0]]].copy() for leg in legs]
    limbs, taken = [], set()
    for i, leg in enumerate(legs):
        if i in taken:
            continue
        apart = [np.linalg.norm(start * [1, -1, 1] - starts[i]) for start in starts]
        partner = next((j for j in np.argsort(apart) if j != i and j not in taken and apart[j] < 0.02), None)
        if partner is not None and (len(legs[partner].hinges) != len(leg.hinges) or abs(starts[i][1]) < 1e-3):
            partner = None
        axes = np.array([data.xaxis[joints[name]] for name in leg.hinges])
        signs = np.ones(len(axes))
        ranges = np.array([_kept(poser, name) for name in leg.hinges])
        other = None
        if partner is not None:
            theirs = np.array([data.xaxis[joints[name]] for name in legs[partner].hinges])
            mirrored = np.sign((axes * [-1.0, 1.0, -1.0] * theirs).sum(axis=1))
            mapped = np.sort(mirrored[:, None] * [_kept(poser, name) for name in legs[partner].hinges], axis=1)
            both = np.stack([np.maximum(ranges, mapped)[:, 0], np.minimum(ranges, mapped)[:, 1]], axis=1)
            if (both[:, 0] <= both[:, 1]).all():  # the ranges of the two legs overlap
                other, signs, ranges = legs[partner], mirrored, both
                taken.add(int(partner))
        bends = [k for k, axis in enumerate(axes) if abs(axis[1]) > LATERAL] or list(range(len(axes)))
        hip_name = leg.hinges[bends[0]]
        hip = data.xanchor[joints[hip_name]].copy()
        knee_hinge = leg.hinges[bends[1] if len(bends) > 1 else bends[0]]
        knee = next(j for j in leg.links if any(hinge.name == knee_hinge for hinge in tree.links[j].hinges))
        side = float(poser.point(leg.end, leg.tip)[1])
        level = data.xmat[poser.ids[leg.end]].reshape(3, 3).T[:, 2].copy()
        limbs.append(_Limb(leg, other, signs, ranges, hip_name, hip, side, knee, 1.0, level))
    for limb in limbs:
        limb.length = _stretched(poser, limb)
        out = OUTWARD * limb.length  # if a leg points sideways at zero angles, its foot has to stand closer to the hip
        limb.side = float(np.clip(limb.side, limb.hip[1] - out, limb.hip[1] + out))
    return limbs


def _stretched(poser: Poser, limb: _Limb) -> float:
    """Return the largest distance of the foot from the hip [m], over random angles within the limits."""
    random = np.random.default_rng(1)
    lows, highs = limb.ranges.T
    hip = int(poser.model.joint(limb.hip_name).id)
    farthest = 0.0
    for k in range(SAMPLES):
        values = np.clip(0.0, lows, highs) if k == 0 else random.uniform(lows, highs)
        poser.pose(dict(zip(limb.leg.hinges, values, strict=True)))
        foot = poser.point(limb.leg.end, limb.leg.tip)
        farthest = max(farthest, float(np.linalg.norm(foot - poser.data.xanchor[hip])))
    return farthest
