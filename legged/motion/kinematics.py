"""Forward kinematics: the motion of a robot's bodies in a clip."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch

from legged.errors import ConfigError, suggest
from legged.math import quat_conjugate, quat_multiply, quat_rotate
from legged.motion.clip import Clip, Velocities
from legged.robots.importing.convert import robot_spec_of
from legged.robots.robot import Robot


class BodyMotion(NamedTuple):
    """Motion of B bodies in T frames, in the world frame. Linear velocities are those of the bodies' origins."""

    pos: np.ndarray
    """(T, B, 3) [m]."""
    quat: np.ndarray
    """(T, B, 4), w first."""
    lin_vel: np.ndarray
    """(T, B, 3) [m/s]."""
    ang_vel: np.ndarray
    """(T, B, 3) [rad/s]."""


class Skeleton:
    """A robot's bodies and joints in MuJoCo, without physics."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.model = robot_spec_of(robot.model_path).compile()
        self.data = mujoco.MjData(self.model)
        self.names = [self.model.body(i).name for i in range(self.model.nbody)]
        self.base = self.names.index(robot.file.base)

    def indices(self, bodies: Sequence[str], where: str) -> list[int]:
        """Return MuJoCo's indices of bodies. Error messages begin with `where`.

        Raises:
            ConfigError: there is no body of this name.
        """
        for name in bodies:
            if name not in self.names[1:]:
                raise ConfigError(f"{where}: {self.robot.name} has no body '{name}'{suggest(name, self.names[1:])}")
        return [self.names.index(name) for name in bodies]

    def frames(self, clip: Clip) -> Iterator[mujoco.MjData]:
        """Yield MuJoCo's data with the poses and velocities of all bodies, frame by frame. The data are reused."""
        robot, data, speeds = self.robot, self.data, clip.velocities()
        data.qpos[:] = robot.default_qpos
        local = _local_angular_velocity(clip, speeds)
        for frame in range(len(clip)):
            data.qpos[:3], data.qpos[3:7] = clip.root_pos[frame], clip.root_quat[frame]
            data.qpos[list(robot.qpos_columns)] = clip.joint_pos[frame]
            data.qvel[:3], data.qvel[3:6] = speeds.root_lin[frame], local[frame]
            data.qvel[list(robot.qvel_columns)] = speeds.joint[frame]
            mujoco.mj_kinematics(self.model, data)
            mujoco.mj_comPos(self.model, data)
            mujoco.mj_comVel(self.model, data)
            yield data

    def body_motion(self, clip: Clip, bodies: Sequence[str]) -> BodyMotion:
        """Return the motion of the bodies with these names.

        Raises:
            ConfigError: there is no body of this name.
        """
        index = self.indices(bodies, clip.name)
        found = BodyMotion(*(np.empty((len(clip), len(index), width)) for width in (3, 4, 3, 3)))
        for frame, data in enumerate(self.frames(clip)):
            found.pos[frame], found.quat[frame] = data.xpos[index], data.xquat[index]
            ang_vel, lin_vel = data.cvel[index, :3], data.cvel[index, 3:]  # at the centre of mass of the robot
            arm = data.xpos[index] - data.subtree_com[self.base]
            found.lin_vel[frame], found.ang_vel[frame] = lin_vel + np.cross(ang_vel, arm), ang_vel
        return found

    def root_poses(
        self, body: str, pos: np.ndarray, quat: np.ndarray, joint_pos: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (T, 3) and orientations (T, 4) of the base, from those of a `body` and from joint angles (T, D).

        Raises:
            ConfigError: there is no body of this name.
        """
        (index,) = self.indices([body], "body")
        still = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(joint_pos), 1))
        places = [
            (data.xpos[index].copy(), data.xquat[index].copy())
            for data in self.frames(Clip(body, 1.0, still[:, :3], still[:, 3:], joint_pos))
        ]
        arm, turn = (torch.from_numpy(np.array(values)) for values in zip(*places, strict=True))
        root = quat_multiply(torch.from_numpy(quat), quat_conjugate(turn))
        return pos - quat_rotate(root, arm).numpy(), root.numpy()


def _local_angular_velocity(clip: Clip, speeds: Velocities) -> np.ndarray:
    """Return the root's angular velocity (T, 3) in its own frame, as MuJoCo's qvel holds it [rad/s]."""
    return quat_rotate(quat_conjugate(torch.from_numpy(clip.root_quat)), torch.from_numpy(speeds.root_ang)).numpy()
