"""Joints without a motor. Springs and closed loops determine where these joints are at given angles of the driven joints."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged.errors import ConfigError

STEPS = 8
"""Number of steps in which the driven joints move to their target angles. The loops stay nearly closed in small steps."""
ITERATIONS = 30
"""Largest number of iterations of Newton's method in each step."""
LARGEST_STEP = 0.3
"""Largest change of a coordinate in one iteration [rad] or [m]."""
CLOSED = 1e-6
"""Error up to which a loop counts as closed [m] or [rad]."""
LEAST_STIFFNESS = 1e-3
"""Least stiffness that is assumed for a joint, as a share of the largest. It holds joints that have no spring or loop."""
TRIES = 20
"""`draw` tries at most this many random poses for each pose that it returns."""


@dataclass(frozen=True)
class PassiveJoints:
    """Passive joints of a robot with D driven joints. P of the passive joints are hinges and slides, the others are balls."""

    model: mujoco.MjModel
    driven: tuple[int, ...]
    """(D,) ids of the driven joints."""
    numbers: tuple[int, ...]
    """(P,) ids of the passive hinges and slides, whose coordinates can be observed."""
    names: tuple[str, ...]
    """(P,) names of the passive hinges and slides."""
    qpos_columns: tuple[int, ...]
    """(P,) columns of the passive hinges and slides in the generalised positions; `qvel_columns` are for the velocities."""
    qvel_columns: tuple[int, ...]

    @classmethod
    def of(cls, model: mujoco.MjModel, driven: Sequence[int], passive: Sequence[int]) -> "PassiveJoints":
        """Return the passive joints of a model. `driven` and `passive` (ids) are all joints except the base's."""
        simple = [i for i in passive if model.jnt_type[i] != mujoco.mjtJoint.mjJNT_BALL]
        return cls(
            model=model,
            driven=tuple(driven),
            numbers=tuple(simple),
            names=tuple(model.joint(i).name for i in simple),
            qpos_columns=tuple(int(model.jnt_qposadr[i]) for i in simple),
            qvel_columns=tuple(int(model.jnt_dofadr[i]) for i in simple),
        )

    def settle(self, angles: np.ndarray, start: np.ndarray) -> np.ndarray | None:
        """Return generalised positions (nq,) near `start` (nq,) with the driven joints at `angles` (D,), all loops closed and
        the least spring energy. Return None if the loops do not close at these angles.

        The driven joints are moved from `start` in steps. In each step, [K J'; J 0] [dq; l] = [-g; -c] is solved repeatedly
        for the changes dq of the passive joints and the Lagrange multipliers l. K is the stiffness, g the gradient of the
        spring energy, and J and c are the Jacobian and the errors of the loops. Gravity is neglected.
        """
        model, data = self.model, mujoco.MjData(self.model)
        columns = model.jnt_qposadr[list(self.driven)]
        dofs = np.setdiff1d(np.arange(6, model.nv), model.jnt_dofadr[list(self.driven)])
        stiffness = model.jnt_stiffness[model.dof_jntid[dofs]]
        least = LEAST_STIFFNESS * max(float(stiffness.max(initial=0.0)), 1.0)
        hessian = np.diag(np.maximum(stiffness, least))
        qpos, first = start.copy(), start[columns].copy()
        for part in range(1, STEPS + 1):
            qpos[columns] = first + (angles - first) * (part / STEPS)
            for _ in range(ITERATIONS):
                errors, jacobian = self._loops(data, qpos)
                away = np.zeros(model.nv)
                mujoco.mj_differentiatePos(model, away, 1.0, model.qpos_spring, qpos)
                rows = len(errors)
                system = np.block([[hessian, jacobian[:, dofs].T], [jacobian[:, dofs], np.zeros((rows, rows))]])
                step = np.linalg.lstsq(system, -np.concatenate([stiffness * away[dofs], errors]), rcond=1e-9)[0][: len(dofs)]
                largest = float(np.abs(step).max(initial=0.0))
                move = np.zeros(model.nv)
                move[dofs] = step * min(1.0, LARGEST_STEP / max(largest, 1e-12))
                mujoco.mj_integratePos(model, qpos, move, 1.0)
                if largest < 1e-8:
                    break
        errors, _ = self._loops(data, qpos)
        return qpos if np.abs(errors).max(initial=0.0) < CLOSED else None

    def _loops(self, data: mujoco.MjData, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors (C,) of the C rows of equality constraints at `qpos`, and their Jacobian (C, nv)."""
        data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_makeConstraint(self.model, data)  # no contacts are made, because no collisions were computed
        rows = np.flatnonzero(np.asarray(data.efc_type) == mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        jacobian = np.zeros((data.nefc, self.model.nv))
        if mujoco.mj_isSparse(self.model) and len(rows):
            places = (data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
            mujoco.mju_sparse2dense(jacobian, data.efc_J, *places)
        elif len(rows):
            jacobian[:] = data.efc_J.reshape(data.nefc, self.model.nv)
        return np.asarray(data.efc_pos)[rows], jacobian[rows]

    def beyond(self, qpos: np.ndarray) -> list[str]:
        """Return the names of the passive hinges and slides that are outside their ranges at `qpos` (nq,)."""
        model = self.model
        found = []
        for number, column, name in zip(self.numbers, self.qpos_columns, self.names, strict=True):
            low, high = model.jnt_range[number]
            if model.jnt_limited[number] and not low <= qpos[column] <= high:
                found.append(name)
        return found

    def draw(self, default: np.ndarray, factor: tuple[float, float], count: int, seed: int, where: str) -> np.ndarray:
        """Return (count, nq) random poses with closed loops. The angles of driven joints are those of `default` (nq,) times
        random numbers from `factor`. Poses with open loops, or with passive joints beyond their ranges, are rejected.

        Raises:
            ConfigError: too few random poses are valid; `where` is the place of `factor` in the configuration.
        """
        random, columns = np.random.default_rng(seed), self.model.jnt_qposadr[list(self.driven)]
        poses: list[np.ndarray] = []
        for _ in range(TRIES * count):
            pose = self.settle(default[columns] * random.uniform(*factor, size=len(columns)), default)
            if pose is not None and not self.beyond(pose):
                poses.append(pose)
            if len(poses) == count:
                return np.array(poses)
        raise ConfigError(f"{where}: only {len(poses)} of {TRIES * count} random poses close the loops; {count} are needed")


def default_qpos(
    model: mujoco.MjModel, driven: Sequence[int], angles: np.ndarray, passive: PassiveJoints | None, where: str
) -> np.ndarray:
    """Return generalised positions (nq,) for a level base at the origin. The joints `driven` (ids) are at `angles` (D,), and
    springs and loops determine the positions of the passive joints.

    Raises:
        ConfigError: at these angles the loops do not close, or passive joints are beyond their ranges. `where` is the place
            of the angles in the configuration.
    """
    qpos = model.qpos0.copy()
    qpos[:7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    if passive is None:
        qpos[model.jnt_qposadr[list(driven)]] = angles
        return qpos
    # Some linkages can close in two ways. A start within the joints' ranges leads to the way that the ranges allow.
    for i in (*driven, *passive.numbers):
        if model.jnt_limited[i]:
            qpos[model.jnt_qposadr[i]] = np.clip(qpos[model.jnt_qposadr[i]], *model.jnt_range[i])
    settled = passive.settle(angles, qpos)
    if settled is None:
        raise ConfigError(f"{where}: the loops of the model's equality constraints do not close at these angles")
    beyond = passive.beyond(settled)
    if beyond:
        raise ConfigError(f"{where}: at these angles the passive joints {', '.join(beyond)} would be beyond their ranges")
    return settled
