"""The C engine on all CPU cores, through `mujoco.batch.Batch`: the default without a GPU, and the reference."""

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from legged.config.schema import SimConfig
from legged.math import quat_rotate, quat_rotate_inverse
from legged.physics.base import Physics, RandomizedField, allocate_state, setter_of
from legged.physics.engine_warnings import keep_out_of_files
from legged.physics.feet import FeetKinematics
from legged.physics.scene.robot_scene import build_model, contact_sensor_columns
from legged.process.cores import available_cores
from legged.process.ranks import Ranks
from legged.robots.robot import Robot
from legged.terrain import Terrain

OVERFLOW = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]


class MujocoPhysics(Physics):
    """N worlds in C MuJoCo, float64 inside, float32 outside."""

    capturable = False

    def __init__(
        self, robot: Robot, sim: SimConfig, num_envs: int, device: torch.device, terrain: Terrain | None = None
    ) -> None:
        """Build the scene and place all robots at the model's initial state; `device` must be the CPU."""
        if device.type != "cpu":
            raise ValueError(f"the mujoco back-end runs on the CPU, not on {device}")
        keep_out_of_files()
        self.num_envs, self.dt, self.device = num_envs, sim.dt, device
        self.model = build_model(robot, sim, terrain, contact_sensors=True)
        # A world that blows up must stay non-finite until the task sees it; the engine would put it back silently.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        # A world holds one robot; looking for parts that do not touch each other costs 6 % of a step.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
        self.robot = robot
        self.state = allocate_state(num_envs, robot, device)
        self.torques = torch.zeros(num_envs, robot.num_dof)
        self.overflowed = torch.zeros(num_envs, dtype=torch.bool)
        self.batch = Batch(self.model, num_envs, sim.threads or max(1, available_cores() // Ranks.now().local_count))
        self._qpos = torch.from_numpy(self.batch.bind("qpos"))
        self._qvel = torch.from_numpy(self.batch.bind("qvel"))
        self._ctrl = torch.from_numpy(self.batch.bind("ctrl"))
        self._warmstart = self.batch.bind("qacc_warmstart")
        start, end = contact_sensor_columns(self.model, robot)
        self._forces = self.batch.bind("sensordata")[:, start:end]
        self._stepped = torch.zeros(num_envs, 1, 1, dtype=torch.bool)  # false: reset since the last step
        self._feet = FeetKinematics(self.model, robot)
        self._down = torch.tensor([0.0, 0.0, -1.0]).expand(num_envs, 3)
        self._warnings = self.batch.warning[:, OVERFLOW, 1].copy()
        self.refresh()

    def step(self) -> None:
        self._ctrl.copy_(self.torques)
        self.batch.step()
        self._stepped.fill_(True)
        self._read_joints()

    def refresh(self) -> None:
        state = self.state
        state.base_pos.copy_(self._qpos[:, :3])
        state.base_quat.copy_(self._qpos[:, 3:7])
        # MuJoCo's free joint: linear velocity in the world frame, angular in the base's.
        state.base_lin_vel_w.copy_(self._qvel[:, :3])
        state.base_lin_vel.copy_(quat_rotate_inverse(state.base_quat, state.base_lin_vel_w))
        state.base_ang_vel.copy_(self._qvel[:, 3:6])
        state.projected_gravity.copy_(quat_rotate_inverse(state.base_quat, self._down))
        self._read_joints()
        self._feet.write(state)
        forces = torch.from_numpy(self._forces.astype(np.float32)).view_as(state.contact_forces)
        state.contact_forces.copy_(torch.where(self._stepped, -forces, 0.0))
        warnings = self.batch.warning[:, OVERFLOW, 1]
        self.overflowed.copy_(torch.from_numpy((warnings > self._warnings).any(axis=1)))
        self._warnings = warnings.copy()

    def _read_joints(self) -> None:
        self.state.dof_pos.copy_(self._qpos[:, 7:])
        self.state.dof_vel.copy_(self._qvel[:, 6:])

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
        rows = mask.view(-1, 1)
        qpos = torch.cat([base_pos, base_quat, dof_pos], dim=1).to(torch.float64)
        qvel = torch.cat([quat_rotate(base_quat, base_lin_vel), base_ang_vel, dof_vel], dim=1).to(torch.float64)
        self._qpos.copy_(torch.where(rows, qpos, self._qpos))
        self._qvel.copy_(torch.where(rows, qvel, self._qvel))
        self.torques.masked_fill_(rows, 0.0)
        self._warmstart[mask.numpy()] = 0.0
        self._stepped.masked_fill_(mask.view(-1, 1, 1), False)

    def push(self, mask: Tensor, lin_vel_xy: Tensor) -> None:
        self._qvel[:, :2].add_(torch.where(mask.view(-1, 1), lin_vel_xy, 0.0))

    def randomize(self, field: RandomizedField, values: Tensor) -> None:
        setter_of(field, friction=self._set_friction, added_base_mass=self._add_base_mass)(values)

    def _set_friction(self, values: Tensor) -> None:
        geoms = [self.model.geom(name).id for name in self.robot.contact_names]
        self.batch.expand("geom_friction")[:, geoms, 0] = values.double().numpy()[:, None]

    def _add_base_mass(self, values: Tensor) -> None:
        base = self.model.body(self.robot.file.base).id
        self.batch.expand("body_mass")[:, base] = self.model.body_mass[base] + values.double().numpy()
        self.batch.set_const()

    def state_tensors(self) -> dict[str, Tensor]:
        return {
            "qpos": self._qpos,
            "qvel": self._qvel,
            "warmstart": torch.from_numpy(self._warmstart),
            "contact_forces": self.state.contact_forces,
            "stepped": self._stepped,
        }

    def copy_to(self, env_id: int, data: mujoco.MjData) -> None:
        data.qpos[:] = self._qpos[env_id].numpy()
        data.qvel[:] = self._qvel[env_id].numpy()
        mujoco.mj_forward(self.model, data)
