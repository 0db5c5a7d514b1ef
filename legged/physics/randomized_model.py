"""Model arrays that differ between worlds, computed from the values of randomised fields."""

import copy
from collections.abc import Callable, Collection, Mapping

import mujoco
import numpy as np
import torch
from torch import Tensor

from legged.config.randomization import DrawConfig, Range, draw_of
from legged.config.world import SimConfig
from legged.errors import ConfigError, suggest
from legged.physics.fields import DERIVED, FIELDS, Change, changed_arrays, own_array
from legged.physics.restitution import DampingOfBounces
from legged.physics.scene import Scene


class RandomizedModel:
    """Per-world arrays of a model, computed from the values of randomised fields."""

    def __init__(
        self, scene: Scene, model: mujoco.MjModel, fields: Collection[str], dtype: torch.dtype, device: torch.device
    ) -> None:
        """Prepare for values of `fields`. The arrays will have the type `dtype` and lie on `device`."""
        self.model, self._scene, self._dtype, self._device = model, scene, dtype, device
        self.rows = {name: FIELDS[name].rows(scene, model) for name in FIELDS.ordered(fields) if FIELDS[name].changes}
        """Field -> rows of the arrays that it changes."""
        self._values: dict[str, Tensor] = {}
        self.bounces = DampingOfBounces(device, dtype) if "restitution" in fields else None
        """Converter from restitution to damping ratios; None unless restitution is among the fields."""

    def give(self, field: str, values: Tensor) -> dict[str, Tensor]:
        """Take the `values` of a field, (N,) or (N, rows), and return the arrays that it changes, (N, ...).

        The arrays are computed from the model's own numbers and the latest values of all fields. New values of a field
        replace its earlier ones.

        Raises:
            ValueError: the model was not made for this field, or the values have another shape.
        """
        if field not in self.rows:
            hint = suggest(field, self.rows, "it was made for")
            raise ValueError(f"randomize: the physics was not made for the field '{field}'{hint}")
        rows = len(self.rows[field])
        if values.dim() != 1 and values.shape[1:] != (rows,):
            raise ValueError(f"randomize: values of {field} must be (N,) or (N, {rows}), not {tuple(values.shape)}")
        self._values[field] = values.to(self._device, self._dtype).reshape(len(values), -1).expand(-1, rows)
        return self.arrays(changed_arrays([field]), self._values)

    def arrays(self, names: Collection[str], values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the model arrays `names`, (N, ...), changed by `values`: (N, 1) or (N, rows) numbers for each field."""
        worlds = len(next(iter(values.values())))
        found = {}
        for array in names:
            own = torch.from_numpy(own_array(self.model, array)).to(self._device, self._dtype)
            found[array] = own.expand(worlds, *own.shape).clone()
            for name in self.rows:
                for change in FIELDS[name].changes:
                    if change.array == array and name in values:
                        rows = torch.from_numpy(self.rows[name]).to(self._device)
                        self._apply(change, rows, values[name].to(self._device, self._dtype), found[array])
        return found

    def _apply(self, change: Change, rows: Tensor, values: Tensor, array: Tensor) -> None:
        """Apply `change` to `rows` of `array` (N, ...), in place. `values` are (N, 1) or (N, rows)."""
        if change.bounce:
            assert self.bounces is not None
            values = self.bounces.ratio(values)
            values = 1.0 / values if change.bounce == "inverse" else values
        if change.weight is not None:
            weight = torch.from_numpy(change.weight(self.model)).to(self._device, self._dtype)
            values = values * weight[rows]
        part = array if change.column is None else array[:, :, change.column]  # a view of `array`
        values = values.reshape(*values.shape, *[1] * (part.dim() - 2))
        old = part[:, rows]
        part[:, rows] = {"set": values.expand_as(old), "add": old + values, "scale": old * values}[change.how]

    def variants(self, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the arrays of K model variants, (K, ...): the arrays that derived fields change, and the arrays `DERIVED`,
        which C MuJoCo computes from them. `values` holds (K, 1) or (K, rows) numbers for each field. Variants are computed
        outside steps, because a captured step cannot compute the arrays `DERIVED`.
        """
        on_host = RandomizedModel(self._scene, self.model, values, torch.float64, torch.device("cpu"))
        changed = on_host.arrays(changed_arrays(values), values)
        model = copy.copy(self.model)
        data = mujoco.MjData(model)
        count = len(next(iter(changed.values())))
        derived = {name: np.empty((count, *getattr(model, name).shape)) for name in DERIVED if getattr(model, name).size}
        for k in range(count):
            for name, array in changed.items():
                getattr(model, name)[:] = array[k].numpy()
            mujoco.mj_setConst(model, data)
            for name, rows in derived.items():
                rows[k] = getattr(model, name)
        found = changed | {name: torch.from_numpy(rows) for name, rows in derived.items()}
        return {name: array.to(self._device, self._dtype) for name, array in found.items()}


def keep_centres_apart(model: mujoco.MjModel, fields: Collection[str]) -> None:
    """If `fields` move centres of mass, switch off MuJoCo's shortcuts for bodies whose centre of mass is their origin."""
    if "body_ipos" in changed_arrays(fields):
        model.body_sameframe[:] = 0
        model.body_simple[:] = 0
        model.dof_simplenum[:] = 0


def check_ranges(
    ranges: Mapping[str, Range | DrawConfig], scene: Scene, sim: SimConfig, where: Callable[[str], str] = str
) -> None:
    """Check that a scene's model allows the fields and values of `ranges` (field -> lowest and highest value, or a
    `DrawConfig`). `where` maps a dotted path of the configuration to the beginning of an error message.

    Raises:
        ConfigError: the scene has nothing that a field changes, or the lowest value is too low, for example because it leaves
            no mass.
    """
    model = scene.model(sim, "none") if ranges else None  # no field changes the ground, so it is left out
    given = RandomizedModel(scene, model, ranges, torch.float64, torch.device("cpu")) if model else None
    for name in FIELDS.ordered(ranges):
        assert given is not None
        assert model is not None
        field = FIELDS[name]
        path, low = where(f"domain_rand.ranges.{name}"), float(draw_of(ranges[name]).range[0])
        if not len(field.rows(scene, model)):
            bodies = [model.body(k).name for k in range(1, model.nbody)]
            near = suggest(name.partition(":")[2], bodies, "bodies") if ":" in name else ""
            raise ConfigError(f"{path}: {scene.name} has no {field.what}{near}")
        if name == "restitution" and (model.geom_solref[field.rows(scene, model), 0] <= 0.0).any():
            reason = "restitution needs contacts with a time constant, but these have a stiffness (a negative solref)"
            raise ConfigError(f"{path}: {scene.name}: {reason}")
        changed = given.give(name, torch.tensor([low], dtype=torch.float64)) if field.changes else {}
        for change in field.changes:
            rows = changed[change.array][:, field.rows(scene, model)]
            numbers = rows if change.column is None else rows[:, :, change.column]
            if change.least is not None and numbers.min() < change.least:
                raise ConfigError(
                    f"{path}: its lowest value, {low:g} ({field.meaning}), makes {change.array} {numbers.min():g};"
                    f" {change.array} must be at least {change.least:g}"
                )
