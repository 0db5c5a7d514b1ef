"""Train a policy: `python train.py --task anymal_c_flat`."""

import argparse
import contextlib
import os
import signal
import sys
import time
from pathlib import Path
from types import FrameType

import torch

from legged.config import TaskConfig, to_yaml
from legged.cores import available_cores
from legged.envs import LeggedRobot
from legged.paths import relative
from legged.physics import engine_name, resolve_physics
from legged.ranks import Ranks
from legged.registry import make_task, task_config
from legged.rl.arguments import (
    add_run_arguments,
    add_task_arguments,
    import_and_check,
    overrides,
    pick_device,
    run_main,
    settle_on,
)
from legged.rl.captured import CapturedRunner
from legged.rl.display import Display
from legged.rl.distributed import RankLost
from legged.rl.resume import resumed
from legged.rl.runner import Runner
from legged.rl.runs import create_run
from legged.startup import STARTED_S


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    start = STARTED_S if argv is None else time.perf_counter()  # as a command, imports are part of it
    parser = argparse.ArgumentParser(prog="train.py", description="Train a legged robot.")
    add_task_arguments(parser)
    add_run_arguments(parser)
    parser.add_argument("--resume", action="store_true", help="go on from a checkpoint, in a new run folder")
    parser.add_argument("--run_name", help="appended to the run folder's name")
    parser.add_argument("--max_iterations", type=int, help="length of the whole training")
    parser.add_argument("--rl_device", help="device of the networks; that of the simulation by default")
    parser.add_argument("--runner", choices=["stock", "captured"], help="training loop (train.runner.loop)")
    parser.add_argument("--headless", action="store_true", help="accepted for legged_gym's sake: training draws nothing")
    parser.add_argument("--show", action="store_true", help="print the full configuration and stop")
    args = parser.parse_intermixed_args(argv)

    import_and_check(args)
    device = pick_device(args.sim_device)
    rl_device = pick_device(args.rl_device, "--rl_device") if args.rl_device else device
    checkpoint: Path | None = None
    changed: list[str] = []
    if args.resume or args.load_run or args.checkpoint is not None:
        cfg, checkpoint, changed = resumed(args)
    else:
        cfg = task_config(args.task, overrides(args), on_cpu=device.type == "cpu")
    resolve_physics(cfg.sim.physics, device, cfg.origins.where("sim.physics"))
    if args.show:
        print(to_yaml(cfg), end="")
        return 0
    if checkpoint:
        print(f"going on with the settings of {relative(checkpoint.parent)}" + "".join(f"; {text}" for text in changed))
    settle_on(device)
    if Ranks.now().first:
        return _train(args, cfg, device, rl_device, checkpoint, start)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        return _train(args, cfg, device, rl_device, checkpoint, start)


def _train(
    args: argparse.Namespace,
    cfg: TaskConfig,
    device: torch.device,
    rl_device: torch.device,
    checkpoint: Path | None,
    start: float,
) -> int:
    """Build and train; returns the exit code. Of several processes the first one has a run folder and a display."""
    folder = create_run(cfg) if Ranks.now().first else None
    if folder:
        print(describe(cfg, device, folder), flush=True)
    task = make_task(cfg, device, graph=not args.no_graph)
    with Display(f"{cfg.task}: {relative(folder)}") if folder else contextlib.nullcontext() as display:
        kind = CapturedRunner if cfg.train.runner.loop == "captured" else Runner
        runner = kind(task, folder, str(rl_device), display)
        if checkpoint:
            why_anew = runner.resume(str(checkpoint))
            how = f"all robots begin anew: {why_anew}" if why_anew else "robots and random numbers go on where they were"
            print(f"resumed {relative(checkpoint)} after iteration {runner.current_learning_iteration}; {how}", flush=True)
        ready = time.perf_counter()
        stopped_by = stop_on_signals(runner)
        try:
            finished = runner.train(cfg.train.runner.max_iterations)
        except RankLost as lost:
            print(lost, file=sys.stderr, flush=True)
            return 1
    if folder:
        _summary(runner, folder, ready - start, finished)
    return 0 if finished else 128 + (stopped_by or [signal.SIGTERM])[0]


def describe(cfg: TaskConfig, device: torch.device, folder: Path) -> str:
    """One line on what is about to run where."""
    if device.type == "cpu":
        engines = {
            "mujoco_warp": "mujoco-warp on the CPU",
            "mujoco": f"C MuJoCo on {cfg.sim.threads or available_cores()} cores",
        }
        engine = engines.get(engine_name(cfg.sim, device), f"Newton's {cfg.sim.solver} solver on the CPU")
        where = f"no GPU in use: {engine}, settings of the task's cpu section"
    else:
        where = torch.cuda.get_device_name(device)
    ranks = Ranks.now()
    share = f" on each of {ranks.count} processes" if ranks.several else ""
    robots = f"{cfg.env.num_envs} robots{share}"
    return f"{cfg.task}: {robots}, {cfg.train.runner.max_iterations} iterations, {where}; {relative(folder)}"


def stop_on_signals(runner: Runner) -> list[int]:
    """Ctrl-C and SIGTERM stop at the end of an iteration, a second one at once. Returns a list that gets the signal.

    Of several processes all stop as soon as one is asked to. There a second signal changes nothing: torchrun passes on what
    the terminal has sent already, and kills who takes more than half a minute.
    """
    received: list[int] = []
    ranks = Ranks.now()

    def handler(number: int, frame: FrameType | None) -> None:
        if received and not ranks.several:
            raise KeyboardInterrupt
        if not received and ranks.first:
            once_more = "" if ranks.several else "; once more to stop at once"
            print(f"stopping after this iteration, with a checkpoint{once_more}", file=sys.stderr, flush=True)
        received.append(number)
        runner.stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)
    return received


def _summary(runner: Runner, folder: Path, start_up_s: float, finished: bool) -> None:
    task: LeggedRobot = runner.env  # type: ignore[assignment]
    steps = runner.logger.tot_timesteps
    loop = runner.logger.loop_s
    print(
        f"{'finished' if finished else 'stopped'} after {runner.current_learning_iteration + 1} iterations: "
        f"{steps:,} steps in {loop:.1f} s of training loop ({steps / max(loop, 1e-9):,.0f} steps/s), "
        f"{start_up_s:.1f} s of start-up, imports and kernel compilation included\n"
        f"checkpoint in {relative(folder)}; see it walk: python play.py --task {task.cfg.task}",
        flush=True,
    )
