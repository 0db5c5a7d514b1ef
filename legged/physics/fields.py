"""What can be randomised: one table, field -> arrays of MuJoCo's model, for all engines that bear MuJoCo's names."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from legged.config.schema import SimConfig
from legged.errors import ConfigError, suggest
from legged.physics.scene import Scene

DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0", "actuator_acc0")
"""Arrays that MuJoCo derives from masses, inertias and armatures."""


def moving_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Return the bodies that some joint moves."""
    return np.flatnonzero(model.body_weldid)


def floating_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Return the bodies with a free joint."""
    return model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]


def joint_dofs(model: mujoco.MjModel) -> np.ndarray:
    """Return the degrees of freedom of hinges and slides."""
    kind = model.jnt_type[model.dof_jntid]
    return np.flatnonzero((kind == mujoco.mjtJoint.mjJNT_HINGE) | (kind == mujoco.mjtJoint.mjJNT_SLIDE))


def linear_actuators(model: mujoco.MjModel) -> np.ndarray:
    """Return the actuators that pull by gear * gain * control: no muscles, nothing without a first gear."""
    muscle = model.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE
    return np.flatnonzero((model.actuator_gear[:, 0] != 0.0) & ~muscle)


def per_gear(model: mujoco.MjModel) -> np.ndarray:
    """Return what one unit of force is in each actuator's gain, (nu,)."""
    gear = model.actuator_gear[:, 0]
    return np.divide(1.0, gear, out=np.zeros_like(gear), where=gear != 0.0)


def mirrored_per_gear(model: mujoco.MjModel) -> np.ndarray:
    """Return the same for the bias on position, of those actuators that have one, (nu,)."""
    return -per_gear(model) * (model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)


@dataclass(frozen=True)
class Change:
    """How one array of the model takes the values of a field."""

    array: str
    how: Literal["set", "add", "scale"]
    column: int | None = None
    """None for arrays of one number a row, and for all columns of others."""
    weight: Callable[[mujoco.MjModel], np.ndarray] | None = None
    """Factor on the values for each row of the array; 1 without."""
    least: float | None = 0.0
    """What the array must not fall below, if anything."""


@dataclass(frozen=True)
class Field:
    """A property that may differ from world to world."""

    meaning: str
    unit: str
    what: str
    """What has the property."""
    rows: Callable[[Scene, mujoco.MjModel], np.ndarray]
    """Those rows of the arrays that change."""
    changes: tuple[Change, ...]
    derived: bool = False
    """Whether constants of the model must be derived again."""


LEAST_MASS = 1e-6
FIELDS = {
    "friction": Field(
        "sliding friction of the robot's shapes, or of all shapes of a scene without robot",
        "1",
        "shapes",
        lambda scene, model: scene.shapes(model),
        (Change("geom_friction", "set", column=0),),
    ),
    "link_mass": Field(
        "factor on mass and inertia of each moving body",
        "1",
        "moving bodies",
        lambda _, model: moving_bodies(model),
        (Change("body_mass", "scale", least=LEAST_MASS), Change("body_inertia", "scale")),
        derived=True,
    ),
    "added_base_mass": Field(
        "mass added to the floating body",
        "kg",
        "floating base",
        lambda _, model: floating_bodies(model)[:1],
        (Change("body_mass", "add", least=LEAST_MASS),),
        derived=True,
    ),
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
    "actuator_gain": Field(
        "force or torque added per unit of control; a position servo's pull towards its target grows alike",
        "N m or N",
        "actuators",
        lambda _, model: linear_actuators(model),
        (
            Change("actuator_gainprm", "add", column=0, weight=per_gear, least=None),
            Change("actuator_biasprm", "add", column=1, weight=mirrored_per_gear, least=None),
        ),
    ),
}
"""Field -> what it changes. Those that scale an array come before those that add to it."""


def changed_arrays(fields: Collection[str]) -> tuple[str, ...]:
    """Return the names of the arrays that `fields` change, each once; those that are derived are not among them."""
    return tuple(dict.fromkeys(change.array for name in fields for change in FIELDS[name].changes))


class RandomizedModel:
    """The arrays of a model, per world, from the values given for its fields."""

    def __init__(
        self, scene: Scene, model: mujoco.MjModel, fields: Collection[str], dtype: torch.dtype, device: torch.device
    ) -> None:
        """Let those `fields` be given; arrays are made of `dtype` on `device`, as the engine keeps them."""
        self._model, self._dtype, self._device = model, dtype, device
        self._rows = {name: field.rows(scene, model) for name, field in FIELDS.items() if name in fields}
        self._values: dict[str, Tensor] = {}

    def give(self, field: str, values: Tensor) -> dict[str, Tensor]:
        """Take `values` (N,) of a field, one per world, or (N, rows); return the arrays that it changes, (N, ...).

        They are made from the model's own numbers and all values given so far: to give a field again replaces its values.

        Raises:
            ValueError: the field is none of those that may be given, or the values have another shape.
        """
        if field not in self._rows:
            told = suggest(field, self._rows, "those are")
            raise ValueError(f"randomize: '{field}' is none of the fields that make_physics was told of{told}")
        rows = len(self._rows[field])
        if values.dim() != 1 and values.shape[1:] != (rows,):
            raise ValueError(f"randomize: values of {field} must be (N,) or (N, {rows}), not {tuple(values.shape)}")
        self._values[field] = values.to(self._device, self._dtype).reshape(len(values), -1).expand(-1, rows)
        return {change.array: self._array(change.array, len(values)) for change in FIELDS[field].changes}

    def _array(self, array: str, worlds: int) -> Tensor:
        """Return one array, (N, ...)."""
        own = torch.from_numpy(getattr(self._model, array)).to(self._device, self._dtype)
        result = own.expand(worlds, *own.shape).clone()
        for name, field in FIELDS.items():
            for change in field.changes:
                if change.array == array and name in self._values:
                    self._apply(change, torch.from_numpy(self._rows[name]).to(self._device), self._values[name], result)
        return result

    def _apply(self, change: Change, rows: Tensor, values: Tensor, array: Tensor) -> None:
        """Change `rows` of one array (N, ...) by `values` (N, R)."""
        if change.weight is not None:
            weight = torch.from_numpy(change.weight(self._model)).to(self._device, self._dtype)
            values = values * weight[rows]
        part = array if change.column is None else array[:, :, change.column]  # a view
        values = values.reshape(*values.shape, *[1] * (part.dim() - 2))
        old = part[:, rows]
        part[:, rows] = {"set": values.expand_as(old), "add": old + values, "scale": old * values}[change.how]


def check_ranges(
    ranges: Mapping[str, Sequence[float]], scene: Scene, sim: SimConfig, where: Callable[[str], str] = str
) -> None:
    """Check `ranges`, field -> lowest and highest value, against a scene; `where` says who set a dotted path.

    Raises:
        ConfigError: there is no such field, the scene has nothing that it changes, or the lowest values leave no mass.
    """
    model = scene.model(sim, "none") if ranges else None  # no field is the ground's, which takes long to build
    for name in ranges:
        if name not in FIELDS:
            path = where("domain_rand.ranges")
            raise ConfigError(f"{path}: there is no field '{name}'{suggest(name, FIELDS, 'fields')}")
    given = RandomizedModel(scene, model, ranges, torch.float64, torch.device("cpu")) if model else None
    for name, field in FIELDS.items():
        if given is None or name not in ranges:
            continue
        path, low = where(f"domain_rand.ranges.{name}"), float(ranges[name][0])
        if not len(field.rows(scene, model)):
            raise ConfigError(f"{path}: {scene.name} has no {field.what}")
        changed = given.give(name, torch.tensor([low], dtype=torch.float64))
        for change in field.changes:
            rows = changed[change.array][:, field.rows(scene, model)]
            numbers = rows if change.column is None else rows[:, :, change.column]
            if change.least is not None and numbers.min() < change.least:
                raise ConfigError(
                    f"{path}: its lowest value, {low:g} ({field.meaning}), makes a {change.array} of {numbers.min():g};"
                    f" at least {change.least:g} must be left"
                )
