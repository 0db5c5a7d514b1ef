"""What a physics step needs around the constraint solver, for robots moved by torques alone.

mujoco-warp launches a stage for everything that a model might have: springs, dampers, gravity compensation, external
forces, muscles with lengths and activations. At 4096 worlds a launch costs microseconds whether it finds anything or not;
together these are a fifth of a step. Where a model has none of them, what comes before contacts is one launch, and
integration is another.
"""

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from legged.physics.fused.smooth_dynamics import SmoothDynamics

NEFC, BROADPHASE, NARROWPHASE = (int(getattr(mjw.OverflowType, n)) for n in ("NEFC", "BROADPHASE", "NARROWPHASE"))

wp.set_module_options({"enable_backward": False})


@wp.func
def turned_by(quat: wp.vec4, rotation: wp.vec3) -> wp.vec4:
    """A unit quaternion (w, x, y, z) after turning by a rotation vector [rad] in its own frame."""
    angle = wp.length(rotation)
    w, xyz = wp.cos(0.5 * angle), wp.sin(0.5 * angle) * wp.normalize(rotation)
    old = wp.vec3(quat[1], quat[2], quat[3])
    new = quat[0] * xyz + w * old + wp.cross(old, xyz)
    return wp.normalize(wp.vec4(quat[0] * w - wp.dot(old, xyz), new[0], new[1], new[2]))


@wp.kernel
def integrate(
    dt: wp.array[float],
    qacc: wp.array2d[float],
    nefc: wp.array[int],
    nacon: wp.array[int],
    ncollision: wp.array[int],
    most_rows: int,
    most_contacts: int,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
    overflow: wp.array[int],
):
    """One thread a world and joint, the base first: semi-implicit Euler, and the flags of what found no room."""
    world, joint = wp.tid()
    h = dt[0]
    if joint > 0:
        dof = 5 + joint
        qvel[world, dof] += h * qacc[world, dof]
        qpos[world, dof + 1] += h * qvel[world, dof]
        warmstart[world, dof] = qacc[world, dof]
        return
    for dof in range(6):
        qvel[world, dof] += h * qacc[world, dof]
        warmstart[world, dof] = qacc[world, dof]
    for k in range(3):
        qpos[world, k] += h * qvel[world, k]
    quat = wp.vec4(qpos[world, 3], qpos[world, 4], qpos[world, 5], qpos[world, 6])
    quat = turned_by(quat, h * wp.vec3(qvel[world, 3], qvel[world, 4], qvel[world, 5]))
    for k in range(4):
        qpos[world, 3 + k] = quat[k]
    if nefc[world] > most_rows:
        overflow[world] |= NEFC
    if ncollision[0] > most_contacts:
        overflow[world] |= BROADPHASE
    if nacon[0] > most_contacts:
        overflow[world] |= NARROWPHASE


class TorqueStep:
    """Launches on mujoco-warp's arrays what comes before contacts and after the solver."""

    def __init__(self, model: mujoco.MjModel, m: Any, d: Any, base: int) -> None:
        """For a model of which nothing is said by `why_not`, whose free body is `base`. Call with the arrays' device as
        Warp's current one.
        """
        free = np.array([-np.inf, np.inf])
        controls = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, free)
        forces = np.where(model.actuator_forcelimited[:, None], model.actuator_forcerange, free)
        limits = np.stack([np.maximum(controls, forces)[:, 0], np.minimum(controls, forces)[:, 1]])
        self._dynamics = SmoothDynamics(model, m, d, base, limits)
        state = [d.qpos, d.qvel, d.qacc_warmstart, d.overflow]
        counts = [d.nefc, d.nacon, d.ncollision, d.njmax, d.naconmax]
        self._integration = (d.nworld, m.njnt), [m.opt.timestep, d.qacc, *counts], state

    @classmethod
    def why_not(cls, model: mujoco.MjModel) -> str:
        """What of a model this does not step; empty if nothing."""
        if not cls.moved_by_torques(model):
            return "more than torques moves the robot: springs, dampers, geared or affine actuators, a fluid"
        return SmoothDynamics.why_not(model)

    @staticmethod
    def moved_by_torques(model: mujoco.MjModel) -> bool:
        """Whether nothing but motors of gear 1, gravity and constraints moves the robot."""
        passive = [model.jnt_stiffness, model.jnt_stiffnesspoly, model.dof_damping, model.dof_dampingpoly]
        passive += [model.actuator_damping, model.actuator_dampingpoly, model.body_gravcomp, model.opt.wind]
        passive += [model.opt.density, model.opt.viscosity, model.geom_adhesion, model.jnt_actfrclimited]
        if model.ntendon or model.nflex or any(np.any(values) for values in passive):
            return False
        plain = np.zeros_like(model.actuator_gear)
        plain[:, 0] = 1.0
        gain = np.zeros_like(model.actuator_gainprm)
        gain[:, 0] = 1.0
        return bool(
            (model.actuator_gear == plain).all()
            and (model.actuator_gainprm == gain).all()
            and (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED).all()
            and (model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE).all()
            and (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE).all()
        )

    def begin(self) -> None:
        """From qpos, qvel and controls: where shapes are, what contacts need to know of the robot, and qfrc_smooth."""
        self._dynamics.launch()

    def integrate(self) -> None:
        """From qacc: the next state, the next warm start, and the overflow flags."""
        dim, inputs, outputs = self._integration
        wp.launch(integrate, dim=dim, inputs=inputs, outputs=outputs)
