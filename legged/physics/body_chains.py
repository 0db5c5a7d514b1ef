"""Chains of joints between the world and named bodies, for forward kinematics from generalised coordinates."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged.errors import ConfigError, suggest

FREE, BALL, SLIDE, HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "SLIDE", "HINGE"))
WELD, END = 4, 5
"""Kinds of links beside those of joints: a body without a joint, and a filler after the last link of a shorter chain."""


@dataclass(frozen=True)
class BodyChains:
    """Links between the world and each of B bodies: one for each joint, and one for each body without a joint. Arrays are
    (levels, B, ...), ordered from the world to the body; lengths are in metres.
    """

    kind: np.ndarray
    """(levels, B) kind of the link: FREE, BALL, SLIDE, HINGE, WELD or END."""
    body_pos: np.ndarray
    """(levels, B, 3) position of the link's frame in the frame of the previous link; `body_quat` (levels, B, 4) is its
    orientation, (w, x, y, z)."""
    body_quat: np.ndarray
    axis: np.ndarray
    """(levels, B, 3) unit vector of a joint's axis in the link's frame; `anchor` (levels, B, 3) is a point on the axis."""
    anchor: np.ndarray
    position: np.ndarray
    """(levels, B) first column of the joint in MuJoCo's generalised positions; `speed` is that in the velocities."""
    speed: np.ndarray
    reference: np.ndarray
    """(levels, B) position at which a slide or hinge does not displace the link's frame [m] or [rad]."""

    @classmethod
    def of(cls, model: mujoco.MjModel, names: Sequence[str], where: str) -> "BodyChains":
        """Return the chains to the bodies `names` of a model.

        Raises:
            ConfigError: the model has no such body; `where` is the beginning of the message.
        """
        known = [model.body(i).name for i in range(model.nbody)]
        for name in names:
            if name not in known:
                raise ConfigError(f"{where}: there is no body '{name}'{suggest(name, known[1:], 'bodies')}")
        chains = [_links(model, known.index(name)) for name in names]
        for chain in chains:
            chain += [_link(END)] * (max(map(len, chains)) - len(chain))
        fields = (np.array(values) for values in zip(*(zip(*chain, strict=True) for chain in chains), strict=True))
        return cls(*(np.swapaxes(values, 0, 1) for values in fields))


def _links(model: mujoco.MjModel, body: int) -> list[tuple]:
    """Return the links from the world to a body, each as a tuple of the fields of BodyChains."""
    found: list[tuple] = []
    while body:
        pos, quat, links = model.body_pos[body], model.body_quat[body], []
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            kind, position = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint])
            at = (model.jnt_axis[joint], model.jnt_pos[joint], position, int(model.jnt_dofadr[joint]))
            links.append((kind, pos, quat, *at, model.qpos0[position]))
            pos, quat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])  # the first link has brought the body's frame
        found = (links or [_link(WELD, pos, quat)]) + found
        body = int(model.body_parentid[body])
    return found


def _link(kind: int, pos: np.ndarray | None = None, quat: np.ndarray | None = None) -> tuple:
    """Return a link without a joint."""
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    still = (np.zeros(3), np.zeros(3), 0, 0, 0.0)
    return (kind, np.zeros(3) if pos is None else pos, identity if quat is None else quat, *still)
