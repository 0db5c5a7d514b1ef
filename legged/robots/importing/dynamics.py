"""Dynamics of an MJCF file that the robot's model has not. Each is reported, or refused if the robot would be another one
without it.

The model has masses, hinges with their limits, springs, damping, armature and friction loss, torque limits, gains of position
and velocity actuators, connect and joint constraints, and the sliding friction of shapes.
"""

from collections.abc import Iterator

import mujoco
import numpy as np

from legged.errors import ConfigError
from legged.robots.importing.tree import Tree

POSES = 8
"""Number of random poses in which lost torques are computed."""
SHARE = 0.1
"""Largest torque that may be left out, as a share of the motor's; of the base's weight for the base."""
LEVER = 0.1
"""Length that turns the robot's weight into a torque, for joints without a torque limit [m]."""
SMALLEST = 1e-9
"""Forces [N] and torques [N m] below this count as zero."""


def account_for(model: mujoco.MjModel, tree: Tree) -> None:
    """Report the dynamics of `model` that `tree`, which was read from it, has not.

    Raises:
        ConfigError: without them, joints would miss more than `SHARE` of their motors' torque, or muscles drive the robot.
    """
    left_out = list(_left_out(model))
    for line, name in left_out:
        tree.say(line, name)
    muscles = [
        _name(model, "actuator", i) for i in range(model.nu) if model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_MUSCLE
    ]
    if muscles:
        raise ConfigError(f"{tree.source}: actuator '{muscles[0]}' is a muscle; robots here have torque motors")
    name, lost, whole = _lost_torque(model, tree)
    if lost > SHARE * whole:
        parts = "; ".join(dict.fromkeys(f"{line}: {about}" for line, about in left_out if line.startswith(PASSIVE)))
        raise ConfigError(
            f"{tree.source}: {name} misses up to {lost:.3g} of {whole:.3g} N m without dynamics that engines here do not have"
            f" ({parts[:200] or 'forces that the file adds'}); express them by stiffness and springref of joints"
        )


PASSIVE = ("tendons", "springs", "gravity")
"""Beginnings of the lines about passive forces."""


def _left_out(model: mujoco.MjModel) -> Iterator[tuple[str, str]]:
    """Yield a line and a name for each part of a model's dynamics that is left out."""
    for i in range(model.ntendon):
        limits = {"range": model.tendon_limited[i], "armature": model.tendon_armature[i]}
        keys = ("stiffness", "stiffnesspoly", "damping", "frictionloss")
        forces = {key: getattr(model, f"tendon_{key}")[i] for key in keys}
        has = ", ".join(key for key, value in (forces | limits).items() if np.any(value))
        yield "tendons are left out", f"{_name(model, 'tendon', i)} ({has or 'no forces'})"
    for i in range(model.njnt):
        dof, name = int(model.jnt_dofadr[i]), _name(model, "joint", i)
        if model.jnt_stiffnesspoly[i].any():
            yield "springs of joints that are not linear become linear", name
        if model.dof_dampingpoly[dof].any():
            yield "damping of joints that is not linear becomes linear", name
        low, high = model.jnt_actfrcrange[i]
        if model.jnt_actfrclimited[i] and low != -high:
            yield UNEVEN, f"{name} ({low:g} to {high:g} N m)"
    for body in np.flatnonzero(model.body_gravcomp):
        yield "gravity compensation of bodies is left out", model.body(int(body)).name or f"link_{body}"
    for i in range(model.nu):
        yield from _of_actuator(model, i, _name(model, "actuator", i))
    for key in ("density", "viscosity", "wind"):
        if np.any(getattr(model.opt, key)):
            yield "drag of air and water is left out", key


UNEVEN = "torque limits that differ by direction become the smaller one"


def _of_actuator(model: mujoco.MjModel, i: int, name: str) -> Iterator[tuple[str, str]]:
    """Yield a line and a name for each part of an actuator that is left out."""
    dynamics = mujoco.mjtDyn(int(model.actuator_dyntype[i])).name[6:].lower()
    if dynamics != "none":
        said = f"{name} ({dynamics}, {model.actuator_dynprm[i, 0]:g} s)" if "filter" in dynamics else f"{name} ({dynamics})"
        yield "filters and states of actuators are left out; control.actuator.delay makes motors late", said
    gain, bias = mujoco.mjtGain(int(model.actuator_gaintype[i])).name, mujoco.mjtBias(int(model.actuator_biastype[i])).name
    for what, kind in (("gain", gain[7:].lower()), ("bias", bias[7:].lower())):
        if kind not in ("fixed", "none", "affine") or (what, kind) == ("gain", "affine"):
            yield "laws of actuators that are no position or velocity law are left out", f"{name} ({what} {kind})"
    low, high = model.actuator_forcerange[i]
    if model.actuator_forcelimited[i] and low != -high:
        yield UNEVEN, f"{name} ({low:g} to {high:g} N m)"
    for key in ("damping", "armature", "delay"):
        if np.any(getattr(model, f"actuator_{key}")[i]):
            yield "properties of actuators that are left out", f"{key} of {name}"
    if model.actuator_plugin[i] >= 0:
        yield "plugins of actuators are left out", name


def _lost_torque(model: mujoco.MjModel, tree: Tree) -> tuple[str, float, float]:
    """Return the joint that misses the largest share of its torque without the forces that are left out, with the largest
    torque that it misses at rest, and its whole torque [N m]. The base may be meant instead, with forces [N].
    """
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    hinges = [(hinge, model.joint(hinge.name)) for hinge in tree.hinges if _has(model, hinge.name)]
    weight = float(model.body_mass.sum() * np.linalg.norm(model.opt.gravity))
    lost = dict.fromkeys((hinge.name for hinge, _ in hinges), 0.0)
    lift = 0.0
    for k in range(POSES):
        data.qpos[:] = model.qpos0
        for hinge, joint in hinges:
            low, high = hinge.range or (-np.pi, np.pi)
            column = joint.qposadr[0]
            data.qpos[column] = random.uniform(low, high) if k else np.clip(data.qpos[column], low, high)
        mujoco.mj_forward(model, data)
        forces = data.qfrc_passive  # at rest: springs and gravity compensation
        for hinge, joint in hinges:
            own = hinge.passive.get("stiffness", 0.0) * (hinge.passive.get("springref", 0.0) - data.qpos[joint.qposadr[0]])
            lost[hinge.name] = max(lost[hinge.name], abs(float(forces[joint.dofadr[0]]) - own))
        if model.njnt and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
            lift = max(lift, float(np.abs(forces[:3]).max()))
    found = [(f"joint '{h.name}'", lost[h.name], h.effort or LEVER * weight) for h, _ in hinges]
    return max([*found, ("the base", lift, max(weight, SMALLEST))], key=lambda one: one[1] / one[2])


def _has(model: mujoco.MjModel, joint: str) -> bool:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint) >= 0


def _name(model: mujoco.MjModel, kind: str, i: int) -> str:
    return getattr(model, kind)(i).name or f"{kind} {i}"
