"""Batched MuJoCo on a GPU by mujoco-warp; also on Warp's CPU device, for tests and for comparison."""

from collections.abc import Callable, Collection
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged.config.schema import SimConfig
from legged.errors import ConfigError
from legged.math import masked_set_
from legged.physics.base import RandomizedField, setter_of
from legged.physics.collider.terrain_contact import TerrainContact
from legged.physics.fused.constraint_solver import ConstraintSolver
from legged.physics.fused.torque_step import TorqueStep
from legged.physics.scene.robot_scene import build_model
from legged.physics.warp.compile import compile_ahead
from legged.physics.warp.exchange import Exchange
from legged.physics.warp.physics import WarpPhysics
from legged.robots.robot import Robot
from legged.robots.robot_model import FLOOR
from legged.terrain import Terrain

# Fields of the model that differ per world once friction or mass are drawn, and those that set_const derives from mass.
PER_WORLD = ("geom_friction", "body_mass", "body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")


def absent_stages(model: mujoco.MjModel) -> int:
    """Flags of the stages that have nothing to do in `model`: mujoco-warp would still launch them."""
    bits, flags = mujoco.mjtDisableBit, 0
    if not any(
        a.any() for a in (model.dof_damping, model.dof_dampingpoly, model.actuator_damping, model.actuator_dampingpoly)
    ):
        flags |= bits.mjDSBL_EULERDAMP  # no damping to integrate implicitly
    if not (model.dof_frictionloss.any() or model.tendon_frictionloss.any()):
        flags |= bits.mjDSBL_FRICTIONLOSS
    return flags


class MujocoWarpPhysics(WarpPhysics):
    """N worlds in mujoco-warp, whose own arrays are the state."""

    def __init__(
        self,
        robot: Robot,
        sim: SimConfig,
        num_envs: int,
        device: torch.device,
        terrain: Terrain | None = None,
        randomized: Collection[RandomizedField] = (),
    ) -> None:
        """Build the scene on `device` and place all robots at the model's initial state; compiles on first use, for
        `randomized` fields too.
        """
        super().__init__(robot, num_envs, sim.dt, device)
        cells = terrain is not None and sim.terrain_collider == "cells"
        self.model = build_model(robot, sim, terrain, "none" if cells else "height_field")
        with wp.ScopedDevice(self._wp_device):
            self._m = mjw.put_model(self.model, batch_sizes={name: num_envs for name in PER_WORLD})
            self._m.opt.warn_overflow = 0  # counted in refresh instead of printed by each thread
            self._d = mjw.make_data(self.model, nworld=num_envs, nconmax=sim.nconmax, njmax=sim.njmax)
            if terrain is not None and cells:
                of_robot = (self.model.geom_contype != 0) & (self.model.geom_bodyid != 0)
                shapes, floor = np.flatnonzero(of_robot), self.model.geom(FLOOR).id
                TerrainContact(self._m, self._d, self.model, floor, terrain.height_map, shapes)
            d = self._d
            self._qpos, self._qvel, self.torques = wp.to_torch(d.qpos), wp.to_torch(d.qvel), wp.to_torch(d.ctrl)
            self.state = self._allocate_state()
            self._exchange = Exchange(self._m, d, self.model, robot, self.state, self.overflowed)
            self._solver = self._choose_solver(sim)
            self._torque_step = self._choose_torque_step(sim)
            self._m.opt.disableflags |= absent_stages(self.model)
        exchanges = (self._exchange.kinematics, self._exchange.contact_forces)
        constants = (self._set_constants,) if "added_base_mass" in randomized else ()
        compile_ahead(self._wp_device, (self._step, *exchanges, *constants))
        if self._wp_device.is_cpu:
            self._advance = self._captured_step()
        self.refresh()

    def _step(self) -> None:
        m, d = self._m, self._d
        if self._solver is None:
            mjw.step(m, d)
            return
        if self._torque_step is not None:
            self._torque_step.begin()
            mjw.collision(m, d)
            mjw.make_constraint(m, d)
            self._solver.solve()
            self._torque_step.integrate()
            return
        mjw.fwd_position(m, d, factorize=False)
        mjw.fwd_velocity(m, d)
        mjw.fwd_actuation(m, d)
        mjw.fwd_acceleration(m, d)
        self._solver.solve()
        mjw.euler(m, d)

    def _choose_solver(self, sim: SimConfig) -> ConstraintSolver | None:
        """Ours, or none for mujoco-warp's own."""
        if sim.constraint_solver == "rounds":
            return None
        if why_not := ConstraintSolver.why_not(self._m, self._d):
            if sim.constraint_solver == "fused":
                raise ConfigError(f"sim.constraint_solver=fused: {why_not}; sim.constraint_solver=auto takes what fits")
            return None
        self._m.opt.run_qacc_smooth = False  # ours does not start from it
        return ConstraintSolver(self._m, self._d)

    def _choose_torque_step(self, sim: SimConfig) -> TorqueStep | None:
        """What replaces mujoco-warp's stages around our solver, where the model allows it."""
        why_not = TorqueStep.why_not(self.model) if self._solver else "needs the fused sim.constraint_solver"
        if sim.smooth_dynamics == "fused" and why_not:
            raise ConfigError(f"sim.smooth_dynamics=fused: {why_not}; sim.smooth_dynamics=auto takes what fits")
        if sim.smooth_dynamics == "stages" or why_not:
            return None
        return TorqueStep(self.model, self._m, self._d, self.model.body(self.robot.file.base).id)

    def library_step(self) -> None:
        """A physics step as mujoco-warp makes it by itself, to compare with."""
        with self._on_device():
            asked = self._m.opt.run_qacc_smooth
            self._m.opt.run_qacc_smooth = True  # its solver starts from it
            mjw.step(self._m, self._d)
            self._m.opt.run_qacc_smooth = asked

    def _set_constants(self) -> None:
        mjw.set_const(self._m, self._d)

    def _captured_step(self) -> Callable[[], Any]:
        """The recorded step, and the state as before it."""
        start = [tensor.clone() for tensor in (self._qpos, self._qvel)]
        recorded = self._record_step()
        for tensor, value in zip((self._qpos, self._qvel), start, strict=True):
            tensor.copy_(value)
        for array in (self._d.qacc_warmstart, self._d.efc.force, self._d.overflow):
            array.zero_()
        return recorded

    def state_tensors(self) -> dict[str, Tensor]:
        return {**super().state_tensors(), "warmstart": wp.to_torch(self._d.qacc_warmstart)}

    def push(self, mask: Tensor, lin_vel_xy: Tensor) -> None:
        masked_set_(self._qvel[:, :2], mask, self._qvel[:, :2] + lin_vel_xy)

    def randomize(self, field: RandomizedField, values: Tensor) -> None:
        setter_of(field, friction=self._set_friction, added_base_mass=self._add_base_mass)(values)

    def _set_friction(self, values: Tensor) -> None:
        geoms = [self.model.geom(name).id for name in self.robot.contact_names]
        friction = wp.to_torch(self._m.geom_friction)
        friction[:, geoms, 0] = values.to(self.device).unsqueeze(1).expand(-1, len(geoms))

    def _add_base_mass(self, values: Tensor) -> None:
        base = self.model.body(self.robot.file.base).id
        mass = wp.to_torch(self._m.body_mass)
        mass[:, base] = float(self.model.body_mass[base]) + values.to(self.device)
        with wp.ScopedDevice(self._wp_device):
            self._set_constants()
