"""`legged train`: trainings from the command line."""

import argparse
import contextlib
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from legged.commandline.arguments import (
    given_import,
    of_legged_gym,
    overrides,
    pick_device,
    register_given,
    settle_name,
    settle_on,
    watch_command,
)
from legged.commandline.command import EXIT_FAILED, quiet_writers, stopping_on_signals, sub_command, when_output_is_lost
from legged.commandline.show import summary
from legged.config import TaskConfig, to_yaml
from legged.config.networks import learns_from_teacher
from legged.deploy.command_parser import argument
from legged.envs import BaseTask
from legged.envs.checks import check_rewards
from legged.errors import ConfigError, RunError
from legged.evaluation.during_training import TrainingEvaluation
from legged.learning.captured import CapturedRunner
from legged.learning.checkpoint import read_checkpoint
from legged.learning.display import Display
from legged.learning.distributed import RankLost, check_reachable
from legged.learning.evaluations import Evaluations
from legged.learning.invocation import Invocation, write_invocation
from legged.learning.report_process import start_report
from legged.learning.resume import resumed
from legged.learning.run_folder import NOTE_FILE, create_run, discard_run, experiment_folder, find_run
from legged.learning.runner import Runner
from legged.learning.student_runner import StudentRunner
from legged.learning.teacher import Teacher, find_teacher, teacher_in, with_teacher
from legged.learning.timing import Timing, write_timing
from legged.learning.trackers import check_tracker
from legged.learning.transfer import transferred
from legged.physics import engine_name, resolve_physics
from legged.process.cores import available_cores
from legged.process.neighbours import Neighbours
from legged.process.paths import full_disk_in, ready_to_write, reason, relative, write_text
from legged.process.ranks import Ranks
from legged.process.startup import program, stage_ended
from legged.registry import make_task, task_class, task_config

ROOM_MB = 16.0
"""Disk space that must be free before a training begins, for its first checkpoints [MiB]."""


@sub_command(
    "legged train anymal_c_flat",
    "legged train anymal_c --num-envs 8192 --seed 3 rewards.scales.torques=-1e-4",
    "legged train anymal_c --resume",
    "legged train anymal_c_step --transfer anymal_c_flat",
    "legged train anymal_c_student --teacher anymal_c",
    arguments=(
        *of_legged_gym("task"),
        argument("--resume", action="store_true", help="continue from a checkpoint, in a new run folder"),
        argument("--transfer", metavar="POLICY", help="begin with the networks of another training, of any task"),
        argument("--teacher", metavar="POLICY", help="policy that a student imitates (train.distillation.teacher)"),
        argument("--run-name", help="text that is appended to the run folder's name"),
        argument("--max-iterations", type=int, help="iterations of the whole training, including those before --resume"),
        argument("--note", help="a sentence about this run, for its report and the table of all runs"),
        argument("--rl-device", help="device of the networks; by default the device of the simulation"),
        argument("--runner", choices=["stock", "captured"], help="training loop (train.runner.loop)"),
        argument("--headless", action="store_true", help="has no effect; accepted because legged_gym has it"),
        argument("--show", action="store_true", help="print the full configuration, terms, actions and joints, and exit"),
    ),
)
def train(args: argparse.Namespace, prepared: Callable[[Runner], None] | None = None) -> int:
    """Train a policy: `legged train anymal_c_flat`, or `python train.py --task anymal_c_flat`."""
    # `prepared` receives the runner after it is built and before it trains.
    stage_ended("imports")
    settle_name(args, "task")
    register_given(args, "task")
    device = pick_device(args.sim_device)
    rl_device = pick_device(args.rl_device, "--rl-device") if args.rl_device else device
    on_cpu, checkpoint = device.type == "cpu", None
    changed: list[str] = []
    if args.transfer:
        for option in ("resume", "load_run"):
            if getattr(args, option):
                raise ConfigError(
                    f"--{option.replace('_', '-')}: continues a training, but --transfer begins a new one; omit one of them"
                )
        cfg, checkpoint = transferred(args.task, overrides(args), args.transfer, args.checkpoint, on_cpu)
    elif args.resume or args.load_run is not None or args.checkpoint is not None:
        cfg, checkpoint, changed = resumed(args.task, overrides(args), args.load_run, args.checkpoint)
    else:
        cfg = task_config(args.task, overrides(args), on_cpu)
    teacher = teacher_of(cfg, checkpoint, args)
    resolve_physics(cfg.sim.physics, device, cfg.origins.where("sim.physics"))
    check_tracker(cfg)
    check_rewards(task_class(cfg.task), cfg)
    if args.show:
        print(to_yaml(cfg), end="")
        print(*summary(cfg), sep="\n")
        return 0
    if checkpoint and not args.transfer:
        print(f"going on with the settings of {relative(checkpoint.parent)}" + "".join(f"; {text}" for text in changed))
    settle_on(device)
    first = Ranks.now().first
    with contextlib.ExitStack() as stack:
        neighbours = stack.enter_context(Neighbours(_name_of(device))) if first else None
        if not first:
            stack.enter_context(contextlib.redirect_stdout(stack.enter_context(open(os.devnull, "w"))))
        check_reachable(Ranks.now())
        if first:
            ready_to_write(experiment_folder(cfg), ROOM_MB)
        print(describe(cfg, device), flush=True)
        task = make_task(cfg if teacher is None else with_teacher(cfg, teacher), device, graph=not args.no_graph)
        with Display(cfg.task) if first else contextlib.nullcontext() as display:
            runner = _runner(task, teacher, rl_device, display)
            if checkpoint and args.transfer:
                print(runner.transfer(str(checkpoint)), flush=True)
            elif checkpoint:
                why = runner.resume(str(checkpoint))
                how = f"all robots begin anew: {why}" if why else "robots and random numbers go on where they were"
                after = f"after iteration {runner.current_learning_iteration}"
                print(f"resumed {relative(checkpoint)} {after}; {how}", flush=True)
            training = _Training(args, cfg, device, runner, None if args.transfer else checkpoint)
            if cfg.train.runner.evaluate_interval:
                runner.evaluate_with(training.evaluations() if first else None)
            if prepared is not None:
                prepared(runner)
            runner.logger.neighbours = neighbours
            training.ready_s = time.perf_counter()
            with stopping_on_signals(runner.stop) as stopped_by, quiet_writers():
                try:
                    folder, finished = training.learn(display)
                except RankLost as lost:
                    print(lost, file=sys.stderr, flush=True)
                    return EXIT_FAILED
                except KeyboardInterrupt:
                    if not stopped_by:
                        raise
                    print("interrupted", file=sys.stderr, flush=True)
                    return 128 + stopped_by[-1]
        if folder:
            training.close(folder, finished)
    if finished:
        return 0
    # Even without a signal to this process, a training stops if its output is lost or if another process gets a signal.
    return 128 + stopped_by[0] if stopped_by else EXIT_FAILED if first else 128 + signal.SIGTERM


def _runner(task: BaseTask, teacher: Teacher | None, rl_device: torch.device, display: Display | None) -> Runner:
    """Build the training loop, and print facts about the engine, the robot and the teacher."""
    physics = task.physics
    if physics.why_c_engine:
        print(f"engine: C MuJoCo, which is faster here than mujoco-warp; reason: {physics.why_c_engine}", flush=True)
    if physics.why_library:
        print(f"part of the step uses mujoco-warp's own launches: {physics.why_library}", flush=True)
    for line in task.robot.adaptations if physics.robot_state is not None else ():
        print(f"{task.robot.file.model}: {line}", flush=True)
    if teacher is not None:
        print(f"teacher: {teacher.told()}", flush=True)
        return StudentRunner(task, teacher, None, str(rl_device), display)
    kind = CapturedRunner if task.cfg.train.runner.loop == "captured" else Runner
    return kind(task, None, str(rl_device), display)


def teacher_of(cfg: TaskConfig, checkpoint: Path | None, args: argparse.Namespace) -> Teacher | None:
    """Return the teacher of a task's student, or None if the task learns from rewards. The teacher of a
    resumed training is in its `checkpoint`. The configuration names the teacher of a new training.

    Raises:
        ConfigError: the teacher is missing or does not fit, or --teacher is given but the task learns from rewards.
    """
    if not learns_from_teacher(cfg):
        if args.teacher is not None:
            learns = "set train.algorithm.class_name=Distillation to change that"
            raise ConfigError(f"--teacher: '{cfg.task}' learns from rewards, not from a teacher; {learns}")
        return None
    return find_teacher(cfg) if checkpoint is None else teacher_in(checkpoint, read_checkpoint(checkpoint))


@dataclass
class _Training:
    """The part of a training that one process runs. Only the first process has a run folder and a display."""

    args: argparse.Namespace
    cfg: TaskConfig
    device: torch.device
    runner: Runner
    resumed_from: Path | None
    """Checkpoint of the training that is continued."""
    ready_s: float = 0.0
    """Time at which everything was built, on the clock of `time.perf_counter` [s]."""

    def evaluations(self) -> Evaluations:
        """Return the evaluations of the policy during the training. A resumed training adds to the earlier evaluations."""
        evaluations = Evaluations(self.runner.env.cfg, TrainingEvaluation(self.runner.env))
        if self.resumed_from is not None:
            evaluations.go_on_from(self.resumed_from)
        return evaluations

    def learn(self, display: Display | None) -> tuple[Path | None, bool]:
        """Train, and write to a new run folder. Return the folder, and True if the training reached its end. All processes
        but the first return None as the folder.

        A training that fails before its first checkpoint leaves no folder. A training that fails later writes the error and
        the times of the training into the folder.

        Raises:
            RunError: the folder can't be written.
        """
        runner, args, cfg = self.runner, self.args, self.cfg
        if display is None:
            return None, runner.train(cfg.train.runner.max_iterations)
        folder = create_run(cfg)
        given = Invocation(args.task_file or args.task, args.module, dict(overrides(args)))
        write_invocation(folder, given, self.resumed_from.parent if self.resumed_from is not None else None)
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
                said = "" if isinstance(error, KeyboardInterrupt) else f"{type(error).__name__}: {error}"
                # RunError: the disk is full. RuntimeError: the CUDA device is broken, so its name can't be read.
                with contextlib.suppress(RunError, RuntimeError):
                    write_timing(folder, self.timing(False, " ".join(said.split())[:500]))
                    self._report(folder, film=False)
            full = full_disk_in(error)
            if full is not None and not isinstance(error, RunError):  # errors of TensorBoard's writer do not state the file
                raise RunError(f"{relative(folder)}: {reason(full)}") from error
            raise

    def timing(self, finished: bool, error: str = "") -> Timing:
        """Return the times of the training and its number of steps."""
        runner, logger, now_s = self.runner, self.runner.logger, time.perf_counter()
        if logger.neighbours is not None:
            logger.neighbours.look()
        return Timing(
            task=runner.env.cfg.task,
            finished=finished,
            robots=runner.env.num_envs * Ranks.now().count,
            iterations=logger.tot_timesteps // logger.steps_per_iteration,
            resumed=self.resumed_from is not None,
            steps=logger.tot_timesteps,
            start_up_s=self.ready_s - self.args.start_s,
            loop_s=logger.loop_s,
            wall_s=now_s - self.args.start_s,
            device=torch.cuda.get_device_name(self.device) if self.device.type == "cuda" else "cpu",
            kernels_compiled=runner.env.physics.compiled,
            beside=logger.neighbours.most if logger.neighbours is not None else 0,
            error=error,
            evaluation_s=runner.evaluations.spent_s if runner.evaluations is not None else 0.0,
        )

    def close(self, folder: Path, finished: bool) -> None:
        """Print a summary of the training, write its times into the run folder, and have its report written."""
        runner, timing = self.runner, self.timing(finished)
        if runner.evaluations is not None:
            print(*runner.evaluations.summary(timing.loop_s), sep="\n")
        print(
            f"{'finished' if finished else 'stopped'} after {runner.current_learning_iteration + 1} iterations: "
            f"{timing.steps:,} steps in {timing.loop_s:.1f} s of training loop ({timing.steps_per_s:,.0f} steps/s"
            f"{timing.company}), {timing.start_up_s:.1f} s of start-up (with imports and kernel compilation), "
            f"{timing.wall_s:.1f} s in all\n"
            f"checkpoint in {relative(folder)}; see it walk: {play_command(self.args, self.cfg, folder)}",
            flush=True,
        )
        write_timing(folder, timing)
        self._report(folder, film=finished)
        runner.logger.hand_over(runner.current_learning_iteration)

    def _report(self, folder: Path, film: bool) -> None:
        runner = self.cfg.train.runner
        if runner.report:
            start_report(folder, [*["--film"] * (film and runner.film), *given_import(self.args)])


def describe(cfg: TaskConfig, device: torch.device) -> str:
    """Return one line about the task, the number of iterations and the device."""

    def counted(count: int, noun: str) -> str:
        return f"{count} {noun}{'s' if count != 1 else ''}"

    if device.type == "cpu":
        cores = counted(cfg.sim.threads or available_cores(), "core")
        engines = {"mujoco_warp": f"mujoco-warp on {cores}", "mujoco": f"C MuJoCo on {cores}"}
        name = engine_name(cfg.sim, device, num_envs=cfg.env.num_envs)
        engine = engines.get(name, f"Newton's {cfg.sim.solver} solver on the CPU")
        where = f"no GPU in use: {engine}"
        if any(source.endswith(": cpu") for source in cfg.origins.values()):
            where += ", settings of the task's cpu section"
    else:
        where = torch.cuda.get_device_name(device)
    share = f" on each of {Ranks.now().count} processes" if Ranks.now().several else ""
    iterations = counted(cfg.train.runner.max_iterations, "iteration")
    return f"{cfg.task}: {counted(cfg.env.num_envs, 'robot')}{share}, {iterations}, {where}"


def play_command(args: argparse.Namespace, cfg: TaskConfig, folder: Path) -> str:
    """Return the command that shows the policy of a run, ready to paste into the shell that started this process."""
    newest = False
    if not cfg.train.runner.experiment_name:
        with contextlib.suppress(ConfigError, OSError):
            newest = find_run(cfg, None) == folder  # another training of this task may have begun later
    if not newest:
        return shlex.join([*program("play"), *given_import(args), relative(folder)])
    module = ["--import", args.module] if args.module else []
    return shlex.join([*program("play"), *module, args.task_file or args.task])


def _name_of(device: torch.device) -> str:
    """Return a device name that is unique on this machine."""
    return f"gpu-{torch.cuda.get_device_properties(device).uuid}" if device.type == "cuda" else "cpu"
