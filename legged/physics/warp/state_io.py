"""Kernels that copy states, kinematics and contact forces between an engine's arrays and those of the task.

In torch (mujoco.py, feet.py), the same formulas take about 140 launches per control step. With 4096 robots, these launches
take a third of the step's time.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp

from legged.physics.contact_groups import ContactGroups
from legged.physics.feet import FootChains
from legged.physics.fused.native import lanes_of
from legged.physics.robot_state import RobotState
from legged.physics.warp.contact_forces import add_contact_forces, find_largest_force, shift_forces, sum_contact_forces
from legged.robots.robot import Robot

# Overflow flags of dropped contacts or constraint rows. All other flags, such as iteration limits, are ignored.
LOST = int(mjw.OverflowType.NEFC | mjw.OverflowType.NJMAX_NNZ | mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE)


@wp.func
def rotate(quat: wp.vec4, vec: wp.vec3) -> wp.vec3:
    """Rotate a vector from body to world frame by a quaternion (w, x, y, z). Warp's own quaternions are (x, y, z, w)."""
    xyz = wp.vec3(quat[1], quat[2], quat[3])
    t = 2.0 * wp.cross(xyz, vec)
    return vec + quat[0] * t + wp.cross(xyz, t)


@wp.func
def rotate_inverse(quat: wp.vec4, vec: wp.vec3) -> wp.vec3:
    """Rotate a vector from world to body frame by a quaternion (w, x, y, z)."""
    xyz = wp.vec3(quat[1], quat[2], quat[3])
    t = 2.0 * wp.cross(xyz, vec)
    return vec - quat[0] * t + wp.cross(xyz, t)


@wp.func
def turn(vec: wp.vec3, axis: wp.vec3, angle: float) -> wp.vec3:
    """Rotate a vector about an axis by Rodrigues' formula."""
    c = wp.cos(angle)
    return c * vec + wp.sin(angle) * wp.cross(axis, vec) + (1.0 - c) * wp.dot(axis, vec) * axis


@wp.kernel
def read_kinematics(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    overflow: wp.array[int],
    lost: int,
    foot_offset: wp.array[wp.vec3],
    position: wp.array2d[int],
    speed: wp.array2d[int],
    axis: wp.array2d[wp.vec3],
    anchor: wp.array2d[wp.vec3],
    body_pos: wp.array2d[wp.vec3],
    body_quat: wp.array2d[wp.vec4],
    base_lin_vel: wp.array[wp.vec3],
    projected_gravity: wp.array[wp.vec3],
    feet_pos: wp.array2d[wp.vec3],
    feet_vel: wp.array2d[wp.vec3],
    overflowed: wp.array[wp.bool],
):
    """Compute base velocity and gravity direction in the base frame, positions and velocities of feet, and overflow flags.
    One thread per world and foot. `position` to `body_quat` are the fields of `FootChains`, (levels, feet) each.
    """
    world, foot = wp.tid()
    base = wp.vec3(qpos[world, 0], qpos[world, 1], qpos[world, 2])
    quat = wp.vec4(qpos[world, 3], qpos[world, 4], qpos[world, 5], qpos[world, 6])
    linear = wp.vec3(qvel[world, 0], qvel[world, 1], qvel[world, 2])
    angular = wp.vec3(qvel[world, 3], qvel[world, 4], qvel[world, 5])

    point = foot_offset[foot]
    velocity = wp.vec3(0.0)
    for level in range(position.shape[0]):
        a = axis[level, foot]
        angle = qpos[world, position[level, foot]]
        point = turn(point - anchor[level, foot], a, angle)
        velocity = turn(velocity, a, angle) + qvel[world, speed[level, foot]] * wp.cross(a, point)
        point = rotate(body_quat[level, foot], point + anchor[level, foot]) + body_pos[level, foot]
        velocity = rotate(body_quat[level, foot], velocity)
    feet_pos[world, foot] = base + rotate(quat, point)
    feet_vel[world, foot] = linear + rotate(quat, velocity + wp.cross(angular, point))

    if foot == 0:
        base_lin_vel[world] = rotate_inverse(quat, linear)
        projected_gravity[world] = rotate_inverse(quat, wp.vec3(0.0, 0.0, -1.0))
        overflowed[world] = (overflow[world] & lost) != 0
        overflow[world] = 0


@wp.kernel
def read_flags(overflow: wp.array[int], lost: int, overflowed: wp.array[wp.bool]):
    """Read and clear the overflow flags of a model without a robot. One thread per world."""
    world = wp.tid()
    overflowed[world] = (overflow[world] & lost) != 0
    overflow[world] = 0


@wp.kernel
def write_states(
    lanes: int,
    mask: wp.array[wp.bool],
    new_qpos: wp.array2d[float],
    new_qvel: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    ctrl: wp.array2d[float],
    act: wp.array2d[float],
    warmstart: wp.array2d[float],
    contact_forces: wp.array2d[wp.vec3],
):
    """Write the states of the worlds in `mask`, and clear their controls, activations, warm starts and contact forces.
    `lanes` threads per world.
    """
    world, lane = wp.tid()
    if not mask[world]:
        return
    for i in range(lane, qpos.shape[1], lanes):
        qpos[world, i] = new_qpos[world, i]
    for i in range(lane, qvel.shape[1], lanes):
        qvel[world, i] = new_qvel[world, i]
    for i in range(lane, ctrl.shape[1], lanes):
        ctrl[world, i] = 0.0
    for i in range(lane, act.shape[1], lanes):
        act[world, i] = 0.0
    for i in range(lane, warmstart.shape[1], lanes):
        warmstart[world, i] = 0.0
    for i in range(lane, contact_forces.shape[1], lanes):
        contact_forces[world, i] = wp.vec3(0.0)


@wp.kernel
def add_velocities(mask: wp.array[wp.bool], delta: wp.array2d[float], qvel: wp.array2d[float]):
    """Add `delta` to velocities in the worlds of `mask`. One thread per world and degree of freedom."""
    world, i = wp.tid()
    if mask[world]:
        qvel[world, i] = qvel[world, i] + delta[world, i]


@dataclass(frozen=True)
class EngineArrays:
    """Arrays (N, ...) of an engine. The kernels read or write them. `qpos` and `qvel` are in MuJoCo's layout."""

    qpos: wp.array
    qvel: wp.array
    ctrl: wp.array
    act: wp.array
    """Activations of actuators with a state; (N, 0) without such actuators."""
    warmstart: wp.array
    """Warm start of the solver; (N, 0) if the engine clears it itself."""
    overflow: wp.array
    """(N,) overflow flags. `StateIO.kinematics` clears them."""
    lost: int
    """Bits of `overflow` that mean that contacts or constraint rows were dropped."""


class StateIO:
    """Launches kernels that write states and read kinematics. Arrays are fixed, so that a graph can capture the launches."""

    def __init__(self, arrays: EngineArrays, overflowed: torch.Tensor) -> None:
        """Prepare for a model without a robot: `kinematics` then sets only `overflowed` (N,). Warp's current device must be
        that of the arrays.
        """
        self._arrays = arrays
        self._overflowed = wp.from_torch(overflowed)
        self._contact_forces = wp.zeros((len(overflowed), 0), dtype=wp.vec3)
        self._groups: list[tuple[wp.array, wp.array]] = []
        """`ContactGroups.bits` of the engine's shapes, and the tensor of `Physics.group_forces`, for each pair of groups."""

    def write(self, mask: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        """Write the state of the worlds in `mask` (N,): `qpos` (N, nq) and `qvel` (N, nv).

        mujoco-warp's reset_data is not used, since it drops the contacts of all worlds.
        """
        own = self._arrays
        lanes = lanes_of(wp.get_device())
        inputs = [lanes, wp.from_torch(mask), wp.from_torch(qpos.contiguous()), wp.from_torch(qvel.contiguous())]
        outputs = [own.qpos, own.qvel, own.ctrl, own.act, own.warmstart, self._contact_forces]
        wp.launch(write_states, dim=(len(mask), lanes), inputs=inputs, outputs=outputs)

    def push(self, mask: torch.Tensor, delta: torch.Tensor, qvel: torch.Tensor) -> None:
        """Add `delta` (N, K) to the first K columns of `qvel` in the worlds of `mask` (N,)."""
        inputs = [wp.from_torch(mask), wp.from_torch(delta), wp.from_torch(qvel)]
        wp.launch(add_velocities, dim=tuple(delta.shape), inputs=inputs)

    def kinematics(self) -> None:
        """Read the overflow flags and, for a robot, its kinematics. Then clear the overflow flags."""
        inputs = [self._arrays.overflow, self._arrays.lost]
        wp.launch(read_flags, dim=len(self._overflowed), inputs=inputs, outputs=[self._overflowed])

    def contact_forces(self) -> None:
        """Read the contact forces of tracked shapes from the last step. Without a robot, this does nothing."""

    def watch(self, shapes: Sequence[str], groups: Mapping[str, ContactGroups], forces: Mapping[str, torch.Tensor]) -> None:
        """Prepare to write the forces between `groups` to `forces`. `shapes` are the names of the engine's shapes, with
        `GROUND` for the ground. Warp's current device must be that of the arrays.
        """
        self._groups = [(wp.array(of.bits(shapes), dtype=int), wp.from_torch(forces[name])) for name, of in groups.items()]

    def measure_groups(self) -> None:
        """Update `Physics.group_forces` after a step."""
        for bits, forces in self._groups:
            wp.launch(shift_forces, dim=len(forces), outputs=[forces])
            self._find_largest(bits, forces)

    def _find_largest(self, bits: wp.array, forces: wp.array) -> None:
        """Write the largest force between two groups of shapes in the last step to the first column of `forces`."""


class RobotStateIO(StateIO, ABC):
    """StateIO of a model with a robot that has a floating base and feet."""

    def __init__(
        self, arrays: EngineArrays, overflowed: torch.Tensor, model: mujoco.MjModel, robot: Robot, state: RobotState
    ) -> None:
        """Prepare to write the fields of `state` that are not views of `qpos` and `qvel`. Warp's current device must be that
        of the arrays.
        """
        super().__init__(arrays, overflowed)
        chains = FootChains.of(model, robot)
        self._contact_forces = wp.from_torch(state.contact_forces, dtype=wp.vec3)
        self._dim = tuple(state.feet_pos.shape[:2])
        self._inputs = [
            arrays.qpos,
            arrays.qvel,
            arrays.overflow,
            arrays.lost,
            wp.array(chains.offset, dtype=wp.vec3),
            wp.array(chains.position, dtype=int),
            wp.array(chains.speed, dtype=int),
            wp.array(chains.axis, dtype=wp.vec3),
            wp.array(chains.anchor, dtype=wp.vec3),
            wp.array(chains.body_pos, dtype=wp.vec3),
            wp.array(chains.body_quat, dtype=wp.vec4),
        ]
        vectors = (state.base_lin_vel, state.projected_gravity, state.feet_pos, state.feet_vel)
        self._outputs = [*(wp.from_torch(t, dtype=wp.vec3) for t in vectors), self._overflowed]

    def kinematics(self) -> None:
        """Read base_lin_vel, projected_gravity, feet_pos, feet_vel and overflowed, and clear the overflow flags."""
        wp.launch(read_kinematics, dim=self._dim, inputs=self._inputs, outputs=self._outputs)

    @abstractmethod
    def contact_forces(self) -> None: ...

    @abstractmethod
    def _find_largest(self, bits: wp.array, forces: wp.array) -> None: ...


class MujocoWarpStateIO(RobotStateIO):
    """StateIO of a robot in mujoco-warp. It also reads the contact forces."""

    def __init__(
        self,
        m: Any,
        d: Any,
        overflowed: torch.Tensor,
        model: mujoco.MjModel,
        robot: Robot,
        state: RobotState,
        slots: int = 0,
    ) -> None:
        """Prepare for mujoco-warp's model `m` and data `d`. `slots` is the number of contacts that each world has room for
        (`ContactStage`), or 0 if all worlds share a pool. Warp's current device must be that of `m` and `d`.
        """
        super().__init__(arrays_of(d), overflowed, model, robot, state)
        self._m, self._d = m, d
        shapes = [-1] * model.ngeom
        for name, contact in zip(robot.shape_names, robot.contact_of_shape, strict=True):
            shapes[model.geom(name).id] = contact
        self._contact_of_geom = wp.array(shapes, dtype=int)
        self._slots = slots
        if not slots:
            self._contact_ids = wp.array(range(d.naconmax), dtype=int)
            self._forces = wp.zeros(d.naconmax, dtype=wp.spatial_vector)

    def contact_forces(self) -> None:
        m, d = self._m, self._d
        if self._slots:
            of, elliptic = d.contact, m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
            lanes = lanes_of(self._contact_forces.device)
            inputs = [lanes, self._slots, d.njmax, elliptic, of.geom, of.dim, of.efc_address, of.friction, of.frame]
            inputs += [d.efc.force, self._contact_of_geom]
            wp.launch(sum_contact_forces, dim=(d.nworld, lanes), inputs=inputs, outputs=[self._contact_forces])
            return
        mjw.contact_force(m, d, self._contact_ids, True, self._forces)
        self._contact_forces.zero_()
        wp.launch(
            add_contact_forces,
            dim=d.naconmax,
            inputs=[d.nacon, d.contact.geom, d.contact.worldid, self._forces, self._contact_of_geom],
            outputs=[self._contact_forces],
        )

    def _find_largest(self, bits: wp.array, forces: wp.array) -> None:
        d, of = self._d, self._d.contact
        inputs = [d.nacon, d.njmax, self._m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC, of.geom, of.dim, of.efc_address]
        inputs += [of.worldid, of.friction, d.efc.force, bits]
        wp.launch(find_largest_force, dim=d.naconmax, inputs=inputs, outputs=[forces])


def arrays_of(d: Any) -> EngineArrays:
    """Return those arrays of mujoco-warp's data `d` that the kernels read or write."""
    return EngineArrays(d.qpos, d.qvel, d.ctrl, d.act, d.qacc_warmstart, d.overflow, LOST)
