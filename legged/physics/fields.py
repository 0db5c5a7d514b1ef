"""Table of the fields that can be randomised, and of the arrays of MuJoCo's model that each field changes."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Literal

import mujoco
import numpy as np

from legged.physics.scene import Scene

DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0", "actuator_acc0")
"""Arrays that MuJoCo derives from masses, inertias and armatures."""


def moving_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Return the ids of the bodies that at least one joint moves."""
    return np.flatnonzero(model.body_weldid)


def floating_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Return the ids of the bodies with a free joint."""
    return model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]


def joint_dofs(model: mujoco.MjModel) -> np.ndarray:
    """Return the indices of the degrees of freedom of hinges and slides."""
    kind = model.jnt_type[model.dof_jntid]
    return np.flatnonzero((kind == mujoco.mjtJoint.mjJNT_HINGE) | (kind == mujoco.mjtJoint.mjJNT_SLIDE))


def linear_actuators(model: mujoco.MjModel) -> np.ndarray:
    """Return the indices of actuators with the force `gear * gain * control`: no muscles, and no actuators of gear 0."""
    muscle = model.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE
    return np.flatnonzero((model.actuator_gear[:, 0] != 0.0) & ~muscle)


def per_gear(model: mujoco.MjModel) -> np.ndarray:
    """Return the gain with which one unit of control produces one unit of force, for each actuator, (nu,)."""
    gear = model.actuator_gear[:, 0]
    return np.divide(1.0, gear, out=np.zeros_like(gear), where=gear != 0.0)


def limited_actuators(model: mujoco.MjModel) -> np.ndarray:
    """Return the indices of the actuators with a force limit."""
    return np.flatnonzero(model.actuator_forcelimited)


def damping_ratio(model: mujoco.MjModel) -> np.ndarray:
    """Return the damping ratio of each shape's contacts, (ngeom,)."""
    return model.geom_solref[:, 1]


def mirrored_per_gear(model: mujoco.MjModel) -> np.ndarray:
    """Return, for each actuator, (nu,), the change of position bias that must accompany a change of gain by `per_gear`. It
    is `-per_gear` for an affine bias, otherwise 0. With both changes, a position servo keeps its target position.
    """
    return -per_gear(model) * (model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)


@dataclass(frozen=True)
class Change:
    """Effect of a field's values on one array of the model."""

    array: str
    how: Literal["set", "add", "scale"]
    column: int | None = None
    """Column of the array that changes; None for all columns, and for arrays with one number per row."""
    weight: Callable[[mujoco.MjModel], np.ndarray] | None = None
    """Function of the model that returns a factor on the values for each row of the array; None for the factor 1."""
    least: float | None = 0.0
    """Smallest allowed number in the array; None for no limit."""
    bounce: Literal["", "ratio", "inverse"] = ""
    """Conversion of the values, if they are restitutions: to damping ratios ("ratio"), or to 1 / damping ratio ("inverse").
    Empty for other fields."""


@dataclass(frozen=True)
class Field:
    """A property that may differ between worlds."""

    meaning: str
    unit: str
    what: str
    """Plural name of the things that have the property, for error messages."""
    rows: Callable[[Scene, mujoco.MjModel], np.ndarray]
    """Function that returns the indices of the array rows that the field changes."""
    changes: tuple[Change, ...]
    derived: bool = False
    """True if MuJoCo must recompute the arrays `DERIVED` after a change of the field."""
    neutral: float = 0.0
    """Value that leaves the model unchanged, or a usual value if no value does."""
    lowest: float | None = None
    """Lowest meaningful value; None without a limit."""
    highest: float | None = None
    """Highest meaningful value; None without a limit."""
    law: bool = False
    """True if the control law of legged robots uses the field. The field then has one row for each joint."""
    each: bool = False
    """True if each row of a world has its own random value by default, instead of one value for all rows."""


OF_BODIES = {"added_mass": "added_base_mass"} | {f"com_{axis}": f"base_com_{axis}" for axis in "xyz"}
"""Field of a named body -> the same field of the floating body."""


class FieldTable(dict[str, Field]):
    """Fields by name. `added_mass:BODY`, `com_x:BODY`, `com_y:BODY` and `com_z:BODY` are the fields of a named body. The
    table makes them on demand, and does not list them.
    """

    def __missing__(self, name: str) -> Field:
        kind, _, body = name.partition(":")
        if not body or kind not in OF_BODIES:
            raise KeyError(name)
        of_base = self[OF_BODIES[kind]]

        def rows(_: Scene, model: mujoco.MjModel) -> np.ndarray:
            return np.array([k for k in range(1, model.nbody) if model.body(k).name == body], dtype=int)

        meaning = of_base.meaning.replace("the floating body", body)
        return replace(of_base, meaning=meaning, what=f"body '{body}'", rows=rows)

    def __contains__(self, name: object) -> bool:
        kind, _, body = str(name).partition(":")
        return super().__contains__(name) or (bool(body) and kind in OF_BODIES)

    def ordered(self, names: Collection[str]) -> list[str]:
        """Return `names` in the order of the table, those of named bodies at the end."""
        return [name for name in self if name in names] + [name for name in names if ":" in name]


LEAST_MASS = 1e-6
GRAVITY = "gravity"
_TABLE: dict[str, Field] = {
    "friction": Field(
        "sliding friction of the robot's shapes, or of all shapes of a scene without robot",
        "1",
        "shapes",
        lambda scene, model: scene.shapes(model),
        (Change("geom_friction", "set", column=0),),
        neutral=1.0,
    ),
    "restitution": Field(
        "share of its speed that a shape keeps when it bounces; this share sets the contacts' damping ratio, which is 1 for"
        " shares below 0.135",
        "1",
        "shapes",
        lambda scene, model: scene.shapes(model),
        (
            Change("geom_solref", "scale", column=0, weight=damping_ratio, least=None, bounce="inverse"),
            Change("geom_solref", "set", column=1, least=None, bounce="ratio"),
        ),
        lowest=0.0,
        highest=1.0,
    ),
    "link_mass": Field(
        "factor on mass and inertia of each moving body",
        "1",
        "moving bodies",
        lambda _, model: moving_bodies(model),
        (Change("body_mass", "scale", least=LEAST_MASS), Change("body_inertia", "scale")),
        derived=True,
        neutral=1.0,
    ),
    "added_base_mass": Field(
        "mass added to the floating body",
        "kg",
        "floating base",
        lambda _, model: floating_bodies(model)[:1],
        (Change("body_mass", "add", least=LEAST_MASS),),
        derived=True,
    ),
    **{
        f"base_com_{axis}": Field(
            f"shift of the floating body's centre of mass along its {axis} axis",
            "m",
            "floating base",
            lambda _, model: floating_bodies(model)[:1],
            (Change("body_ipos", "add", column=column, least=None),),
            derived=True,
        )
        for column, axis in enumerate("xyz")
    },
    **{
        f"gravity_{axis}": Field(
            f"acceleration added to gravity along the world's {axis} axis; `projected_gravity` does not include it",
            "m/s^2",
            "gravity",
            lambda _, model: np.zeros(1, dtype=int),
            (Change(GRAVITY, "add", column=column, least=None),),
        )
        for column, axis in enumerate("xyz")
    },
    "joint_armature": Field(
        "rotor inertia added to each hinge and slide",
        "kg m^2 or kg",
        "hinges and slides",
        lambda _, model: joint_dofs(model),
        (Change("dof_armature", "add"),),
        derived=True,
    ),
    "joint_damping": Field(
        "viscous damping added to each hinge and slide",
        "N m s/rad or N s/m",
        "hinges and slides",
        lambda _, model: joint_dofs(model),
        (Change("dof_damping", "add"),),
    ),
    "joint_friction": Field(
        "dry friction added to each hinge and slide",
        "N m or N",
        "hinges and slides",
        lambda _, model: joint_dofs(model),
        (Change("dof_frictionloss", "add"),),
    ),
    "joint_offset": Field(
        "error of each joint's encoder: control law and observation `dof_pos` get the true angle plus this error",
        "rad",
        "joints with a motor",
        lambda _, model: np.arange(model.nu),
        (),
        law=True,
        each=True,
    ),
    "motor_strength": Field(
        "factor on the force or torque that each actuator produces for a control",
        "1",
        "actuators",
        lambda _, model: linear_actuators(model),
        (Change("actuator_gainprm", "scale", column=0, least=None), Change("actuator_biasprm", "scale", least=None)),
        neutral=1.0,
        lowest=0.0,
    ),
    "actuator_gain": Field(
        "addition to each actuator's force or torque per unit of control (for a position servo: to its stiffness)",
        "N m or N",
        "actuators",
        lambda _, model: linear_actuators(model),
        (
            Change("actuator_gainprm", "add", column=0, weight=per_gear, least=None),
            Change("actuator_biasprm", "add", column=1, weight=mirrored_per_gear, least=None),
        ),
    ),
    **{
        name: Field(
            f"factor on {of}",
            "1",
            "joints with a motor",
            lambda _, model: np.arange(model.nu),
            (),
            neutral=1.0,
            lowest=0.0,
            law=True,
        )
        for name, of in (
            ("p_gain", "the stiffness of each joint's control law"),
            ("d_gain", "the damping of each joint's control law"),
            ("velocity_limit", "each joint's velocity limit in rewards and torque-speed curves"),
        )
    },
    "torque_limit": Field(
        "factor on the largest force or torque of each actuator",
        "1",
        "actuators with a limit",
        lambda _, model: limited_actuators(model),
        (Change("actuator_forcerange", "scale", least=None),),
        neutral=1.0,
        lowest=0.0,
        law=True,
    ),
}
FIELDS = FieldTable(_TABLE)
"""Field name -> field. Fields that scale an array precede those that add to it. `Physics.randomize` accepts the fields that
change arrays of the model. All other fields affect only the control law.
"""

NEWTONS_FIELDS = ("friction", "added_base_mass")
"""Fields that every solver of the engine `newton` supports, because the engine's own model has arrays for them. The
engine's solver `mujoco` supports all fields."""


def row_counts(scene: Scene, model: mujoco.MjModel, names: Collection[str]) -> dict[str, int]:
    """Return the number of array rows that each field of the table and each of `names` changes, or the number of joints if it
    changes no array.
    """
    return {name: len(FIELDS[name].rows(scene, model)) for name in {*FIELDS, *names}}


def own_array(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return the array of the model that `Change.array` names; gravity is returned with one row, (1, 3)."""
    return model.opt.gravity[None] if name == GRAVITY else getattr(model, name)


def changed_arrays(fields: Collection[str]) -> tuple[str, ...]:
    """Return the names of the arrays that `fields` change, without duplicates and without derived arrays."""
    return tuple(dict.fromkeys(change.array for name in fields for change in FIELDS[name].changes))
