"""Newton's solvers behind the `Physics` interface, on a GPU or on Warp's CPU device."""

from collections.abc import Callable, Collection, Mapping

import newton
import torch
import warp as wp
from torch import Tensor

from legged.config.world import SimConfig
from legged.errors import suggest
from legged.physics.contact_groups import GROUND, zero_forces
from legged.physics.fields import NEWTONS_FIELDS
from legged.physics.newton.fields import SolverFields
from legged.physics.newton.simulation import Simulation
from legged.physics.newton.state_io import NewtonStateIO
from legged.physics.robot_state import robot_state
from legged.physics.scene import RobotScene
from legged.physics.warp.compile import compile_ahead
from legged.physics.warp.physics import WarpPhysics
from legged.robots.reserved_names import FLOOR


class NewtonPhysics(WarpPhysics):
    """N worlds in one of Newton's solvers (`sim.solver`). `qpos` and `qvel` are a copy of Newton's state in MuJoCo's layout.
    Steps update the copy; resets and pushes write it back.
    """

    _state_io: NewtonStateIO

    def __init__(
        self,
        scene: RobotScene,
        sim: SimConfig,
        num_envs: int,
        device: torch.device,
        randomized: Collection[str] = (),
        pushed: bool = False,
        launches: Collection[Callable[[], object]] = (),
    ) -> None:
        """Build the scene on `device` and set all robots to the model's initial state. Kernels are compiled on first use,
        and those that `launches` launch with them.

        Raises:
            ConfigError: the robot has meshes, and a package that Newton needs to read them is not installed.
        """
        super().__init__(num_envs, sim.dt, device)
        robot = scene.robot
        self.model = scene.model(sim, "none")
        self.ctrl = torch.zeros(num_envs, robot.num_dof, device=device)
        self.qpos = torch.zeros(num_envs, 7 + robot.num_dof, device=device)
        self.qvel = torch.zeros(num_envs, 6 + robot.num_dof, device=device)
        self.robot_state = robot_state(self.qpos, self.qvel, robot)
        self._quantities = {}
        self.group_forces = zero_forces(scene.contact_groups, num_envs, device)
        self._randomized, self._scene = tuple(randomized), scene
        self._fields: SolverFields | None = None
        """Arrays of the MuJoCo solver that fields change. None if only friction and the base's mass are randomised, and only
        at start-up."""
        self.forces = torch.zeros(num_envs, self.model.nbody, 6, device=device) if pushed else None
        # Newton's masks have N + 1 entries; the last is for objects outside all worlds.
        self._mask = torch.zeros(num_envs + 1, dtype=torch.bool, device=device)
        self._wp_mask = wp.from_torch(self._mask)
        with wp.ScopedDevice(self._wp_device):
            self._simulation = Simulation(robot, sim, num_envs, scene.terrain, self._wp_device)
            task = tuple(wp.from_torch(tensor) for tensor in (self.qpos, self.qvel, self.ctrl))
            self._state_io = NewtonStateIO(self._simulation, task, self.overflowed, self.model, robot, self.robot_state)
            shapes = [GROUND if label == FLOOR else label.rpartition("/")[2] for label in self._simulation.model.shape_label]
            self._state_io.watch(shapes, scene.contact_groups, self.group_forces)
            if set(randomized) - set(NEWTONS_FIELDS):
                self._state_io.motors = self._solvers_fields()
            if self.forces is not None:
                self._simulation.push_with(self.forces, self.model)
            self._state_io.read()
            start = self.qpos.clone()
        own = self._state_io
        launches = (own.kinematics, own.contact_forces, own.measure_groups, *launches)
        self.compiled = compile_ahead(self._wp_device, (self._step, self._put, self._forget, *launches))
        if self._wp_device.is_cpu:
            self._advance = self._record_step()
        with wp.ScopedDevice(self._wp_device):  # set the initial state again, because the calls above may have changed it
            self.qpos.copy_(start)
            self.qvel.zero_()
            self._mask[:-1].fill_(True)
            self._forget()
            self._put()
        self.refresh()

    def _step(self) -> None:
        self._state_io.apply_torques()
        self._simulation.step(self.dt)
        self._state_io.note_lost_contacts()
        self._state_io.read()

    def _forget(self) -> None:
        """Clear the solver's memory of earlier steps in the worlds of `_mask`."""
        self._simulation.forget(self._wp_mask)

    def _put(self) -> None:
        """Copy the task's state to Newton's joints and bodies, in the worlds of `_mask`."""
        self._state_io.put(self._wp_mask)
        self._simulation.place_bodies(self._wp_mask)

    def write(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        with self._on_device():
            self._mask[:-1].copy_(mask)
            self._forget()
            self._state_io.write(mask, qpos, qvel)
            self._put()
        self._clear_groups(mask)
        if self.forces is not None:
            self.forces.masked_fill_(mask.view(-1, 1, 1), 0.0)

    def load_state(self, saved: Mapping[str, Tensor]) -> None:
        """Load a state as in `Physics`, except that the solver's own memory (warm starts, matched contacts) is cleared."""
        super().load_state(saved)
        with self._on_device():
            self._mask[:-1].fill_(True)
            self._forget()
            self._put()
        self.refresh()

    def push(self, mask: Tensor, delta: Tensor) -> None:
        super().push(mask, delta)
        with self._on_device():
            self._mask[:-1].copy_(mask)
            self._put()

    def randomize(self, field: str, values: Tensor) -> None:
        if field not in self._randomized:
            hint = suggest(field, self._randomized, "it was made for")
            raise ValueError(f"randomize: the physics was not made for the field '{field}'{hint}")
        if self._fields is None:
            {"friction": self._set_friction, "added_base_mass": self._add_base_mass}[field](values.to(self.device))
            return
        with wp.ScopedDevice(self._wp_device):
            self._fields.give(field, values)

    def prepare_redraws(self, drawn: Tensor, columns: Mapping[str, slice], fields: Collection[str]) -> None:
        with wp.ScopedDevice(self._wp_device):
            self._solvers_fields().prepare(drawn, columns, fields)

    def redraw(self, mask: Tensor) -> None:
        with self._on_device():
            self._solvers_fields().redraw(mask)

    def set_variants(self, values: Mapping[str, Tensor]) -> None:
        with wp.ScopedDevice(self._wp_device):
            self._solvers_fields().set_variants(values)

    def choose_variants(self, mask: Tensor, chosen: Tensor) -> None:
        with self._on_device():
            self._solvers_fields().choose(mask, chosen)

    def _solvers_fields(self) -> SolverFields:
        """Return the object that changes the solver's arrays. The first call creates it."""
        if self._fields is None:
            base_com, robot = self._state_io.base_com, self._scene
            self._fields = SolverFields(robot, self.model, self._simulation, base_com, self._randomized)
        return self._fields

    def _set_friction(self, values: Tensor) -> None:
        model, layout = self._simulation.model, self._simulation.layout
        friction = wp.to_torch(model.shape_material_mu)[: self.num_envs * layout.num_shapes].view(self.num_envs, -1)
        factor = self._simulation.setup.friction_factor
        friction[:, layout.shapes] = (values * factor).unsqueeze(1).expand(-1, len(layout.shapes))
        self._notify(newton.ModelFlags.SHAPE_PROPERTIES)

    def _add_base_mass(self, values: Tensor) -> None:
        model, base = self._simulation.model, self._simulation.layout.base
        mass = float(self.model.body_mass[self.model.jnt_bodyid[0]]) + values
        wp.to_torch(model.body_mass).view(self.num_envs, -1)[:, base] = mass
        wp.to_torch(model.body_inv_mass).view(self.num_envs, -1)[:, base] = 1.0 / mass
        self._notify(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)

    def _notify(self, changed: newton.ModelFlags) -> None:
        with self._on_device():
            self._simulation.solver.notify_model_changed(changed)
