"""Rule for the gains of a robot whose file states none. Gains follow from the inertia that each joint moves, and from the
weight that the joint carries.

Two inertias matter. With the robot in the air, a joint moves its child links against the rest of the robot. With the feet on
the ground, the same joint moves the base as well.

P gains give the first inertia the natural frequency FREQUENCY sqrt(g / h), where h is the robot's standing height. They are
raised until no joint gives way under the robot's weight. D gains give the geometric mean of the two inertias the damping
ratio RATIO. Both gains are limited so that an explicit control law is stable at steps of 5 ms.

For ANYmal C and Go2 the rule gives the makers' P gains within a factor of two. Its D gains are 0.7 to 2.4 times the makers'
for ANYmal C, and 1.9 to 3.7 times for Go2.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

FREQUENCY = 6.0
"""Natural frequency of a joint in the air, times sqrt(h / g) [1]. The frequency is 4 Hz for a standing height h = 0.5 m."""
RATIO = 0.5
"""Damping ratio [1]."""
SAG = 0.25
"""Largest deflection of a joint under the robot's weight [rad]."""
SHIFT = 0.1
"""Least P gain of a leg's joint, as a share of mass * g * h [1/rad]. With less gain an ankle could not shift the weight."""
LARGEST_TARGET = 0.3
"""P gains are limited so that only targets at least this far from the joint's angle demand the whole torque [rad]."""
TIME_STEP = 0.005
"""Physics step in which an explicit control law has to be stable [s]."""
MARGIN = 1.0
"""Largest eigenvalue allowed for TIME_STEP M^-1 D and TIME_STEP^2 M^-1 K, with inertia M, D gains D and P gains K. From 2 on,
an explicit law may diverge."""

VELOCITY_LIMIT = 30.0
"""Largest joint speed of a robot whose file states none [rad/s]. It is typical of the geared motors of legged robots."""


def gains(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    joints: Sequence[int],
    feet: Sequence[int],
    effort: np.ndarray,
    height: float,
    rolling: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return stiffness [N m/rad] and damping [N m s/rad] (D,) of the hinges `joints` (ids).

    `qpos` is the pose in which the robot stands, `feet` are the shapes (ids) that it stands on, `effort` (D,) the motors'
    torque limits [N m], and `height` the base's height above the ground [m]. `rolling` (D,) holds the largest speed of each
    wheel [rad/s], and 0 for other joints. A wheel's stiffness is a gain on its speed [N m s/rad], and its damping is 0. A
    speed error as large as the largest speed demands the whole torque. The gain is smaller if the explicit law would
    otherwise be unstable in the air.
    """
    data, inverse = _inverse_inertia(model, qpos)
    dofs = model.jnt_dofadr[list(joints)]
    jacobian = np.vstack([_jacobian(model, data, foot) for foot in feet])
    at_feet = jacobian @ inverse
    held = inverse - at_feet.T @ np.linalg.pinv(at_feet @ jacobian.T) @ at_feet
    in_air = 1.0 / inverse[dofs, dofs]
    on_feet = 1.0 / np.maximum(held[dofs, dofs], 1e-6 / in_air)
    weight = np.abs(_static_torques(data, jacobian)[dofs])
    gravity = np.linalg.norm(model.opt.gravity)
    leg = np.abs(jacobian[:, dofs]).max(axis=0) > 0.0
    least = np.maximum(weight / SAG, SHIFT * model.body_mass.sum() * gravity * height * leg)
    stiffness = np.minimum(np.maximum(in_air * FREQUENCY**2 * gravity / height, least), effort / LARGEST_TARGET)
    # This limit keeps all eigenvalues of TIME_STEP^2 M^-1 K within MARGIN (Gershgorin). It lowers the gains of light toes.
    stiffness = np.minimum(stiffness, MARGIN / (TIME_STEP**2 * np.abs(inverse[np.ix_(dofs, dofs)]).sum(axis=0)))
    damping = 2.0 * RATIO * np.sqrt(stiffness * np.sqrt(in_air * on_feet))
    damping = np.minimum(damping, MARGIN * in_air / TIME_STEP)
    fastest = TIME_STEP * np.abs(np.linalg.eigvals(inverse[np.ix_(dofs, dofs)] * damping)).max()
    damping = damping * min(1.0, MARGIN / fastest)
    wheels = np.zeros(len(dofs)) if rolling is None else rolling
    of_wheels = np.minimum(effort / np.maximum(wheels, 1e-9), MARGIN * in_air / TIME_STEP)
    return np.where(wheels > 0.0, of_wheels, stiffness), np.where(wheels > 0.0, 0.0, damping)


def inertia_in_air(model: mujoco.MjModel, qpos: np.ndarray, joints: Sequence[int]) -> np.ndarray:
    """Return the inertia (D,) [kg m^2] that each motor of the hinges `joints` (ids) turns while the robot is in the air in
    the pose `qpos` and all other joints move freely.
    """
    dofs = model.jnt_dofadr[list(joints)]
    return np.asarray(1.0 / _inverse_inertia(model, qpos)[1][dofs, dofs])


def standing_torques(model: mujoco.MjModel, qpos: np.ndarray, joints: Sequence[int], feet: Sequence[int]) -> np.ndarray:
    """Return the torques (D,) [N m] with which the hinges `joints` (ids) hold the robot at rest in the pose `qpos`. The
    ground forces on the shapes `feet` (ids) balance the weight, and their sum of squares is the least possible.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    jacobian = np.vstack([_jacobian(model, data, foot) for foot in feet])
    return _static_torques(data, jacobian)[model.jnt_dofadr[list(joints)]]


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the joint-space inertia (V, V) of V degrees of freedom. `mj_forward` must have filled `data`."""
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def _inverse_inertia(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[mujoco.MjData, np.ndarray]:
    """Return MuJoCo's data of the robot at rest in the pose `qpos`, and the inverse (V, V) of the joint-space inertia."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data, np.linalg.inv(mass_matrix(model, data))


def _jacobian(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Return the translational Jacobian (3, V) of the centre of a shape."""
    found = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, found, None, data.geom_xpos[geom], model.geom_bodyid[geom])
    return found


def _static_torques(data: mujoco.MjData, jacobian: np.ndarray) -> np.ndarray:
    """Return the generalised forces (V,) that hold the robot at rest (see `standing_torques`). `jacobian` is of the feet."""
    forces = np.linalg.lstsq(jacobian[:, :6].T, data.qfrc_bias[:6], rcond=None)[0]
    return np.asarray(data.qfrc_bias - jacobian.T @ forces)
