"""Train a policy: `legged train anymal_c_flat`, or `python train.py --task anymal_c_flat`."""

import argparse
import contextlib
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from legged.commandline.arguments import (
    add_legged_gym_arguments,
    given_import,
    overrides,
    pick_device,
    register_given,
    settle_name,
    settle_on,
    watch_command,
)
from legged.commandline.command import EXIT_FAILED, run_main
from legged.commandline.output import when_output_is_lost
from legged.commandline.show import summary
from legged.commandline.stopping import quiet_writers, stopping_on_signals
from legged.config import TaskConfig, to_yaml
from legged.config.networks import learns_from_teacher
from legged.errors import ConfigError, RunError
from legged.evaluation.during_training import TrainingEvaluation, check_commands
from legged.learning.captured import CapturedRunner
from legged.learning.checkpoint import read_checkpoint
from legged.learning.display import Display
from legged.learning.distributed import RankLost, check_reachable
from legged.learning.evaluations import Evaluations
from legged.learning.invocation import Invocation, write_invocation
from legged.learning.resume import resumed
from legged.learning.run_folder import NOTE_FILE, create_run, discard_run, experiment_folder, find_run
from legged.learning.runner import Runner
from legged.learning.student_runner import StudentRunner
from legged.learning.teacher import Teacher, find_teacher, teacher_in, with_teacher
from legged.learning.timing import Timing, write_timing
from legged.learning.trackers import check_tracker
from legged.learning.transfer import transferred
from legged.physics import engine_name, resolve_physics
from legged.process.command_parser import CommandParser
from legged.process.cores import available_cores
from legged.process.neighbours import Neighbours
from legged.process.paths import full_disk_in, ready_to_write, reason, relative, write_text
from legged.process.ranks import Ranks
from legged.process.startup import STARTED_S, program, stage_ended
from legged.registry import make_task, task_config

ROOM_MB = 16.0
"""Disk space that must be free before a training begins, for its first checkpoints [MiB]."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


Prepared = Callable[[Runner], None]
"""Function that receives the runner after it is built and before it trains."""


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged train",
        __doc__,
        "legged train anymal_c_flat",
        "legged train anymal_c --num-envs 8192 --seed 3 rewards.scales.torques=-1e-4",
        "legged train anymal_c --resume",
        "legged train anymal_c_step --transfer anymal_c_flat",
        "legged train anymal_c_student --teacher anymal_c",
    )
    add_legged_gym_arguments(parser, "task")
    parser.add_argument("--resume", action="store_true", help="continue from a checkpoint, in a new run folder")
    parser.add_argument(
        "--transfer", metavar="POLICY", help="begin with the networks of another training, also of another task"
    )
    parser.add_argument("--teacher", metavar="POLICY", help="policy that a student imitates (train.distillation.teacher)")
    parser.add_argument("--run-name", help="appended to the run folder's name")
    parser.add_argument("--max-iterations", type=int, help="length of the whole training")
    parser.add_argument("--note", help="a sentence about this run, for its report and the table of all runs")
    parser.add_argument("--rl-device", help="device of the networks; that of the simulation by default")
    parser.add_argument("--runner", choices=["stock", "captured"], help="training loop (train.runner.loop)")
    parser.add_argument("--headless", action="store_true", help="without effect; legged_gym has this option")
    parser.add_argument(
        "--show", action="store_true", help="print the full configuration, terms, actions and joints, and stop"
    )
    return parser


def train_as_asked(argv: list[str], prepared: Prepared) -> int:
    """Run a training with the arguments `argv` inside another command; return the exit code. Errors are raised.

    Raises:
        ConfigError: the command line or the configuration is wrong.
        RunError: training could not go on.
    """
    return _main(argv, prepared)


def _main(argv: list[str] | None, prepared: Prepared | None = None) -> int:
    start = STARTED_S if argv is None else time.perf_counter()  # the time of a command includes its imports
    stage_ended("imports")
    args = build_parser().parse_intermixed_args(argv)

    settle_name(args, "task")
    register_given(args, "task")
    device = pick_device(args.sim_device)
    rl_device = pick_device(args.rl_device, "--rl-device") if args.rl_device else device
    checkpoint: Path | None = None
    changed: list[str] = []
    if args.transfer:
        for option in ("resume", "load_run"):
            if getattr(args, option):
                raise ConfigError(f"--{option.replace('_', '-')}: continues a training, --transfer begins one; give either")
        on_cpu = device.type == "cpu"
        cfg, checkpoint = transferred(args.task, overrides(args), args.transfer, args.checkpoint, on_cpu)
    elif args.resume or args.load_run is not None or args.checkpoint is not None:
        cfg, checkpoint, changed = resumed(args.task, overrides(args), args.load_run, args.checkpoint)
    else:
        cfg = task_config(args.task, overrides(args), on_cpu=device.type == "cpu")
    teacher = teacher_of(cfg, checkpoint, args)
    resolve_physics(cfg.sim.physics, device, cfg.origins.where("sim.physics"))
    check_commands(cfg)
    check_tracker(cfg)
    if args.show:
        print(to_yaml(cfg), end="")
        print(*summary(cfg), sep="\n")
        return 0
    if checkpoint and not args.transfer:
        print(f"going on with the settings of {relative(checkpoint.parent)}" + "".join(f"; {text}" for text in changed))
    settle_on(device)
    if Ranks.now().first:
        with Neighbours(_name_of(device)) as neighbours:
            return _train(args, cfg, device, rl_device, checkpoint, teacher, start, prepared, neighbours)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        return _train(args, cfg, device, rl_device, checkpoint, teacher, start, prepared, None)


def _train(
    args: argparse.Namespace,
    cfg: TaskConfig,
    device: torch.device,
    rl_device: torch.device,
    checkpoint: Path | None,
    teacher: Teacher | None,
    start: float,
    prepared: Prepared | None,
    neighbours: Neighbours | None,
) -> int:
    """Build the task and train; return the exit code. Of several processes only the first has a run folder and a display."""
    first = Ranks.now().first
    check_reachable(Ranks.now())
    if first:
        ready_to_write(experiment_folder(cfg), ROOM_MB)
        print(describe(cfg, device), flush=True)
    task = make_task(cfg if teacher is None else with_teacher(cfg, teacher), device, graph=not args.no_graph)
    if first and task.physics.why_c_engine:
        print(f"C MuJoCo instead, which is faster here: {task.physics.why_c_engine}", flush=True)
    if first and task.physics.why_library:
        print(f"mujoco-warp's own launches: {task.physics.why_library}", flush=True)
    for line in task.robot.adaptations if first and task.physics.robot_state is not None else ():
        print(f"{task.robot.file.model}: {line}", flush=True)
    with Display(cfg.task) if first else contextlib.nullcontext() as display:
        kind = CapturedRunner if cfg.train.runner.loop == "captured" else Runner
        if teacher is None:
            runner = kind(task, None, str(rl_device), display)
        else:
            runner = StudentRunner(task, teacher, None, str(rl_device), display)
            print(f"teacher: {teacher.told()}", flush=True)
        if checkpoint and args.transfer:
            print(runner.transfer(str(checkpoint)), flush=True)
        elif checkpoint:
            why_anew = runner.resume(str(checkpoint))
            how = f"all robots begin anew: {why_anew}" if why_anew else "robots and random numbers go on where they were"
            print(f"resumed {relative(checkpoint)} after iteration {runner.current_learning_iteration}; {how}", flush=True)
        if cfg.train.runner.evaluate_interval:
            _evaluate_during(runner, checkpoint if not args.transfer else None)
        if prepared is not None:
            prepared(runner)
        runner.logger.neighbours = neighbours
        ready = time.perf_counter()
        resumed = checkpoint is not None and not args.transfer

        def timing(finished: bool, error: str = "") -> Timing:
            times = _timing(runner, device, ready - start, time.perf_counter() - start, finished, resumed)
            return replace(times, error=error)

        with stopping_on_signals(runner.stop) as stopped_by, quiet_writers():
            try:
                folder, finished = _learn(runner, cfg, display, args, timing, checkpoint if resumed else None)
            except RankLost as lost:
                print(lost, file=sys.stderr, flush=True)
                return EXIT_FAILED
            except KeyboardInterrupt:
                if not stopped_by:
                    raise
                print("interrupted", file=sys.stderr, flush=True)
                return 128 + stopped_by[-1]
    if folder:
        took = timing(finished)
        _summary(runner, folder, took, play_command(args, cfg, folder))
        write_timing(folder, took)
        _report(folder, cfg, args if finished else None)
        runner.logger.hand_over(runner.current_learning_iteration)
    if finished:
        return 0
    # No signal of this process: its output was lost, or another process was told to stop.
    return 128 + stopped_by[0] if stopped_by else EXIT_FAILED if first else 128 + signal.SIGTERM


def teacher_of(cfg: TaskConfig, checkpoint: Path | None, args: argparse.Namespace) -> Teacher | None:
    """Return the teacher of a task that imitates one: for a resumed training the teacher in its `checkpoint`, else the one in
    the configuration.

    Raises:
        ConfigError: the teacher is missing or does not fit, or one is named for a task that imitates none.
    """
    if not learns_from_teacher(cfg):
        if args.teacher is not None:
            learns = "train.algorithm.class_name=Distillation would"
            raise ConfigError(f"--teacher: '{cfg.task}' learns from rewards, not from a teacher; {learns}")
        return None
    return find_teacher(cfg) if checkpoint is None else teacher_in(checkpoint, read_checkpoint(checkpoint))


def _evaluate_during(runner: Runner, resumed_from: Path | None) -> None:
    """Set up evaluations of the policy during the training, in the first process."""
    evaluations = None
    if Ranks.now().first:
        evaluations = Evaluations(runner.env.cfg, TrainingEvaluation(runner.env))
        if resumed_from is not None:
            evaluations.go_on_from(resumed_from)
    runner.evaluate_with(evaluations)


def _learn(
    runner: Runner,
    cfg: TaskConfig,
    display: Display | None,
    args: argparse.Namespace,
    timing: Callable[[bool, str], Timing],
    goes_on_from: Path | None,
) -> tuple[Path | None, bool]:
    """Train into a new run folder; return the folder (None if another process has it) and True if training reached its end.

    A training that fails before its first checkpoint leaves no folder. One that fails later writes the error and its times
    into the folder. `goes_on_from` is the checkpoint of a resumed training.

    Raises:
        RunError: the folder can't be written.
    """
    folder = create_run(cfg) if display else None
    if folder is None or display is None:
        return None, runner.train(cfg.train.runner.max_iterations)
    given = Invocation(args.task_file or args.task, args.module, dict(overrides(args)))
    write_invocation(folder, given, goes_on_from.parent if goes_on_from is not None else None)
    if args.note is not None:
        write_text(folder / NOTE_FILE, f"{args.note}\n")
    print(f"run folder {relative(folder)}\nwatch it: {watch_command(args, folder)}", flush=True)
    display.title = f"{cfg.task}: {relative(folder)}"
    if runner.evaluations is not None:
        runner.evaluations.begin_in(folder)
    runner.logger.log_dir = str(folder)
    when_output_is_lost(runner.stop)
    try:
        return folder, runner.train(cfg.train.runner.max_iterations)
    except BaseException as error:
        if runner.logger.writer is not None:
            with contextlib.suppress(OSError):
                runner.logger.stop_logging_writer()
        discard_run(folder)
        if folder.is_dir():
            _leave_word(folder, error, cfg, timing)
        full = full_disk_in(error)
        if full is not None and not isinstance(error, RunError):  # TensorBoard's writer does not name the file
            raise RunError(f"{relative(folder)}: {reason(full)}") from error
        raise


def _leave_word(folder: Path, error: BaseException, cfg: TaskConfig, timing: Callable[[bool, str], Timing]) -> None:
    """Write the error and the report into the folder of a failed training; a full disk may prevent that."""
    said = "" if isinstance(error, KeyboardInterrupt) else " ".join(f"{type(error).__name__}: {error}".split())[:500]
    with contextlib.suppress(RunError, RuntimeError):  # the name of a broken CUDA device can't be read
        write_timing(folder, timing(False, said))
        _report(folder, cfg, None)


def _report(folder: Path, cfg: TaskConfig, args: argparse.Namespace | None) -> None:
    """Write the report on a training that has ended, unless its configuration switches reports off. The film needs the
    arguments with which the task is found again, so without `args` there is no film.
    """
    if not cfg.train.runner.report:
        return
    from legged.evaluation.reports.run_report import report_at_end  # imported late: no training needs it at its start

    film_with = None
    if args is not None and cfg.train.runner.film:
        film_with = given_import(args)
    report_at_end(folder, film_with)


def describe(cfg: TaskConfig, device: torch.device) -> str:
    """Return one line about the task, the number of iterations and the device."""
    if device.type == "cpu":
        cores = _counted(cfg.sim.threads or available_cores(), "core")
        engines = {"mujoco_warp": f"mujoco-warp on {cores}", "mujoco": f"C MuJoCo on {cores}"}
        name = engine_name(cfg.sim, device, num_envs=cfg.env.num_envs)
        engine = engines.get(name, f"Newton's {cfg.sim.solver} solver on the CPU")
        where = f"no GPU in use: {engine}"
        if any(source.endswith(": cpu") for source in cfg.origins.values()):
            where += ", settings of the task's cpu section"
    else:
        where = torch.cuda.get_device_name(device)
    ranks = Ranks.now()
    share = f" on each of {ranks.count} processes" if ranks.several else ""
    robots = f"{_counted(cfg.env.num_envs, 'robot')}{share}"
    return f"{cfg.task}: {robots}, {_counted(cfg.train.runner.max_iterations, 'iteration')}, {where}"


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' if count != 1 else ''}"


def play_command(args: argparse.Namespace, cfg: TaskConfig, folder: Path) -> str:
    """Return the command that shows the policy of a run, ready to paste into the shell that started this process."""
    newest = False
    if not cfg.train.runner.experiment_name:
        with contextlib.suppress(ConfigError, OSError):
            newest = find_run(cfg, None) == folder  # otherwise another training of this task runs at the same time
    if not newest:
        return shlex.join([*program("play"), *given_import(args), relative(folder)])
    module = ["--import", args.module] if args.module else []
    return shlex.join([*program("play"), *module, args.task_file or args.task])


def _name_of(device: torch.device) -> str:
    """Return the name of a device that is unique on this machine."""
    return f"gpu-{torch.cuda.get_device_properties(device).uuid}" if device.type == "cuda" else "cpu"


def _timing(runner: Runner, device: torch.device, start_up_s: float, wall_s: float, finished: bool, resumed: bool) -> Timing:
    """Return the times of the training and its number of steps."""
    steps, neighbours = runner.logger.tot_timesteps, runner.logger.neighbours
    if neighbours is not None:
        neighbours.look()
    return Timing(
        task=runner.env.cfg.task,
        finished=finished,
        robots=runner.env.num_envs * Ranks.now().count,
        iterations=steps // runner.logger.steps_per_iteration,
        resumed=resumed,
        steps=steps,
        start_up_s=start_up_s,
        loop_s=runner.logger.loop_s,
        wall_s=wall_s,
        device=torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        kernels_compiled=runner.env.physics.compiled,
        beside=neighbours.most if neighbours is not None else 0,
        evaluation_s=runner.evaluations.spent_s if runner.evaluations is not None else 0.0,
    )


def _summary(runner: Runner, folder: Path, timing: Timing, play: str) -> None:
    if runner.evaluations is not None:
        print(*runner.evaluations.summary(timing.loop_s), sep="\n")
    print(
        f"{'finished' if timing.finished else 'stopped'} after {runner.current_learning_iteration + 1} iterations: "
        f"{timing.steps:,} steps in {timing.loop_s:.1f} s of training loop ({timing.steps_per_s:,.0f} steps/s"
        f"{timing.company}), {timing.start_up_s:.1f} s of start-up, imports and kernel compilation included\n"
        f"checkpoint in {relative(folder)}; see it walk: {play}",
        flush=True,
    )
