"""Batched MuJoCo by mujoco-warp, on a GPU or on Warp's CPU device."""

from collections.abc import Callable, Collection, Mapping
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.physics.collider.contact_pairs import DEFAULT_SOLREF, is_mixed
from legged.physics.collider.terrain_contact import TerrainContact
from legged.physics.contact_groups import geom_names, zero_forces
from legged.physics.fields import DERIVED, FIELDS, GRAVITY, changed_arrays
from legged.physics.fused.block_step import BlockStep
from legged.physics.fused.constraint_solver import ConstraintSolver, ask_for_dense_rows
from legged.physics.fused.contact_stage import ContactStage
from legged.physics.fused.smooth_dynamics import PUSHED, SmoothDynamics
from legged.physics.fused.torque_step import TorqueStep
from legged.physics.quantities import LAST_STEP, stage_of
from legged.physics.randomized_model import RandomizedModel, keep_centres_apart
from legged.physics.robot_state import DrivenJoints, robot_state
from legged.physics.scene import Scene
from legged.physics.warp.compile import compile_ahead
from legged.physics.warp.physics import WarpPhysics
from legged.physics.warp.randomize_kernels import Redraws, Variants
from legged.physics.warp.state_io import MujocoWarpStateIO, StateIO, arrays_of
from legged.process.cores import available_cores
from legged.process.ranks import Ranks
from legged.robots.reserved_names import FLOOR
from legged.robots.robot_model import disabled_groups

PER_WORLD = ("geom_friction", "body_mass", *DERIVED)
"""Arrays of the model that always have one row per world. Arrays of randomised fields also have one row per world."""


def absent_stages(model: mujoco.MjModel, randomized: Collection[str] = ()) -> int:
    """Return the disable flags of stages that have no effect in `model`, whatever values the arrays `randomized` take.
    mujoco-warp would launch these stages anyway.
    """
    bits, flags = mujoco.mjtDisableBit, 0

    def without(*arrays: str) -> bool:
        return not any(name in randomized or getattr(model, name).any() for name in arrays)

    if without("dof_damping", "dof_dampingpoly", "actuator_damping", "actuator_dampingpoly"):
        flags |= bits.mjDSBL_EULERDAMP  # there is no damping to integrate implicitly
    if without("dof_frictionloss", "tendon_frictionloss"):
        flags |= bits.mjDSBL_FRICTIONLOSS
    return flags


def ignored(model: mujoco.MjModel) -> str:
    """Return the first feature of a model that mujoco-warp would ignore silently, or an empty text."""
    for group in disabled_groups(model):
        return f"it would ignore that the model disables the actuators of group {group}"
    scalar = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE))
    for kind, limited, span, margin in (
        ("joint", (model.jnt_limited != 0) & scalar, np.diff(model.jnt_range)[:, 0], model.jnt_margin),
        ("tendon", model.tendon_limited != 0, np.diff(model.tendon_range)[:, 0], model.tendon_margin),
    ):
        for i in np.flatnonzero(limited & (span < 2.0 * margin)):
            return (
                f"{kind} '{getattr(model, kind)(i).name}' can be within the margin ({margin[i]:g}) of both its limits, which"
                f" are {span[i]:g} apart, and only the nearer limit would exert force"
            )
    return ""


class NoBlocks(Exception):
    """Error for a model whose step cannot run in blocks of worlds. On a CPU, only a step in blocks is faster than the C
    engine.
    """


class MujocoWarpPhysics(WarpPhysics):
    """N worlds in mujoco-warp. The tensors of the state are views of mujoco-warp's own arrays."""

    def __init__(
        self,
        scene: Scene,
        sim: SimConfig,
        num_envs: int,
        device: torch.device,
        randomized: Collection[str] = (),
        quantities: Collection[str] = (),
        only_blocks: bool = False,
        pushed: bool = False,
        launches: Collection[Callable[[], object]] = (),
    ) -> None:
        """Build the scene on `device` and set all worlds to the model's initial state. Kernels are compiled on first use,
        including those that `randomized` fields need, and those that `launches` launch.

        Raises:
            ConfigError: mujoco-warp cannot simulate the model, or the model does not support the requested `sim.step`.
            NoBlocks: `only_blocks` is set, and the step cannot run in blocks of worlds.
        """
        super().__init__(num_envs, sim.dt, device)
        terrain = scene.terrain
        cells = terrain is not None and sim.terrain_collider == "cells"
        self.model = scene.model(sim, "none" if cells else "height_field")
        if sim.step != "library":
            ask_for_dense_rows(self.model)
        for solrefs in (self.model.eq_solref, self.model.jnt_solref, self.model.dof_solref):
            solrefs[is_mixed(solrefs)] = DEFAULT_SOLREF  # unlike C MuJoCo, mujoco-warp does not replace mixed solrefs
        keep_centres_apart(self.model, randomized)
        self._randomized = RandomizedModel(scene, self.model, randomized, torch.float32, device)
        self.group_forces = zero_forces(scene.contact_groups, num_envs, device)
        self._redraws: Redraws | None = None
        self._variants: Variants | None = None
        self._per_world = changed_arrays(randomized)
        """Names of the model arrays with one row per world."""
        with wp.ScopedDevice(self._wp_device):
            self._m = self._put_model(scene.name)
            self._m.opt.warn_overflow = 0  # instead of a warning from each thread, `refresh` reports overflows
            self._d = mjw.make_data(self.model, nworld=num_envs, nconmax=sim.nconmax, njmax=sim.njmax)
            self._on_cells: TerrainContact | None = None
            if terrain is not None and cells:
                of_robot = (self.model.geom_contype != 0) & (self.model.geom_bodyid != 0)
                shapes, floor = np.flatnonzero(of_robot), self.model.geom(FLOOR).id
                self._on_cells = TerrainContact(self._m, self._d, self.model, floor, terrain.height_map, shapes)
            d = self._d
            self.qpos, self.qvel, self.ctrl = wp.to_torch(d.qpos), wp.to_torch(d.qvel), wp.to_torch(d.ctrl)
            if pushed:
                self.forces = wp.to_torch(d.xfrc_applied).view(num_envs, self.model.nbody, 6)
            sample = mujoco.MjData(self.model)
            self._quantities = {
                name: wp.to_torch(getattr(d, name)).view(num_envs, *getattr(sample, name).shape) for name in quantities
            }
            self._m.opt.disableflags |= absent_stages(self.model, self._per_world)
            self._choose_step(sim.step, sim.threads or max(1, available_cores() // Ranks.now().local_count))
            if only_blocks and (self._blocks is None or quantities):
                raise NoBlocks(self._why_no_blocks(quantities))
            if scene.robot is None:
                self._state_io = StateIO(arrays_of(d), self.overflowed)
            else:
                self.robot_state = robot_state(self.qpos, self.qvel, scene.robot)
                self._joints = DrivenJoints(self.qpos, self.qvel, self.robot_state, scene.robot)
                slots = 0 if self._contacts is None else int(self._contacts.constants["SLOTS"])
                of = (self.model, scene.robot, self.robot_state)
                self._state_io = MujocoWarpStateIO(self._m, d, self.overflowed, *of, slots)
                self._state_io.watch(geom_names(self.model), scene.contact_groups, self.group_forces)
        own = self._state_io
        launches = (own.kinematics, own.contact_forces, own.measure_groups, *launches)
        constants = (self._set_constants,) if any(FIELDS[name].derived for name in randomized) else ()
        self.compiled = compile_ahead(self._wp_device, (self._step, self._update_quantities, *launches, *constants))
        self.library_step = self._library_step
        if self._blocks is not None:
            with self._on_device():
                self._advance = self._blocks.recorded()
        elif self._wp_device.is_cpu:
            self._advance = self._captured_step()
        self.refresh()

    def _put_model(self, scene: str) -> Any:
        """Return mujoco-warp's model, with one row per world in the arrays that may differ between worlds.

        Raises:
            ConfigError: mujoco-warp cannot simulate the model.
        """
        if reason := ignored(self.model):
            raise ConfigError(f"sim.physics: mujoco_warp cannot simulate {scene} (try sim.physics=mujoco): {reason}")
        names = [name for name in (*PER_WORLD, *self._per_world) if name != GRAVITY and getattr(self.model, name).size]
        try:
            m = mjw.put_model(self.model, batch_sizes=dict.fromkeys(names, self.num_envs))
        except NotImplementedError as error:
            raise ConfigError(
                f"sim.physics: mujoco_warp cannot simulate {scene} (try sim.physics=mujoco): {error}"
            ) from error
        if GRAVITY in self._per_world:
            m.opt.gravity = wp.array(np.tile(self.model.opt.gravity, (self.num_envs, 1)), dtype=wp.vec3)
        return m

    def refresh(self) -> None:
        super().refresh()
        if self._quantities:
            with self._on_device():
                self._update_quantities()

    def _update_quantities(self) -> None:
        """Launch the stages that compute the requested quantities."""
        stage = stage_of(self._quantities)
        if stage >= int(mujoco.mjtStage.mjSTAGE_POS):
            mjw.kinematics(self._m, self._d)
            mjw.com_pos(self._m, self._d)
        if stage >= int(mujoco.mjtStage.mjSTAGE_VEL):
            mjw.com_vel(self._m, self._d)

    def write(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        super().write(mask, qpos, qvel)
        for forces in self._of_last_step().values():
            forces.masked_fill_(mask.view(-1, 1), 0.0)
        if self.forces is not None:
            self.forces.masked_fill_(mask.view(-1, 1, 1), 0.0)

    def _of_last_step(self) -> dict[str, Tensor]:
        """Return the requested quantities that only a step computes."""
        return {name: self._quantities[name] for name in LAST_STEP if name in self._quantities}

    def _step(self) -> None:
        m, d = self._m, self._d
        if self._blocks is not None:
            self._blocks.launch()
        elif self._fused_step is not None:
            self._fused_step.begin()
            if self._contacts is not None:
                self._contacts.launch()
            else:
                mjw.collision(m, d)
                mjw.make_constraint(m, d)
            self._fused_step.finish()
        elif self._solver is not None:
            mjw.fwd_position(m, d, factorize=False)
            mjw.fwd_velocity(m, d)
            mjw.fwd_actuation(m, d)
            mjw.fwd_acceleration(m, d)
            self._solver.solve()
            mjw.euler(m, d)
        else:
            mjw.step(m, d)

    def _choose_step(self, step: str, threads: int) -> None:
        """Prepare the step that `sim.step` requests: the fused step, the fused constraint solver within mujoco-warp's step,
        or mujoco-warp's step alone.

        Raises:
            ConfigError: `fused` was requested, and the model does not support it.
        """
        self._fused_step: TorqueStep | None = None
        self._contacts: ContactStage | None = None
        self._blocks: BlockStep | None = None
        self._solver: ConstraintSolver | None = None
        if step == "library":
            self.why_library = "sim.step=library"
            return
        per_world = (*PER_WORLD, *self._per_world, *(() if self.forces is None else (PUSHED,)))
        no_solver = ConstraintSolver.why_not(self._m, self._d)
        self.why_library = no_solver or SmoothDynamics.why_not(self.model, per_world)
        if step == "fused" and self.why_library:
            raise ConfigError(f"sim.step=fused: {self.why_library}; sim.step=auto uses fused parts that support the model")
        if no_solver:
            return
        self._m.opt.run_qacc_smooth = False  # the fused solver does not use `qacc_smooth`
        if self.why_library:
            self._solver = ConstraintSolver(self.model, self._m, self._d)
        else:
            no_contacts = ContactStage.why_not(self.model, self._m, self._d, per_world)
            if no_contacts:
                self.why_library = f"(contacts only) {no_contacts}"
            else:
                self._contacts = ContactStage(self.model, self._m, self._d, per_world, self._on_cells)
            active_set = None if self._contacts is None else self._contacts.active_set
            self._fused_step = TorqueStep(self.model, self._m, self._d, per_world, active_set)
            if self._contacts is not None and BlockStep.fits(self._fused_step):
                self._blocks = BlockStep(self._fused_step, self._contacts, threads)

    def _why_no_blocks(self, quantities: Collection[str]) -> str:
        """Return the reason why the step cannot run in blocks of worlds, or would be slower than the C engine."""
        if self.why_library:
            return self.why_library
        if quantities:
            return f"mujoco-warp's own launches compute {', '.join(quantities)}"
        return "the constraint rows exceed a thread's stack, or friction cones are elliptic"

    def _library_step(self) -> None:
        """Make a physics step of mujoco-warp's library."""
        with self._on_device():
            asked = self._m.opt.run_qacc_smooth
            self._m.opt.run_qacc_smooth = True  # mujoco-warp's solver uses `qacc_smooth`
            mjw.step(self._m, self._d)
            self._m.opt.run_qacc_smooth = asked

    def _set_constants(self) -> None:
        mjw.set_const(self._m, self._d)

    def _captured_step(self) -> Callable[[], Any]:
        """Record a step, then restore the state that preceded it. Return a function that replays the step."""
        start = [tensor.clone() for tensor in (self.qpos, self.qvel)]
        recorded = self._record_step()
        for tensor, value in zip((self.qpos, self.qvel), start, strict=True):
            tensor.copy_(value)
        d = self._d
        for array in (d.qacc_warmstart, d.act, d.qfrc_actuator, d.efc.force, d.overflow):
            array.zero_()
        return recorded

    def state_tensors(self) -> dict[str, Tensor]:
        own = {"act": wp.to_torch(self._d.act), "warmstart": wp.to_torch(self._d.qacc_warmstart)}
        if self._contacts is not None:
            own["last_rows"] = wp.to_torch(self._contacts.active_set.last)
        return {**super().state_tensors(), **own, **self._of_last_step()}

    def randomize(self, field: str, values: Tensor) -> None:
        for name, array in self._randomized.give(field, values).items():
            self._array(name).copy_(array.view_as(self._array(name)))
        if FIELDS[field].derived:
            with wp.ScopedDevice(self._wp_device):
                self._set_constants()

    def _array(self, name: str) -> Tensor:
        """Return an array of the model with one row per world, (N, ...)."""
        return wp.to_torch(self._m.opt.gravity if name == GRAVITY else getattr(self._m, name))

    def prepare_redraws(self, drawn: Tensor, columns: Mapping[str, slice], fields: Collection[str]) -> None:
        arrays = {name: self._array(name) for name in changed_arrays(fields)}
        with wp.ScopedDevice(self._wp_device):
            self._redraws = Redraws(self._randomized, drawn, columns, arrays)

    def redraw(self, mask: Tensor) -> None:
        if self._redraws is not None:
            with self._on_device():
                self._redraws.launch(mask)

    def set_variants(self, values: Mapping[str, Tensor]) -> None:
        made = self._randomized.variants(values)
        with wp.ScopedDevice(self._wp_device):
            if self._variants is None:
                self._variants = Variants({name: (array, self._array(name)) for name, array in made.items()})
            else:
                self._variants.replace(made)

    def choose_variants(self, mask: Tensor, chosen: Tensor) -> None:
        if self._variants is not None:
            with self._on_device():
                self._variants.launch(mask, chosen)
