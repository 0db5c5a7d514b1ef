"""Between Newton's arrays and those of the task: conventions, contact forces by shape, and the penalty law of contacts.

Newton: quaternions (x, y, z, w); velocity of a body's centre of mass, world frame; angular velocity, world frame. The
task's arrays are in MuJoCo's layout: (w, x, y, z); velocity of the base's origin, world frame; angular, base frame.
"""

from typing import Any

import mujoco
import newton
import numpy as np
import torch
import warp as wp

from legged.physics.base import RobotState
from legged.physics.exchange import StateExchange, rotate, rotate_inverse
from legged.physics.newton_model import Layout
from legged.robot import Robot

wp.set_module_options({"enable_backward": False})


@wp.kernel
def write_torques(torques: wp.array2d[float], dof_qd: wp.array[int], joint_f: wp.array2d[float]):
    """One thread a joint."""
    world, dof = wp.tid()
    joint_f[world, dof_qd[dof]] = torques[world, dof]


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
    """One thread a world: Newton -> task."""
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
    """One thread a world of `mask`: task -> Newton."""
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
    """One thread a contact: its force on the first shape, and the reaction on the second, world frame [N]."""
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
def flag_lost_contacts(count: wp.array[int], capacity: int, overflow: wp.array[int]):
    """One thread a world. The pool is everybody's, so where it overflows, every world may have lost contacts."""
    if count[0] > capacity:
        overflow[wp.tid()] = 1


@wp.kernel
def take_flags(flags: wp.array[Any], lost: int, overflow: wp.array[int]):
    """One thread a world: the solver's flags, which it may clear at its next step, or never."""
    world = wp.tid()
    if (int(flags[world]) & lost) != 0:
        overflow[world] = 1
    flags[world] = flags.dtype(0)


@wp.func
def point_motion(
    body: int,
    point: wp.vec3,
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
):
    """World position and velocity of a contact point given in its body, or in the world if it has none."""
    if body < 0:
        return point, wp.vec3(0.0)
    at = wp.transform_point(body_q[body], point)
    arm = at - wp.transform_point(body_q[body], body_com[body])
    return at, wp.spatial_top(body_qd[body]) + wp.cross(wp.spatial_bottom(body_qd[body]), arm)


@wp.kernel
def penalty_forces(
    count: wp.array[int],
    shape0: wp.array[int],
    shape1: wp.array[int],
    point0: wp.array[wp.vec3],
    point1: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    margin0: wp.array[float],
    margin1: wp.array[float],
    body_of_shape: wp.array[int],
    friction: wp.array[float],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
    stiffness: float,
    damping: float,
    slope: float,
    force: wp.array[wp.spatial_vector],
):
    """One thread a contact: the force on its first shape by the law of Newton's solvers with springs in contacts.

    The spring pushes in proportion to depth, the damper against approach; friction opposes sliding in proportion to its
    speed, up to Coulomb's limit of the mean coefficient.
    """
    i = wp.tid()
    if i >= count[0]:
        return
    force[i] = wp.spatial_vector()
    first, second = shape0[i], shape1[i]
    up = -normal[i]  # towards the first shape
    at0, velocity0 = point_motion(body_of_shape[first], point0[i], body_q, body_qd, body_com)
    at1, velocity1 = point_motion(body_of_shape[second], point1[i], body_q, body_qd, body_com)
    depth = margin0[i] + margin1[i] - wp.dot(up, at0 - at1)
    if depth <= 0.0:
        return
    velocity = velocity0 - velocity1
    approach = wp.max(-wp.dot(up, velocity), 0.0)
    press = stiffness * depth + damping * approach
    sliding = velocity - up * wp.dot(up, velocity)
    resist = wp.min(slope * wp.length(sliding), 0.5 * (friction[first] + friction[second]) * press)
    force[i] = wp.spatial_vector(press * up - resist * wp.normalize(sliding), wp.vec3(0.0))


class NewtonExchange(StateExchange):
    """Launches the kernels above on fixed arrays: `state` is the one that the solver starts a step from."""

    def __init__(
        self,
        newton_model: newton.Model,
        layout: Layout,
        newton_state: newton.State,
        control: newton.Control,
        contacts: newton.Contacts,
        model: mujoco.MjModel,
        robot: Robot,
        state: RobotState,
        qpos: wp.array,
        qvel: wp.array,
        torques: wp.array,
        overflowed: torch.Tensor,
    ) -> None:
        """`qpos`, `qvel`, `torques` are the task's side, (N, ...). Call with the model's device as Warp's current one."""
        count = len(qpos)
        self._overflow = wp.zeros(count, dtype=int)
        nothing = wp.zeros((count, 0), dtype=float)  # the solver is asked to clear its warm start
        super().__init__(model, robot, state, qpos, qvel, torques, nothing, self._overflow, 1, overflowed)
        self._model, self._layout, self._contacts = newton_model, layout, contacts
        self._qpos, self._qvel, self._torques = qpos, qvel, torques
        self._joint_q = newton_state.joint_q.reshape((count, layout.coords))
        self._joint_qd = newton_state.joint_qd.reshape((count, layout.dofs))
        self._joint_f = control.joint_f.reshape((count, layout.dofs))
        self._dof_q, self._dof_qd = wp.array(layout.dof_q, dtype=int), wp.array(layout.dof_qd, dtype=int)
        base_com = newton_model.body_com.numpy()[layout.base :: layout.bodies]
        self._base_com = wp.array(base_com[:count], dtype=wp.vec3)
        tracked = np.full(newton_model.shape_count, -1)
        worlds = tracked[: count * layout.num_shapes].reshape(count, layout.num_shapes)
        worlds[:, layout.shapes] = np.arange(len(layout.shapes))
        self._tracked = wp.array(tracked, dtype=int)
        self.force = wp.zeros(max(contacts.rigid_contact_max, 1), dtype=wp.spatial_vector)
        """Force on the first shape of each contact, for solvers that don't report it."""
        self.reported: wp.array | None = None
        """The same, where the solver does."""

    @property
    def _convention(self) -> list[Any]:
        return [self._base_com, self._layout.root_q, self._layout.root_qd, self._dof_q, self._dof_qd]

    def apply_torques(self) -> None:
        """Task -> generalised forces of the joints."""
        wp.launch(write_torques, dim=self._torques.shape, inputs=[self._torques, self._dof_qd], outputs=[self._joint_f])

    def read(self) -> None:
        """Newton's joint coordinates -> task."""
        inputs = [self._joint_q, self._joint_qd, *self._convention]
        wp.launch(read_states, dim=len(self._qpos), inputs=inputs, outputs=[self._qpos, self._qvel])

    def put(self, mask: wp.array) -> None:
        """Task -> Newton's joint coordinates, for the worlds of `mask`; bodies must follow."""
        inputs = [mask, self._qpos, self._qvel, *self._convention]
        wp.launch(put_states, dim=len(self._qpos), inputs=inputs, outputs=[self._joint_q, self._joint_qd])

    def note_lost_contacts(self, flags: wp.array | None, lost: int) -> None:
        """Keep until the next refresh what was lost in this step: in the pool of contacts, and, if the solver says so, by
        the bits `lost` of its `flags` (N,), which are cleared.
        """
        contacts = self._contacts
        inputs = [contacts.rigid_contact_count, contacts.rigid_contact_max]
        wp.launch(flag_lost_contacts, dim=len(self._qpos), inputs=inputs, outputs=[self._overflow])
        if flags is not None:
            wp.launch(take_flags, dim=len(self._qpos), inputs=[flags, lost], outputs=[self._overflow])

    def penalty_forces(self, state: newton.State, law: tuple[float, float, float]) -> None:
        """`force` of the contacts at the bodies' present state, with stiffness, damping and slope of friction."""
        model, contacts = self._model, self._contacts
        wp.launch(
            penalty_forces,
            dim=contacts.rigid_contact_max,
            inputs=[
                contacts.rigid_contact_count,
                contacts.rigid_contact_shape0,
                contacts.rigid_contact_shape1,
                contacts.rigid_contact_point0,
                contacts.rigid_contact_point1,
                contacts.rigid_contact_normal,
                contacts.rigid_contact_margin0,
                contacts.rigid_contact_margin1,
                model.shape_body,
                model.shape_material_mu,
                state.body_q,
                state.body_qd,
                model.body_com,
                *law,
            ],
            outputs=[self.force],
        )

    def contact_forces(self) -> None:
        contacts = self._contacts
        self._contact_forces.zero_()
        wp.launch(
            add_shape_forces,
            dim=contacts.rigid_contact_max,
            inputs=[
                contacts.rigid_contact_count,
                contacts.rigid_contact_shape0,
                contacts.rigid_contact_shape1,
                self.force if self.reported is None else self.reported,
                self._tracked,
                self._model.shape_world,
            ],
            outputs=[self._contact_forces],
        )
