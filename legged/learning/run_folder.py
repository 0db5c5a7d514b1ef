"""Run folders: logs/<experiment>/<date_time>_<run>/ with configuration, code state, TensorBoard files and checkpoints."""

import itertools
import os
import re
import subprocess
import tomllib
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from importlib import metadata
from pathlib import Path

from legged.config import TaskConfig, from_dict, has_robot, to_yaml
from legged.config.actuator import MOTORS
from legged.config.checks import shown
from legged.config.loader import file_paths, read_yaml
from legged.errors import ConfigError, suggest
from legged.learning.invocation import INVOCATION_FILE
from legged.process.paths import data_folder, exists, listed, make_folder, not_made, relative, write_bytes, write_text
from legged.registry import YAML_ENDINGS, register_file, task_config, task_names, task_schema

LOGS = Path("logs")
CONFIG_FILE = "config.yaml"
CODE_FILE = "code.diff"
NOTE_FILE = "note.txt"
REPORT = "report"
"""Name of the report's files, before their ending."""
SHIPPED_MODEL = "model.pt"
BEST_MODEL = "model_best.pt"
BEST = "best"
"""Value of --checkpoint that selects the best model."""
FROM_LEGGED_GYM = "docs/migrating.md (A trained policy) tells how policies of legged_gym are evaluated here"
GIT_S = 30.0
"""Time limit for git, which can be slow on a network disk [s]."""


def experiment_folder(cfg: TaskConfig) -> Path:
    """Return the folder of a task's runs. It is always in logs/, because the experiment's name must not be a path."""
    return LOGS / (cfg.train.runner.experiment_name or cfg.task)


def create_run(cfg: TaskConfig) -> Path:
    """Make a new run folder with the resolved configuration and the state of the code. Two processes never get the same
    folder, even if they start in the same second.

    Raises:
        ConfigError: the run's name is not a valid folder name.
        RunError: the folder can't be made, or a file can't be written.
    """
    parent = experiment_folder(cfg)
    folder = parent / stamped(cfg)
    make_folder(parent)
    for number in itertools.count(2):
        try:
            folder.mkdir()
            break
        except FileExistsError:  # another run began in this second
            folder = parent / f"{stamped(cfg)}-{number}"
        except (OSError, ValueError) as error:
            raise not_made(folder, error) from error
    if has_robot(cfg) and cfg.control.actuator.network:  # the run keeps a copy of the network's file
        write_bytes(folder / MOTORS, Path(cfg.control.actuator.network).read_bytes())
        cfg = replace(cfg, control=replace(cfg.control, actuator=replace(cfg.control.actuator, network=MOTORS)))
    write_text(folder / CONFIG_FILE, to_yaml(cfg))
    write_text(folder / CODE_FILE, code_state())
    return folder


def stamped(cfg: TaskConfig) -> str:
    """Return the folder name of a run that begins now: date and time, then `run_name` if it is set."""
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    return f"{stamp}_{cfg.train.runner.run_name}" if cfg.train.runner.run_name else stamp


def discard_run(folder: Path) -> None:
    """Remove the folder of a run that failed before its first checkpoint, and parent folders that are then empty. Keep a
    folder that holds files which the run did not write.

    A state file without its checkpoint is removed too, because it is of no use.
    """
    if checkpoints(folder) or (folder / BEST_MODEL).is_file():
        return
    ours = [folder / name for name in (CONFIG_FILE, CODE_FILE, INVOCATION_FILE, NOTE_FILE, MOTORS)]
    ours += [*folder.glob("events.out.tfevents.*"), *folder.glob("state_*.pt")]
    with suppress(OSError):
        for path in ours:
            path.unlink(missing_ok=True)
        for empty in (folder, *folder.parents[: len(folder.parts) - 1]):
            empty.rmdir()


def code_state() -> str:
    """Return version, commit, status and diff of the running code.

    Commit, status and diff are given only if the code lies in this project's own git repository. Untracked files appear by
    name only.
    """
    package = Path(__file__).resolve().parents[1]
    version = f"legged {_version()}\n"
    try:
        top, commit = _git(package.parent, "rev-parse", "--show-toplevel", "HEAD").splitlines()
        if Path(top).resolve() != package.parent:
            return f"{version}not in a git repository of its own\n"
        _git(package.parent, "ls-files", "--error-unmatch", f"{package.name}/__init__.py", "pyproject.toml")
        project = tomllib.loads((package.parent / "pyproject.toml").read_text(encoding="utf-8"))
        if project.get("project", {}).get("name") != package.name:
            return f"{version}not in a git repository of its own\n"
        status = _git(package.parent, "status", "--short")
        changed = any(not line.startswith("??") for line in status.splitlines())
        difference = _git(package.parent, "diff", "--no-ext-diff", "--no-color", "HEAD") if changed else ""
        return f"{version}commit {commit}\n{status}\n{difference}"
    except FileNotFoundError:
        return f"{version}git is not on the PATH, so the commit is unknown\n"
    except subprocess.CalledProcessError:
        return f"{version}not in a git repository of its own\n"
    except (OSError, subprocess.TimeoutExpired, ValueError) as error:
        return f"{version}git failed: {error}\n"


def _git(folder: Path, *args: str) -> str:
    """Return the output of git for the repository of a folder. Git's environment variables are ignored."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    command = ["git", "-C", str(folder), *args]
    result = subprocess.run(command, capture_output=True, check=True, timeout=GIT_S, env=environment)
    return result.stdout.decode("utf-8", errors="replace")


def _version() -> str:
    """Return the installed version of this package."""
    try:
        return metadata.version("legged")
    except metadata.PackageNotFoundError:
        return "(not installed)"


def find_run(cfg: TaskConfig, load_run: str | None) -> Path:
    """Return the run folder that `load_run` names: the name of a run of the task, a path, or None for the newest run.

    Raises:
        ConfigError: there is no such run.
    """
    parent = experiment_folder(cfg)
    runs = sorted((p for p in listed(parent) if checkpoints(p)), key=_last_saved)
    if load_run in (None, "-1"):
        if not runs:
            shipped = ", and the package has no policy of this task"
            which = shipped if load_run is None and not exists(data_folder("resources") / "policies" / cfg.task) else ""
            where = "--load-run" if load_run else f"'{cfg.task}'"
            raise ConfigError(f"{where}: there is no run with a checkpoint in {relative(parent)}{which}; train one first")
        return runs[-1]
    for folder in (parent / str(load_run), Path(str(load_run))):
        with suppress(OSError, ValueError):  # `load_run` can be an invalid folder name
            if str(load_run).strip() and folder.is_dir():
                return folder
    raise ConfigError(f"--load-run: there is no run '{load_run}'{suggest(str(load_run), [p.name for p in runs], 'runs')}")


def run_named(name: str, where: str, begun: bool = False) -> Path:
    """Return the run folder for a `name` that a user gave.

    The name can be one of these:

    - a run's folder, or `<experiment>/<run>` below logs/;
    - a task or its YAML file, for the task's newest run or else its shipped policy;
    - an experiment, for its newest run.

    The run needs a checkpoint, unless `begun` allows a run without one. `where` is the argument that gave the name.

    Raises:
        ConfigError: there is no such run.
    """
    top = data_folder("resources").parent
    with suppress(OSError, ValueError):  # `name` can be an invalid folder name
        for folder in (parent / name for parent in (Path(), LOGS, top) if name.strip()):
            if exists(folder / CONFIG_FILE):
                return folder
    is_run = _has_begun if begun else checkpoints
    if name.endswith(YAML_ENDINGS):
        name = register_file(name, where)
    if name in task_names():
        experiment = experiment_folder(task_config(name))
        runs = [run for run in listed(experiment) if is_run(run)]
        shipped = shipped_policy(name)
        if not runs and shipped is None:
            raise ConfigError(
                f"{where}: '{name}' has neither a run in {relative(experiment)} nor a shipped policy; train it first"
            )
        return max(runs, key=_last_saved) if runs else shipped or experiment
    with suppress(OSError, ValueError):
        for folder in (parent / name for parent in (Path(), LOGS) if name.strip()):
            runs = [run for run in listed(folder) if is_run(run)]
            if runs:
                return max(runs, key=_last_saved)
    known = [f"{run.parent.name}/{run.name}" for run in _runs_in_logs() if is_run(run)]
    if exists(Path(name)) and Path(name).is_dir():
        said = f"there is no {CONFIG_FILE} in it or in its folders{_remedy(Path(name))}"
        raise ConfigError(f"{where}: {shown(name)} holds no run: {said}")
    if exists(Path(name)) and name.endswith(".pt"):
        raise ConfigError(f"{where}: {shown(name)} is a file; name the folder of the run; {FROM_LEGGED_GYM}")
    raise ConfigError(f"{where}: there is no task and no run {shown(name)}{suggest(name[:100], [*task_names(), *known])}")


def own_run(name: str, where: str) -> Path:
    """Return the folder of one of this user's runs. `run_named` describes the possible names. The run need not have a
    checkpoint.

    Raises:
        ConfigError: there is no such run, or the name is that of a shipped policy.
    """
    folder = run_named(name, where, begun=True)
    if folder.resolve().parent == data_folder("resources") / "policies":
        raise ConfigError(f"{where}: '{name}' has no run in {LOGS}/; its shipped policy is not a run")
    return folder


def newest_run(where: str) -> Path:
    """Return the folder in logs/ of the run that saved a checkpoint last. If a run has no checkpoint, the time of
    its start counts.

    Raises:
        ConfigError: there is no run.
    """
    runs = [run for run in _runs_in_logs() if _has_begun(run)]
    if not runs:
        raise ConfigError(f"{where}: there is no run in {LOGS}/; train one first, or name a task whose policy is shipped")
    return max(runs, key=_last_saved)


def _runs_in_logs() -> list[Path]:
    return [run for experiment in listed(LOGS) for run in listed(experiment)]


def _has_begun(folder: Path) -> bool:
    return exists(folder / CONFIG_FILE)


def find_checkpoint(folder: Path, checkpoint: int | str | None) -> Path:
    """Return a checkpoint of a run folder. `checkpoint` is an iteration, BEST for the policy with the best evaluation during
    training, or None for the latest checkpoint.

    Raises:
        ConfigError: the folder has no such checkpoint.
    """
    if checkpoint == BEST:
        if not (folder / BEST_MODEL).is_file():
            keeping = "a training writes it if train.runner.evaluate_interval is set"
            raise ConfigError(f"--checkpoint: {relative(folder)} has no {BEST_MODEL}; {keeping}")
        return folder / BEST_MODEL
    found = checkpoints(folder)
    if not found:
        raise ConfigError(f"{relative(folder)}: holds no checkpoint (model_<iteration>.pt)")
    if checkpoint is None or checkpoint == -1:
        return found[max(found)]
    if checkpoint not in found:
        have = ", ".join(str(i) for i in sorted(found))
        raise ConfigError(f"--checkpoint: {relative(folder)} has no checkpoint {checkpoint} (it has: {have})")
    return found[checkpoint]


def of_another_policy(folder: Path, checkpoint: object) -> bool:
    """Return True if `checkpoint`, the name of an evaluated file, is not the name of the last checkpoint in `folder`. Then
    training went on after the evaluation, or an earlier checkpoint was evaluated. For a shipped policy return False,
    because its original file name is unknown.
    """
    found = checkpoints(folder)
    last = found[max(found)].name if found else SHIPPED_MODEL
    return last != SHIPPED_MODEL and isinstance(checkpoint, str) and checkpoint != last


def shipped_policy(task: str) -> Path | None:
    """Return the folder of the policy that this package ships for a task, or None."""
    folder = data_folder("resources") / "policies" / task
    return folder if (folder / SHIPPED_MODEL).is_file() else None


def run_config(folder: Path, where: str = "POLICY") -> TaskConfig:
    """Return the configuration with which a run was trained. `where` is the argument that named the run.

    Raises:
        ConfigError: the folder has no configuration, or the configuration no longer fits the schema.
    """
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise ConfigError(f"{where}: {relative(folder)} is not a run folder (it has no {CONFIG_FILE}){_remedy(folder)}")
    data = read_yaml(path)
    file_paths(data, folder)
    return from_dict(data, source=str(path), schema=task_schema(str(data.get("task", ""))))


def _last_saved(folder: Path) -> float:
    """Return when the latest checkpoint of a run was written, or when the run began if it has no checkpoint [s since 1970].
    Evaluations and videos in the folder do not count.
    """
    stamps = []
    for path in list(checkpoints(folder).values()) or [folder / CONFIG_FILE]:
        with suppress(OSError):  # the file may have been removed
            stamps.append(path.stat().st_mtime)
    return max(stamps, default=0.0)


def _remedy(folder: Path) -> str:
    """Return the end of an error about a folder without a configuration. With checkpoints it may be a run of legged_gym."""
    return f"; {FROM_LEGGED_GYM}" if checkpoints(folder) else ""


def checkpoints(folder: Path) -> dict[int, Path]:
    """Return the checkpoints of a folder, sorted by iteration. A shipped policy has the iteration 0."""
    found: dict[int, Path] = {}
    for path in listed(folder, "model*.pt"):
        match = re.fullmatch(r"model_(\d+)\.pt", path.name, re.ASCII)
        if not path.is_file():  # skip folders and broken links
            continue
        if match:
            found[int(match.group(1))] = path
        elif path.name == SHIPPED_MODEL:
            found[0] = path
    return dict(sorted(found.items()))
