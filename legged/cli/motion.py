"""`legged motion`: check, show and convert reference motions."""

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console

from legged.commandline.command import sub_command
from legged.deploy.command_parser import argument, check_number
from legged.errors import ConfigError
from legged.figures import figure
from legged.motion.checks import SOFT, Quality, quality_of
from legged.motion.clip import Clip, write_clip
from legged.motion.kinematics import Skeleton
from legged.motion.readers import CSV_FPS, read_clip
from legged.play.films import mp4
from legged.process.paths import ready_to_write, relative
from legged.rendering.clip_pictures import SIZE, pictures_of
from legged.robots.robot import load_robot
from legged.tables import screen_table

RATE = 50.0
"""Frames per second of the written clips: the control rate of most tasks."""
FILM_FPS = 25
HEADS = (
    *("clip", "frames", "time\n[s]", "base height\n[m]", "mean and largest\nspeed [m/s]", "joint speed\n[% of limit]"),
    *(
        f"beyond {100 * SOFT:.0f} % of\nrange [% of frames]",
        "sole, median\nand lowest [mm]",
        "feet on the ground\n2, 1, 0 [%]",
    ),
)


@sub_command(
    "legged motion walk.csv --robot g1",
    "legged motion clips/*.npz --no-film",
    "legged motion tracker.onnx",
    arguments=(
        argument("files", nargs="+", type=Path, metavar="FILE", help="csv, npz or onnx files with motions of one robot"),
        argument("--robot", default="g1", help="robot, or its folder; g1 by default"),
        argument("--fps", type=float, default=CSV_FPS, help=f"frames per second of csv files; {CSV_FPS:g} by default"),
        argument("--rate", type=float, default=RATE, help=f"frames per second of the written clips; {RATE:g} by default"),
        argument("--no-film", action="store_true", help="write no films"),
        argument("--out", type=Path, default=Path("logs/motion"), help="folder for clips, plots and films; logs/motion"),
    ),
)
def motion(args: argparse.Namespace) -> int:
    """Check reference motions, and resample them for training: `legged motion walk.csv`.

    Each motion is replayed through the robot's model. The command prints figures, and what the robot can't do: angles outside
    the range of a joint, speeds above its limit, soles below the ground, jumps. It writes each motion as npz, with a plot of
    heights and joint angles and a film. It reads csv files (columns: position, quaternion x y z w, joints), npz files of
    mjlab and holosoma, and ONNX trackers that hold their motion.
    """
    check_number("--fps", args.fps, 1e-3, 10_000)
    check_number("--rate", args.rate, 1.0, 1000)
    robot = load_robot(args.robot)
    skeleton = Skeleton(robot)
    clips = [read_clip(path, skeleton, args.fps).resampled(args.rate) for path in args.files]
    for name in {clip.name for clip in clips}:
        if sum(clip.name == name for clip in clips) > 1:
            raise ConfigError(f"FILE: two files are named '{name}', so one clip would be written over the other")
    for path in args.files:
        if path.resolve() == (args.out / f"{path.stem}.npz").resolve():
            raise ConfigError(f"--out: {relative(path)} would be overwritten by its resampled clip; name another folder")
    ready_to_write(args.out)
    measured = [quality_of(clip, skeleton) for clip in clips]
    rows = [_row(clip, quality) for clip, quality in zip(clips, measured, strict=True)]
    Console(width=150).print(screen_table(f"motions of {robot.name}", HEADS, rows))
    for clip, quality in zip(clips, measured, strict=True):
        for finding in quality.findings():
            print(f"{clip.name}: {finding}")
    for clip, quality in zip(clips, measured, strict=True):
        path = args.out / f"{clip.name}.npz"
        write_clip(clip, robot, path)
        _plot(clip, quality, skeleton, path.with_suffix(".png"))
        print(f"written: {relative(path)} and {path.with_suffix('.png').name}")
        if not args.no_film:
            every = max(1, round(clip.fps / FILM_FPS))
            with mp4(path.with_suffix(".mp4"), clip.fps / every, *SIZE) as append:
                for picture in pictures_of(clip, robot, every):
                    append(picture)
    return 0


def _row(clip: Clip, quality: Quality) -> list[str]:
    low, high = quality.root_height
    mean, largest = quality.speed
    return [
        clip.name,
        str(len(clip)),
        f"{quality.seconds:.1f}",
        f"{low:.2f} to {high:.2f}",
        f"{mean:.2f}, {largest:.2f}",
        f"{100 * quality.joint_speed:.0f}",
        f"{100 * quality.beyond_soft:.0f}",
        f"{1000 * np.median(quality.lower_sole):.0f}, {1000 * quality.soles.min():.0f}",
        ", ".join(f"{100 * share:.0f}" for share in quality.supports),
    ]


def _plot(clip: Clip, quality: Quality, skeleton: Skeleton, path: Path) -> None:
    """Plot the heights of base and soles, and the angle of each joint as a share of its range."""
    time = np.arange(len(clip)) / clip.fps
    low, high = skeleton.robot.dof_pos_limits.T
    with figure(path, (10, 8), rows=3) as (drawn, axes):
        heights, feet, joints = axes[:, 0]
        drawn.suptitle(clip.name)
        heights.plot(time, clip.root_pos[:, 2], label="base")
        heights.set_ylabel("height of the base [m]")
        for i, names in enumerate(skeleton.robot.feet_shapes):
            feet.plot(time, 1000 * quality.soles[:, i], label=names[0])
        feet.axhline(0.0, color="0.7", zorder=0)
        feet.set_ylabel("height of soles [mm]")
        feet.legend(loc="upper right")
        bounded = np.isfinite(low) & np.isfinite(high)
        share = (clip.joint_pos - low)[:, bounded] / (high - low)[bounded]
        joints.plot(time, 100 * share, linewidth=0.8)
        for bound in (0.0, 100.0):
            joints.axhline(bound, color="0.5", zorder=0)
        joints.set_ylabel("joint angles [% of range]")
        joints.set_xlabel("time [s]")
