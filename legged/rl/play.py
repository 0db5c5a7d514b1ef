"""See a policy walk, and export it: `python play.py --task anymal_c_flat`."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import imageio.v3
import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tensordict import TensorDict
from torch import Tensor

from legged.config import ConfigError
from legged.envs import LeggedRobot
from legged.headless import HEADLESS
from legged.paths import relative
from legged.rendering import Camera
from legged.rl.arguments import (
    add_run_arguments,
    add_task_arguments,
    import_and_check,
    overrides,
    pick_device,
    run_main,
)
from legged.rl.export import export
from legged.rl.policy import find_policy, restore, undisturbed
from legged.rl.viewer import view

FPS = 25
SCHEDULE = (  # seconds; vx, vy [m/s], yaw rate [rad/s]
    (2.0, (0.5, 0.0, 0.0)),
    (2.5, (1.0, 0.0, 0.0)),
    (2.0, (0.0, 0.5, 0.0)),
    (2.5, (0.4, 0.0, 0.8)),
    (1.5, (0.0, 0.0, -0.8)),
    (1.5, (0.0, 0.0, 0.0)),
)
"""What the robots are asked to do in the video, clipped to the ranges the task was trained on."""


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(prog="play.py", description="See a policy walk, and export it.")
    add_task_arguments(parser)
    add_run_arguments(parser)
    parser.add_argument("--headless", action="store_true", help="record even where there is a display")
    parser.add_argument("--gif", action="store_true", help="also write a GIF")
    parser.add_argument("--no-video", action="store_true", help="export and measure only")
    parser.add_argument("--out", type=Path, help="folder for video and exported/; the run folder by default")
    args = parser.parse_intermixed_args(argv)
    import_and_check(args)
    device = pick_device(args.sim_device)
    if device.type == "cpu":
        torch.set_num_threads(1)
    policy = find_policy(args)
    count = 4 if args.num_envs is None else args.num_envs
    seconds = sum(duration for duration, _ in SCHEDULE)
    changes = undisturbed(count, seconds) + [c for c in overrides(args) if c[0] != "train.runner.experiment_name"]
    task, runner = restore(policy, [*changes, ("env.num_envs", count)], device, graph=not args.no_graph)
    print(f"{policy.cfg.task}: {relative(policy.checkpoint)}")

    folder = args.out or default_output(policy.folder)
    differences = export(runner, folder / "exported")
    for name, difference in differences.items():
        print(f"exported {relative(folder / 'exported' / name)}, largest difference to the policy {difference:.1e}")

    act = runner.get_inference_policy(str(device))
    if not (HEADLESS or args.headless or args.no_video):
        view(task, act)
    result = record(task, act, None if args.no_video else folder, args.gif)
    Console(width=90).print(result)
    return 0


def default_output(folder: Path) -> Path:
    """The run folder; for the shipped policy, which may lie where nothing can be written, logs/play/<task>."""
    return Path("logs") / "play" / folder.name if folder.parent.name == "policies" else folder


@torch.inference_mode()
def record(task: LeggedRobot, act: Callable[[TensorDict], Tensor], folder: Path | None, gif: bool) -> Table:
    """Let the robots follow the schedule; write play.mp4 (and .gif) to `folder`; returns a table of errors and falls."""
    camera = Camera(task, min(task.num_envs, 9)) if folder else None
    if folder:
        folder.mkdir(parents=True, exist_ok=True)
    frames: list[np.ndarray] = []
    every = max(1, round(1.0 / (FPS * task.dt)))
    table = Table(title="following commands", title_justify="left")
    for name in ("vx, vy [m/s], yaw [rad/s]", "velocity RMSE", "yaw rate RMSE", "falls"):
        table.add_column(escape(name), justify="left" if name.startswith("vx") else "right")
    low, high = task.command_sampler.full_ranges.cpu().numpy().T
    task.reset()
    start = time.perf_counter()
    for seconds, wanted in SCHEDULE:
        command = np.clip(np.array(wanted), low, high)
        held = torch.tensor(command, dtype=torch.float32, device=task.device)  # type: ignore[arg-type]
        observations = task.hold_commands(held)
        lin, ang, falls, measured = 0.0, 0.0, 0, 0
        steps = round(seconds / task.dt)
        for step in range(steps):
            observations, _, _, _ = task.step(act(observations))
            falls += int(task.terminated_buf.sum())
            if step * task.dt >= 1.0:  # the first second of a command is for getting there
                error = (task.commands[:, :2] - task.base_lin_vel[:, :2]).square().sum(dim=1)
                lin += float(error.mean())
                ang += float((task.commands[:, 2] - task.base_ang_vel[:, 2]).square().mean())
                measured += 1
            if camera and step % every == 0:
                frames.append(camera.picture(_caption(task)))
        table.add_row(
            ", ".join(f"{value:g}" for value in command),
            f"{(lin / measured) ** 0.5:.3f} m/s",
            f"{(ang / measured) ** 0.5:.3f} rad/s",
            str(falls),
        )
    if camera and folder:
        camera.close()
        _write_video(frames, folder, gif)
        print(f"recorded {len(frames)} frames in {time.perf_counter() - start:.1f} s")
    return table


def _caption(task: LeggedRobot) -> list[str]:
    """Commanded and actual velocity, the latter as the mean of the robots."""
    wanted = task.commands[0, :3].tolist()
    actual = [*task.base_lin_vel[:, :2].mean(dim=0).tolist(), float(task.base_ang_vel[:, 2].mean())]
    return [
        f"{name}  {v[0]:+.2f}  {v[1]:+.2f} m/s  {v[2]:+.2f} rad/s" for name, v in (("commanded", wanted), ("actual", actual))
    ]


def _write_video(frames: list[np.ndarray], folder: Path, gif: bool) -> None:
    """play.mp4 and, if asked for, a smaller play.gif."""
    video = folder / "play.mp4"
    part = folder / "play.part.mp4"
    try:
        imageio.v3.imwrite(part, np.stack(frames), fps=FPS, codec="libx264", quality=7, macro_block_size=2)
    except (ImportError, OSError, ValueError) as error:
        raise ConfigError(f"{video}: cannot write video ({error}); pip install 'imageio[ffmpeg]'") from error
    part.replace(video)
    print(f"video {relative(video)}")
    if gif:
        part = folder / "play.part.gif"
        pictures = [Image.fromarray(frame).resize((416, 234), Image.Resampling.LANCZOS) for frame in frames[:: FPS // 8]]
        pictures = [picture.quantize(64, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE) for picture in pictures]
        first, *rest = pictures
        first.save(part, save_all=True, append_images=rest, duration=1000 * (FPS // 8) // FPS, loop=0)
        part.replace(folder / "play.gif")
        print(f"video {relative(folder / 'play.gif')}")
