"""Newton's solvers behind the interface: on a GPU, or on Warp's CPU device."""

import warnings
from typing import Any

import newton
import torch
import warp as wp
from newton.solvers import SolverBase, SolverMuJoCo, SolverSteel
from torch import Tensor

from legged.config.schema import SimConfig
from legged.math import masked_set_
from legged.physics.base import RandomizedField
from legged.physics.exchange import LOST
from legged.physics.newton_exchange import NewtonExchange
from legged.physics.newton_model import build_newton_model
from legged.physics.newton_solvers import SOLVERS
from legged.physics.scene import build_model
from legged.physics.warp_physics import WarpPhysics
from legged.robot import Robot
from legged.terrain import Terrain

Observable = SolverBase.ObservableKind


class NewtonPhysics(WarpPhysics):
    """N worlds in one of Newton's solvers (`sim.solver`). The state that the task sees is a copy in its own conventions,
    made after every step and written back by resets and pushes.
    """

    def __init__(
        self, robot: Robot, sim: SimConfig, num_envs: int, device: torch.device, terrain: Terrain | None = None
    ) -> None:
        """Build the scene on `device` and place all robots at the model's initial state; compiles on first use."""
        super().__init__(robot, num_envs, sim.dt, device)
        self._setup = setup = SOLVERS[sim.solver]
        self.model = build_model(robot, sim, terrain, "none")
        with wp.ScopedDevice(self._wp_device), warnings.catch_warnings():
            # Newton names MuJoCo 3.17; the contract holds with the one that we use, and is tested with it.
            warnings.filterwarnings("ignore", "MuJoCo dependency version mismatch", newton.NewtonWarning)
            self._newton, self._layout = build_newton_model(
                robot, setup, sim.self_collisions, num_envs, terrain, self._wp_device
            )
            self._allocate(sim)
        if self._wp_device.is_cpu:
            start = self._qpos.clone(), self._qvel.clone()
            self._advance = self._record_step()
            self._qpos.copy_(start[0])
            self._qvel.copy_(start[1])
            self._mask[:-1].fill_(True)
            self._solver.reset(self._now, self._wp_mask)
            self._put()
        self.refresh()

    def _allocate(self, sim: SimConfig) -> None:
        model, setup, layout, device = self._newton, self._setup, self._layout, self.device
        self._now, self._next, self._control = model.state(), model.state(), model.control()
        self._pipeline = (
            None
            if setup.own_contacts
            else newton.CollisionPipeline(
                model, broad_phase="explicit", rigid_contact_max=sim.nconmax * self.num_envs, **setup.pipeline
            )
        )
        self._solver = setup.make(model, sim)
        if self._pipeline is None:
            self._contacts = newton.Contacts(self._solver.get_max_contact_count(), 0, device=self._wp_device)
        else:
            self._contacts = self._pipeline.contacts()
        self._mask = torch.zeros(self.num_envs + 1, dtype=torch.bool, device=device)  # the last one: what is in no world
        self._wp_mask = wp.from_torch(self._mask)
        qpos = wp.zeros((self.num_envs, 7 + self.robot.num_dof), dtype=float)
        qvel = wp.zeros((self.num_envs, 6 + self.robot.num_dof), dtype=float)
        self._qpos, self._qvel = wp.to_torch(qpos), wp.to_torch(qvel)
        self.torques = torch.zeros(self.num_envs, self.robot.num_dof, device=device)
        self.state = self._allocate_state()
        self._exchange: NewtonExchange = NewtonExchange(
            model,
            layout,
            self._now,
            self._control,
            self._contacts,
            self.model,
            self.robot,
            self.state,
            qpos,
            qvel,
            wp.from_torch(self.torques),
            self.overflowed,
        )
        self._observables = self._observe()
        self._exchange.read()

    def _observe(self) -> Any:
        """What the solver reports of a step beside the state."""
        kinds = {Observable.CONTACT_F} if self._setup.reports_forces else set()
        self._lost_flags, self._lost = None, 0
        if isinstance(self._solver, SolverMuJoCo):
            kinds.add(self._solver.ObservableKind.OVERFLOW)
        elif isinstance(self._solver, SolverSteel):
            self._lost_flags, self._lost = self._solver.constraint_overflow, 1
        if not kinds:
            return None
        observables = self._solver.observables(kinds, contacts=self._contacts)
        self._exchange.reported = observables.contact_f
        if isinstance(self._solver, SolverMuJoCo):
            bits = self._solver.OverflowBits
            self._lost_flags, self._lost = observables.overflow, int(LOST | bits.SOLVER_NCONMAX | bits.CONTACT_PIPELINE)
        return observables

    def _step(self) -> None:
        self._exchange.apply_torques()
        setup, before, after = self._setup, self._now, self._next
        for substep in range(setup.substeps):
            before.clear_forces()
            if self._pipeline is not None:
                self._pipeline.collide(before, self._contacts)
            last = substep == setup.substeps - 1
            if last and setup.contact is not None and not setup.reports_forces:
                self._exchange.penalty_forces(before, setup.contact)
            extra = {} if self._observables is None else {"observables": self._observables}
            self._solver.step(before, after, self._control, self._contacts, self.dt / setup.substeps, **extra)
            before, after = after, before
        if before is not self._now:  # the addresses of one state are what everybody knows
            self._now.assign(before)
        if setup.maximal:
            newton.eval_ik(self._newton, self._now, self._now.joint_q, self._now.joint_qd)
        self._exchange.note_lost_contacts(self._lost_flags, self._lost)
        self._exchange.read()

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
            self._solver.reset(self._now, self._wp_mask)  # to the model's defaults, which the next lines replace
            if self._pipeline is not None:
                self._pipeline.reset_contact_matching(self._wp_mask)
            self._exchange.write(mask, base_pos, base_quat, base_lin_vel, base_ang_vel, dof_pos, dof_vel)
            self._put()

    def push(self, mask: Tensor, lin_vel_xy: Tensor) -> None:
        masked_set_(self._qvel[:, :2], mask, self._qvel[:, :2] + lin_vel_xy)
        with self._on_device():
            self._mask[:-1].copy_(mask)
            self._put()

    def _put(self) -> None:
        """The task's state of the worlds of `_mask` into Newton's joints and bodies."""
        self._exchange.put(self._wp_mask)
        worlds = self._wp_mask[: self.num_envs]
        newton.eval_fk(self._newton, self._now.joint_q, self._now.joint_qd, self._now, mask=worlds)

    def randomize(self, field: RandomizedField, values: Tensor) -> None:
        model, layout = self._newton, self._layout
        values = values.to(self.device)
        if field == "friction":
            shapes = len(layout.shapes)
            friction = wp.to_torch(model.shape_material_mu)[: self.num_envs * layout.num_shapes].view(self.num_envs, -1)
            friction[:, layout.shapes] = (values * self._setup.friction_factor).unsqueeze(1).expand(-1, shapes)
            changed = newton.ModelFlags.SHAPE_PROPERTIES
        else:
            mass = float(self.model.body(self.robot.file.base).mass[0]) + values
            wp.to_torch(model.body_mass).view(self.num_envs, -1)[:, layout.base] = mass
            wp.to_torch(model.body_inv_mass).view(self.num_envs, -1)[:, layout.base] = 1.0 / mass
            changed = newton.ModelFlags.BODY_INERTIAL_PROPERTIES
        with self._on_device():
            self._solver.notify_model_changed(changed)
