"""Command-line arguments that several commands share, and functions that evaluate the parsed arguments."""

import argparse
import re
import shlex
from pathlib import Path
from typing import Any

import torch

from legged.config import parse_override
from legged.deploy.command_parser import Argument, argument
from legged.errors import ConfigError
from legged.process.paths import relative
from legged.process.ranks import Ranks
from legged.process.startup import program
from legged.registry import YAML_ENDINGS, import_tasks, register_file

TASK_HELP = "a task, e.g. anymal_c_flat, or its YAML file"
POLICY_HELP = "a task (its newest run, else the shipped policy), its YAML file, a run, or a run's folder"
OVERRIDE = re.compile(r"[\w.]+=")
"""Pattern of the beginning of an override `key=value`. A key has no slash, so a path such as `logs/a=b` does not match."""


def _iteration(text: str) -> int | str:
    """Return the value of --checkpoint: an iteration, or `best`. For any other text, argparse prints the error."""
    try:
        return text if text == "best" else int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"invalid value: '{text}' (allowed: an iteration, or best)") from None


class Once(argparse.Action):
    """Option that may be given once. If it were given twice, argparse would silently use the last value."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: Any = None
    ) -> None:
        """Store the value, or end the program if the option was given before."""
        before = getattr(namespace, self.dest)
        if before is not None:
            parser.error(f"{option}: is given twice, {before} and {values}; write {option} {before},{values}")
        setattr(namespace, self.dest, values)


IMPORT = argument(
    "--import", dest="module", action=Once, help="module, .py or YAML file with user-defined tasks; join several by commas"
)
"""The option `--import`, for files and modules with user-defined tasks. `args.module` holds its value."""
BUILD = (
    IMPORT,
    argument("--num-envs", type=int, help="number of robots (env.num_envs)"),
    argument("--seed", type=int, help="random seed (env.seed)"),
    argument("--physics", metavar="ENGINE", help="engine: mujoco_warp, mujoco or newton; by default chosen for the device"),
    argument("--solver", metavar="NAME", help="solver of the engine newton (sim.solver), e.g. xpbd; by default mujoco"),
    argument("--sim-device", help="cpu or cuda[:i]; by default the GPU if there is one (watch: the CPU)"),
    argument("--no-graph", action="store_true", help="run the step eagerly instead of as one CUDA graph"),
    argument("overrides", nargs="*", metavar="key=value", help="any setting, e.g. rewards.scales.torques=-1e-4"),
)
"""Arguments that determine how a task is built, such as the engine, the device and `key=value` overrides."""
TASK = (argument("task", metavar="TASK", help=TASK_HELP), *BUILD)
"""The positional argument TASK, and the arguments of `BUILD`."""
CHECKPOINT = argument("--checkpoint", type=_iteration, help="iteration of the checkpoint, or best; the latest by default")
"""The option that chooses among the checkpoints of a run."""
POLICY = (argument("policy", metavar="POLICY", help=POLICY_HELP), CHECKPOINT, *BUILD)
"""The positional argument POLICY, --checkpoint, and the arguments of `BUILD`."""
TILES = (
    argument("--terrain", metavar="TYPE", help="type of the tiles, e.g. stairs_up; by default the types of the task"),
    argument("--difficulty", type=float, help="difficulty of all tiles, 0 to 1; by default 0.5 in the first row, then 0.8"),
)
"""Options that choose the tiles on which a policy is shown."""


def of_legged_gym(name: str) -> tuple[Argument, ...]:
    """Return the arguments that `train` and `play` share: the positional argument `name`, options that choose a run of the
    task, and the arguments of `BUILD`. They also share legged_gym's option --task, which can replace the positional argument.
    """
    return (
        argument(name, nargs="?", metavar=name.upper(), help=TASK_HELP if name == "task" else POLICY_HELP),
        argument("--task", dest="task_option", metavar="TASK", help=f"legged_gym's way to give the argument {name.upper()}"),
        argument("--experiment-name", help="folder under logs/; the task's name by default"),
        argument("--load-run", metavar="RUN", help="a run of the task, by name or folder; the newest by default"),
        CHECKPOINT,
        *BUILD,
    )


def settle_name(args: argparse.Namespace, name: str) -> None:
    """Set `args.<name>` to the value of the positional argument or of legged_gym's --task. A `key=value` in the place of the
    positional argument becomes an override.

    Raises:
        ConfigError: neither is given, or both are given with different values.
    """
    override_is_no_name(args, name)
    given = getattr(args, name)
    if given is not None and args.task_option not in (None, given):
        raise ConfigError(f"--task: '{args.task_option}' is given together with {name.upper()} '{given}'; leave one out")
    if given is None and args.task_option is None:
        wanted = "a task" if name == "task" else "a task or a run"
        raise ConfigError(f"{name.upper()}: is missing; name {wanted}, e.g. anymal_c")
    setattr(args, name, args.task_option if given is None else given)


def override_is_no_name(args: argparse.Namespace, name: str) -> None:
    """If a `key=value` stands in the place of the positional argument `name`, move it to the overrides."""
    given = getattr(args, name)
    if given is not None and OVERRIDE.match(given):
        args.overrides.insert(0, given)
        setattr(args, name, None)


def overrides(args: argparse.Namespace) -> list[tuple[str, Any]]:
    """Return all overrides of a command line as (dotted path, value). Overrides of the form `key=value` come first, and then
    those of flags such as --seed.

    Raises:
        ConfigError: a text is not of the form `key=value`, or --solver is given without the engine newton.
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
    given = {key: getattr(args, flag, None) for flag, key in flags.items()}
    found = [parse_override(text) for text in args.overrides]
    found += [(key, value) for key, value in given.items() if value is not None]
    engine = dict(found).get("sim.physics")
    if args.solver is not None and engine != "newton":
        raise ConfigError(f"--solver: '{args.solver}' is a solver of the engine newton; add --physics newton (got {engine})")
    return found


def policy_overrides(args: argparse.Namespace) -> list[tuple[str, Any]]:
    """Return all overrides except the experiment name, which chooses the run of a policy.

    Raises:
        ConfigError: as for `overrides`.
    """
    return [change for change in overrides(args) if change[0] != "train.runner.experiment_name"]


def velocity_command(text: str) -> tuple[float, float, float]:
    """Return vx, vy [m/s] and yaw rate [rad/s] of --command.

    Raises:
        ConfigError: the text is not three numbers, or one of them is above 100 or below -100.
    """
    try:
        vx, vy, yaw = (float(part) for part in text.split(","))
    except ValueError:
        vx = vy = yaw = float("nan")
    if not all(abs(value) <= 100.0 for value in (vx, vy, yaw)):
        raise ConfigError(f"--command: expected three numbers from -100 to 100 like 0.5,0,0.2; got '{text}'")
    return vx, vy, yaw


def pick_device(name: str | None, flag: str = "--sim-device") -> torch.device:
    """Return the device `name`, by default a GPU if there is one. Under torchrun each process has the GPU of its local rank.

    Raises:
        ConfigError: the device does not exist, or under torchrun it is the GPU of another process.
    """
    ranks, gpus = Ranks.now(), torch.cuda.device_count()
    own = f"cuda:{ranks.local_rank}"
    if name is None and not torch.cuda.is_available():
        return torch.device("cpu")
    if name is None or (ranks.several and name == "cuda"):
        name = own
    if ranks.several and name not in ("cpu", own):
        raise ConfigError(f"{flag}: all {ranks.count} processes would share '{name}'; without the flag each gets its own GPU")
    if ranks.several and name == own and 0 < gpus <= ranks.local_rank:
        raise ConfigError(
            f"{ranks.local_count} processes need a GPU each, but torch sees {gpus} here; use --nproc-per-node {gpus}"
        )
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"{flag}: '{name}' is not a device (allowed: cpu, cuda, cuda:0, ...)") from error
    if device.type == "cpu" and device.index in (None, 0):
        return torch.device("cpu")
    if device.type == "cpu":
        raise ConfigError(f"{flag}: '{name}': there is one device 'cpu'; sim.threads sets the number of cores")
    if device.type != "cuda":
        raise ConfigError(f"{flag}: '{name}' is not supported (allowed: cpu, cuda, cuda:0, ...)")
    if not torch.cuda.is_available():
        raise ConfigError(f"{flag}: '{name}' was asked for, but torch sees no GPU here; without the flag the CPU is used")
    if (device.index or 0) >= gpus:
        raise ConfigError(f"{flag}: '{name}': this machine has {gpus} GPU(s), counted from 0")
    return torch.device("cuda", device.index or 0)


def settle_on(device: torch.device) -> None:
    """Configure torch for a command that runs on `device`."""
    if device.type == "cpu":
        # The C engine uses all cores. If torch's threads compete for them, operations on small tensors become slower.
        torch.set_num_threads(1)
    else:
        torch.cuda.set_device(device)  # otherwise, operations without an explicit device would run on the first GPU


def measuring_device(args: argparse.Namespace) -> torch.device:
    """Return the device of a command that measures a policy, and configure torch for this device. Without --sim-device,
    `--physics mujoco` uses the CPU, and all other engines use the GPU if there is one.

    Raises:
        ConfigError: as for `pick_device`.
    """
    device = torch.device("cpu") if args.physics == "mujoco" and args.sim_device is None else pick_device(args.sim_device)
    settle_on(device)
    return device


def watch_command(args: argparse.Namespace, folder: Path) -> str:
    """Return the command that shows the policy of a run folder in a browser, also during the training. `args` are the
    arguments of the running command.
    """
    return shlex.join([*program("watch"), *given_import(args), relative(folder)])


def given_import(args: argparse.Namespace) -> list[str]:
    """Return the option --import as words for another command that needs the user-defined tasks of this command."""
    files = [file for file in (args.module, args.task_file) if file]
    return ["--import", ",".join(files)] if files else []


def import_given(args: argparse.Namespace) -> None:
    """Register the user-defined tasks of --import, if it is given."""
    if args.module:
        import_tasks(args.module)


def register_given(args: argparse.Namespace, name: str) -> None:
    """Register the user-defined tasks of --import. If `args.<name>` is a YAML file, replace it by the name of its task."""
    import_given(args)
    given = getattr(args, name)
    args.task_file = given if given is not None and given.endswith(YAML_ENDINGS) else None
    if args.task_file:
        setattr(args, name, register_file(given, name.upper()))
