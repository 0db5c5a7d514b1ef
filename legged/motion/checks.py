"""Checks of a clip against its robot: joint limits, speeds, soles, jumps."""

from typing import NamedTuple

import numpy as np

from legged.motion.clip import Clip
from legged.motion.kinematics import Skeleton
from legged.robots.stance import lowest_point

SOFT = 0.9
"""Soft limits of a joint cover this share of its range, around its middle."""
TOLERANCE = 1e-3
"""Angles may be this far outside hard limits, because files hold rounded numbers [rad]."""
SUNK, FLOATING = 0.02, 0.05
"""A sole deeper than SUNK in the ground, or a lower sole that always stays more than FLOATING above it, is a finding [m]."""
STANDING = 0.015
"""A foot stands if its sole is lower than this [m]."""
FASTEST, FASTEST_TURN = 10.0, 20.0
"""Speeds of the root between two frames that count as a jump [m/s, rad/s]."""


class Quality(NamedTuple):
    """Figures of a clip."""

    seconds: float
    root_height: tuple[float, float]
    """Lowest and highest base position above the ground [m]."""
    speed: tuple[float, float]
    """Mean and largest horizontal speed of the base [m/s]."""
    joint_speed: float
    """Largest joint speed as a share of the joint's limit."""
    fastest_joint: str
    beyond_soft: float
    """Share of the frames in which a joint is outside its soft limits; `beyond_hard` [rad] is the largest angle outside hard
    limits, and `worst_joint` the joint that has it."""
    beyond_hard: float
    worst_joint: str
    soles: np.ndarray
    """(T, F) height of the lowest point of each foot above the ground z = 0 [m]."""
    jumps: tuple[int, ...]
    """Frames before which the root moves or turns too fast."""

    @property
    def lower_sole(self) -> np.ndarray:
        """(T,) height of the lower sole [m]."""
        return self.soles.min(axis=1)  # type: ignore[no-any-return]

    @property
    def supports(self) -> tuple[float, float, float]:
        """Shares of the frames with two or more standing feet, with one, and with none."""
        feet = (self.soles < STANDING).sum(axis=1)
        return float((feet > 1).mean()), float((feet == 1).mean()), float((feet == 0).mean())

    def findings(self) -> list[str]:
        """Return a sentence about each thing that a robot can't do, or that looks wrong."""
        found = []
        if self.beyond_hard > TOLERANCE:
            found.append(f"{self.worst_joint} leaves its range by {self.beyond_hard:.3f} rad")
        if self.joint_speed > 1.0:
            found.append(f"{self.fastest_joint} moves at {100 * self.joint_speed:.0f} % of its speed limit")
        if (deepest := float(self.soles.min())) < -SUNK:
            frame = int(self.soles.min(axis=1).argmin())
            found.append(f"a sole is {-1000 * deepest:.0f} mm below the ground in frame {frame}")
        if (gap := float(self.lower_sole.min())) > FLOATING:
            found.append(f"the feet stay {1000 * gap:.0f} mm or more above the ground")
        if self.jumps:
            more = f" and {len(self.jumps) - 1} other frames" if len(self.jumps) > 1 else ""
            found.append(f"the root jumps before frame {self.jumps[0]}{more}")
        return found


def quality_of(clip: Clip, skeleton: Skeleton) -> Quality:
    """Replay a clip through the robot's model and measure it."""
    robot, speeds = skeleton.robot, clip.velocities()
    low, high = robot.dof_pos_limits.T
    with np.errstate(invalid="ignore"):
        middle, half = 0.5 * (low + high), 0.5 * SOFT * (high - low)
    soft = np.nan_to_num(np.abs(clip.joint_pos - middle) - half, nan=-np.inf) > 0.0
    hard = np.maximum(low - clip.joint_pos, clip.joint_pos - high).max(axis=0)
    share = (np.abs(speeds.joint) / robot.dof_vel_limits).max(axis=0)
    shapes = [[skeleton.model.geom(name).id for name in foot] for foot in robot.feet_shapes]
    soles = [
        [min(lowest_point(skeleton.model, data, shape) for shape in foot) for foot in shapes]
        for data in skeleton.frames(clip)
    ]
    step = np.linalg.norm(np.diff(clip.root_pos, axis=0), axis=1) * clip.fps
    cosine = np.abs((clip.root_quat[1:] * clip.root_quat[:-1]).sum(axis=1)).clip(max=1.0)
    jumps = np.flatnonzero((step > FASTEST) | (2.0 * np.arccos(cosine) * clip.fps > FASTEST_TURN)) + 1
    speed = np.linalg.norm(speeds.root_lin[:, :2], axis=1)
    return Quality(
        seconds=clip.seconds,
        root_height=(float(clip.root_pos[:, 2].min()), float(clip.root_pos[:, 2].max())),
        speed=(float(speed.mean()), float(speed.max())),
        joint_speed=float(share.max()),
        fastest_joint=robot.joint_names[int(share.argmax())],
        beyond_soft=float(soft.any(axis=1).mean()),
        beyond_hard=float(max(hard.max(), 0.0)),
        worst_joint=robot.joint_names[int(hard.argmax())],
        soles=np.array(soles),
        jumps=tuple(int(frame) for frame in jumps),
    )
