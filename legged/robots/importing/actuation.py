"""Torque limits and gains from a robot's file, with a check that the gains are stable in the explicit control law."""

from collections.abc import Sequence

import mujoco
import numpy as np

from legged.robots.gains import TIME_STEP, VELOCITY_LIMIT, gains, inertia_in_air, mass_matrix, standing_torques
from legged.robots.importing.legs import Leg, Poser
from legged.robots.importing.tree import Tree

SHARE, ELSEWHERE = 0.4, 0.1
"""Guessed torque limits of leg joints and of other joints, as shares of weight times base height."""
GRAVITY = 9.81
SAG = 1.0
"""Largest deflection of a joint under the robot's weight [rad]. The file's gains are left out if they allow a larger one."""


def guess_efforts(tree: Tree, legs: list[Leg], height: float) -> None:
    """Guess the missing torque limits of motors from the weight and the `height` [m] of the robot. Limits that the file
    states are kept.
    """
    weight = sum(link.mass for link in tree.links) * GRAVITY * height
    of_legs = {name for leg in legs for name in leg.hinges}
    for hinge in tree.hinges:
        if hinge.driven and hinge.effort is None:
            hinge.effort = round((SHARE if hinge.name in of_legs else ELSEWHERE) * weight, 1)
            share = SHARE if hinge.name in of_legs else ELSEWHERE
            tree.say(
                f"guess: torque limits missing in the file are set to {share:g} m g h", f"{hinge.name} {hinge.effort:g} N m"
            )


def speed_limits(tree: Tree) -> dict[str, float]:
    """Return hinge -> speed limit [rad/s] for all hinges with a motor, with a default for missing limits. The table is empty
    if the file states no limits.
    """
    driven = [hinge for hinge in tree.hinges if hinge.driven]
    if not any(hinge.velocity for hinge in driven):
        return {}
    for hinge in driven:
        if hinge.velocity is None:
            tree.say(f"guess: speed limits missing in the file are set to {VELOCITY_LIMIT:g} rad/s", hinge.name)
    return {hinge.name: hinge.velocity or VELOCITY_LIMIT for hinge in driven}


def give_rotors(tree: Tree, angles: dict[str, float]) -> None:
    """Add a rotor inertia (armature) to the wheels that are too light for a stable gain on their speed. The inertias of the
    wheels are those in the pose at `angles` [rad].
    """
    wheels = [hinge for hinge in tree.hinges if hinge.rolls and hinge.driven]
    poser = Poser(tree)
    own = inertia_in_air(poser.model, poser.pose(angles).qpos, [int(poser.model.joint(hinge.name).id) for hinge in wheels])
    for hinge, inertia in zip(wheels, own, strict=True):
        missing = TIME_STEP * (hinge.effort or 0.0) / (hinge.velocity or VELOCITY_LIMIT) - float(inertia)
        if missing > 0.0:
            hinge.passive["armature"] = round(hinge.passive.get("armature", 0.0) + 1.01 * missing, 6)
            tree.say(
                "guess: wheels too light for the torque and speed of their motors get this rotor inertia",
                f"{hinge.name} {hinge.passive['armature']:.3g} kg m^2",
            )


def rule_gains(tree: Tree, angles: dict[str, float], feet: Sequence[str], height: float) -> tuple[dict[str, float], ...]:
    """Return hinge -> P gain [N m/rad] and hinge -> D gain [N m s/rad] by the rule for a robot without gains (gains.py). The
    robot is in the pose at `angles` [rad], with the base at `height` [m], on the shapes `feet`. The P gain of a wheel is a
    gain on its speed [N m s/rad], and its D gain is 0.
    """
    driven = [hinge for hinge in tree.hinges if hinge.driven]
    poser = Poser(tree)
    model, qpos = poser.model, poser.pose(angles).qpos.copy()
    joints, shapes = [int(model.joint(hinge.name).id) for hinge in driven], [int(model.geom(name).id) for name in feet]
    effort = np.array([hinge.effort or 0.0 for hinge in driven])
    rolling = np.array([(hinge.velocity or VELOCITY_LIMIT) * hinge.rolls for hinge in driven])
    both = gains(model, qpos, joints, shapes, effort, height, rolling)
    return tuple(dict(zip((hinge.name for hinge in driven), values.tolist(), strict=True)) for values in both)


def take_gains(
    tree: Tree, angles: dict[str, float], feet: Sequence[str], height: float
) -> tuple[dict[str, float], dict[str, float]]:
    """Return hinge -> P gain [N m/rad] and hinge -> D gain [N m s/rad] of the file's position actuators. Other hinges have
    the gains of `rule_gains`, but the gain of a wheel is at most that of its velocity actuator in the file.

    If an actuator has no D gain, the damping of the joint becomes the D gain and is removed from the joint. Both tables are
    empty if the file has no gains, if nothing is damped, if the explicit law would be unstable, or if the robot would sink
    too far on the shapes `feet` in the pose at `angles` [rad], with the base at `height` [m].
    """
    stated = [hinge for hinge in tree.hinges if hinge.driven and hinge.stiffness and not hinge.rolls]
    if not stated:
        return {}, {}
    damping = {hinge.name: float(hinge.damping or hinge.passive.get("damping", 0.0)) for hinge in stated}
    if not any(damping.values()):  # `growth` is then 1, and rounding errors would decide whether it exceeds 1
        tree.say("gains of the file's position actuators are left out: neither actuators nor joints have any damping")
        return {}, {}
    p, d = rule_gains(tree, angles, feet, height)
    stiffness = p | {hinge.name: float(hinge.stiffness or 0.0) for hinge in stated}
    damping = d | damping
    for hinge in tree.hinges:
        if hinge.rolls and hinge.driven and hinge.damping and not hinge.stiffness:  # the file has a velocity actuator
            stiffness[hinge.name] = min(hinge.damping, stiffness[hinge.name])
    grows = growth(tree, angles, stiffness, damping)
    if grows > 1.0:
        tree.say(
            f"gains of the file's position actuators are left out: at steps of {TIME_STEP * 1000:g} ms an explicit law with"
            f" them makes deviations {grows:.3g} times as large in each step"
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
    for hinge in stated:
        if not hinge.damping and "damping" in hinge.passive:
            del hinge.passive["damping"]
            tree.say("joint damping becomes the D gain where the actuator has no damping", hinge.name)
    tree.say("gains are those of the file's position actuators")
    for hinge in tree.hinges:
        if hinge.driven and hinge not in stated:
            tree.say("guess: a rule chooses the gains of joints without a position actuator", hinge.name)
    return stiffness, damping


def _sags(tree: Tree, angles: dict[str, float], stiffness: dict[str, float], feet: Sequence[str]) -> dict[str, float]:
    """Return hinge -> deflection under the robot's weight [rad] for all driven hinges except wheels. The base is level."""
    stiffness = {hinge.name: stiffness[hinge.name] for hinge in tree.hinges if hinge.driven and not hinge.rolls}
    poser = Poser(tree)
    data = poser.pose(angles)
    shapes = [int(poser.model.geom(name).id) for name in feet]
    torques = standing_torques(poser.model, data.qpos, [int(poser.model.joint(name).id) for name in stiffness], shapes)
    return {name: abs(float(torque)) / gain for (name, gain), torque in zip(stiffness.items(), torques, strict=True)}


def growth(tree: Tree, angles: dict[str, float], stiffness: dict[str, float], damping: dict[str, float]) -> float:
    """Return the largest factor by which a deviation from the pose at `angles` [rad] grows in one step of semi-implicit Euler
    with explicit torques -K q - D v and a free base. K of a wheel acts on its speed. A joint with D = 0 keeps its damping.
    """
    rolls = {hinge.name: stiffness[hinge.name] for hinge in tree.hinges if hinge.driven and hinge.rolls}
    stiffness, damping = stiffness | dict.fromkeys(rolls, 0.0), damping | rolls
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
