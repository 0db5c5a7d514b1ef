"""A physics step in few launches: one before contacts, one for constraint forces, one for integration.

mujoco-warp launches a stage for every feature that a model might have: gravity compensation, external forces, muscles with
lengths and activations, fluids, tendons. At 4096 worlds each launch costs microseconds even if it computes nothing, which
adds up to a fifth of a step. This step supports trees of joints with springs, dampers and motors; `SmoothDynamics.why_not`
returns the first feature of a model that this step does not support. The step applies external forces on bodies only if
`TorqueStep(randomized=...)` contains their name, `xfrc_applied`. It ignores `qfrc_applied`. It does not compute sensors or
cameras, and computes poses of bodies and sites only if equality constraints need them.
"""

from collections.abc import Collection
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

from legged.physics.fused.active_set import ActiveSet
from legged.physics.fused.constraint_solver import ConstraintSolver
from legged.physics.fused.smooth_dynamics import BALL, FREE, SmoothDynamics, has_dampers

NEFC, BROADPHASE, NARROWPHASE = (int(getattr(mjw.OverflowType, n)) for n in ("NEFC", "BROADPHASE", "NARROWPHASE"))
FREE_JOINT, BALL_JOINT = wp.constant(FREE), wp.constant(BALL)

wp.set_module_options({"enable_backward": False})


@wp.func
def turned_by(quat: wp.vec4, rotation: wp.vec3) -> wp.vec4:
    """Return a unit quaternion (w, x, y, z) rotated by a rotation vector [rad] in its own frame."""
    angle = wp.length(rotation)
    w, xyz = wp.cos(0.5 * angle), wp.sin(0.5 * angle) * wp.normalize(rotation)
    old = wp.vec3(quat[1], quat[2], quat[3])
    new = quat[0] * xyz + w * old + wp.cross(old, xyz)
    return wp.normalize(wp.vec4(quat[0] * w - wp.dot(old, xyz), new[0], new[1], new[2]))


@wp.struct
class StateArrays:
    """Arrays of mujoco-warp's model and data for the integration, which writes `qpos` and all arrays after it."""

    timestep: wp.array[float]
    jnt_type: wp.array[int]
    jnt_qposadr: wp.array[int]
    jnt_dofadr: wp.array[int]
    advance: wp.array2d[float]
    qacc: wp.array2d[float]
    nefc: wp.array[int]
    nacon: wp.array[int]
    ncollision: wp.array[int]
    most_rows: int
    most_contacts: int
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    warmstart: wp.array2d[float]
    overflow: wp.array[int]


@wp.func
def three(of: wp.array2d[float], world: int, at: int) -> wp.vec3:
    """Return three numbers of a world's row, starting at `at`."""
    return wp.vec3(of[world, at], of[world, at + 1], of[world, at + 2])


@wp.func
def put_three(to: wp.array2d[float], world: int, at: int, numbers: wp.vec3) -> None:
    """Write three numbers into a world's row, starting at `at`."""
    for k in range(3):
        to[world, at + k] = numbers[k]


@wp.func
def turn_joint(world: int, at: int, dof: int, h: float, of: StateArrays) -> None:
    """Integrate a joint's quaternion, which starts at `at` in qpos, and its velocity, which starts at `dof` in qvel."""
    velocity, gain = three(of.qvel, world, dof), three(of.advance, world, dof)
    acceleration = three(of.qacc, world, dof)
    quat = wp.vec4(of.qpos[world, at], of.qpos[world, at + 1], of.qpos[world, at + 2], of.qpos[world, at + 3])
    velocity += h * gain
    quat = turned_by(quat, h * velocity)
    put_three(of.qvel, world, dof, velocity)
    put_three(of.warmstart, world, dof, acceleration)
    for k in range(4):
        of.qpos[world, at + k] = quat[k]


@wp.func
def integrate_joint(world: int, joint: int, of: StateArrays) -> None:
    """Integrate one joint by semi-implicit Euler. The call for joint 0 also sets the world's overflow flags.

    All reads precede all writes, because the compiler moves no read ahead of a write. The reads then wait for memory
    together. For a free joint, this order holds separately for the position and for the orientation.
    """
    h = of.timestep[world % of.timestep.shape[0]]
    at, dof = of.jnt_qposadr[joint], of.jnt_dofadr[joint]
    kind = of.jnt_type[joint]
    if kind == FREE_JOINT:
        velocity, gain = three(of.qvel, world, dof), three(of.advance, world, dof)
        acceleration, place = three(of.qacc, world, dof), three(of.qpos, world, at)
        velocity += h * gain
        put_three(of.qvel, world, dof, velocity)
        put_three(of.warmstart, world, dof, acceleration)
        put_three(of.qpos, world, at, place + h * velocity)
        turn_joint(world, at + 3, dof + 3, h, of)
    elif kind == BALL_JOINT:
        turn_joint(world, at, dof, h, of)
    else:
        speed = of.qvel[world, dof] + h * of.advance[world, dof]
        angle = of.qpos[world, at] + h * speed
        last = of.qacc[world, dof]
        of.qvel[world, dof] = speed
        of.warmstart[world, dof] = last
        of.qpos[world, at] = angle
    if joint > 0:
        return
    if of.nefc[world] > of.most_rows:
        of.overflow[world] |= NEFC
    if of.ncollision[0] > of.most_contacts:
        of.overflow[world] |= BROADPHASE
    if of.nacon[0] > of.most_contacts:
        of.overflow[world] |= NARROWPHASE


@wp.kernel
def integrate(of: StateArrays):
    """Integrate all joints. One thread per world and joint."""
    world, joint = wp.tid()
    integrate_joint(world, joint, of)


class TorqueStep:
    """Launches all stages of a step except contacts and constraint rows. The caller computes these between `begin` and
    `finish`.
    """

    def __init__(
        self, model: mujoco.MjModel, m: Any, d: Any, randomized: Collection[str] = (), active_set: ActiveSet | None = None
    ) -> None:
        """Prepare the launches for a `model` that `SmoothDynamics` and `ConstraintSolver` support; `m` and `d` are
        mujoco-warp's model and data for it. `randomized` names the arrays in which worlds differ. `active_set` holds the row
        states of the last step, if rows have keys. Warp's current device must be that of `m` and `d`.
        """
        self.dynamics = SmoothDynamics(model, m, d, randomized)
        self.solver = ConstraintSolver(model, m, d, damped=has_dampers(model, randomized), active_set=active_set)
        of = self.state = StateArrays()
        of.timestep, of.jnt_type, of.jnt_qposadr, of.jnt_dofadr = m.opt.timestep, m.jnt_type, m.jnt_qposadr, m.jnt_dofadr
        of.advance, of.qacc = self.solver.advance, d.qacc
        of.nefc, of.nacon, of.ncollision, of.most_rows, of.most_contacts = d.nefc, d.nacon, d.ncollision, d.njmax, d.naconmax
        of.qpos, of.qvel, of.warmstart, of.overflow = d.qpos, d.qvel, d.qacc_warmstart, d.overflow
        self.worlds, self.joints = d.nworld, m.njnt

    def begin(self) -> None:
        """Compute the inputs of contacts and constraint rows, and all forces except constraint forces, from qpos, qvel and
        ctrl.
        """
        self.dynamics.launch()

    def finish(self) -> None:
        """Compute constraint forces from the constraint rows, then the next state, the warm start and the overflow flags."""
        self.solver.solve()
        wp.launch(integrate, dim=(self.worlds, self.joints), inputs=[self.state])
