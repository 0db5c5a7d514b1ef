"""Newton's solvers behind the interface: on a GPU, or on Warp's CPU device."""

from collections.abc import Mapping

import newton
import torch
import warp as wp
from torch import Tensor

from legged.config.schema import SimConfig
from legged.math import masked_set_
from legged.physics.base import RandomizedField, setter_of
from legged.physics.newton.exchange import NewtonExchange
from legged.physics.newton.simulation import Simulation
from legged.physics.scene.robot_scene import build_model
from legged.physics.warp.compile import compile_ahead
from legged.physics.warp.physics import WarpPhysics
from legged.robots.robot import Robot
from legged.terrain import Terrain


class NewtonPhysics(WarpPhysics):
    """N worlds in one of Newton's solvers (`sim.solver`). The state that the task sees is a copy in its own conventions,
    made after every step and written back by resets and pushes.
    """

    _exchange: NewtonExchange

    def __init__(
        self, robot: Robot, sim: SimConfig, num_envs: int, device: torch.device, terrain: Terrain | None = None
    ) -> None:
        """Build the scene on `device` and place all robots at the model's initial state; compiles on first use."""
        super().__init__(robot, num_envs, sim.dt, device)
        self.model = build_model(robot, sim, terrain, "none")
        self.torques = torch.zeros(num_envs, robot.num_dof, device=device)
        self._qpos = torch.zeros(num_envs, 7 + robot.num_dof, device=device)
        self._qvel = torch.zeros(num_envs, 6 + robot.num_dof, device=device)
        self.state = self._allocate_state()
        # Newton's masks have one place more than there are worlds: for what is in none of them.
        self._mask = torch.zeros(num_envs + 1, dtype=torch.bool, device=device)
        self._wp_mask = wp.from_torch(self._mask)
        with wp.ScopedDevice(self._wp_device):
            self._simulation = Simulation(robot, sim, num_envs, terrain, self._wp_device)
            qpos, qvel, torques = (wp.from_torch(tensor) for tensor in (self._qpos, self._qvel, self.torques))
            self._exchange = NewtonExchange(
                self._simulation, self.model, robot, self.state, qpos, qvel, torques, self.overflowed
            )
            self._exchange.read()
            start = self._qpos.clone()
        compile_ahead(
            self._wp_device, (self._step, self._put, self._exchange.kinematics, self._exchange.contact_forces, self._forget)
        )
        if self._wp_device.is_cpu:
            self._advance = self._record_step()
        with wp.ScopedDevice(self._wp_device):  # what was tried left its traces
            self._qpos.copy_(start)
            self._qvel.zero_()
            self._mask[:-1].fill_(True)
            self._forget()
            self._put()
        self.refresh()

    def _step(self) -> None:
        self._exchange.apply_torques()
        self._simulation.step(self.dt)
        self._exchange.note_lost_contacts()
        self._exchange.read()

    def _forget(self) -> None:
        """Clear what the worlds of `_mask` would carry over a step."""
        self._simulation.forget(self._wp_mask)

    def _put(self) -> None:
        """The task's state of the worlds of `_mask` into Newton's joints and bodies."""
        self._exchange.put(self._wp_mask)
        self._simulation.place_bodies(self._wp_mask)

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
        with self._on_device():
            self._mask[:-1].copy_(mask)
            self._forget()
            self._exchange.write(mask, base_pos, base_quat, base_lin_vel, base_ang_vel, dof_pos, dof_vel)
            self._put()

    def load_state(self, saved: Mapping[str, Tensor]) -> None:
        """As every engine, but a solver's own memory (warm starts, matched contacts) begins anew."""
        super().load_state(saved)
        with self._on_device():
            self._mask[:-1].fill_(True)
            self._forget()
            self._put()
        self.refresh()

    def push(self, mask: Tensor, lin_vel_xy: Tensor) -> None:
        masked_set_(self._qvel[:, :2], mask, self._qvel[:, :2] + lin_vel_xy)
        with self._on_device():
            self._mask[:-1].copy_(mask)
            self._put()

    def randomize(self, field: RandomizedField, values: Tensor) -> None:
        setter_of(field, friction=self._set_friction, added_base_mass=self._add_base_mass)(values.to(self.device))

    def _set_friction(self, values: Tensor) -> None:
        model, layout = self._simulation.model, self._simulation.layout
        friction = wp.to_torch(model.shape_material_mu)[: self.num_envs * layout.num_shapes].view(self.num_envs, -1)
        factor = self._simulation.setup.friction_factor
        friction[:, layout.shapes] = (values * factor).unsqueeze(1).expand(-1, len(layout.shapes))
        self._notify(newton.ModelFlags.SHAPE_PROPERTIES)

    def _add_base_mass(self, values: Tensor) -> None:
        model, base = self._simulation.model, self._simulation.layout.base
        mass = float(self.model.body(self.robot.file.base).mass[0]) + values
        wp.to_torch(model.body_mass).view(self.num_envs, -1)[:, base] = mass
        wp.to_torch(model.body_inv_mass).view(self.num_envs, -1)[:, base] = 1.0 / mass
        self._notify(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)

    def _notify(self, changed: newton.ModelFlags) -> None:
        """Tell the solver what has changed."""
        with self._on_device():
            self._simulation.solver.notify_model_changed(changed)
