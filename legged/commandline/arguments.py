"""Command-line arguments that train, play and evaluate share, and how they become a configuration."""

import argparse
import shlex
from pathlib import Path
from typing import Any

import torch

from legged.commandline.parser import add_import_argument
from legged.config import parse_override
from legged.errors import ConfigError
from legged.process.paths import relative
from legged.process.ranks import Ranks
from legged.registry import YAML_ENDINGS, import_tasks, register_file


def add_task_arguments(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Add --task, which a run may name as well unless it is `required`, --import, engine and devices, and free `key=value`
    overrides.
    """
    parser.add_argument("--task", required=required, help="name of the task, e.g. anymal_c_flat, or a YAML file")
    add_import_argument(parser)
    parser.add_argument("--num_envs", type=int, help="number of robots (env.num_envs)")
    parser.add_argument("--seed", type=int, help="random seed (env.seed)")
    parser.add_argument("--physics", metavar="ENGINE", help="mujoco_warp, mujoco or newton; that of the device by default")
    parser.add_argument("--solver", metavar="NAME", help="solver of newton (sim.solver), e.g. xpbd; mujoco by default")
    parser.add_argument("--sim_device", help="cpu or cuda[:i]; the GPU if there is one")
    parser.add_argument("--no-graph", action="store_true", help="run the step eagerly instead of as one CUDA graph")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="any field, e.g. rewards.scales.torques=-1e-4")


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say which policy to load."""
    parser.add_argument("--experiment_name", help="folder under logs/; the task's name by default")
    parser.add_argument("--load_run", help="run folder, by name or path; the newest by default")
    parser.add_argument("--checkpoint", type=_iteration, help="iteration of the checkpoint, or best; the latest by default")


def _iteration(text: str) -> int | str:
    """Read the iteration of a checkpoint, or `best`; argparse says what is wrong with anything else."""
    if text == "best":
        return text
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"invalid value: '{text}' (an iteration, or best)") from None


def overrides(args: argparse.Namespace) -> list[tuple[str, Any]]:
    """Return all overrides of a command line; flags come after `key=value`s.

    Raises:
        ConfigError: not of the form `key=value`, or --solver without the engine whose it is.
    """
    flags = {
        "num_envs": "env.num_envs",
        "seed": "env.seed",
        "max_iterations": "train.runner.max_iterations",
        "experiment_name": "train.runner.experiment_name",
        "run_name": "train.runner.run_name",
        "runner": "train.runner.loop",
        "teacher": "train.distillation.teacher",
        "physics": "sim.physics",
        "solver": "sim.solver",
    }
    found = [parse_override(text) for text in args.overrides]
    for flag, key in flags.items():
        value = getattr(args, flag, None)
        if value is not None:
            found.append((key, value))
    engine = dict(found).get("sim.physics")
    if args.solver is not None and engine != "newton":
        raise ConfigError(f"--solver: '{args.solver}' would be a solver of newton; add --physics newton (got {engine})")
    return found


def policy_overrides(args: argparse.Namespace) -> list[tuple[str, Any]]:
    """Return all overrides but the experiment name, which says what run a policy is of.

    Raises:
        ConfigError: as `overrides`.
    """
    return [change for change in overrides(args) if change[0] != "train.runner.experiment_name"]


def pick_device(name: str | None, flag: str = "--sim_device") -> torch.device:
    """Return the device that was asked for, else the GPU if there is one; under torchrun the GPU of this process's number.

    Raises:
        ConfigError: no such device, no GPU here, or under torchrun another one than its own.
    """
    ranks = Ranks.now()
    own = f"cuda:{ranks.local_rank}"
    if name is None:
        if not torch.cuda.is_available():
            return torch.device("cpu")
        name = own
    if ranks.several and name not in ("cpu", "cuda", own):
        raise ConfigError(f"{flag}: '{name}' is one device for {ranks.count} processes; leave it out, and each gets its own")
    if ranks.several and name == own and ranks.local_rank >= torch.cuda.device_count():
        have = torch.cuda.device_count()
        raise ConfigError(
            f"{ranks.local_count} processes want a GPU each, but torch sees {have} here; --nproc-per-node {have}"
        )
    if ranks.several and name == "cuda":
        name = own
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"{flag}: '{name}' is not a device (allowed: cpu, cuda, cuda:0, ...)") from error
    if device.type not in ("cpu", "cuda"):
        raise ConfigError(f"{flag}: '{name}' is not supported (allowed: cpu, cuda, cuda:0, ...)")
    if device.type == "cuda":
        if not torch.cuda.is_available():
            raise ConfigError(f"{flag}: '{name}' was asked for, but torch sees no GPU here; leave it out to use the CPU")
        if (device.index or 0) >= torch.cuda.device_count():
            raise ConfigError(f"{flag}: '{name}': this machine has {torch.cuda.device_count()} GPU(s), counted from 0")
        return torch.device("cuda", device.index or 0)
    return device


def settle_on(device: torch.device) -> None:
    """Set torch up for a command that runs on `device`."""
    if device.type == "cpu":
        # The C engine takes the cores; torch's small tensors are slower when its own threads compete for them.
        torch.set_num_threads(1)
    else:
        torch.cuda.set_device(device)  # what names no device must not end up on the first GPU


def register_given(args: argparse.Namespace) -> None:
    """Let the user's module register its tasks, if one was named; a file given as --task becomes a task."""
    if args.module:
        import_tasks(args.module)
    args.given_task = args.task  # what another process would have to be given
    if args.task is not None and args.task.endswith(YAML_ENDINGS):
        args.task = register_file(args.task)


def watch_command(args: argparse.Namespace, folder: Path) -> str:
    """Return the command that shows the policy of a run folder in a browser, also while it is trained; `args` were given to
    the command that runs now.
    """
    words = ["python", "-m", "legged.tools.watch"]
    if args.module:
        words += ["--import", args.module]
    if args.given_task.endswith(YAML_ENDINGS):  # whose name alone would mean nothing
        words += ["--task", args.given_task]
    return shlex.join([*words, "--load_run", relative(folder)])
