"""Randomisation in Newton's MuJoCo solver, by writing into the arrays of its internal mujoco-warp model.

A captured step cannot notify the solver of changes in Newton's own arrays. The solver's internal arrays have one row per
world, under MuJoCo's names. Motors are not part of the solver, which receives their torques as joint forces.
"""

from collections.abc import Collection, Mapping
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged.physics.fields import DERIVED, FIELDS, GRAVITY, changed_arrays
from legged.physics.newton.simulation import Simulation
from legged.physics.randomized_model import RandomizedModel
from legged.physics.scene import Scene
from legged.physics.warp.randomize_kernels import Redraws, Variants

MOTORS = ("motor_strength", "actuator_gain", "torque_limit")
"""Fields of the motors, which convert controls to torques outside the solver."""
CENTRES, BASE_CENTRE = "body_com", "base_com"
"""Names in this file for two arrays that must follow changes of the solver's `body_ipos`: the centres of mass of Newton's
bodies, and the base's centre of mass that `NewtonStateIO` uses to convert velocities."""


class _SolversScene(Scene):
    """Scene of the solver's internal model, whose order of shapes differs from the robot's."""

    def __init__(self, name: str, solvers: mujoco.MjModel) -> None:
        self.name, self._solvers = name, solvers

    def model(self, *_: Any, **__: Any) -> mujoco.MjModel:
        return self._solvers

    def shapes(self, model: mujoco.MjModel) -> np.ndarray:
        return np.flatnonzero(model.geom_bodyid)


class SolverFields:
    """Changes arrays of the solver and of the motors for randomised fields."""

    def __init__(
        self, scene: Scene, model: mujoco.MjModel, simulation: Simulation, base_com: Tensor, fields: Collection[str]
    ) -> None:
        """Prepare to randomise `fields`. `model` is the robot's MuJoCo model. `base_com` (N, 3) is the base's centre of mass
        that `NewtonStateIO` uses to convert velocities. Warp's current device must be that of the simulation.
        """
        solver: Any = simulation.solver
        self._m, self._d, worlds, device = solver.mjw_model, solver.mjw_data, len(base_com), base_com.device
        motors = [name for name in fields if name in MOTORS]
        others = [name for name in fields if name not in MOTORS]
        inside = _SolversScene(scene.name, solver.mj_model)
        self._models = {
            True: RandomizedModel(scene, model, motors, torch.float32, device),
            False: RandomizedModel(inside, solver.mj_model, others, torch.float32, device),
        }
        """Models that fields change. Key True has the model for fields of the motors, key False the solver's model."""
        self.gains, self.limits = (
            torch.tensor(own, dtype=torch.float32, device=device).repeat(worlds, 1, 1)
            for own in (model.actuator_gainprm, model.actuator_forcerange)
        )
        """`gains` (N, D, 10) holds gains in its first column, `limits` (N, D, 2) the least and greatest torques [N m]."""
        self.motors = bool(motors)
        """True if the motors change the torques that the task requests."""
        bodies = solver.mjc_body_to_newton.numpy()[0]
        self._body_order = [int(np.flatnonzero(bodies == k)[0]) for k in range(simulation.layout.bodies)]
        self._base = self._body_order[simulation.layout.base]
        self._arrays = {
            "actuator_gainprm": self.gains,
            "actuator_biasprm": torch.zeros_like(self.gains),
            "actuator_forcerange": self.limits,
            CENTRES: wp.to_torch(simulation.model.body_com).view(worlds, -1, 3),
            BASE_CENTRE: base_com,
        }
        for name in (*changed_arrays(others), *DERIVED):
            if name == GRAVITY:
                self._arrays[name] = wp.to_torch(self._m.opt.gravity)
            elif getattr(solver.mj_model, name).size:
                self._arrays[name] = wp.to_torch(getattr(self._m, name))
        self._redraws: list[Redraws] = []
        self._variants: Variants | None = None

    def give(self, field: str, values: Tensor) -> None:
        """Set the `values` of a field at start-up. Derived constants are computed again if necessary."""
        made = self._models[field in MOTORS].give(field, values)
        for name, array in self._with_centres(made).items():
            self._arrays[name].copy_(array.view_as(self._arrays[name]))
        if FIELDS[field].derived:
            mjw.set_const(self._m, self._d)

    def _with_centres(self, made: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the arrays `made`. If `body_ipos` is among them, add the arrays `CENTRES` and `BASE_CENTRE`."""
        if "body_ipos" not in made:
            return dict(made)
        centres = made["body_ipos"]
        return {**made, CENTRES: centres[:, self._body_order], BASE_CENTRE: centres[:, self._base]}

    def prepare(self, drawn: Tensor, columns: Mapping[str, slice], fields: Collection[str]) -> None:
        self._redraws = []
        for of_motors, model in self._models.items():
            names = changed_arrays([name for name in fields if (name in MOTORS) == of_motors])
            if names:
                self._redraws.append(Redraws(model, drawn, columns, {name: self._arrays[name] for name in names}))

    def redraw(self, mask: Tensor) -> None:
        """Apply the current random values to the model arrays of the worlds in `mask` (N,)."""
        for launch in self._redraws:
            launch.launch(mask)

    def set_variants(self, values: Mapping[str, Tensor]) -> None:
        made = self._with_centres(self._models[False].variants(values))
        if self._variants is None:
            self._variants = Variants({name: (array, self._arrays[name]) for name, array in made.items()})
        else:
            self._variants.replace(made)

    def choose(self, mask: Tensor, chosen: Tensor) -> None:
        """Copy variant `chosen[i]` into each world i of `mask`. `mask` and `chosen` have the shape (N,)."""
        if self._variants is not None:
            self._variants.launch(mask, chosen)
