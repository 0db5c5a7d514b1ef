"""See a policy walk, and export it: `python play.py --task anymal_c_flat`."""

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tensordict import TensorDict
from torch import Tensor

from legged.commandline.arguments import (
    add_run_arguments,
    add_task_arguments,
    import_and_check,
    pick_device,
    policy_overrides,
    settle_on,
)
from legged.commandline.command import run_main
from legged.config import override
from legged.envs import LeggedRobot
from legged.errors import RunError
from legged.play.outing import EPISODE_S, walk_out
from legged.play.playground import SETTING, Playground
from legged.play.video import Video
from legged.play.viewer import view
from legged.policies.export import export
from legged.policies.restore import find_policy, restore, undisturbed
from legged.process.headless import HEADLESS
from legged.process.paths import ready_to_write, relative
from legged.rendering import window_opens

ROOM_MB = 24.0
"""What the disk must have room for: the film and the exported policy [MiB]."""
MOST_SHOWN = 9
"""Robots in the picture on a plane."""
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
    parser.add_argument("--terrain", metavar="TYPE", help="type of the tiles, e.g. stairs_up; the task's own by default")
    parser.add_argument("--difficulty", type=float, help="of the tiles, 0 to 1; 0.5 and 0.8 by default")
    parser.add_argument("--headless", action="store_true", help="record even where there is a display")
    parser.add_argument("--gif", action="store_true", help="also write a GIF")
    parser.add_argument("--no-video", action="store_true", help="export and measure only")
    parser.add_argument("--out", type=Path, help="folder for video and exported/; the run folder by default")
    args = parser.parse_intermixed_args(argv)
    import_and_check(args)
    device = pick_device(args.sim_device)
    settle_on(device)
    policy = find_policy(args)
    asked = policy_overrides(args)
    wanted = override(policy.cfg, asked)
    playground = Playground.of(wanted, args.terrain, args.difficulty)
    count = args.num_envs if args.num_envs is not None else 4 if playground is None else len(playground.order)
    seconds = EPISODE_S if playground else sum(duration for duration, _ in SCHEDULE)
    changes = [*undisturbed(count, seconds), *(SETTING if playground else ()), *asked, ("env.num_envs", count)]
    terrain = None
    if playground:
        changes += playground.changes(wanted)
        terrain = playground.build(override(policy.cfg, changes))
    folder = args.out or policy.output("play")
    ready_to_write(folder, ROOM_MB)
    task, runner = restore(policy, changes, device, graph=not args.no_graph, terrain=terrain)
    print(f"{policy.cfg.task}: {relative(policy.checkpoint)}")

    differences = export(runner, folder / "exported")
    for name, difference in differences.items():
        print(f"exported {relative(folder / 'exported' / name)}, largest difference to the policy {difference:.1e}")

    act = runner.get_inference_policy(str(device))
    if not (HEADLESS or args.headless or args.no_video):
        if window_opens():
            view(task, act, playground)
        else:
            print("no window opens on this display: recording only")
    elif not (args.no_video or args.headless) and "DISPLAY" in os.environ:
        print(f"the display {os.environ['DISPLAY']} (DISPLAY) does not answer: recording only")
    shown = min(task.num_envs, len(playground.order) if playground else MOST_SHOWN)
    video, failure = _video(task, shown, None if args.no_video else folder, args.gif)
    result = walk_out(task, act, playground, video) if playground else record(task, act, video)
    Console(width=90).print(result)
    if failure is None:
        video.write()
        return 0
    raise failure


def _video(task: LeggedRobot, count: int, folder: Path | None, gif: bool) -> tuple[Video, RunError | None]:
    """What films the robots; where nothing can be rendered, what films nothing, and why: they are measured all the same."""
    try:
        return Video(task, count, folder, gif), None
    except RunError as error:
        return Video(task, count, None), error


@torch.inference_mode()
def record(task: LeggedRobot, act: Callable[[TensorDict], Tensor], video: Video) -> Table:
    """Let the robots follow the schedule, filmed by `video`; returns a table of errors and falls."""
    table = Table(title="following commands", title_justify="left")
    for name in ("vx, vy [m/s], yaw [rad/s]", "velocity RMSE", "yaw rate RMSE", "falls"):
        table.add_column(escape(name), justify="left" if name.startswith("vx") else "right")
    low, high = task.command_sampler.full_ranges.cpu().numpy().T
    task.reset()
    for seconds, wanted in SCHEDULE:
        command = np.clip(np.array(wanted), low, high)
        held = torch.tensor(command, dtype=torch.float32, device=task.device)  # type: ignore[arg-type]
        observations = task.hold_commands(held)
        lin, ang, falls, measured = 0.0, 0.0, 0, 0
        steps = max(1, round(seconds / task.dt))
        for step in range(steps):
            observations, _, _, _ = task.step(act(observations))
            falls += int(task.terminated_buf.sum())
            if step * task.dt >= 1.0:  # the first second of a command is for getting there
                error = (task.commands[:, :2] - task.base_lin_vel[:, :2]).square().sum(dim=1)
                lin += float(error.mean())
                ang += float((task.commands[:, 2] - task.base_ang_vel[:, 2]).square().mean())
                measured += 1
            if video.due(step):
                video.take(slice(None))
        table.add_row(
            ", ".join(f"{value:g}" for value in command),
            # With long control steps a command may be over before anything was measured.
            f"{(lin / measured) ** 0.5:.3f} m/s" if measured else "-",
            f"{(ang / measured) ** 0.5:.3f} rad/s" if measured else "-",
            str(falls),
        )
    return table


if __name__ == "__main__":
    sys.exit(main())
