"""`legged benchmark`: times of control steps, of training iterations and of a start."""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import torch

from legged.benchmarks import (
    LOOPS,
    device_name,
    kernel_table,
    kernel_times,
    loops_of,
    report,
    synchronize,
    time_iterations,
    time_steps,
)
from legged.commandline.arguments import add_task_arguments, overrides, pick_device, register_given, settle_on
from legged.commandline.command import EXIT_WRONG_INPUT, LACKS_MEMORY, sub_command
from legged.config import LeggedConfig, TaskConfig, override
from legged.config.networks import learns_from_teacher
from legged.errors import ConfigError, RunError
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.teacher import find_teacher, with_teacher
from legged.physics import resolve_physics
from legged.policies.actor import Actor
from legged.policies.restore import policy_of
from legged.process.command_parser import CommandParser
from legged.process.paths import make_folder, ready_to_write, relative, write_text
from legged.process.startup import STAGES_FILE
from legged.registry import make_task, task_config

RESULT = "benchmark.json"
KERNEL_STEPS = 20
"""Number of control steps whose kernels --kernels times."""
GROUNDS: dict[str, list[tuple[str, Any]]] = {
    "plane": [("terrain.mesh_type", "plane")],
    "terrain, our collider": [("sim.terrain_collider", "cells")],
    # The general collider needs room for its candidate pairs and for more contacts.
    "terrain, general collider": [("sim.terrain_collider", "convex"), ("sim.nconmax", 64), ("sim.njmax", 256)],
}
KILLED = -9
"""Exit code of a process that Linux ended because memory ran out."""
NO_ROOM = "out of memory"
"""Result of a size that does not fit into memory."""
COLUMNS: tuple[tuple[str, int, Callable[[dict[str, Any]], str]], ...] = (
    ("robots", 12, lambda row: f"{row['num_envs']:,}"),
    ("control step", 14, lambda row: f"{row['control_step_ms']:.2f} ms"),
    ("steps/s", 13, lambda row: f"{row['env_steps_per_s']:,.0f}"),
    ("iteration", 13, lambda row: f"{row['iteration_ms']:.1f} ms" if "iteration_ms" in row else "-"),
    ("training steps/s", 18, lambda row: f"{row['robot_steps_per_s']:,.0f}" if "robot_steps_per_s" in row else "-"),
    ("GPU memory", 12, lambda row: f"{row['gpu_memory_gib']:.1f} GiB" if "gpu_memory_gib" in row else "-"),
)
"""Columns of the table: heading, width, text."""
ENDS = "first iteration"
CAPTURES = ("step captured", "training captured")
"""Stages that end when a CUDA graph is captured, or on the CPU when the step is checked."""


def _add_arguments(parser: CommandParser) -> None:
    add_task_arguments(parser)
    parser.add_argument(
        "--repeats", type=int, default=5, help="number of measurements; the result is their median; 5 by default"
    )
    parser.add_argument("--out", type=Path, help=f"folder for {RESULT}; without it nothing is written")


def _add_steps(parser: CommandParser) -> None:
    _add_arguments(parser)
    parser.add_argument("--steps", type=int, default=200, help="control steps a measurement; 200 by default")


def _add_step_arguments(parser: CommandParser) -> None:
    """Add the options that choose the timed steps and iterations."""
    _add_steps(parser)
    parser.add_argument("--iterations", type=int, help="of each training loop; 20 by default, 3 on the CPU, 0 for none")
    parser.add_argument("--runner", choices=list(LOOPS), help="time this training loop only (train.runner.loop)")
    parser.add_argument("--policy", metavar="POLICY", help="policy that moves the robots; random actions without it")


def _settle(args: argparse.Namespace) -> tuple[TaskConfig, torch.device]:
    """Check the arguments that commands share; return the configuration and the device."""
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


def _measure(
    cfg: TaskConfig, device: torch.device, args: argparse.Namespace, policy: Path | None = None
) -> tuple[Any, dict[str, Any]]:
    """Build a task and time its steps, under a checkpoint's policy or random actions; return the task and the figures."""
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


def _add_memory(result: dict[str, Any], device: torch.device) -> None:
    """Add the GPU memory in use to a result."""
    if device.type == "cuda":
        free, whole = torch.cuda.mem_get_info(device)
        result["gpu_memory_gib"] = (whole - free) / 2**30


def without(given: Sequence[str], *flags: str) -> list[str]:
    """Return a command line without some options and their values."""
    own = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for flag in flags:
        own.add_argument(flag)
    return own.parse_known_args(list(given))[1]


def _last_line(text: str, code: int) -> str:
    """Return the last line of a process's error output, its reason to end with `code`."""
    return (text.strip().splitlines() or [f"exit code {code}"])[-1].removeprefix("error: ")


def _write(args: argparse.Namespace, result: Any) -> None:
    """Write a result into the folder of --out, if one was given."""
    if args.out is not None:
        make_folder(args.out)
        write_text(args.out / RESULT, json.dumps(result, indent=1))


def _add_kernels(parser: CommandParser) -> None:
    _add_step_arguments(parser)
    parser.add_argument("--kernels", type=int, metavar="COUNT", help="also list this many kernels that take longest (GPU)")


@sub_command(
    "legged benchmark step anymal_c_flat --runner captured --out times",
    "legged benchmark step go2 --num-envs 8192 --policy go2",
    add=_add_kernels,
)
def step(args: argparse.Namespace) -> int:
    """Time a control step, the physics in it, and training iterations: `legged benchmark step anymal_c_flat`.

    Random actions move the robots, or a policy with `--policy`. Robots that flail under random actions need more solver
    rounds where their physics is randomised or has dry friction. On a GPU the timed steps run under torch's sync debug mode
    "error", which raises at any synchronisation with the host.
    """
    cfg, device = _settle(args)
    if args.kernels is not None and device.type != "cuda":
        raise ConfigError(f"--kernels: needs a GPU, and the task is on {device}")
    if args.kernels is not None and args.policy is not None:
        raise ConfigError("--kernels: lists what is launched under random actions; leave it or --policy out")
    settle_on(device)
    count = args.iterations if args.iterations is not None else (3 if device.type == "cpu" else 20)
    policy = None
    if args.policy is not None:
        policy = policy_of(args.policy, where="--policy").checkpoint
        check_fits(policy, read_checkpoint(policy), cfg)
    teacher = find_teacher(cfg) if learns_from_teacher(cfg) and count > 0 else None
    task, result = _measure(cfg if teacher is None else with_teacher(cfg, teacher), device, args, policy)
    if args.kernels is not None:
        result["kernels"] = kernel_times(task, KERNEL_STEPS)
        print(kernel_table(result["kernels"], args.kernels), flush=True)
    if count > 0:
        loops = loops_of(task.cfg, teacher, args.runner)
        result["iterations"] = {loop: time_iterations(kind, task, count) for loop, kind in loops.items()}
    _add_memory(result, device)
    print(report(task, result), flush=True)
    _write(args, result)
    return 0


def _add_robots(parser: CommandParser) -> None:
    _add_step_arguments(parser)
    parser.add_argument("--robots", required=True, help="numbers of robots, e.g. 1024,4096,16384")


@sub_command(
    "legged benchmark scale anymal_c --robots 1024,4096,16384",
    "legged benchmark scale go2_flat --robots 256,1024 --iterations 0 --out times",
    add=_add_robots,
)
def scale(args: argparse.Namespace) -> int:
    """Measure speed and memory against the number of robots: `legged benchmark scale anymal_c --robots 1024,4096,16384`.

    Each number is measured as by `legged benchmark step`, in a process of its own, so that each has the memory to itself.
    """
    sizes = [part.strip().replace("_", "") for part in args.robots.split(",")]
    if not all(size.isdecimal() and int(size) > 0 for size in sizes):
        raise ConfigError(f"--robots: '{args.robots}' is not a list of numbers of robots, like 1024,4096,16384")
    if args.num_envs is not None:
        raise ConfigError("--num-envs: --robots names all numbers of robots; leave it out")
    cfg, device = _settle(args)
    loop = args.runner or cfg.train.runner.loop
    given = without(args.words, "--robots", "--out", "--num-envs", "--runner")
    result = {"task": cfg.task, "device": device_name(device), "loop": loop}
    print(f"{cfg.task}, {result['device']}, {loop} training", flush=True)
    print("".join(f"{name:>{width}}" for name, width, _ in COLUMNS), flush=True)
    rows = []
    for size in sizes:
        rows.append(_measure_apart(given, int(size), loop))
        failed = rows[-1].get("failed")
        shown = COLUMNS if failed is None else COLUMNS[:1]
        line = "".join(f"{text(rows[-1]):>{width}}" for _, width, text in shown)
        print(line if failed is None else f"{line}  {failed}", flush=True)
    _write(args, result | {"sizes": rows})
    return int(any(row.get("failed", NO_ROOM) != NO_ROOM for row in rows))


def _measure_apart(arguments: Sequence[str], size: int, loop: str) -> dict[str, Any]:
    """Return the benchmark's results for `size` robots with these arguments; `failed` has the reason if they are missing.
    ConfigError: the configuration does not allow so many robots.
    """
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "legged", "benchmark", "step", *arguments]
        words += ["--num-envs", str(size), "--runner", loop, "--out", folder]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode == EXIT_WRONG_INPUT:
            raise ConfigError(_last_line(done.stderr, done.returncode))
        if done.returncode == KILLED or (done.returncode and LACKS_MEMORY.search(done.stderr)):
            return {"num_envs": size, "failed": NO_ROOM}
        if done.returncode:
            print(done.stderr, file=sys.stderr)
            return {"num_envs": size, "failed": _last_line(done.stderr, done.returncode)}
        result = json.loads((Path(folder) / RESULT).read_text(encoding="utf-8"))
    iterations = result.pop("iterations", {}).get(loop, {})
    return {**result, **iterations}


@sub_command(
    "legged benchmark ground anymal_c",
    "legged benchmark ground go2 --num-envs 2048 --out times",
    add=_add_steps,
)
def ground(args: argparse.Namespace) -> int:
    """Measure speed on different ground: `legged benchmark ground anymal_c`.

    The task is timed on a plane, on its terrain with this package's collider, and on its terrain with mujoco-warp's general
    one.
    """
    cfg, device = _settle(args)
    where = cfg.origins.where("sim.physics")
    if resolve_physics(cfg.sim.physics, device, where, cfg.env.num_envs) != "mujoco_warp":
        raise ConfigError(f"{where}: colliders of mujoco_warp are compared; add sim.physics=mujoco_warp")
    if not isinstance(cfg, LeggedConfig) or cfg.terrain.mesh_type == "plane":
        raise ConfigError(f"TASK: '{cfg.task}' has no terrain")
    settle_on(device)
    results = {}
    for name, changes in GROUNDS.items():
        task, results[name] = _measure(override(cfg, changes), device, args)
        _add_memory(results[name], device)
        print(f"{name}: {report(task, results[name])}", flush=True)
    _write(args, results)
    return 0


@sub_command(
    "legged benchmark startup anymal_c_flat",
    "legged benchmark startup go2 --repeats 3 --out times",
    add=_add_arguments,
)
def startup(args: argparse.Namespace) -> int:
    """Time a training until it begins: `legged benchmark startup anymal_c_flat`.

    A training is started in a process of its own and ended after its first iteration. The seconds at which each stage of the
    start ended are printed, next to those that `import torch` alone takes.
    """
    _settle(args)
    times = _time_start(args.words, args.repeats)
    print(f"import torch: {times['torch_s']:.2f} s\na training, seconds since its process was started:")
    print(*(f"  {seconds:7.2f}  {name}" for name, seconds in times["stages"].items()), sep="\n")
    print(
        f"to the first iteration: {times['ratio']:.2f} x import torch; less {times['capture_s']:.2f} s of capturing graphs:"
        f" {times['ratio_without_capture']:.2f} x",
        flush=True,
    )
    _write(args, times)
    return 0


def _time_start(given: Sequence[str], repeats: int) -> dict[str, Any]:
    """Return medians of `repeats` runs, after one run that fills caches: `torch_s`, the time of `import torch`; `stages`, the
    end of each stage of a training with the arguments `given`, since the start of its process; `capture_s`; the `ratio` of
    the end of the first iteration to `torch_s`; and `ratio_without_capture`. Times are in seconds.
    """
    training = ["-m", "legged", "train", *without(given, "--out", "--repeats"), "--max-iterations", "1"]
    runs = [(_run("-c", "import torch"), _run(*training, "train.runner.film=false")) for _ in range(repeats + 1)][1:]
    torch_s = median(alone["end"] for alone, _ in runs)
    stages = {name: median(stages[name] for _, stages in runs) for name in runs[0][1]}
    names = list(stages)
    capture_s = sum(stages[name] - stages[names[names.index(name) - 1]] for name in CAPTURES if name in stages)
    return {
        "torch_s": torch_s,
        "stages": stages,
        "capture_s": capture_s,
        "ratio": stages[ENDS] / torch_s,
        "ratio_without_capture": (stages[ENDS] - capture_s) / torch_s,
    }


def _run(*arguments: str) -> dict[str, float]:
    """Run Python in an empty folder; return the end of each stage of a start, and of the process as `end` [s]."""
    with tempfile.TemporaryDirectory() as folder, tempfile.NamedTemporaryFile("r", encoding="utf-8") as file:
        # Where this package is not installed, the process finds it as this one did, and so user-defined modules.
        path = os.pathsep.join(str(Path(entry or ".").resolve()) for entry in sys.path)
        environment = os.environ | {"PYTHONPATH": path, STAGES_FILE: file.name}
        start = time.time()
        done = subprocess.run(
            [sys.executable, *arguments], capture_output=True, text=True, check=False, cwd=folder, env=environment
        )
        end = time.time()
        lines = file.read().splitlines()
    if done.returncode:
        raise RunError(f"startup: {_last_line(done.stderr, done.returncode)}")
    return {name: float(when) - start for when, name in (line.split(" ", 1) for line in lines)} | {"end": end - start}
