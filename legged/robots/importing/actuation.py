"""Torque limits and gains that a file states, and whether they hold here: the law of the joints is an explicit one."""

from collections.abc import Sequence

import mujoco
import numpy as np

from legged.robots.gains import TIME_STEP, VELOCITY_LIMIT, mass_matrix, standing_torques
from legged.robots.importing.legs import Leg, Poser
from legged.robots.importing.tree import Tree

SHARE, ELSEWHERE = 0.4, 0.1
"""Guess of a torque limit, in weight times height of the base: of a leg, of other joints."""
GRAVITY = 9.81
SAG = 1.0
"""Gains of a file under which a joint gives way by more than this are none to stand with [rad]."""


def guess_efforts(tree: Tree, legs: list[Leg], height: float) -> None:
    """Give motors without a torque limit one, by weight and height [m] of the robot; a hinge that the file limits to another
    value keeps it.
    """
    weight = sum(link.mass for link in tree.links) * GRAVITY * height
    of_legs = {name for leg in legs for name in leg.hinges}
    for hinge in tree.hinges:
        if hinge.driven and hinge.effort is None:
            hinge.effort = round((SHARE if hinge.name in of_legs else ELSEWHERE) * weight, 1)
            share = SHARE if hinge.name in of_legs else ELSEWHERE
            tree.say(f"guess: torque limits that the file lacks are {share:g} m g h", f"{hinge.name} {hinge.effort:g} N m")


def speed_limits(tree: Tree) -> dict[str, float]:
    """Return the speed limits of all hinges with a motor [rad/s], where the file states any; what it leaves out is as
    elsewhere.
    """
    driven = [hinge for hinge in tree.hinges if hinge.driven]
    if not any(hinge.velocity for hinge in driven):
        return {}
    for hinge in driven:
        if hinge.velocity is None:
            tree.say(f"guess: speed limits that the file lacks are {VELOCITY_LIMIT:g} rad/s", hinge.name)
    return {hinge.name: hinge.velocity or VELOCITY_LIMIT for hinge in driven}


def take_gains(tree: Tree, angles: dict[str, float], feet: Sequence[str]) -> tuple[dict[str, float], dict[str, float]]:
    """Return P and D gains [N m/rad], [N m s/rad] of the file's position actuators by hinge; the damping of a hinge whose
    actuator has none is its D gain, and leaves the hinge. Empty, where the file has none, nothing is damped, or
    they would not hold the robot up on the shapes `feet` in the pose at `angles` [rad].
    """
    driven = [hinge for hinge in tree.hinges if hinge.driven]
    stated = [hinge for hinge in driven if hinge.stiffness]
    if not stated:
        return {}, {}
    if len(stated) < len(driven):
        for hinge in driven:
            if not hinge.stiffness:
                tree.say("gains of the file are left out, because these joints have none", hinge.name)
        return {}, {}
    stiffness = {hinge.name: float(hinge.stiffness or 0.0) for hinge in driven}
    damping = {hinge.name: float(hinge.damping or hinge.passive.get("damping", 0.0)) for hinge in driven}
    if not any(damping.values()):  # on the verge of growth, to either side of which rounding puts it
        tree.say("gains of the file's position actuators are left out: neither actuators nor joints have any damping")
        return {}, {}
    growth = _growth(tree, angles, stiffness, damping)
    if growth > 1.0:
        tree.say(
            f"gains of the file's position actuators are left out: at steps of {TIME_STEP * 1000:g} ms an explicit law with"
            f" them makes deviations grow by {growth:.3g} a step"
        )
        return {}, {}
    sags = _sags(tree, angles, stiffness, feet)
    worst = max(sags, key=lambda name: sags[name])
    if sags[worst] > SAG:
        tree.say(
            f"gains of the file's position actuators are left out: under the robot's weight {worst} would give way by"
            f" {sags[worst]:.2g} rad"
        )
        return {}, {}
    for hinge in driven:
        if not hinge.damping and "damping" in hinge.passive:
            del hinge.passive["damping"]
            tree.say("damping of joints whose actuators have none is their D gain instead", hinge.name)
    tree.say("gains are those of the file's position actuators")
    return stiffness, damping


def _sags(tree: Tree, angles: dict[str, float], stiffness: dict[str, float], feet: Sequence[str]) -> dict[str, float]:
    """Return how far each joint gives way under the robot's weight [rad], with the base level on its feet."""
    poser = Poser(tree)
    data = poser.pose(angles)
    shapes = [int(poser.model.geom(name).id) for name in feet]
    torques = standing_torques(poser.model, data.qpos, [int(poser.model.joint(name).id) for name in stiffness], shapes)
    return {name: abs(float(torque)) / gain for (name, gain), torque in zip(stiffness.items(), torques, strict=True)}


def _growth(tree: Tree, angles: dict[str, float], stiffness: dict[str, float], damping: dict[str, float]) -> float:
    """Return the largest factor by which a deviation grows in a step of semi-implicit Euler with explicit torques -K q - D v,
    the base free, in the pose at `angles`; damping and armature of the joints count.
    """
    poser = Poser(tree)
    data = poser.pose(angles)
    mujoco.mj_forward(poser.model, data)
    inertia = mass_matrix(poser.model, data)
    dofs = [int(poser.model.joint(name).dofadr[0]) for name in stiffness]
    own = poser.model.dof_damping[dofs]
    mobility = np.linalg.inv(inertia)[np.ix_(dofs, dofs)]
    k = mobility @ np.diag(list(stiffness.values()))
    d = mobility @ (np.diag(list(damping.values())) + np.diag(own * [damping[name] == 0.0 for name in stiffness]))
    eye = np.eye(len(dofs))
    rates = np.hstack([-TIME_STEP * k, eye - TIME_STEP * d])
    step = np.vstack([np.hstack([eye, np.zeros_like(eye)]) + TIME_STEP * rates, rates])
    return float(np.abs(np.linalg.eigvals(step)).max())
