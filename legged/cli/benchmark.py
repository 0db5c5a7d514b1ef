"""`legged benchmark`: times of control steps, of training iterations and of the start of a training."""

import argparse
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from statistics import median
from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.commandline.arguments import TASK, overrides, pick_device, register_given, settle_on
from legged.commandline.command import EXIT_WRONG_INPUT, LACKS_MEMORY, sub_command
from legged.config import TaskConfig, has_robot, override
from legged.config.networks import learns_from_teacher
from legged.deploy.command_parser import argument, check_number
from legged.envs import BaseTask
from legged.errors import ConfigError, RunError
from legged.evaluation.result_file import write_result
from legged.graph.step_graph import StepGraph
from legged.learning.captured import CapturedRunner
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.display import Progress
from legged.learning.runner import Runner
from legged.learning.student_runner import StudentRunner
from legged.learning.teacher import Teacher, find_teacher, with_teacher
from legged.physics import resolve_physics
from legged.policies.actor import Actor
from legged.policies.restore import policy_of
from legged.process.paths import ready_to_write, relative
from legged.process.startup import STAGES_FILE
from legged.registry import make_task, task_config

RESULT = "benchmark.json"
KERNEL_STEPS = 20
"""Number of control steps that --kernels measures."""
GROUNDS: dict[str, list[tuple[str, Any]]] = {
    "plane": [("terrain.mesh_type", "plane")],
    "terrain, our collider": [("sim.terrain_collider", "cells")],
    # mujoco-warp's general collider needs more memory: it stores pairs of shapes that may touch, and finds more contacts.
    "terrain, general collider": [("sim.terrain_collider", "convex"), ("sim.nconmax", 64), ("sim.njmax", 256)],
}
KILLED = -9
"""Exit code of a process that Linux ended because memory ran out."""
NO_ROOM = "out of memory"
"""Text in the result if the robots do not fit into memory."""
COLUMNS: tuple[tuple[str, int, Callable[[dict[str, Any]], str]], ...] = (
    ("robots", 12, lambda row: f"{row['num_envs']:,}"),
    ("control step", 14, lambda row: f"{row['control_step_ms']:.2f} ms"),
    ("steps/s", 13, lambda row: f"{row['env_steps_per_s']:,.0f}"),
    ("iteration", 13, lambda row: f"{row['iteration_ms']:.1f} ms" if "iteration_ms" in row else "-"),
    ("training steps/s", 18, lambda row: f"{row['robot_steps_per_s']:,.0f}" if "robot_steps_per_s" in row else "-"),
    ("GPU memory", 12, lambda row: f"{row['gpu_memory_gib']:.1f} GiB" if "gpu_memory_gib" in row else "-"),
)
"""Columns of the table of `legged benchmark scale`: heading, width in characters, function that formats a row's value."""
ENDS = "first iteration"
CAPTURES = ("step captured", "training captured")
"""Stages of a training's start that capture a CUDA graph. On the CPU, they only check that a capture is possible."""
Turn = tuple[Callable[[], object], Callable[[], object]]
"""Two functions: a preparation, which is not timed, and then the function that is timed."""
LOOPS: dict[str, Callable[..., Runner]] = {"stock": Runner, "captured": CapturedRunner}
"""Training loops by name."""


MEASURED = (
    *TASK,
    argument("--repeats", type=int, default=5, help="number of measurements, whose median is the result; 5 by default"),
    argument("--out", type=Path, help=f"folder for {RESULT}; no file is written by default"),
)
"""Arguments of all benchmarks."""
STEPS = (
    *MEASURED,
    argument("--steps", type=int, default=200, help="control steps of each measurement; 200 by default"),
)
"""Arguments of benchmarks of control steps."""
ITERATIONS = (
    *STEPS,
    argument("--iterations", type=int, help="training iterations of each loop, 0 for none; 20 by default, 3 on the CPU"),
    argument("--runner", choices=list(LOOPS), help="time only this training loop, one of the values of train.runner.loop"),
    argument("--policy", metavar="POLICY", help="policy that moves the robots; random actions by default"),
)
"""Arguments of benchmarks of control steps and training iterations."""


def _settle(args: argparse.Namespace) -> tuple[TaskConfig, torch.device]:
    """Check the arguments of a benchmark; return the configuration and the device."""
    register_given(args, "task")
    device = pick_device(args.sim_device)
    cfg = task_config(args.task, overrides(args), on_cpu=device.type == "cpu")
    for name, least in (("steps", 1), ("repeats", 1), ("iterations", 0), ("kernels", 1)):
        check_number(f"--{name}", getattr(args, name, None), least)
    if args.out is not None:
        ready_to_write(args.out)
    return cfg, device


def _measure(
    cfg: TaskConfig, device: torch.device, args: argparse.Namespace, policy: Path | None = None
) -> tuple[Any, dict[str, Any]]:
    """Build a task and time its steps; return task and results. `policy` is a checkpoint; by default actions are random."""
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
    if device.type == "cuda":
        free, whole = torch.cuda.mem_get_info(device)
        result["gpu_memory_gib"] = (whole - free) / 2**30


def without(given: Sequence[str], *flags: str) -> list[str]:
    """Return the arguments `given` without the options `flags` and their values."""
    own = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for flag in flags:
        own.add_argument(flag)
    return own.parse_known_args(list(given))[1]


def _last_line(text: str, code: int) -> str:
    """Return the last line of a process's error output; if it printed nothing, return the exit code `code` as text."""
    return (text.strip().splitlines() or [f"exit code {code}"])[-1].removeprefix("error: ")


def _write(args: argparse.Namespace, result: Any) -> None:
    if args.out is not None:
        write_result(args.out / RESULT, result)


@sub_command(
    "legged benchmark step anymal_c_flat --runner captured --out times",
    "legged benchmark step go2 --num-envs 8192 --policy go2",
    arguments=(
        *ITERATIONS,
        argument("--kernels", type=int, metavar="COUNT", help="also list the COUNT slowest kernels; needs a GPU"),
    ),
)
def step(args: argparse.Namespace) -> int:
    """Time a control step, the physics in it, and training iterations: `legged benchmark step anymal_c_flat`.

    By default random actions move the robots; with `--policy` a policy moves them. If the physics is randomised or has dry
    friction, the solver needs more iterations under random actions than for robots that walk. On a GPU, torch raises an error
    if a timed step synchronises with the host.
    """
    cfg, device = _settle(args)
    if args.kernels is not None and device.type != "cuda":
        raise ConfigError(f"--kernels: needs a GPU, but the task is on {device}")
    if args.kernels is not None and args.policy is not None:
        raise ConfigError("--kernels: works only with random actions; leave out either --kernels or --policy")
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


@sub_command(
    "legged benchmark scale anymal_c --robots 1024,4096,16384",
    "legged benchmark scale go2_flat --robots 256,1024 --iterations 0 --out times",
    arguments=(*ITERATIONS, argument("--robots", required=True, help="numbers of robots, e.g. 1024,4096,16384")),
)
def scale(args: argparse.Namespace) -> int:
    """Measure times and memory for several numbers of robots: `legged benchmark scale anymal_c --robots 1024,4096,16384`.

    For each number of robots a separate process runs `legged benchmark step`, so that each measurement can use all memory.
    """
    sizes = [part.strip().replace("_", "") for part in args.robots.split(",")]
    if not all(size.isdecimal() and int(size) > 0 for size in sizes):
        raise ConfigError(f"--robots: '{args.robots}' is not a list of numbers of robots, like 1024,4096,16384")
    if args.num_envs is not None:
        raise ConfigError("--num-envs: leave it out, because --robots gives the numbers of robots")
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
    """Run `legged benchmark step` for `size` robots in another process; return its results. If the process fails,
    the result `failed` is the reason. Raises ConfigError if the configuration does not allow this number of robots.
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
    arguments=STEPS,
)
def ground(args: argparse.Namespace) -> int:
    """Measure the speed of simulation on different ground: `legged benchmark ground anymal_c`.

    The task is timed on a plane, on its terrain with this package's collider, and on its terrain with mujoco-warp's general
    collider.
    """
    cfg, device = _settle(args)
    where = cfg.origins.where("sim.physics")
    if resolve_physics(cfg.sim.physics, device, where, cfg.env.num_envs) != "mujoco_warp":
        raise ConfigError(f"{where}: this command compares colliders of mujoco_warp; add sim.physics=mujoco_warp")
    if not has_robot(cfg) or cfg.terrain.mesh_type == "plane":
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
    arguments=MEASURED,
)
def startup(args: argparse.Namespace) -> int:
    """Measure how long a training takes to begin: `legged benchmark startup anymal_c_flat`.

    A training is started in a separate process and ended after its first iteration. The command prints the time at which each
    stage of the start ended, and how long `import torch` alone takes [s].
    """
    _settle(args)
    times = _time_start(args.words, args.repeats)
    print(f"import torch: {times['torch_s']:.2f} s\nstages of a training, seconds since its process was started:")
    print(*(f"  {seconds:7.2f}  {name}" for name, seconds in times["stages"].items()), sep="\n")
    print(
        f"end of the first iteration: {times['ratio']:.2f} x import torch; without the {times['capture_s']:.2f} s"
        f" for capturing graphs, {times['ratio_without_capture']:.2f} x import torch",
        flush=True,
    )
    _write(args, times)
    return 0


def _time_start(given: Sequence[str], repeats: int) -> dict[str, Any]:
    """Start `repeats` trainings with the arguments `given`, after a first one that fills the caches; return medians.
    `torch_s` is the duration of `import torch`, and `capture_s` that of capturing graphs [s]. `stages` are the times from the
    start of the process to the end of each stage [s]. `ratio` is the end of the first iteration, divided by `torch_s`.
    """
    training = ["-m", "legged", "train", *without(given, "--out", "--repeats"), "--max-iterations", "1"]
    runs = [(_run("-c", "import torch"), _run(*training, "train.runner.report=false")) for _ in range(repeats + 1)][1:]
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
    """Run Python in an empty folder; return stage -> time of its end since Python's start [s]. `end` is Python's exit."""
    with tempfile.TemporaryDirectory() as folder, tempfile.NamedTemporaryFile("r", encoding="utf-8") as file:
        # With the import path of this process, the child process finds this package and user-defined modules.
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


# ---- measurements ----------------------------------------------------------------------------------------------------


class Driver:
    """Source of the robots' actions: a policy or random numbers. The time for computing actions is not measured."""

    def __init__(self, task: BaseTask, act: Callable[[TensorDict], Tensor] | None) -> None:
        """`act` is the policy, a function from observations to actions (N, D). If it is None, actions are random."""
        self._task, self._act = task, act
        self._table = 0.3 * torch.randn(32, task.num_envs, task.num_actions, device=torch.device(task.device))
        self._made = 0
        self._kept: dict[str, Tensor] = {}
        self.actions = torch.zeros_like(self._table[0])
        """(N, D) actions of the next control step."""

    def decide(self) -> None:
        """Restore the state that `keep` stored, if any, and choose the `actions` of the next control step."""
        self.put_back()
        random = self._table[self._made % len(self._table)]
        self.actions.copy_(random if self._act is None else self._act(self._task.get_observations()))
        self._made += 1

    def keep(self) -> None:
        """If a policy acts, store the physics' state. `put_back` restores this state after the physics alone was timed."""
        if self._act is not None:
            self._kept = {name: tensor.clone() for name, tensor in self._task.physics.state_tensors().items()}

    def put_back(self) -> None:
        """Restore the state that the last `keep` has stored."""
        if self._kept:
            self._task.physics.load_state(self._kept)


@torch.inference_mode()
def time_steps(task: BaseTask, steps: int, repeats: int, act: Callable[[TensorDict], Tensor] | None = None) -> dict[str, Any]:
    """Time a task's control step, and the physics of a control step alone; return the times [ms] and other results. The
    policy `act` maps observations to actions. Without `act`, actions are random.

    Physics alone means `decimation` engine steps under the present torques. On a GPU, one CUDA graph contains these steps. If
    mujoco-warp simulates the robots, `decimation` calls of mujoco_warp.step are timed too. Each control step is followed by
    one run of the physics alone, so that states, contacts and clock rates are those of a rollout. If only the physics ran,
    all robots would soon lie on the ground.
    """
    device = torch.device(task.device)
    driver = Driver(task, act)
    for _ in range(50):  # let the robots land and reach states like those in a training
        driver.decide()
        task.step(driver.actions)
    steps_of = {"physics": task.physics.step}
    library = task.physics.library_step
    # On a CPU, compiling mujoco_warp.step takes minutes, so it is timed only if sim.physics is set to an engine.
    if library is not None and (device.type == "cuda" or task.cfg.sim.physics != "auto"):
        steps_of["library"] = library
    alone = {name: _control_period(task, step) for name, step in steps_of.items()}
    turns: list[Turn] = [(driver.decide, lambda: task.step(driver.actions))]
    turns += [(driver.put_back if k else driver.keep, run) for k, run in enumerate(alone.values())]
    results = [_time_in_turns(turns, steps, device) for _ in range(repeats)]
    driver.put_back()
    times: dict[str, Any] = {"num_envs": task.num_envs}
    for name, measured in zip(("control_step", *alone), map(sorted, zip(*results, strict=True)), strict=True):
        times |= {f"{name}_ms": median(measured), f"{name}_ms_range": [measured[0], measured[-1]]}
    return {
        **times,
        "ratio": times["control_step_ms"] / times["physics_ms"],
        "env_steps_per_s": task.num_envs / times["control_step_ms"] * 1e3,
        "captured": float(task.captured),
        "overflows": float(task.metrics.flush()["Metrics/contact_overflows"]),
    }


def _control_period(task: BaseTask, step: Callable[[], None]) -> Callable[[], None]:
    """Return a function that runs the engine steps of a control step; for a captured task, the function runs a CUDA graph."""

    def run() -> None:
        for _ in range(task.cfg.control.decimation):
            step()

    return StepGraph(run, torch.device(task.device), enabled=True) if task.captured else run


def _time_in_turns(turns: Sequence[Turn], steps: int, device: torch.device) -> list[float]:
    """Return the mean time of each timed function [ms]. On a GPU, synchronising with the host raises an error."""
    on_gpu = device.type == "cuda"

    def mark() -> Any:
        if not on_gpu:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    synchronize(device)
    spans: list[list[tuple[Any, Any]]] = [[] for _ in turns]
    try:
        if on_gpu:
            torch.cuda.set_sync_debug_mode("error")
        for _ in range(steps):
            for (prepare, function), measured in zip(turns, spans, strict=True):
                prepare()
                first = mark()
                function()
                measured.append((first, mark()))
    finally:
        if on_gpu:
            torch.cuda.set_sync_debug_mode("default")
    synchronize(device)
    times = [[a.elapsed_time(b) if on_gpu else 1e3 * (b - a) for a, b in measured] for measured in spans]
    return [sum(each) / steps for each in times]


def device_name(device: torch.device) -> str:
    """Return the name of a device for results."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"


def synchronize(device: torch.device) -> None:
    """Wait until a GPU has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def loops_of(cfg: TaskConfig, teacher: Teacher | None, asked: str | None) -> dict[str, Callable[..., Runner]]:
    """Return the training loops to time, name -> runner: the loop `asked`, or all loops if `asked` is None. Students of a
    `teacher` and policies with an estimator can use only the loop of the configuration.
    """
    own = cfg.train.runner.loop
    if teacher is not None:
        return {own: partial(StudentRunner, teacher=teacher)}
    one = own if cfg.train.policy.estimator.targets else asked
    return {one: LOOPS[one]} if one else LOOPS


def time_iterations(kind: Callable[..., Runner], task: BaseTask, count: int) -> dict[str, Any]:
    """Train new networks with the runner `kind` for `count` iterations, after a first iteration that is not timed. Return
    the medians of rollout, update and iteration times, and the range of iteration times [ms].
    """
    shown: list[Progress] = []
    display = SimpleNamespace(show=shown.append)
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()) as said:
        runner = kind(task, log_dir=Path(folder), device=str(task.device), display=display)
        runner.learn(count + 1, init_at_random_ep_len=True)
    seen = shown[1:]
    whole = sorted(1e3 * (progress.collect_s + progress.learn_s) for progress in seen)
    steps = task.cfg.train.runner.num_steps_per_env
    return {
        "rollout_ms": 1e3 * median([progress.collect_s for progress in seen]),
        "update_ms": 1e3 * median([progress.learn_s for progress in seen]),
        "iteration_ms": median(whole),
        "iteration_ms_range": [whole[0], whole[-1]],
        "steps_per_iteration": steps,
        "robot_steps_per_s": task.num_envs * steps / median(whole) * 1e3,
        "note": said.getvalue().strip(),
    }


def kernel_times(task: BaseTask, steps: int) -> list[dict[str, Any]]:
    """Return the kernels of a control step, slowest first. `launches` is the number of a kernel's launches in a control
    step, and `total_us` is the GPU time of all these launches [us]. Both are means over `steps` steps with random actions.
    """
    actions = 0.3 * torch.randn(task.num_envs, task.num_actions, device=torch.device(task.device))
    task.step(actions)
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for _ in range(steps):
            task.step(actions)
        torch.cuda.synchronize()
    seen = [e for e in profile.key_averages() if e.device_type == torch.autograd.DeviceType.CUDA]
    times = [{"name": e.key, "launches": e.count / steps, "total_us": e.device_time_total / steps} for e in seen]
    return sorted(times, key=lambda time: -time["total_us"])


def kernel_table(times: list[dict[str, Any]], longest: int) -> str:
    """Return a table as text. Its rows are the slowest kernels, at most `longest` of them, and the sum over all kernels."""
    launches, total = (sum(time[key] for time in times) for key in ("launches", "total_us"))
    whole = {"name": f"all {len(times)} kernels of a control step", "launches": launches, "total_us": total}
    rows = [f"{time['total_us']:9.1f} {time['launches']:9.1f}  {time['name'][:90]}" for time in (*times[:longest], whole)]
    return "\n".join([f"{'us':>9} {'launches':>9}  kernel", *rows])


def report(task: BaseTask, result: dict[str, Any]) -> str:
    """Return a benchmark's results as lines of text."""
    where = device_name(torch.device(task.device))
    how = "one CUDA graph, no host synchronisation in the timed steps" if task.captured else "eager"
    lines = [
        f"{task.cfg.task}, {task.num_envs} robots, {where}, {how}",
        f"  control step  {result['control_step_ms']:.3f} ms  ({result['env_steps_per_s']:,.0f} robot steps/s)",
        *([f"  robots moved by {result['policy']}"] if "policy" in result else []),
        f"  physics alone {result['physics_ms']:.3f} ms  (control step = {result['ratio']:.3f} x physics)",
        *([f"  mujoco_warp.step alone {result['library_ms']:.3f} ms"] if "library_ms" in result else []),
        *(
            [f"  part of the step uses mujoco-warp's own launches: {task.physics.why_library}"]
            if task.physics.why_library
            else []
        ),
        f"  robot steps in which contacts were lost for lack of memory: {result['overflows']:.0f}",
        f"  building the task, with compilation of kernels that were not cached: {result['build_s']:.1f} s",
    ]
    for loop, times in result.get("iterations", {}).items():
        beyond = times["iteration_ms"] - times["steps_per_iteration"] * result["physics_ms"]
        lines.append(
            f"  {loop} training: rollout {times['rollout_ms']:.1f} + update {times['update_ms']:.1f} ms = iteration"
            f" {times['iteration_ms']:.1f} ms, of which {beyond:.1f} ms are not physics ({times['robot_steps_per_s']:,.0f}"
            " robot steps/s)" + (f"; {times['note']}" if times["note"] else "")
        )
    if "gpu_memory_gib" in result:
        lines.append(f"  GPU memory in use: {result['gpu_memory_gib']:.1f} GiB")
    return "\n".join(lines)
