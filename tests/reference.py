"""What the physics tests share: states to put robots in, a PD law, and single worlds of C MuJoCo as the reference."""

import itertools
from dataclasses import dataclass, fields, replace

import mujoco
import numpy as np
import torch
from devices import engine_of
from torch import Tensor

from legged.config.robot import TerrainConfig
from legged.config.world import SimConfig
from legged.math import quat_rotate
from legged.physics import Physics, RobotState
from legged.physics.scene import RobotScene
from legged.robots.robot import Robot
from legged.terrain import Terrain, TileSpec

TOUCHING = 0.54982
"""Base height at which the feet of the default pose end 1 mm above the ground [m]."""
FIELDS = tuple(field.name for field in fields(RobotState))


@dataclass(frozen=True)
class States:
    """States of robots in the frames of RobotState, one row a world."""

    base_pos: Tensor
    base_quat: Tensor
    base_lin_vel: Tensor
    base_ang_vel: Tensor
    dof_pos: Tensor
    dof_vel: Tensor

    @classmethod
    def of(cls, physics: Physics) -> "States":
        """Where the worlds are now."""
        return cls(*(getattr(physics.robot_state, field.name).clone() for field in fields(cls)))

    @property
    def qpos(self) -> Tensor:
        """(N, 7 + D) as MuJoCo has it."""
        return torch.cat([self.base_pos, self.base_quat, self.dof_pos], dim=1)

    @property
    def qvel(self) -> Tensor:
        """(N, 6 + D) as MuJoCo has it: the linear velocity in the world frame."""
        return torch.cat([quat_rotate(self.base_quat, self.base_lin_vel), self.base_ang_vel, self.dof_vel], dim=1)

    def write(self, physics: Physics, mask: Tensor | None = None) -> None:
        """Into the worlds of `mask`, by default all; refreshed."""
        every = torch.ones(physics.num_envs, dtype=torch.bool)
        physics.write(every if mask is None else mask, self.qpos, self.qvel)
        physics.refresh()


def standing(robot: Robot, count: int, height: float = TOUCHING) -> States:
    """At rest, level, in the default pose."""
    zeros = torch.zeros(count, 3)
    pos, quat = zeros.clone(), torch.zeros(count, 4)
    pos[:, 2], quat[:, 0] = height, 1.0
    angles = torch.tensor(robot.default_dof_pos, dtype=torch.float32).repeat(count, 1)
    return States(pos, quat, zeros, zeros, angles, torch.zeros_like(angles))


def random_states(robot: Robot, count: int, seed: int) -> States:
    """Near the ground, tilted by about 10 degrees, any heading, everything moving."""
    generator = torch.Generator().manual_seed(seed)

    def draw(columns: int, half: float) -> Tensor:
        return (2.0 * torch.rand(count, columns, generator=generator) - 1.0) * half

    state = standing(robot, count)
    tilt = torch.cat([torch.ones(count, 1), draw(2, 0.1), torch.zeros(count, 1)], dim=1)
    yaw = draw(1, torch.pi)[:, 0] / 2.0
    c, s = torch.cos(yaw), torch.sin(yaw)
    w, x, y, _ = tilt.unbind(dim=1)
    quat = torch.stack([c * w, c * x - s * y, c * y + s * x, s * w], dim=1)  # yaw after tilt
    return States(
        base_pos=state.base_pos + draw(3, 0.05) + torch.tensor([3.0, -2.0, 0.05]),
        base_quat=quat / quat.norm(dim=1, keepdim=True),
        base_lin_vel=draw(3, 0.5),
        base_ang_vel=draw(3, 0.5),
        dof_pos=state.dof_pos * (1.0 + draw(robot.num_dof, 0.3)),
        dof_vel=draw(robot.num_dof, 1.0),
    )


def heaps(robot: Robot, count: int, seed: int) -> States:
    """A little above the ground in any orientation, legs anywhere: they land on whatever comes first."""
    generator = torch.Generator().manual_seed(seed)
    state = random_states(robot, count, seed)
    quat = torch.randn(count, 4, generator=generator)
    low, high = torch.tensor([-0.4, -2.5, -2.5]), torch.tensor([0.4, 2.5, 2.5])
    angles = low + (high - low) * torch.rand(count, robot.num_dof // 3, 3, generator=generator)
    pos = state.base_pos.clone()
    pos[:, 2] = 0.8
    quat = quat / quat.norm(dim=1, keepdim=True)
    return replace(state, base_pos=pos, base_quat=quat, dof_pos=angles.reshape(count, -1))


def pd(angles: Tensor, rates: Tensor, targets: Tensor, stiffness: float = 90.0, damping: float = 4.0) -> Tensor:
    """Explicit PD torques, clipped at ANYmal C's 80 N m."""
    return (stiffness * (targets - angles) - damping * rates).clamp(-80.0, 80.0)


def snapshot(physics: Physics) -> Tensor:
    """(N, K) a copy of all of `state`."""
    return torch.cat([getattr(physics.robot_state, name).reshape(physics.num_envs, -1) for name in FIELDS], dim=1)


def bits(tensor: Tensor) -> Tensor:
    """The bit patterns, by which a NaN equals itself."""
    return tensor.contiguous().view(torch.int32)


REORDERED = {"base_lin_vel": 4e-3, "base_lin_vel_w": 4e-3, "base_ang_vel": 4e-3, "feet_vel": 4e-3, "dof_vel": 2e-2}
"""What the order of contacts may make of velocities in a hundred steps [m/s], [rad/s]; of positions it may be 2e-4, of forces
2 N: twice what a float32 engine may be from C MuJoCo, for here are two of them.
"""


def assert_same(physics: Physics, found: Tensor, expected: Tensor) -> None:
    """Check that snapshots or rollouts (..., K) are the same, bit by bit on the CPU. On a GPU contacts come in another order
    each time, and with them what is summed over rows of constraints.
    """
    if engine_of(physics).device.type == "cpu":
        assert torch.equal(bits(found), bits(expected))
        return
    limits = [
        torch.full((value[0].numel(),), {**REORDERED, "contact_forces": 2.0}.get(name, 2e-4))
        for name, value in ((name, getattr(physics.robot_state, name)) for name in FIELDS)
    ]
    bad = (found - expected).abs() > torch.cat(limits)
    bad |= found.isfinite() != expected.isfinite()
    columns = bad.flatten(0, -2).any(dim=0).split([len(limit) for limit in limits])
    wrong = [name for name, column in zip(FIELDS, columns, strict=True) if column.any()]
    assert not wrong, f"{wrong} differ by up to {(found - expected).nan_to_num().abs().max():.1e}"


def roll(physics: Physics, targets: Tensor, steps: int, stiffness: float = 90.0, damping: float = 4.0) -> Tensor:
    """(steps, N, K) `state` after each of `steps` steps under PD towards the angles `targets` (N, D)."""
    states = []
    for _ in range(steps):
        physics.ctrl.copy_(pd(physics.robot_state.dof_pos, physics.robot_state.dof_vel, targets, stiffness, damping))
        physics.step()
        physics.refresh()
        states.append(snapshot(physics))
    return torch.stack(states)


class CWorlds:
    """One MjData a world, stepped by mj_step: float64, no batching, no code of ours but the model."""

    def __init__(self, robot: Robot, sim: SimConfig, states: States) -> None:
        self.robot, self.model = robot, RobotScene(robot).model(sim)
        self.shapes = {self.model.geom(name).id: i for name, i in zip(robot.shape_names, robot.contact_of_shape, strict=True)}
        self.feet = [[self.model.geom(name).id for name in shapes] for shapes in robot.feet_shapes]
        self._live = mujoco.MjData(self.model)
        self.worlds = []
        for i in range(len(states.base_pos)):
            data = mujoco.MjData(self.model)
            data.qpos[:] = torch.cat([states.base_pos[i], states.base_quat[i], states.dof_pos[i]]).numpy()
            mujoco.mju_rotVecQuat(data.qvel[:3], states.base_lin_vel[i].double().numpy(), data.qpos[3:7])
            data.qvel[3:] = torch.cat([states.base_ang_vel[i], states.dof_vel[i]]).numpy()
            self.worlds.append(data)

    def step(self, torques: Tensor) -> None:
        for data, torque in zip(self.worlds, torques, strict=True):
            data.ctrl[:] = torque.numpy()
            mujoco.mj_step(self.model, data)

    def steep_capsules(self) -> np.ndarray:
        """(N,) whether a capsule steeper than 60 degrees touched the ground in the last step.

        There mujoco-warp's own launches turn the friction pyramid another way than C MuJoCo and our contact stage (they give
        up aligning it with the capsule), so that sliding differs by what the pyramid's orientation makes.
        """
        found = []
        for data in self.worlds:
            geoms = [int(geom) for contact in data.contact for geom in contact.geom]
            capsules = [geom for geom in geoms if self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE]
            found.append(any(abs(data.geom_xmat[geom][8]) > 0.86 for geom in capsules))
        return np.array(found)

    def step_pd(self, targets: Tensor) -> None:
        """One step under PD on these worlds' own joints."""
        angles = torch.from_numpy(np.stack([data.qpos[7:] for data in self.worlds]))
        rates = torch.from_numpy(np.stack([data.qvel[6:] for data in self.worlds]))
        self.step(pd(angles, rates, targets.double()))

    def observe(self) -> dict[str, np.ndarray]:
        """All of RobotState."""
        rows = [self._observe(data) for data in self.worlds]
        return {name: np.stack([row[name] for row in rows]) for name in FIELDS}

    def _observe(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        live = self._live  # after mj_step, data itself holds the kinematics of the state before
        live.qpos[:], live.qvel[:] = data.qpos, data.qvel
        mujoco.mj_kinematics(self.model, live)
        mujoco.mj_comPos(self.model, live)
        mujoco.mj_comVel(self.model, live)
        to_base = live.body(self.robot.file.base).xmat.reshape(3, 3).T
        velocity = np.zeros((self.model.ngeom, 6))
        for i in itertools.chain(*self.feet):
            mujoco.mj_objectVelocity(self.model, live, mujoco.mjtObj.mjOBJ_GEOM, i, velocity[i], 0)
        return {
            "base_pos": data.qpos[:3],
            "base_quat": data.qpos[3:7],
            "base_lin_vel": to_base @ live.qvel[:3],
            "base_lin_vel_w": data.qvel[:3],
            "base_ang_vel": data.qvel[3:6],
            "projected_gravity": to_base @ [0.0, 0.0, -1.0],
            "dof_pos": data.qpos[7:],
            "dof_vel": data.qvel[6:],
            "feet_pos": np.array([live.geom_xpos[shapes].mean(axis=0) for shapes in self.feet]),
            "feet_vel": np.array([velocity[shapes, 3:].mean(axis=0) for shapes in self.feet]),
            "contact_forces": self._contact_forces(data),
        }

    def _contact_forces(self, data: mujoco.MjData) -> np.ndarray:
        """What the last step's solver left, summed over the contacts of each shape or foot, world frame."""
        forces = np.zeros((len(self.robot.contact_names), 3))
        wrench = np.zeros(6)
        for i in range(data.ncon):
            contact = data.contact[i]
            mujoco.mj_contactForce(self.model, data, i, wrench)
            on_second = contact.frame.reshape(3, 3).T @ wrench[:3]
            for geom, force in ((contact.geom1, -on_second), (contact.geom2, on_second)):
                if geom in self.shapes:
                    forces[self.shapes[geom]] += force
        return forces


def tiles(*names_and_sizes: tuple[str, float]) -> Terrain:
    """A row of tiles of these types and sizes, on a height map, the same every time."""
    cfg = TerrainConfig(mesh_type="height_map", border_size=4.0)
    return Terrain.of_tiles([[TileSpec(*pair) for pair in names_and_sizes]], cfg, np.random.default_rng(5))
