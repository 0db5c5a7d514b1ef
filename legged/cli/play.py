"""`legged play`: a film, the measured errors and the exported files of a policy."""

import argparse
import os
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from legged.commandline.arguments import (
    TILES,
    of_legged_gym,
    pick_device,
    policy_overrides,
    register_given,
    settle_name,
    settle_on,
    watch_command,
)
from legged.commandline.command import sub_command
from legged.config import follows_velocities, override
from legged.deploy.command_parser import argument
from legged.envs import is_velocity_task
from legged.errors import ConfigError
from legged.learning.run_folder import find_run, run_config
from legged.play.demonstrations import EPISODE_S, SCHEDULE, follow_schedule, roll_out, walk_out
from legged.play.films import Video
from legged.play.playground import SETTING, Playground
from legged.play.viewer import view
from legged.policies.actor import Actor
from legged.policies.episodes import for_episodes
from legged.policies.export import EXPORTED, export, megabytes
from legged.policies.restore import TrainedPolicy, policy_of, restore, undisturbed
from legged.process.headless import HEADLESS
from legged.process.paths import ready_to_write, relative
from legged.registry import task_config
from legged.rendering.camera import window_opens

FILM_MB = 19.0
"""Disk space for the film [MiB]."""
MOST_ROBOTS = 4096
"""Largest number of robots. More would take minutes to build, and gigabytes."""
MOST_SHOWN = 9
"""Largest number of robots that the film shows on a plane."""
SHOWN_ON_A_PLANE = 4
"""Default number of robots on a plane."""


@sub_command(
    "legged play anymal_c --terrain stairs_up --difficulty 0.8",
    "legged play anymal_c_flat/2026-11-22_05-38-19 --headless --gif",
    arguments=(
        *of_legged_gym("policy"),
        *TILES,
        argument("--headless", action="store_true", help="open no window, even if there is a display"),
        argument("--gif", action="store_true", help="also write a GIF"),
        argument("--no-video", action="store_true", help="film nothing; only export and measure"),
        argument("--out", type=Path, help="folder for the film and for exported/; by default the run folder"),
    ),
)
def play(args: argparse.Namespace) -> int:
    """Film a policy, measure it and export it: `legged play anymal_c_flat`, or `python play.py --task anymal_c_flat`.

    On a machine with a display, a window opens before the film is made. In this window the arrow keys steer the robot.
    """
    if args.gif and args.no_video:
        raise ConfigError("--gif: cannot be combined with --no-video; leave out one of them")
    settle_name(args, "policy")
    register_given(args, "policy")
    device = pick_device(args.sim_device)
    settle_on(device)
    policy = policy_of(_named(args), args.checkpoint)
    asked = policy_overrides(args)
    count = dict(asked).get("env.num_envs", 1)
    if isinstance(count, int) and count > MOST_ROBOTS:
        raise ConfigError(f"--num-envs: must be from 1 to {MOST_ROBOTS}, got {count}; a film shows at most {MOST_SHOWN}")
    folder = args.out or policy.output("play")
    playground, task, act = _on_ground(args, policy, asked, device, folder)
    print(f"{policy.cfg.task}: {relative(policy.checkpoint)}\nwatch it: {watch_command(args, policy.folder)}")

    differences = export(task, act.network, folder / EXPORTED, trained=policy.cfg, run=relative(policy.folder))
    for name, difference in differences.items():
        print(f"exported {relative(folder / EXPORTED / name)}, largest difference to the policy {difference:.1e}")

    if not (HEADLESS or args.headless or args.no_video):
        if not window_opens():
            print("no window opens on this display: recording only")
        else:
            view(task, act, playground)
    elif not (args.no_video or args.headless) and "DISPLAY" in os.environ:
        print(f"the display {os.environ['DISPLAY']} (DISPLAY) does not answer: recording only")
    shown = min(task.num_envs, len(playground.order) if playground else MOST_SHOWN)
    with Video(task, shown, None if args.no_video else folder, args.gif) as video:
        if not is_velocity_task(task):
            result = roll_out(task, act, video)
        else:
            result = walk_out(task, act, playground, video) if playground else follow_schedule(task, act, video)
        Console(width=90).print(result)
    return 0


def _named(args: argparse.Namespace) -> str:
    """Return `args.policy`. If --load-run or --experiment-name chooses a run of the task `args.policy`, return its folder."""
    if args.load_run is None and args.experiment_name is None:
        return str(args.policy)
    flags = [("train.runner.experiment_name", args.experiment_name)] if args.experiment_name else []
    folder = find_run(task_config(args.policy, flags), args.load_run)
    trained_on = run_config(folder, "--load-run").task
    if trained_on != args.policy:
        raise ConfigError(f"--load-run: {relative(folder)} was trained on '{trained_on}', not on '{args.policy}'")
    return str(folder)


def _on_ground(
    args: argparse.Namespace, policy: TrainedPolicy, asked: list[tuple[str, Any]], device: torch.device, folder: Path
) -> tuple[Playground | None, Any, Actor]:
    """Build a policy's task on a playground, a plane, or the ground of its model. Return playground, task and policy."""
    cfg: Any = override(policy.cfg, asked)
    playground = Playground.of(cfg, args.terrain, args.difficulty)
    count = len(playground.order) if playground else SHOWN_ON_A_PLANE
    if follows_velocities(policy.cfg):
        changes = undisturbed(cfg, count, EPISODE_S if playground else sum(seconds for seconds, _ in SCHEDULE))
    else:
        changes = for_episodes(cfg, count)
    changes += [*(SETTING if playground else ()), *asked]
    terrain = None
    if playground:
        changes += playground.changes(cfg)
        terrain = playground.build(override(cfg, changes))
    ready_to_write(folder, FILM_MB + megabytes(cfg))
    task, act = restore(policy, changes, device, graph=not args.no_graph, terrain=terrain)
    if playground:
        playground.place(task)
    return playground, task, act
