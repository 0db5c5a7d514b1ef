"""A Newton solver with its states, contacts and substeps."""

import warnings
from typing import Any

import mujoco
import newton
import numpy as np
import torch
import warp as wp
from newton.solvers import SolverBase, SolverMuJoCo, SolverSteel

from legged.config.world import SimConfig
from legged.physics.collider.terrain_contact import TerrainContact
from legged.physics.newton.model import build_newton_model, uses_cell_collider
from legged.physics.newton.solvers import SOLVERS
from legged.physics.newton.springs import launch_spring_forces
from legged.physics.warp.state_io import LOST
from legged.robots.reserved_names import FLOOR
from legged.robots.robot import Robot
from legged.terrain import Terrain


@wp.kernel
def push_bodies(forces: wp.array3d[float], bodies: wp.array[int], count: int, body_f: wp.array[wp.spatial_vector]) -> None:
    """Copy external forces from MuJoCo's order of bodies to Newton's. One thread per world and body."""
    world, body = wp.tid()  # type: ignore[misc]
    if bodies[body] >= 0:
        force = wp.vec3(forces[world, body, 0], forces[world, body, 1], forces[world, body, 2])
        torque = wp.vec3(forces[world, body, 3], forces[world, body, 4], forces[world, body, 5])
        body_f[world * count + bodies[body]] = wp.spatial_vector(force, torque)


class Simulation:
    """N worlds in Newton's own conventions. A step consists of Warp launches on fixed arrays, so a graph can capture it."""

    def __init__(self, robot: Robot, sim: SimConfig, num_envs: int, terrain: Terrain | None, device: Any) -> None:
        """Build the scene and its solver. `device` is a Warp device, and must be Warp's current one.

        Raises:
            ConfigError: see `build_newton_model`.
        """
        self.setup = setup = SOLVERS[sim.solver]
        self.model, self.layout = build_newton_model(robot, setup, sim, num_envs, terrain, device)
        self.state, self._next = self.model.state(), self.model.state()
        self.control = self.model.control()
        capacity = sim.nconmax * num_envs
        self._pipeline: newton.CollisionPipeline | None = None
        if not setup.own_contacts:
            self._pipeline = newton.CollisionPipeline(
                self.model, broad_phase="explicit", rigid_contact_max=capacity, **setup.pipeline
            )
        with warnings.catch_warnings():
            # Newton warns if MuJoCo's version is not 3.17. This package requires 4.0, and its tests run Newton with 4.0.
            warnings.filterwarnings("ignore", "MuJoCo dependency version mismatch", newton.NewtonWarning)
            self.solver = setup.make(self.model, sim)
        if terrain is not None and uses_cell_collider(setup, sim):
            self._add_cell_collider(terrain)
        if self._pipeline is None:
            capacity = self.solver.get_max_contact_count()
            self.contacts = newton.Contacts(capacity, 0, device=device)
        else:
            self.contacts = self._pipeline.contacts()
        self.lost: wp.array | None = None
        """(N,) or longer: the solver's flags for dropped contacts or constraint rows; None if the solver has none."""
        self.lost_bits = 1
        """Bits of `lost` that mean that contacts or rows were dropped."""
        self._pushes: list[Any] | None = None
        """External forces, the bodies' indices, and the number of bodies in a world; None without external forces."""
        self._observables = self._request()
        if self._observables is None or setup.springs is not None:
            self.force = wp.zeros(capacity, dtype=wp.spatial_vector)
        else:
            self.force = self._observables.contact_f
        """(contacts,) force on the first shape of each contact in the last substep, world frame [N]."""

    def _add_cell_collider(self, terrain: Terrain) -> None:
        """Register the height-map collider, which keeps vertical faces, in Newton's MuJoCo solver."""
        solver = self.solver
        assert isinstance(solver, SolverMuJoCo)
        model = solver.mj_model
        ground = self.model.shape_label.index(FLOOR)
        (floor,) = np.flatnonzero(solver.mjc_geom_to_newton_shape.numpy()[0] == ground)
        shapes = np.flatnonzero(model.geom_bodyid)
        TerrainContact(solver.mjw_model, solver.mjw_data, model, int(floor), terrain.height_map, shapes)

    def _request(self) -> SolverBase.Observables | None:
        """Return the arrays that each step of the solver writes besides the state, or None if there are no such arrays."""
        solver, kinds = self.solver, set()
        if self.setup.springs is None:
            kinds.add(solver.ObservableKind.CONTACT_F)
        if isinstance(solver, SolverMuJoCo):
            kinds.add(solver.ObservableKind.OVERFLOW)
        observables = solver.observables(kinds, contacts=self.contacts) if kinds else None
        if isinstance(solver, SolverMuJoCo) and observables is not None:
            bits = solver.OverflowBits
            self.lost, self.lost_bits = observables.overflow, int(LOST | bits.SOLVER_NCONMAX | bits.CONTACT_PIPELINE)
        elif isinstance(solver, SolverSteel):
            self.lost = solver.constraint_overflow
        return observables

    def push_with(self, forces: torch.Tensor, model: mujoco.MjModel) -> None:
        """Apply `forces` (N, B, 6) in every step: forces [N] and torques [N m] at centres of mass, world frame. They act on
        Newton's bodies with the same names as the B bodies of `model`.
        """
        labels = [label.rpartition("/")[2] for label in self.model.body_label[: self.layout.bodies]]
        number = {name: k for k, name in enumerate(labels)}
        bodies = [number.get(model.body(k).name, -1) for k in range(model.nbody)]
        self._pushes = [wp.from_torch(forces), wp.array(bodies, dtype=int), self.layout.bodies]

    def step(self, dt: float) -> None:
        """Advance `state` by dt [s] under `control`."""
        setup, before, after = self.setup, self.state, self._next
        extra = {} if self._observables is None else {"observables": self._observables}
        for substep in range(setup.substeps):
            before.clear_forces()
            if self._pushes is not None:
                wp.launch(push_bodies, dim=self._pushes[0].shape[:2], inputs=[*self._pushes, before.body_f])
            if self._pipeline is not None:
                self._pipeline.collide(before, self.contacts)
            if setup.springs is not None and substep == setup.substeps - 1:
                launch_spring_forces(self.model, before, self.contacts, setup.springs, self.force)
            self.solver.step(before, after, self.control, self.contacts, dt / setup.substeps, **extra)
            before, after = after, before
        if before is not self.state:  # copy, because other objects hold the addresses of `self.state`
            self.state.assign(before)
        if setup.maximal:
            newton.eval_ik(self.model, self.state, self.state.joint_q, self.state.joint_qd)

    def forget(self, mask: wp.array) -> None:
        """Clear the solver's memory of earlier steps in the worlds of `mask` (N + 1,), and set their state to the model's
        default.
        """
        self.solver.reset(self.state, mask)
        if self._pipeline is not None:
            self._pipeline.reset_contact_matching(mask)

    def place_bodies(self, mask: wp.array) -> None:
        """Compute the poses of the bodies in the worlds of `mask` (N + 1,) from their joint coordinates."""
        worlds = mask[: self.model.world_count]
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state, mask=worlds)
