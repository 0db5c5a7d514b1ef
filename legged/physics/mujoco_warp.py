"""Batched MuJoCo on a GPU by mujoco-warp; also on Warp's CPU device, for tests and for comparison."""

from collections.abc import Callable, Collection
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged.config.schema import SimConfig
from legged.math import masked_set_
from legged.physics.base import Physics, RandomizedField, RobotState, allocate_state
from legged.physics.constraint_solver import ConstraintSolver
from legged.physics.exchange import Exchange
from legged.physics.kernels import compile_ahead
from legged.physics.scene import FLOOR, build_model
from legged.physics.terrain_contact import TerrainContact
from legged.robot import Robot
from legged.terrain import Terrain

# Fields of the model that differ per world once friction or mass are drawn, and those that set_const derives from mass.
PER_WORLD = ("geom_friction", "body_mass", "body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")

wp.config.log_level = wp.LOG_WARNING
wp.init()


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


class MujocoWarpPhysics(Physics):
    """N worlds in mujoco-warp. All tensors of `state` and the engine's own arrays live on one device, at fixed
    addresses, so that a step can be captured; on the CPU the step is captured here, by Warp.
    """

    capturable = True

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
        self.num_envs, self.dt, self.device = num_envs, sim.dt, device
        cells = terrain is not None and sim.terrain_collider == "cells"
        self.model = build_model(robot, sim, terrain, "none" if cells else "height_field")
        self.robot = robot
        self.overflowed = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._wp_device = wp.device_from_torch(device)
        with wp.ScopedDevice(self._wp_device):
            self._m = mjw.put_model(self.model, batch_sizes={name: num_envs for name in PER_WORLD})
            self._m.opt.warn_overflow = 0  # counted in refresh instead of printed by each thread
            self._d = mjw.make_data(self.model, nworld=num_envs, nconmax=sim.nconmax, njmax=sim.njmax)
            if terrain is not None and cells:
                TerrainContact(self._m, self._d, self.model, FLOOR, terrain.height_map)
            d = self._d
            self._qpos, self._qvel, self.torques = wp.to_torch(d.qpos), wp.to_torch(d.qvel), wp.to_torch(d.ctrl)
            self.state = self._views(allocate_state(num_envs, robot, device))
            self._exchange = Exchange(self._m, d, self.model, robot, self.state, self.overflowed)
            self._solver = ConstraintSolver(self._m, d) if sim.constraint_solver == "fused" else None
            if self._solver is not None:
                self._m.opt.run_qacc_smooth = False  # ours does not start from it
            self._m.opt.disableflags |= absent_stages(self.model)
        exchanges = (self._exchange.kinematics, self._exchange.contact_forces)
        constants = (self._set_constants,) if "added_base_mass" in randomized else ()
        compile_ahead(self._wp_device, (self._step, *exchanges, *constants))
        self._forces_read = False
        self._advance: Callable[[], Any] = self._step
        if self._wp_device.is_cpu:
            self._advance = self._captured_step()
        self.refresh()

    def _views(self, state: RobotState) -> RobotState:
        """`state` with the fields that the engine holds in our convention already as views of its own arrays."""
        return replace(
            state,
            base_pos=self._qpos[:, :3],
            base_quat=self._qpos[:, 3:7],
            base_lin_vel_w=self._qvel[:, :3],
            base_ang_vel=self._qvel[:, 3:6],
            dof_pos=self._qpos[:, 7:],
            dof_vel=self._qvel[:, 6:],
        )

    def _step(self) -> None:
        m, d = self._m, self._d
        if self._solver is None:
            mjw.step(m, d)
            return
        mjw.fwd_position(m, d, factorize=False)
        mjw.fwd_velocity(m, d)
        mjw.fwd_actuation(m, d)
        mjw.fwd_acceleration(m, d)
        self._solver.solve()
        mjw.euler(m, d)

    def _set_constants(self) -> None:
        mjw.set_const(self._m, self._d)

    def _captured_step(self) -> Callable[[], Any]:
        """One step as a Warp graph on the CPU: the same arithmetic without the cost of launching from Python."""
        start = [tensor.clone() for tensor in (self._qpos, self._qvel)]
        with wp.ScopedDevice(self._wp_device):
            self._step()  # compiles; recording does not execute
            with wp.ScopedCapture(self._wp_device) as capture:
                self._step()
        for tensor, value in zip((self._qpos, self._qvel), start, strict=True):
            tensor.copy_(value)
        for array in (self._d.qacc_warmstart, self._d.efc.force, self._d.overflow):
            array.zero_()
        return lambda: wp.capture_launch(capture.graph)

    def _on_torch_stream(self) -> Any:
        """Warp launches on the stream torch uses now, so that both stay in order, also while capturing."""
        if self._wp_device.is_cpu:
            return nullcontext()
        stream = torch.cuda.current_stream(self.device)
        if self._wp_device.stream.cuda_stream == stream.cuda_stream:
            return nullcontext()  # a second Warp object for the same stream would not know of the capture on it
        return wp.ScopedStream(wp.stream_from_torch(stream), sync_enter=False)

    def step(self) -> None:
        with wp.ScopedDevice(self._wp_device), self._on_torch_stream():
            self._advance()
        self._forces_read = False

    def refresh(self) -> None:
        with wp.ScopedDevice(self._wp_device), self._on_torch_stream():
            self._exchange.kinematics()
            if not self._forces_read:  # once a step: a reset in between has cleared its worlds' forces
                self._exchange.contact_forces()
                self._forces_read = True

    def write_state(
        self,
        mask: Tensor,
        base_pos: Tensor,
        base_quat: Tensor,
        base_lin_vel: Tensor,
        base_ang_vel: Tensor,
        dof_pos: Tensor,
        dof_vel: Tensor,
    ) -> None:
        # mujoco-warp's own reset_data would drop the contacts of all worlds.
        with wp.ScopedDevice(self._wp_device), self._on_torch_stream():
            self._exchange.write(mask, base_pos, base_quat, base_lin_vel, base_ang_vel, dof_pos, dof_vel)

    def push(self, mask: Tensor, lin_vel_xy: Tensor) -> None:
        masked_set_(self._qvel[:, :2], mask, self._qvel[:, :2] + lin_vel_xy)

    def randomize(self, field: RandomizedField, values: Tensor) -> None:
        if field == "friction":
            geoms = [self.model.geom(name).id for name in self.robot.contact_names]
            friction = wp.to_torch(self._m.geom_friction)
            friction[:, geoms, 0] = values.to(self.device).unsqueeze(1).expand(-1, len(geoms))
            return
        base = self.model.body(self.robot.file.base).id
        mass = wp.to_torch(self._m.body_mass)
        mass[:, base] = float(self.model.body_mass[base]) + values.to(self.device)
        with wp.ScopedDevice(self._wp_device):
            self._set_constants()

    def copy_to(self, env_id: int, data: mujoco.MjData) -> None:
        data.qpos[:] = self._qpos[env_id].cpu().numpy().astype(np.float64)
        data.qvel[:] = self._qvel[env_id].cpu().numpy().astype(np.float64)
        mujoco.mj_forward(self.model, data)
