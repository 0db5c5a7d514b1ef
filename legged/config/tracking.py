"""Configuration of a robot that tracks reference motions: the clips, what is compared, and how episodes begin."""

from dataclasses import dataclass, field
from typing import TypeGuard

from legged.config.bounds import LONGEST_S, TERMS, between, positive, quantity
from legged.config.mdp import Range
from legged.config.robot import MOTION, RobotConfig
from legged.config.section import Section
from legged.config.task import TaskConfig


@dataclass(frozen=True)
class MotionConfig(Section):
    """Reference motions, and the bodies that are compared with them."""

    files: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Files of clips, or folders of clips (csv, npz, onnx), relative to the configuration file."""
    csv_fps: float = field(default=30.0, metadata=quantity("Hz", positive(10_000, low=1e-3)))
    """Frames per second of csv files, which do not say [Hz]."""
    anchor: str = ""
    """Body whose pose and heading bodies are compared with, e.g. the torso."""
    bodies: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Bodies whose poses and velocities are rewarded. They include the anchor."""
    extremities: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Bodies whose height error ends an episode, e.g. ankles and wrists."""
    max_anchor_height_error: float = field(default=0.25, metadata=quantity("m", positive(100)))
    """Largest height error of the anchor [m]."""
    max_anchor_gravity_error: float = field(default=0.8, metadata=positive(2))
    """Largest difference of the z components of gravity in the frames of robot's and reference's anchor."""
    max_extremity_height_error: float = field(default=0.25, metadata=quantity("m", positive(100)))
    """Largest height error of an extremity, relative to the anchor [m]."""
    bin_s: float = field(default=1.0, metadata=quantity("s", positive(LONGEST_S, low=0.02)))
    """Length of the parts of a clip whose failures are counted [s]. Episodes begin more often in parts with failures."""
    uniform: float = field(default=0.1, metadata=positive(1e6, low=1e-6))
    """Failures per step that are added to the counted ones, in equal shares for all parts. They keep every part in use."""
    memory: float = field(default=0.001, metadata=between(0, 1))
    """Share by which the counts of failures follow those of a step."""
    pose_noise: tuple[float, float, float, float, float, float] = field(
        default=(0.05, 0.05, 0.01, 0.1, 0.1, 0.2), metadata=MOTION
    )
    """Half widths of the uniform noise on initial poses: x, y, z [m], and a rotation vector [rad], world frame."""
    velocity_noise: tuple[float, float, float, float, float, float] = field(
        default=(0.5, 0.5, 0.2, 0.52, 0.52, 0.78), metadata=MOTION
    )
    """Half widths of the uniform noise on initial velocities: x, y, z [m/s]; roll, pitch, yaw [rad/s], world frame."""
    joint_noise: Range = field(default=(-0.1, 0.1), metadata=quantity("rad", MOTION))
    """Range of the uniform noise on initial joint angles [rad]."""


@dataclass(frozen=True)
class TrackingConfig(RobotConfig):
    """Configuration of a robot that tracks reference motions."""

    motion: MotionConfig = field(default_factory=MotionConfig)
    """Reference motions."""


def tracks_motions(cfg: TaskConfig) -> TypeGuard[TrackingConfig]:
    """Return whether the task's robots track reference motions."""
    return isinstance(cfg, TrackingConfig)
