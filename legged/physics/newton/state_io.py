"""Conversion of states between Newton's conventions and the task's, and sums of contact forces on each shape.

Newton's quaternions are (x, y, z, w). Newton's linear velocity is that of a body's centre of mass. Both linear and
angular velocities are in the world frame. The task's arrays are in MuJoCo's layout: quaternions are (w, x, y, z), the linear
velocity is that of the base's origin in the world frame, and the angular velocity is in the base frame.
"""

from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp

from legged.physics.newton.fields import SolverFields
from legged.physics.newton.simulation import Simulation
from legged.physics.robot_state import RobotState
from legged.physics.warp.contact_forces import between
from legged.physics.warp.state_io import EngineArrays, RobotStateIO, rotate, rotate_inverse
from legged.robots.robot import Robot


@wp.kernel
def write_torques(torques: wp.array2d[float], dof_qd: wp.array[int], joint_f: wp.array2d[float]):
    """Copy the task's torques to Newton's joint forces. One thread per joint."""
    world, dof = wp.tid()
    joint_f[world, dof_qd[dof]] = torques[world, dof]


@wp.kernel
def write_varied_torques(
    torques: wp.array2d[float],
    gains: wp.array3d[float],
    limits: wp.array3d[float],
    dof_qd: wp.array[int],
    joint_f: wp.array2d[float],
):
    """Compute Newton's joint forces from the task's torques with gains and limits, as MuJoCo's actuators do. One thread per
    joint.
    """
    world, dof = wp.tid()
    given = gains[world, dof, 0] * torques[world, dof]
    joint_f[world, dof_qd[dof]] = wp.clamp(given, limits[world, dof, 0], limits[world, dof, 1])


@wp.kernel
def read_states(
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    base_com: wp.array[wp.vec3],
    root_q: int,
    root_qd: int,
    dof_q: wp.array[int],
    dof_qd: wp.array[int],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
):
    """Convert Newton's state to the task's. One thread per world."""
    world = wp.tid()
    quat = wp.vec4(
        joint_q[world, root_q + 6], joint_q[world, root_q + 3], joint_q[world, root_q + 4], joint_q[world, root_q + 5]
    )
    of_com = wp.vec3(joint_qd[world, root_qd], joint_qd[world, root_qd + 1], joint_qd[world, root_qd + 2])
    spin = wp.vec3(joint_qd[world, root_qd + 3], joint_qd[world, root_qd + 4], joint_qd[world, root_qd + 5])
    linear = of_com - wp.cross(spin, rotate(quat, base_com[world]))
    angular = rotate_inverse(quat, spin)
    for i in range(3):
        qpos[world, i] = joint_q[world, root_q + i]
        qvel[world, i] = linear[i]
        qvel[world, 3 + i] = angular[i]
    for i in range(4):
        qpos[world, 3 + i] = quat[i]
    for i in range(dof_q.shape[0]):
        qpos[world, 7 + i] = joint_q[world, dof_q[i]]
        qvel[world, 6 + i] = joint_qd[world, dof_qd[i]]


@wp.kernel
def put_states(
    mask: wp.array[wp.bool],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    base_com: wp.array[wp.vec3],
    root_q: int,
    root_qd: int,
    dof_q: wp.array[int],
    dof_qd: wp.array[int],
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
):
    """Convert the task's state to Newton's in the worlds of `mask`. One thread per world."""
    world = wp.tid()
    if not mask[world]:
        return
    quat = wp.vec4(qpos[world, 3], qpos[world, 4], qpos[world, 5], qpos[world, 6])
    spin = rotate(quat, wp.vec3(qvel[world, 3], qvel[world, 4], qvel[world, 5]))
    of_com = wp.vec3(qvel[world, 0], qvel[world, 1], qvel[world, 2]) + wp.cross(spin, rotate(quat, base_com[world]))
    for i in range(3):
        joint_q[world, root_q + i] = qpos[world, i]
        joint_q[world, root_q + 3 + i] = quat[1 + i]
        joint_qd[world, root_qd + i] = of_com[i]
        joint_qd[world, root_qd + 3 + i] = spin[i]
    joint_q[world, root_q + 6] = quat[0]
    for i in range(dof_q.shape[0]):
        joint_q[world, dof_q[i]] = qpos[world, 7 + i]
        joint_qd[world, dof_qd[i]] = qvel[world, 6 + i]


@wp.kernel
def add_shape_forces(
    count: wp.array[int],
    shape0: wp.array[int],
    shape1: wp.array[int],
    force: wp.array[wp.spatial_vector],
    tracked: wp.array[int],
    world_of_shape: wp.array[int],
    contact_forces: wp.array2d[wp.vec3],
):
    """Add each contact's force to the sum of its first shape, and the opposite force to the sum of its second shape, world
    frame [N]. One thread per contact.
    """
    i = wp.tid()
    if i >= count[0]:
        return
    on_first = wp.spatial_top(force[i])
    first, second = shape0[i], shape1[i]
    if first >= 0 and tracked[first] >= 0:
        wp.atomic_add(contact_forces, world_of_shape[first], tracked[first], on_first)
    if second >= 0 and tracked[second] >= 0:
        wp.atomic_add(contact_forces, world_of_shape[second], tracked[second], -on_first)


@wp.kernel
def find_largest_force(
    count: wp.array[int],
    shape0: wp.array[int],
    shape1: wp.array[int],
    force: wp.array[wp.spatial_vector],
    world_of_shape: wp.array[int],
    bits: wp.array[int],
    forces: wp.array2d[float],
):
    """Raise the first column of `forces` to the largest force of a contact between two groups of shapes [N]. One thread per
    contact.
    """
    i = wp.tid()
    if i >= count[0] or shape0[i] < 0 or shape1[i] < 0:
        return
    if between(bits[shape0[i]], bits[shape1[i]]):
        world = wp.max(world_of_shape[shape0[i]], world_of_shape[shape1[i]])  # that of the ground is -1
        wp.atomic_max(forces, world, 0, wp.length(wp.spatial_top(force[i])))


@wp.kernel
def flag_lost_contacts(count: wp.array[int], capacity: int, overflow: wp.array[int]):
    """Set the flags of all worlds if the pool of contacts that they share has overflowed, because each may have lost
    contacts. One thread per world.
    """
    if count[0] > capacity:
        overflow[wp.tid()] = 1


@wp.kernel
def take_flags(flags: wp.array[Any], lost: int, overflow: wp.array[int]):
    """Move the solver's flags to `overflow`, because the solver clears them late or never. One thread per world."""
    world = wp.tid()
    if (int(flags[world]) & lost) != 0:
        overflow[world] = 1
    flags[world] = flags.dtype(0)


class NewtonStateIO(RobotStateIO):
    """Launches the kernels above, on arrays of a simulation and of the task. All arrays keep their addresses."""

    def __init__(
        self,
        simulation: Simulation,
        task: tuple[wp.array, ...],
        overflowed: torch.Tensor,
        model: mujoco.MjModel,
        robot: Robot,
        state: RobotState,
    ) -> None:
        """Prepare the launches. `task` holds qpos, qvel and ctrl. Warp's current device must be that of the arrays."""
        self._qpos, self._qvel, self._torques = task
        count, layout = len(overflowed), simulation.layout
        self._overflow = wp.zeros(count, dtype=int)
        nothing = wp.zeros((count, 0), dtype=float)  # there are no activations, and the solver clears its warm start itself
        arrays = EngineArrays(*task, nothing, nothing, self._overflow, lost=1)
        super().__init__(arrays, overflowed, model, robot, state)
        self._simulation = simulation
        self._joint_q = simulation.state.joint_q.reshape((count, layout.coords))
        self._joint_qd = simulation.state.joint_qd.reshape((count, layout.dofs))
        self._joint_f = simulation.control.joint_f.reshape((count, layout.dofs))
        self._dof_qd = wp.array(layout.dof_qd, dtype=int)
        base_com = simulation.model.body_com.numpy().reshape(count, layout.bodies, 3)[:, layout.base]
        of_base = wp.array(base_com, dtype=wp.vec3)
        self.base_com = wp.to_torch(of_base)
        """(N, 3) centre of mass of the base, base frame [m]."""
        self.motors: SolverFields | None = None
        """Gains and limits that convert requested torques; None if torques are applied as requested."""
        self._convention = [
            of_base,
            layout.root_q,
            layout.root_qd,
            wp.array(layout.dof_q, dtype=int),
            self._dof_qd,
        ]
        tracked = np.full(simulation.model.shape_count, -1)
        worlds = tracked[: count * layout.num_shapes].reshape(count, layout.num_shapes)
        worlds[:, layout.shapes] = robot.contact_of_shape
        self._tracked = wp.array(tracked, dtype=int)

    def apply_torques(self) -> None:
        """Convert the task's controls to generalised forces of Newton's joints."""
        if self.motors is not None and self.motors.motors:
            varied = [wp.from_torch(self.motors.gains), wp.from_torch(self.motors.limits)]
            inputs = [self._torques, *varied, self._dof_qd]
            wp.launch(write_varied_torques, dim=self._torques.shape, inputs=inputs, outputs=[self._joint_f])
            return
        wp.launch(write_torques, dim=self._torques.shape, inputs=[self._torques, self._dof_qd], outputs=[self._joint_f])

    def read(self) -> None:
        """Convert Newton's joint coordinates to the task's."""
        inputs = [self._joint_q, self._joint_qd, *self._convention]
        wp.launch(read_states, dim=len(self._qpos), inputs=inputs, outputs=[self._qpos, self._qvel])

    def put(self, mask: wp.array) -> None:
        """Convert the task's coordinates to Newton's for the worlds of `mask`. Newton's bodies must be updated afterwards."""
        inputs = [mask, self._qpos, self._qvel, *self._convention]
        wp.launch(put_states, dim=len(self._qpos), inputs=inputs, outputs=[self._joint_q, self._joint_qd])

    def note_lost_contacts(self) -> None:
        """Set `_overflow` for the worlds that may have lost contacts in this step. If the pool of contacts has overflowed,
        these are all worlds, otherwise those that the solver has flagged. Clear the solver's flags.
        """
        simulation, contacts = self._simulation, self._simulation.contacts
        inputs = [contacts.rigid_contact_count, contacts.rigid_contact_max]
        wp.launch(flag_lost_contacts, dim=len(self._qpos), inputs=inputs, outputs=[self._overflow])
        if simulation.lost is not None:
            inputs = [simulation.lost, simulation.lost_bits]
            wp.launch(take_flags, dim=len(self._qpos), inputs=inputs, outputs=[self._overflow])

    def _find_largest(self, bits: wp.array, forces: wp.array) -> None:
        of, model = self._simulation.contacts, self._simulation.model
        inputs = [of.rigid_contact_count, of.rigid_contact_shape0, of.rigid_contact_shape1, self._simulation.force]
        inputs += [model.shape_world, bits]
        wp.launch(find_largest_force, dim=of.rigid_contact_max, inputs=inputs, outputs=[forces])

    def contact_forces(self) -> None:
        contacts = self._simulation.contacts
        self._contact_forces.zero_()
        wp.launch(
            add_shape_forces,
            dim=contacts.rigid_contact_max,
            inputs=[
                contacts.rigid_contact_count,
                contacts.rigid_contact_shape0,
                contacts.rigid_contact_shape1,
                self._simulation.force,
                self._tracked,
                self._simulation.model.shape_world,
            ],
            outputs=[self._contact_forces],
        )
