"""Left-right symmetry of a robot, found in its model."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

FLIP = np.array([1.0, -1.0, 1.0])
"""Reflection in the base's xz plane."""
APART = 0.01
"""Largest distance of a joint or foot from the mirror image of its partner [m]."""
TURNED = 0.01
"""Largest difference between a joint's angle and the mirrored angle of its partner [rad]."""


@dataclass(frozen=True)
class Mirror:
    """Left and right partners of D joints and F feet. A joint or foot in the middle is its own partner."""

    joints: tuple[int, ...]
    """(D,) for each joint, the index of the joint whose angle it takes in the mirrored robot."""
    signs: tuple[float, ...]
    """(D,) signs, 1 or -1. In the mirrored robot, a joint's angle is its sign times its partner's angle."""
    feet: tuple[int, ...]
    """(F,) for each foot, the index of the foot whose place it takes in the mirrored robot."""
    passive: tuple[int, ...] = ()
    """(P,) partners of passive hinges and slides; `passive_signs` (P,) are their signs. Both tuples are empty if
    one of these joints has no partner.
    """
    passive_signs: tuple[float, ...] = ()

    @classmethod
    def of(
        cls, model: mujoco.MjModel, joints: Sequence[int], feet: Sequence[Sequence[str]], passive: Sequence[int] = ()
    ) -> "Mirror | None":
        """Find the symmetry of a robot from the positions of its joints and feet at zero angles.

        `joints` are the hinges with a motor (ids), `feet` the names of each foot's shapes, and `passive` the passive hinges
        and slides (ids). Return None if a joint or a foot has no partner.
        """
        data = mujoco.MjData(model)
        data.qpos[:] = 0.0
        data.qpos[3] = 1.0  # with the unit quaternion, the base is level
        data.qpos[model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_BALL]] = 1.0
        mujoco.mj_kinematics(model, data)
        partners, signs = _joint_partners(model, data, joints)
        centres = np.array([np.mean([data.geom(name).xpos for name in shapes], axis=0) for shapes in feet])
        foot_partners = _partners(centres, centres * FLIP)
        if partners is None or foot_partners is None:
            return None
        others, their_signs = _joint_partners(model, data, passive)
        return cls(tuple(partners), signs, tuple(foot_partners), tuple(others or ()), their_signs)

    def uneven_joint(self, angles: np.ndarray) -> int | None:
        """Return the index of the first joint whose angle in `angles` (D,) [rad] differs from the mirrored angle of its
        partner; None if the pose is symmetric.
        """
        image = np.asarray(self.signs) * angles[list(self.joints)]
        apart = np.flatnonzero(np.abs(image - angles) > TURNED)
        return int(apart[0]) if len(apart) else None


def _joint_partners(
    model: mujoco.MjModel, data: mujoco.MjData, joints: Sequence[int]
) -> tuple[list[int] | None, tuple[float, ...]]:
    """Return the partners and the signs of hinges and slides; None and () if any of them lacks a partner."""
    anchors, axes = data.xanchor[list(joints)], data.xaxis[list(joints)]
    # Joints of a hip may have the same anchor, but their axes differ. A reflection does not change the absolute values of
    # an axis's components.
    partners = _partners(np.hstack([anchors, np.abs(axes)]), np.hstack([anchors * FLIP, np.abs(axes)]))
    if partners is None:
        return None, ()
    # A hinge's axis is a pseudo-vector: the reflection keeps its y and reverses x and z. A slide's axis is a vector: the
    # reflection reverses its y.
    hinge = model.jnt_type[list(joints)] == mujoco.mjtJoint.mjJNT_HINGE
    signs = np.sign((np.where(hinge[:, None], -FLIP, FLIP) * axes * axes[partners]).sum(axis=1))
    return partners, tuple(float(sign) for sign in signs)


def _partners(places: np.ndarray, reflected: np.ndarray) -> list[int] | None:
    """Return for each row of `places` the index of the nearest row of `reflected`; None if any is farther than APART."""
    distance = np.linalg.norm(places[:, None] - reflected[None], axis=2)
    if distance.size == 0 or (distance.min(axis=1) > APART).any():
        return None
    return [int(i) for i in distance.argmin(axis=1)]
