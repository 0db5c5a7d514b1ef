"""Task of a robot that tracks reference motions. Terms, weights and limits are those of BeyondMimic (Liao et al., arXiv
2508.08241), as mjlab has them.

At the end of a control step, a robot should have reached its frame of the motion. Observations show the frame after it.
"""

from typing import Any, ClassVar, TypeGuard

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config.task import TaskConfig
from legged.config.tracking import TrackingConfig, tracks_motions
from legged.envs.base_task import BaseTask
from legged.envs.marks import concurrent, unit
from legged.envs.robot_task import RobotTask
from legged.errors import ConfigError
from legged.math import (
    quat_angle,
    quat_conjugate,
    quat_from_rotation_vector,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
    yaw_of,
)
from legged.mdp.reference_motion import ReferenceMotion
from legged.mdp.sensors import BodyStates, Sensor
from legged.motion.clip import Clip
from legged.motion.kinematics import Skeleton
from legged.motion.readers import motion_files, read_clip
from legged.robots.robot import load_robot

ERRORS = ("world_error", "body_error", "extremity_error", "joint_error", "largest_error")
"""Mean distances of bodies from their places in the world, and of bodies and extremities from their places relative to the
anchor [m]; the root mean square error of the joint angles [rad]; the largest of all bodies' distances from their places
relative to the anchor [m]."""


class MotionTracking(RobotTask):
    """Robots that track reference motions on a plane. N robots, D joints, B tracked bodies.

    An error counts relative to the anchor if the reference is first moved to the robot: turned by the difference of the
    anchors' headings, and shifted so that the anchors are above each other. The reference's heights are kept.
    """

    Config: ClassVar[type[TaskConfig]] = TrackingConfig
    cfg: TrackingConfig
    ANCHOR_POS, ANCHOR_ANGLE, BODY_POS, BODY_ANGLE, BODY_LIN_VEL, BODY_ANG_VEL = 0.3, 0.4, 0.3, 0.4, 1.0, 3.14
    """Errors for which the rewards fall to 1/e [m, rad, m, rad, m/s, rad/s]."""

    @classmethod
    def check(cls, cfg: TaskConfig) -> None:
        super().check(cfg)
        assert tracks_motions(cfg)
        motion, where = cfg.motion, cfg.origins.where
        robot = load_robot(cfg.robot, where("robot"))
        if robot.passive is not None:
            raise ConfigError(f"{where('robot')}: '{robot.name}' has joints without a motor, which no reference moves")
        if cfg.terrain.mesh_type != "plane":
            raise ConfigError(f"{where('terrain.mesh_type')}: motions are tracked on a plane, got '{cfg.terrain.mesh_type}'")
        if cfg.observations.joints:
            raise ConfigError(f"{where('observations.joints')}: an exported tracker observes all joints; remove the setting")
        skeleton = Skeleton(robot)
        skeleton.indices(motion.bodies, where("motion.bodies"))
        if not motion.extremities:
            raise ConfigError(f"{where('motion.extremities')}: name at least one of motion.bodies")
        for path, names in (("motion.anchor", [motion.anchor]), ("motion.extremities", motion.extremities)):
            for name in names:
                if name not in motion.bodies:
                    raise ConfigError(f"{where(path)}: '{name}' must be one of motion.bodies: {', '.join(motion.bodies)}")
        _clips(cfg, skeleton)

    # ---- construction ------------------------------------------------------------------------------------------------

    def make_sensors(self) -> dict[str, Sensor]:
        where = self.cfg.origins.where("motion.bodies")
        self.bodies = BodyStates(self.physics, self.cfg.motion.bodies, self.kernels, where)
        return {**super().make_sensors(), "bodies": self.bodies}

    def make_commands(self) -> None:
        """Load the motions, and reserve the random numbers of initial states."""
        motion, device = self.cfg.motion, self.device
        settings = (motion.bin_s, motion.uniform, motion.memory)
        skeleton = Skeleton(self.robot)
        self.motion = ReferenceMotion(_clips(self.cfg, skeleton), skeleton, motion.bodies, self.numbers, *settings)
        self._anchor = motion.bodies.index(motion.anchor)
        self._extremities = torch.tensor([motion.bodies.index(name) for name in motion.extremities], device=device)
        pose, velocity = (torch.tensor(noise, device=device) for noise in (motion.pose_noise, motion.velocity_noise))
        self._pose_noise = self.numbers.between(-pose, pose, 6)
        self._velocity_noise = self.numbers.between(-velocity, velocity, 6)
        self._joint_noise = self.numbers.between(*motion.joint_noise, self.robot.num_dof)
        self.target_pos = torch.zeros_like(self.bodies.pos)
        """(N, B, 3) positions of the reference's bodies, moved to the robot [m]; `target_quat` (N, B, 4) are orientations."""
        self.target_quat = torch.zeros_like(self.bodies.quat)
        self.errors = torch.zeros(self.num_envs, len(ERRORS), device=device)
        """(N, 5) errors of the step, before resets, in the order of `ERRORS`."""

    # ---- hooks of a control step -------------------------------------------------------------------------------------

    def draw_reset(self) -> None:
        """Draw a frame of the motions, and noise on its pose and velocities."""
        self.motion.draw()
        start, pose, velocity = self.motion.start, self._pose_noise.values, self._velocity_noise.values
        low, high = self.dof_pos_limits.unbind(dim=1)
        turn = quat_multiply(quat_from_rotation_vector(pose[:, 3:]), start.root_quat)
        ang_vel = quat_rotate(quat_conjugate(turn), start.root_ang_vel + velocity[:, 3:])
        joints = torch.clamp(start.joint_pos + self._joint_noise.values, low, high)
        torch.cat([start.root_pos + pose[:, :3], turn, joints], dim=1, out=self.reset_qpos)
        torch.cat([start.root_lin_vel + velocity[:, :3], ang_vel, start.joint_vel], dim=1, out=self.reset_qvel)

    def place(self) -> None:
        """Keep the drawn positions: the motions have their place in the world."""

    def advance(self) -> None:
        """Compare the bodies with the reference."""
        super().advance()
        anchor, now, bodies = self._anchor, self.motion.now, self.bodies
        half = 0.5 * yaw_of(quat_multiply(bodies.quat[:, anchor], quat_conjugate(now.quat[:, anchor])))
        none = torch.zeros_like(half)
        heading = torch.stack([half.cos(), none, none, half.sin()], dim=1).unsqueeze(1).expand_as(now.quat)
        start = torch.cat([bodies.pos[:, anchor, :2], now.pos[:, anchor, 2:]], dim=1).unsqueeze(1)
        torch.add(start, quat_rotate(heading, now.pos - now.pos[:, anchor : anchor + 1]), out=self.target_pos)
        self.target_quat.copy_(quat_multiply(heading, now.quat))
        world, moved = ((pos - bodies.pos).norm(dim=2) for pos in (now.pos, self.target_pos))
        joint = (now.joint_pos - self.dof_pos).square().mean(dim=1).sqrt()
        extremity = moved[:, self._extremities].mean(dim=1)
        torch.stack([world.mean(dim=1), moved.mean(dim=1), extremity, joint, moved.amax(dim=1)], dim=1, out=self.errors)

    def update_curricula(self) -> None:
        self.motion.count(self.terminated_buf)

    def forget(self, mask: Tensor) -> None:
        super().forget(mask)
        self.motion.begin(mask)

    def ask(self) -> None:
        self.motion.advance()

    def start_at(self, frames: Tensor) -> TensorDict:
        """Begin an episode of each robot in `frames` (N,), rows of `motion.table`. Return the observations."""
        self.motion.chosen = frames
        try:
            return self.reset()
        finally:
            self.motion.chosen = None

    def reset_curricula(self) -> None:
        super().reset_curricula()
        self.motion.failures.zero_()

    def progress(self) -> dict[str, Any]:
        return super().progress() | {"motion": {"failures": self.motion.failures.clone()}}

    def load_progress(self, progress: dict[str, Any]) -> None:
        super().load_progress(progress)
        failures = progress.get("motion", {}).get("failures")
        if failures is not None and failures.shape == self.motion.failures.shape:  # other motions have other parts
            self.motion.failures.copy_(failures)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.motion.read()

    def parts(self) -> dict[str, Any]:
        return {**super().parts(), "motion": self.motion}

    # ---- observations ------------------------------------------------------------------------------------------------

    @unit("rad, rad/s")
    def _obs_reference(self) -> Tensor:
        """Joint angles [rad] and velocities [rad/s] of the reference."""
        return self.motion.now.rows[:, : 2 * self.robot.num_dof]

    @unit("m")
    def _obs_anchor_pos(self) -> Tensor:
        """Position of the reference's anchor in the frame of the robot's anchor [m]."""
        anchor = self._anchor
        turn = quat_conjugate(self.bodies.quat[:, anchor])
        return quat_rotate(turn, self.motion.now.pos[:, anchor] - self.bodies.pos[:, anchor])

    @unit("1")
    def _obs_anchor_ori(self) -> Tensor:
        """Orientation of the reference's anchor in the frame of the robot's anchor: two columns of its matrix, row by row."""
        anchor = self._anchor
        turn = quat_multiply(quat_conjugate(self.bodies.quat[:, anchor]), self.motion.now.quat[:, anchor])
        return quat_to_matrix(turn)[:, :, :2].flatten(1)

    @unit("m")
    def _obs_body_pos(self) -> Tensor:
        """Positions of the bodies in the frame of the robot's anchor [m]."""
        pos, anchor = self.bodies.pos, self._anchor
        turn = quat_conjugate(self.bodies.quat[:, anchor : anchor + 1]).expand_as(self.bodies.quat)
        return quat_rotate(turn, pos - pos[:, anchor : anchor + 1]).flatten(1)

    @unit("1")
    def _obs_body_ori(self) -> Tensor:
        """Orientations of the bodies in the frame of the robot's anchor: two columns of each matrix, row by row."""
        quat, anchor = self.bodies.quat, self._anchor
        turn = quat_multiply(quat_conjugate(quat[:, anchor : anchor + 1]).expand_as(quat), quat)
        return quat_to_matrix(turn.flatten(0, 1))[:, :, :2].reshape(self.num_envs, -1)

    # ---- rewards -----------------------------------------------------------------------------------------------------

    @concurrent
    @unit("1")
    def _reward_anchor_pos(self) -> Tensor:
        """Anchor at its place in the world: exp(-(error / 0.3 m)^2)."""
        error = self.motion.now.pos[:, self._anchor] - self.bodies.pos[:, self._anchor]
        return torch.exp(-error.square().sum(dim=1) / self.ANCHOR_POS**2)

    @concurrent
    @unit("1")
    def _reward_anchor_ori(self) -> Tensor:
        """Anchor with its orientation in the world: exp(-(angle / 0.4 rad)^2)."""
        angle = quat_angle(*self._anchor_quats())
        return torch.exp(-angle.square() / self.ANCHOR_ANGLE**2)

    @concurrent
    @unit("1")
    def _reward_body_pos(self) -> Tensor:
        """Bodies at their places relative to the anchor: exp(-mean (error / 0.3 m)^2)."""
        error = (self.target_pos - self.bodies.pos).square().sum(dim=2).mean(dim=1)
        return torch.exp(-error / self.BODY_POS**2)

    @concurrent
    @unit("1")
    def _reward_body_ori(self) -> Tensor:
        """Bodies with their orientations relative to the anchor: exp(-mean (angle / 0.4 rad)^2)."""
        error = quat_angle(self.target_quat, self.bodies.quat).square().mean(dim=1)
        return torch.exp(-error / self.BODY_ANGLE**2)

    @concurrent
    @unit("1")
    def _reward_body_lin_vel(self) -> Tensor:
        """Bodies with their velocities in the world: exp(-mean (error / 1 m/s)^2)."""
        error = (self.motion.now.lin_vel - self.bodies.lin_vel).square().sum(dim=2).mean(dim=1)
        return torch.exp(-error / self.BODY_LIN_VEL**2)

    @concurrent
    @unit("1")
    def _reward_body_ang_vel(self) -> Tensor:
        """Bodies with their angular velocities in the world: exp(-mean (error / 3.14 rad/s)^2)."""
        error = (self.motion.now.ang_vel - self.bodies.ang_vel).square().sum(dim=2).mean(dim=1)
        return torch.exp(-error / self.BODY_ANG_VEL**2)

    # ---- terminations and metrics ------------------------------------------------------------------------------------

    @concurrent
    def _terminate_anchor_height(self) -> Tensor:
        """Height of the anchor: the error exceeds `motion.max_anchor_height_error`."""
        error = self.motion.now.pos[:, self._anchor, 2] - self.bodies.pos[:, self._anchor, 2]
        return error.abs() > self.cfg.motion.max_anchor_height_error

    @concurrent
    def _terminate_anchor_ori(self) -> Tensor:
        """Tilt of the anchor: the error of gravity's z component exceeds `motion.max_anchor_gravity_error`."""
        ref, own = (2.0 * (q[:, 1].square() + q[:, 2].square()) for q in self._anchor_quats())
        return (ref - own).abs() > self.cfg.motion.max_anchor_gravity_error

    @concurrent
    def _terminate_extremity_height(self) -> Tensor:
        """Height of an extremity relative to the anchor: the error exceeds `motion.max_extremity_height_error`."""
        error = (self.target_pos - self.bodies.pos)[:, self._extremities, 2].abs()
        return (error > self.cfg.motion.max_extremity_height_error).any(dim=1)

    @concurrent
    def _terminate_clip_end(self) -> Tensor:
        """End of the clip; a time-out."""
        return self.motion.ended()

    @concurrent
    @unit("m")
    def _metric_world_error(self) -> Tensor:
        """Mean distance of the bodies from their places in the world [m]."""
        return self.errors[:, 0]

    @concurrent
    @unit("m")
    def _metric_body_error(self) -> Tensor:
        """Mean distance of the bodies from their places relative to the anchor [m]."""
        return self.errors[:, 1]

    @concurrent
    @unit("rad")
    def _metric_joint_error(self) -> Tensor:
        """Root mean square error of the joint angles [rad]."""
        return self.errors[:, 3]

    def _anchor_quats(self) -> tuple[Tensor, Tensor]:
        return self.motion.now.quat[:, self._anchor], self.bodies.quat[:, self._anchor]


def is_tracking_task(task: BaseTask) -> TypeGuard[MotionTracking]:
    """Return whether a task's robots track reference motions."""
    return isinstance(task, MotionTracking)


def _clips(cfg: TrackingConfig, skeleton: Skeleton) -> list[Clip]:
    """Return the clips of a task, at its control rate."""
    motion = cfg.motion
    files = motion_files(motion.files, cfg.origins.where("motion.files"))
    return [read_clip(file, skeleton, motion.csv_fps).resampled(round(1.0 / cfg.dt, 6)) for file in files]
