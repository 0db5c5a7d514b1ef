"""Report of what the imported model leaves out of the dynamics in an MJCF file. The file is refused if a muscle drives the
robot. It is also refused if, at rest, a joint would lack more than a tenth of its torque limit, or the base would lack a
force of more than a tenth of the robot's weight.

The imported model has masses, hinges with their limits, springs, damping, armature and friction loss, torque limits, gains of
position and velocity actuators, connect and joint constraints, and the sliding friction of shapes.
"""

from collections.abc import Iterator

import mujoco
import numpy as np

from legged.errors import ConfigError
from legged.robots.importing.tree import Tree

POSES = 8
"""Number of poses in which lost torques are computed."""
SHARE = 0.1
"""Largest share of a joint's torque limit, or of the robot's weight for the base, that may be left out."""
LEVER = 0.1
"""Lever arm [m]. The robot's weight times this length stands in for the torque limit of joints without one."""
ARRAYS = (
    ("tendons are left out", "tendon", "stiffness stiffnesspoly damping frictionloss limited armature"),
    ("nonlinear springs of joints become linear", "jnt", "stiffnesspoly"),
    ("nonlinear damping of joints becomes linear", "dof", "dampingpoly"),
    ("gravity compensation is left out", "body", "gravcomp"),
    ("properties of actuators are left out", "actuator", "damping armature delay"),
)
"""Line for the user, kind of element, and names of properties. Elements without a property have 0 in MuJoCo's array."""
UNEVEN = "torque limits that differ by direction become the smaller one"
FILTERS = "filters and states of actuators are left out; control.actuator.delay can stand in for them"
LAWS = "actuators other than motors, position servos and velocity servos become motors with the task's control law"


def account_for(model: mujoco.MjModel, tree: Tree) -> None:
    """Report the dynamics of `model` that are left out of `tree`, which was read from it.

    Raises:
        ConfigError: a joint would lack more than `SHARE` of its motor's torque, or a muscle drives the robot.
    """
    left_out = list(_left_out(model))
    for line, name in left_out:
        tree.say(line, name)
    name, lost, whole = _lost_torque(model, tree)
    if lost > SHARE * whole:
        parts = "; ".join(f"{line}: {about}" for line, about in left_out)
        raise ConfigError(
            f"{tree.source}: {name} would lack up to {lost:.3g} of {whole:.3g} N m, because engines here do not simulate"
            f" everything in the file ({parts[:300]}); model the missing forces by stiffness and springref of joints"
        )
    for i in np.flatnonzero(model.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE).tolist():
        raise ConfigError(
            f"{tree.source}: actuator '{_name(model, 'actuator', i)}' is a muscle; robots here have torque motors"
        )


def _left_out(model: mujoco.MjModel) -> Iterator[tuple[str, str]]:
    """Yield a line and a name for each part of a model's dynamics that is left out."""
    for line, kind, properties in ARRAYS:
        has = {key: getattr(model, f"{kind}_{key}") for key in properties.split()}
        for i in range(len(next(iter(has.values())))):
            of = ", ".join(key for key, values in has.items() if np.any(values[i]))
            if of or kind == "tendon":
                yield line, f"{_name(model, kind, i)} ({of or 'no forces'})"
    ranges = [("jnt", i, model.jnt_actfrcrange[i]) for i in np.flatnonzero(model.jnt_actfrclimited).tolist()]
    ranges += [("actuator", i, model.actuator_forcerange[i]) for i in np.flatnonzero(model.actuator_forcelimited).tolist()]
    for kind, number, (low, high) in ranges:
        if low != -high:
            yield UNEVEN, f"{_name(model, kind, number)} ({low:g} to {high:g} N m)"
    for i in range(model.nu):
        name, time = _name(model, "actuator", i), model.actuator_dynprm[i, 0]
        enums = (mujoco.mjtDyn, "dyn"), (mujoco.mjtGain, "gain"), (mujoco.mjtBias, "bias")
        dynamics, gain, bias = (
            enum(int(getattr(model, f"actuator_{key}type")[i])).name.split("_")[1].lower() for enum, key in enums
        )
        if dynamics != "none":
            yield FILTERS, f"{name} ({dynamics}{f', {time:g} s' if 'filter' in dynamics else ''})"
        if gain != "fixed" or bias not in ("none", "affine") or model.actuator_plugin[i] >= 0:
            yield LAWS, f"{name} (gain {gain}, bias {bias})"
    for key in ("density", "viscosity", "wind"):
        if np.any(getattr(model.opt, key)):
            yield "drag of air and water is left out", key


def _lost_torque(model: mujoco.MjModel, tree: Tree) -> tuple[str, float, float]:
    """Return (name, left-out torque at rest, torque limit) [N m] of the joint for which this torque is the largest share of
    the limit. If the share of the base is larger, return ('the base', left-out force, weight) [N].
    """
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    named = {model.joint(i).name: model.joint(i) for i in range(model.njnt)}
    hinges = [(hinge, named[hinge.name]) for hinge in tree.hinges if hinge.name in named]
    weight = float(model.body_mass.sum() * 9.81)
    lost, lift = np.zeros(len(hinges)), 0.0
    for _ in range(POSES):
        for hinge, joint in hinges:
            data.qpos[joint.qposadr] = random.uniform(*(hinge.range or (-np.pi, np.pi)))
        mujoco.mj_forward(model, data)  # at rest, passive forces are springs and gravity compensation
        for k, (hinge, joint) in enumerate(hinges):
            stretch = hinge.passive.get("springref", 0.0) - data.qpos[joint.qposadr[0]]
            left_out = data.qfrc_passive[joint.dofadr[0]] - hinge.passive.get("stiffness", 0.0) * stretch
            lost[k] = max(lost[k], abs(left_out))
        if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
            lift = max(lift, float(np.abs(data.qfrc_passive[:3]).max()))
    whole = [hinge.effort or LEVER * weight for hinge, _ in hinges]
    found = [(f"joint '{hinge.name}'", float(lost[k]), whole[k]) for k, (hinge, _) in enumerate(hinges)]
    return max([*found, ("the base", lift, weight)], key=lambda one: one[1] / one[2])


def _name(model: mujoco.MjModel, kind: str, i: int) -> str:
    """Return the name of an element; a degree of freedom has the name of its joint."""
    number, of = (int(model.dof_jntid[i]), "jnt") if kind == "dof" else (int(i), kind)
    return getattr(model, of)(number).name or f"{of} {number}"
