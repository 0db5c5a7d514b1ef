"""C MuJoCo on all CPU cores, through `mujoco.batch.Batch`. It is the reference for the other engines."""

from collections.abc import Collection, Mapping

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from legged.config.world import SimConfig
from legged.math import quat_rotate_inverse
from legged.physics.base import Physics
from legged.physics.contact_groups import sensor_columns, zero_forces
from legged.physics.engine_warnings import keep_out_of_files
from legged.physics.feet import FeetKinematics
from legged.physics.fields import FIELDS, GRAVITY, changed_arrays
from legged.physics.quantities import LAST_STEP, STAGES, stage_of
from legged.physics.randomized_model import RandomizedModel, keep_centres_apart
from legged.physics.robot_state import DrivenJoints, RobotState, robot_state
from legged.physics.scene import Scene
from legged.physics.scene.robot_scene import contact_sensor_columns
from legged.process.cores import available_cores
from legged.process.ranks import Ranks
from legged.robots.robot import Robot

OVERFLOW = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]


class MujocoPhysics(Physics):
    """N worlds in C MuJoCo, which computes in float64; inputs and outputs are float32."""

    capturable = False

    def __init__(
        self,
        scene: Scene,
        sim: SimConfig,
        num_envs: int,
        device: torch.device,
        randomized: Collection[str] = (),
        quantities: Collection[str] = (),
        pushed: bool = False,
    ) -> None:
        """Build the scene and set all worlds to the model's initial state. `device` is the CPU."""
        keep_out_of_files()
        self.num_envs, self.dt, self.device = num_envs, sim.dt, device
        self.model = scene.model(sim, contact_sensors=True)
        # MuJoCo silently resets a diverged state by default. This flag lets the state stay non-finite, and the task sees it.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        # Constraint islands gain nothing, because a world holds one robot. Finding them costs 6 % of a step.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
        keep_centres_apart(self.model, randomized)
        self._randomized = RandomizedModel(scene, self.model, randomized, torch.float64, device)
        self._redrawn: tuple[str, ...] = ()
        """Names of the arrays that `redraw` changes."""
        self._variants: dict[str, np.ndarray] = {}
        self.qpos, self.qvel = torch.zeros(num_envs, self.model.nq), torch.zeros(num_envs, self.model.nv)
        self.ctrl = torch.zeros(num_envs, self.model.nu)
        self.overflowed = torch.zeros(num_envs, dtype=torch.bool)
        self.batch = Batch(self.model, num_envs, sim.threads or max(1, available_cores() // Ranks.now().local_count))
        self.forces = torch.zeros(num_envs, self.model.nbody, 6) if pushed else None
        if pushed:
            self._forces = torch.from_numpy(self.batch.bind("xfrc_applied")).view(num_envs, -1, 6)
        names = ("qpos", "qvel", "ctrl", "act", "qacc_warmstart")
        self._qpos, self._qvel, self._ctrl, self._act, self._warmstart = (
            torch.from_numpy(self.batch.bind(name)) for name in names
        )
        self._robot: _RobotReader | None = None
        self._joints: DrivenJoints | None = None
        if scene.robot is not None:
            self.robot_state = robot_state(self.qpos, self.qvel, scene.robot)
            self._joints = DrivenJoints(self.qpos, self.qvel, self.robot_state, scene.robot)
            self._robot = _RobotReader(self.batch, self.robot_state, scene.robot, self.qpos, self.qvel)
        self.group_forces = zero_forces(scene.contact_groups, num_envs, device)
        self._group_columns = {name: sensor_columns(self.model, name) for name in self.group_forces}
        self._sensors = self.batch.bind("sensordata")
        self._reader = _QuantityReader(self.batch, quantities)
        self._quantities = self._reader.values
        self._warnings = self.batch.warning[:, OVERFLOW, 1].copy()
        self.refresh()

    def step(self) -> None:
        self._ctrl.copy_(self.ctrl)
        if self.forces is not None:
            self._forces.copy_(self.forces)
        self.batch.step()
        if self._robot is not None:
            self._robot.stepped = True
        for name, forces in self.group_forces.items():
            largest = np.linalg.norm(self._sensors[:, self._group_columns[name]], axis=2).max(axis=1)
            forces[:, 1:] = forces[:, :-1].clone()
            forces[:, 0] = torch.from_numpy(largest)
        self._reader.note_step()
        self._read()

    def refresh(self) -> None:
        self._read()
        if self._robot is not None:
            self._robot.read()  # `_reader.read` overwrites the sensor data, so the robot is read first
        self._reader.read()
        warnings = self.batch.warning[:, OVERFLOW, 1]
        self.overflowed.copy_(torch.from_numpy((warnings > self._warnings).any(axis=1)))
        self._warnings = warnings.copy()

    def _read(self) -> None:
        self.qpos.copy_(self._qpos)
        self.qvel.copy_(self._qvel)
        if self._joints is not None:
            self._joints.read()

    def write(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        rows = mask.view(-1, 1)
        self._qpos.copy_(torch.where(rows, qpos.to(torch.float64), self._qpos))
        self._qvel.copy_(torch.where(rows, qvel.to(torch.float64), self._qvel))
        for cleared in (self.ctrl, self._act, self._warmstart):
            cleared.masked_fill_(rows, 0.0)
        if self.forces is not None:
            self.forces.masked_fill_(mask.view(-1, 1, 1), 0.0)
        self._clear_groups(mask)
        if self.robot_state is not None:
            self.robot_state.contact_forces.masked_fill_(mask.view(-1, 1, 1), 0.0)
        self._reader.note_write(mask)

    def push(self, mask: Tensor, delta: Tensor) -> None:
        self._reader.stale |= mask
        self._qvel[:, : delta.shape[1]].add_(torch.where(mask.view(-1, 1), delta, 0.0))

    def randomize(self, field: str, values: Tensor) -> None:
        for name, array in self._randomized.give(field, values).items():
            self._array(name)[:] = array.numpy()
        if FIELDS[field].derived:
            self.batch.set_const()
        self._reader.stale.fill_(True)

    def _array(self, name: str) -> np.ndarray:
        """Return the per-world copies of an array of the model, (N, ...)."""
        return self.batch.expand(f"opt.{name}")[:, None] if name == GRAVITY else self.batch.expand(name)

    def prepare_redraws(self, drawn: Tensor, columns: Mapping[str, slice], fields: Collection[str]) -> None:
        self._drawn, self._columns, self._redrawn = drawn, dict(columns), changed_arrays(fields)

    def redraw(self, mask: Tensor) -> None:
        worlds = mask.nonzero().flatten()
        if len(worlds):
            values = {name: self._drawn[worlds, columns] for name, columns in self._columns.items()}
            for name, array in self._randomized.arrays(self._redrawn, values).items():
                self._array(name)[worlds.numpy()] = array.numpy()
            self._reader.stale |= mask

    def set_variants(self, values: Mapping[str, Tensor]) -> None:
        self._variants = {name: array.numpy() for name, array in self._randomized.variants(values).items()}

    def choose_variants(self, mask: Tensor, chosen: Tensor) -> None:
        worlds = mask.nonzero().flatten()
        if len(worlds):
            models = chosen[worlds].numpy()
            for name, array in self._variants.items():
                self._array(name)[worlds.numpy()] = array[models]
            self._reader.stale |= mask

    def state_tensors(self) -> dict[str, Tensor]:
        state = {"qpos": self._qpos, "qvel": self._qvel, "act": self._act, "warmstart": self._warmstart}
        return {**state, **self._reader.of_last_step, **self._shared_state()}

    def load_state(self, saved: Mapping[str, Tensor]) -> None:
        self._reader.stale.fill_(True)
        super().load_state(saved)

    def copy_to(self, env_id: int, data: mujoco.MjData) -> None:
        data.qpos[:] = self._qpos[env_id].numpy()
        data.qvel[:] = self._qvel[env_id].numpy()
        mujoco.mj_forward(self.model, data)


class _RobotReader:
    """Computes the fields of RobotState that are not views of qpos and qvel."""

    def __init__(self, batch: Batch, state: RobotState, robot: Robot, qpos: Tensor, qvel: Tensor) -> None:
        """Prepare to read contact sensors from `batch`, and the task's `qpos` (N, nq) and `qvel` (N, nv)."""
        self.stepped = False
        """True if the sensors hold forces that `state` does not hold yet."""
        self._state = state
        start, end = contact_sensor_columns(batch.model, robot)
        self._forces = batch.bind("sensordata")[:, start:end]
        self._feet = FeetKinematics(batch.model, robot, qpos, qvel)
        contacts = robot.contact_of_shape
        self._contacts = None if len(set(contacts)) == len(contacts) else torch.tensor(contacts)
        """Contact index of each shape; None if each shape has its own contact."""
        self._down = torch.tensor([0.0, 0.0, -1.0]).expand(len(state.base_pos), 3)

    def read(self) -> None:
        """Update the base's velocity and gravity in the base frame, and the feet. After a step, update contact forces too."""
        state = self._state
        state.base_lin_vel.copy_(quat_rotate_inverse(state.base_quat, state.base_lin_vel_w))
        state.projected_gravity.copy_(quat_rotate_inverse(state.base_quat, self._down))
        self._feet.write(state)
        if self.stepped:  # without a new step, a copy would restore the forces that `write` has cleared
            forces = torch.from_numpy(-self._forces.astype(np.float32)).view(len(self._forces), -1, 3)
            if self._contacts is None:
                state.contact_forces.copy_(forces)
            else:
                state.contact_forces.zero_().index_add_(1, self._contacts, forces)
            self.stepped = False


class _QuantityReader:
    """Copies requested quantities from the batch's arrays. `read` updates only the worlds whose state has changed."""

    def __init__(self, batch: Batch, names: Collection[str]) -> None:
        """Prepare to copy the quantities `names`."""
        self._batch, self._stage = batch, stage_of(names)
        self._bound = {name: batch.bind(name) for name in names}
        self.values = {name: torch.zeros(bound.shape) for name, bound in self._bound.items()}
        self.of_last_step = {name: self.values[name] for name in LAST_STEP if name in names}
        self.stale = torch.ones(batch.nsim, dtype=torch.bool)
        """(N,) worlds whose state has changed since the last `read`."""

    def note_step(self) -> None:
        """Copy the quantities that only a step computes."""
        self.stale.fill_(True)
        for name, value in self.of_last_step.items():
            value.copy_(torch.from_numpy(self._bound[name].astype(np.float32)))

    def note_write(self, mask: Tensor) -> None:
        """Clear the last step's quantities in the worlds of `mask` (N,)."""
        self.stale |= mask
        for value in self.of_last_step.values():
            value.masked_fill_(mask.view(-1, 1), 0.0)

    def read(self) -> None:
        """Compute and copy the quantities that depend on the state alone."""
        if self._stage and self.stale.any():
            worlds = self.stale.nonzero().flatten()
            ids = worlds.numpy()
            self._batch.forward(ids, stage=self._stage)
            for name, value in self.values.items():
                if name in STAGES:
                    value[worlds] = torch.from_numpy(self._bound[name][ids].astype(np.float32))
        self.stale.fill_(False)
