"""Arguments and measurements that the sub-commands of `legged benchmark` share."""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch

from legged.benchmarks.iteration_times import LOOPS, loops_of, time_iterations
from legged.benchmarks.step_times import synchronize, time_steps
from legged.commandline.arguments import add_task_arguments, overrides, pick_device, register_given
from legged.config import TaskConfig
from legged.config.networks import learns_from_teacher
from legged.errors import ConfigError
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.teacher import Teacher, find_teacher, with_teacher
from legged.policies.actor import Actor
from legged.policies.restore import policy_of
from legged.process.paths import make_folder, ready_to_write, relative, write_text
from legged.registry import make_task, task_config

RESULT = "benchmark.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the task, the number of measurements, and --out."""
    add_task_arguments(parser)
    parser.add_argument(
        "--repeats", type=int, default=5, help="number of measurements; the result is their median; 5 by default"
    )
    parser.add_argument("--out", type=Path, help=f"folder for {RESULT}; without it nothing is written")


def add_step_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose the timed steps and iterations."""
    parser.add_argument("--steps", type=int, default=200, help="control steps of a measurement; 200 by default")
    parser.add_argument(
        "--iterations", type=int, help="timed iterations of each loop; 20 by default, 3 on the CPU, 0 for none"
    )
    parser.add_argument("--runner", choices=list(LOOPS), help="time this training loop only (train.runner.loop)")
    parser.add_argument("--policy", metavar="POLICY", help="policy that moves the robots; random actions without it")


def settle(args: argparse.Namespace) -> tuple[TaskConfig, torch.device]:
    """Return the configuration and the device of a command line.

    Raises:
        ConfigError: an argument is wrong.
    """
    register_given(args, "task")
    device = pick_device(args.sim_device)
    cfg = task_config(args.task, overrides(args), on_cpu=device.type == "cpu")
    for name, least in (("steps", 1), ("repeats", 1), ("iterations", 0), ("kernels", 1)):
        value = getattr(args, name, None)
        if value is not None and value < least:
            raise ConfigError(f"--{name}: must be at least {least}, got {value}")
    if args.out is not None:
        ready_to_write(args.out)
    return cfg, device


def policy_in(args: argparse.Namespace, cfg: TaskConfig) -> Path | None:
    """Return the checkpoint of --policy, or None without --policy.

    Raises:
        ConfigError: there is no such policy, or it does not fit the task.
    """
    if args.policy is None:
        return None
    path = policy_of(args.policy, where="--policy").checkpoint
    check_fits(path, read_checkpoint(path), cfg)
    return path


def taught(cfg: TaskConfig, iterations: int) -> tuple[TaskConfig, Teacher | None]:
    """Return a configuration with the teacher that training iterations need, and the teacher."""
    teacher = find_teacher(cfg) if learns_from_teacher(cfg) and iterations > 0 else None
    return (cfg if teacher is None else with_teacher(cfg, teacher)), teacher


def measure(
    cfg: TaskConfig, device: torch.device, args: argparse.Namespace, policy: Path | None
) -> tuple[Any, dict[str, Any]]:
    """Build a task and time its steps; return the task and the figures."""
    start = time.perf_counter()
    task = make_task(cfg, device, graph=not args.no_graph)
    synchronize(device)
    build_s = time.perf_counter() - start
    actor = None
    if policy is not None:
        actor = Actor(task, device)
        actor.load(policy)
    result = {**time_steps(task, args.steps, args.repeats, actor), "build_s": build_s}
    return task, result if policy is None else {**result, "policy": relative(policy)}


def add_memory(result: dict[str, Any], device: torch.device) -> None:
    """Add the GPU memory in use to a result."""
    if device.type == "cuda":
        free, whole = torch.cuda.mem_get_info(device)
        result["gpu_memory_gib"] = (whole - free) / 2**30


def time_loops(task: Any, cfg: TaskConfig, teacher: Teacher | None, only: str | None, count: int) -> dict[str, Any]:
    """Return the times of `count` iterations of each training loop, or of `only` one."""
    return {loop: time_iterations(kind, task, count) for loop, kind in loops_of(cfg, teacher, only).items()}


def write(args: argparse.Namespace, result: Any) -> None:
    """Write a result into the folder of --out, if one was given."""
    if args.out is not None:
        make_folder(args.out)
        write_text(args.out / RESULT, json.dumps(result, indent=1))
