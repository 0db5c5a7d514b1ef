"""Between mujoco-warp's arrays and the task: one Warp launch to write states, one to read kinematics, two for forces.

The same formulas in torch (mujoco.py, feet.py) take some 140 launches a control step, a third of its time at 4096 robots.
"""

from abc import ABC, abstractmethod
from typing import Any

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp

from legged.physics.base import RobotState
from legged.physics.feet import FootChains
from legged.robots.robot import Robot

# Contacts or constraint rows were dropped; the other bits (iteration caps) are no loss.
LOST = int(mjw.OverflowType.NEFC | mjw.OverflowType.NJMAX_NNZ | mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE)

wp.set_module_options({"enable_backward": False})


@wp.func
def rotate(quat: wp.vec4, vec: wp.vec3) -> wp.vec3:
    """Body -> world for a quaternion (w, x, y, z); Warp's own quaternions are (x, y, z, w)."""
    xyz = wp.vec3(quat[1], quat[2], quat[3])
    t = 2.0 * wp.cross(xyz, vec)
    return vec + quat[0] * t + wp.cross(xyz, t)


@wp.func
def rotate_inverse(quat: wp.vec4, vec: wp.vec3) -> wp.vec3:
    """World -> body."""
    xyz = wp.vec3(quat[1], quat[2], quat[3])
    t = 2.0 * wp.cross(xyz, vec)
    return vec - quat[0] * t + wp.cross(xyz, t)


@wp.func
def turn(vec: wp.vec3, axis: wp.vec3, angle: float) -> wp.vec3:
    """Rodrigues' formula."""
    c = wp.cos(angle)
    return c * vec + wp.sin(angle) * wp.cross(axis, vec) + (1.0 - c) * wp.dot(axis, vec) * axis


@wp.kernel
def read_kinematics(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    overflow: wp.array[int],
    lost: int,
    foot_offset: wp.array[wp.vec3],
    joint: wp.array2d[int],
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
    """One thread a world and foot. Tables are (levels, feet), from the foot's body up to the base's child."""
    world, foot = wp.tid()
    base = wp.vec3(qpos[world, 0], qpos[world, 1], qpos[world, 2])
    quat = wp.vec4(qpos[world, 3], qpos[world, 4], qpos[world, 5], qpos[world, 6])
    linear = wp.vec3(qvel[world, 0], qvel[world, 1], qvel[world, 2])
    angular = wp.vec3(qvel[world, 3], qvel[world, 4], qvel[world, 5])

    point = foot_offset[foot]
    velocity = wp.vec3(0.0)
    for level in range(joint.shape[0]):
        j = joint[level, foot]
        a = axis[level, foot]
        angle = qpos[world, 7 + j]
        point = turn(point - anchor[level, foot], a, angle)
        velocity = turn(velocity, a, angle) + qvel[world, 6 + j] * wp.cross(a, point)
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
def add_contact_forces(
    nacon: wp.array[int],
    geom: wp.array[wp.vec2i],
    worldid: wp.array[int],
    force: wp.array[wp.spatial_vector],
    shape_of_geom: wp.array[int],
    contact_forces: wp.array2d[wp.vec3],
):
    """One thread a contact: its force on the second shape, and the reaction on the first, world frame [N]."""
    i = wp.tid()
    if i >= nacon[0]:
        return
    on_second = wp.spatial_top(force[i])
    first, second = shape_of_geom[geom[i][0]], shape_of_geom[geom[i][1]]
    if first >= 0:
        wp.atomic_add(contact_forces, worldid[i], first, -on_second)
    if second >= 0:
        wp.atomic_add(contact_forces, worldid[i], second, on_second)


@wp.kernel
def write_states(
    mask: wp.array[wp.bool],
    base_pos: wp.array2d[float],
    base_quat: wp.array2d[float],
    base_lin_vel: wp.array2d[float],
    base_ang_vel: wp.array2d[float],
    dof_pos: wp.array2d[float],
    dof_vel: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    ctrl: wp.array2d[float],
    warmstart: wp.array2d[float],
    contact_forces: wp.array2d[wp.vec3],
):
    """One thread a world. Clears what would carry over a step: controls and the solver's warm start."""
    world = wp.tid()
    if not mask[world]:
        return
    quat = wp.vec4(base_quat[world, 0], base_quat[world, 1], base_quat[world, 2], base_quat[world, 3])
    linear = rotate(quat, wp.vec3(base_lin_vel[world, 0], base_lin_vel[world, 1], base_lin_vel[world, 2]))
    for i in range(3):
        qpos[world, i] = base_pos[world, i]
        qvel[world, i] = linear[i]
        qvel[world, 3 + i] = base_ang_vel[world, i]
    for i in range(4):
        qpos[world, 3 + i] = quat[i]
    for i in range(dof_pos.shape[1]):
        qpos[world, 7 + i] = dof_pos[world, i]
        qvel[world, 6 + i] = dof_vel[world, i]
    for i in range(ctrl.shape[1]):
        ctrl[world, i] = 0.0
    for i in range(warmstart.shape[1]):
        warmstart[world, i] = 0.0
    for i in range(contact_forces.shape[1]):
        contact_forces[world, i] = wp.vec3(0.0)


class StateExchange(ABC):
    """Launches the kernels that write states and read kinematics on fixed arrays, so that a capture can hold them."""

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: Robot,
        state: RobotState,
        qpos: wp.array,
        qvel: wp.array,
        torques: wp.array,
        warmstart: wp.array,
        overflow: wp.array,
        lost: int,
        overflowed: torch.Tensor,
    ) -> None:
        """Arrays are (N, ...), `qpos` and `qvel` in MuJoCo's layout; the bits `lost` of `overflow` mean that contacts were
        dropped. Call with the arrays' device as Warp's current one.
        """
        chains = FootChains.of(model, robot)
        self._state = state
        self._contact_forces = wp.from_torch(state.contact_forces, dtype=wp.vec3)
        self._written = [qpos, qvel, torques, warmstart, self._contact_forces]
        self._inputs = [
            qpos,
            qvel,
            overflow,
            lost,
            wp.array(chains.offset, dtype=wp.vec3),
            wp.array(chains.joint, dtype=int),
            wp.array(chains.axis, dtype=wp.vec3),
            wp.array(chains.anchor, dtype=wp.vec3),
            wp.array(chains.body_pos, dtype=wp.vec3),
            wp.array(chains.body_quat, dtype=wp.vec4),
        ]
        vectors = (state.base_lin_vel, state.projected_gravity, state.feet_pos, state.feet_vel)
        self._outputs = [*(wp.from_torch(t, dtype=wp.vec3) for t in vectors), wp.from_torch(overflowed)]

    def write(self, mask: torch.Tensor, *values: torch.Tensor) -> None:
        """Task -> engine, for the worlds of `mask`: values as Physics.write_state takes them, in its order.

        mujoco-warp's own reset_data would drop the contacts of all worlds.
        """
        inputs = [wp.from_torch(mask), *(wp.from_torch(value.contiguous()) for value in values)]
        wp.launch(write_states, dim=self._state.feet_pos.shape[0], inputs=inputs, outputs=self._written)

    def kinematics(self) -> None:
        """Engine -> base_lin_vel, projected_gravity, feet_pos, feet_vel, overflowed; clears the overflow flags."""
        dim = self._state.feet_pos.shape[:2]
        wp.launch(read_kinematics, dim=tuple(dim), inputs=self._inputs, outputs=self._outputs)

    @abstractmethod
    def contact_forces(self) -> None:
        """Engine -> contact_forces, as the last step's solver left them."""


class Exchange(StateExchange):
    """The same with the arrays of mujoco-warp, and its contact forces."""

    def __init__(
        self, m: Any, d: Any, model: mujoco.MjModel, robot: Robot, state: RobotState, overflowed: torch.Tensor
    ) -> None:
        """`m`, `d` are mujoco-warp's model and data; call with their device as Warp's current one."""
        super().__init__(model, robot, state, d.qpos, d.qvel, d.ctrl, d.qacc_warmstart, d.overflow, LOST, overflowed)
        self._m, self._d = m, d
        shapes = [-1] * model.ngeom
        for index, name in enumerate(robot.contact_names):
            shapes[model.geom(name).id] = index
        self._shape_of_geom = wp.array(shapes, dtype=int)
        self._contact_ids = wp.array(range(d.naconmax), dtype=int)
        self._forces = wp.zeros(d.naconmax, dtype=wp.spatial_vector)

    def contact_forces(self) -> None:
        m, d = self._m, self._d
        mjw.contact_force(m, d, self._contact_ids, True, self._forces)
        self._contact_forces.zero_()
        wp.launch(
            add_contact_forces,
            dim=d.naconmax,
            inputs=[d.nacon, d.contact.geom, d.contact.worldid, self._forces, self._shape_of_geom],
            outputs=[self._contact_forces],
        )
