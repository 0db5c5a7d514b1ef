"""Reading of a robot's MJCF, with checks of the conditions that engines rely on."""

import contextlib
import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np

from legged.errors import ConfigError, suggest
from legged.process.paths import exists
from legged.robots.importing.convert import robot_spec_of
from legged.robots.patterns import match_names
from legged.robots.reserved_names import RESERVED

GROUPS = 31
"""Number of actuator groups that a model can disable; they are numbered from 0."""
LARGEST_NUMBER = 1e12
"""Largest number allowed in a model. Larger numbers may overflow in float32, with which GPUs compute."""
NUMBERS = ("qpos0", "qpos_spring", "body_", "jnt_", "dof_", "geom_", "site_", "actuator_", "mesh_", "eq_", "tendon_")
"""`read_model` checks the numbers in the model's arrays whose names begin with one of these texts."""


def read_model(folder: Path, file: str, where: str) -> mujoco.MjModel:
    """Return the compiled model of `file` in `folder`. `where` is the file that names the model, for error messages.

    Raises:
        ConfigError: there is no such file, MuJoCo refuses it, or its numbers or options are not allowed.
    """
    path = folder / file
    if not exists(path) or not path.is_file():
        raise ConfigError(f"{where}: model: there is no file '{file}' in {folder}")
    at = f"{where}: model: {path}"
    warnings: list[str] = []
    try:
        with _warnings_to(warnings):
            model = robot_spec_of(path).compile()
    except ConfigError as error:
        raise ConfigError(f"{where}: model: {error}") from error
    except Exception as error:  # MuJoCo raises errors of several classes
        raise ConfigError(f"{at}: MuJoCo refuses it: {' '.join(str(error).split())}") from error
    if warnings:
        raise ConfigError(f"{at}: MuJoCo warns: {' '.join(warnings[0].split())}")
    for owner in (model, model.opt):
        for name in dir(owner):
            if owner is model and not name.startswith(NUMBERS):
                continue
            values = getattr(owner, name)
            numeric = isinstance(values, float) or (isinstance(values, np.ndarray) and values.dtype.kind == "f")
            if numeric and not (np.abs(values) <= LARGEST_NUMBER).all():
                raise ConfigError(f"{at}: compiled {name}: numbers must be finite and at most {LARGEST_NUMBER:g}")
    for flag in ("CONTACT", "CONSTRAINT", "ACTUATION"):
        if model.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"):
            raise ConfigError(f"{at}: option flag: {flag.lower()} is disabled; without it the robot could not walk")
    for group in disabled_groups(model):
        raise ConfigError(f"{at}: option actuatorgroupdisable: group {group} has motors and must not be disabled")
    for flag in ("SLEEP", "IPC"):
        if model.opt.enableflags & getattr(mujoco.mjtEnableBit, f"mjENBL_{flag}"):
            raise ConfigError(f"{at}: option flag: {flag.lower()} is enabled; remove it, as its state is not kept per robot")
    return model


def disabled_groups(model: mujoco.MjModel) -> list[int]:
    """Return the actuator groups that have actuators but are disabled in the model's options."""
    groups = sorted({int(group) for group in model.actuator_group if 0 <= group < GROUPS})
    return [group for group in groups if model.opt.disableactuator >> group & 1]


@contextlib.contextmanager
def _warnings_to(warnings: list[str]) -> Iterator[None]:
    """Append MuJoCo's warnings to a list. MuJoCo itself would print them and write a file into the working directory."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warnings.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def check_model(model: mujoco.MjModel, base: str, where: str, passive: Sequence[str] = ()) -> None:
    """Check the conditions that engines rely on, as far as `robot_spec_of` does not ensure them. The first joint is on the
    base. Each later joint is passive (a pattern in `passive` matches its name) or is a hinge with one motor, whose torque has
    a limit. No shape or sensor has a name that the scene needs.

    Raises:
        ConfigError: a condition is not met; the message begins with `where`.
    """
    undriven = passive_joints(model, passive, where)
    _check_tree(model, base, undriven, where)
    _check_motors(model, undriven, where)
    for kind, count in (("geom", model.ngeom), ("sensor", model.nsensor)):
        for name in (getattr(model, kind)(i).name for i in range(count)):
            if re.fullmatch(RESERVED[kind], name):
                raise ConfigError(f"{where}: model: {kind} '{name}': the scene needs this name; choose another")
    if base_mass(model, base) <= 0.0:
        raise ConfigError(f"{where}: base: body '{base}' has no mass")


def aimless_shapes(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return one line that names the collision shapes whose contype and conaffinity exclude contacts with the ground, or no
    line. The task replaces contype and conaffinity, so that all collision shapes collide with the ground.
    """
    touched, meets = model.geom_contype | model.geom_conaffinity, (model.geom_contype & 1) | (model.geom_conaffinity & 3)
    names = [model.geom(int(i)).name for i in np.flatnonzero((touched != 0) & (meets == 0))]
    said = "shapes collide with the ground, although their contype and conaffinity exclude it"
    return (f"{said}: {', '.join(names)[:200]}",) if names else ()


def base_mass(model: mujoco.MjModel, base: str) -> float:
    """Return the mass of the floating body [kg]."""
    return float(model.body(base).mass[0])


def passive_joints(model: mujoco.MjModel, patterns: Sequence[str], where: str) -> list[int]:
    """Return the ids of the passive joints, whose names the patterns match. The base's joint is never passive.

    Raises:
        ConfigError: a pattern matches no joint's name; `where` is the file of the patterns.
    """
    names = [model.joint(i).name for i in range(1, model.njnt)]
    return [1 + i for i in match_names(patterns, names, f"{where}: passive_joints")]


def driven_joints(model: mujoco.MjModel, passive: Collection[int]) -> list[int]:
    """Return the ids of all joints except the base's and `passive`."""
    return [i for i in range(1, model.njnt) if i not in passive]


def _check_tree(model: mujoco.MjModel, base: str, passive: Collection[int], where: str) -> None:
    bodies = [model.body(i).name for i in range(model.nbody)]
    if base not in bodies:
        raise ConfigError(f"{where}: base: the model has no body '{base}'{suggest(base, bodies)}")
    if (model.jnt_type[driven_joints(model, passive)] != mujoco.mjtJoint.mjJNT_HINGE).any():
        hinges = "needs one free joint, on the base, followed by hinges only"
        raise ConfigError(f"{where}: model: {hinges}; list slides and balls under passive_joints")
    if model.jnt_bodyid[0] != bodies.index(base):
        raise ConfigError(f"{where}: base: the free joint is on '{bodies[model.jnt_bodyid[0]]}', not on '{base}'")


def _check_motors(model: mujoco.MjModel, passive: Collection[int], where: str) -> None:
    """Check that each driven hinge has one motor with a valid torque limit, in the order of the hinges."""
    names = tuple(model.joint(i).name for i in driven_joints(model, passive))
    driven = tuple(model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu))
    if driven != names:
        extra = "; list joints without a motor under passive_joints" if len(driven) < len(names) else ""
        order = "needs one motor per hinge in the same order"
        raise ConfigError(f"{where}: model: {order}; hinges {names}, motors {driven}{extra}")
    for i, joint in enumerate(names):
        if problem := _why_no_torque_limit(model, i):
            raise ConfigError(f"{where}: model: the actuator of '{joint}' {problem}")


def _why_no_torque_limit(model: mujoco.MjModel, i: int) -> str:
    """Return the reason why an actuator's forcerange is not a valid torque limit; '' if it is valid."""
    low, high = model.actuator_forcerange[i]
    if not model.actuator_forcelimited[i]:
        return "has no limit: every motor needs a forcerange (the torque limit)"
    if not (0.0 < high < 1e6) or low != -high:
        return f"has forcerange [{low:g}, {high:g}]: the torque limit must be above 0, finite, and the same both ways"
    if model.actuator_ctrllimited[i] and (model.actuator_ctrlrange[i] != (low, high)).any():
        lowest, highest = model.actuator_ctrlrange[i]
        if lowest > low or highest < high:
            return f"has ctrlrange [{lowest:g}, {highest:g}]; it must not be narrower than forcerange [{low:g}, {high:g}]"
    return ""
