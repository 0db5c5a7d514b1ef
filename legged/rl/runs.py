"""Run folders: logs/<experiment>/<date_time>_<run>/ with configuration, code state, TensorBoard and checkpoints."""

import re
import subprocess
from datetime import datetime
from pathlib import Path

from legged.config import TaskConfig, from_dict, to_yaml
from legged.config.loader import read_yaml
from legged.errors import ConfigError, suggest
from legged.paths import data_folder, relative, replacing

LOGS = Path("logs")
CONFIG_FILE = "config.yaml"
SHIPPED_MODEL = "model.pt"


def experiment_folder(cfg: TaskConfig) -> Path:
    """Where the runs of a task lie."""
    return LOGS / (cfg.train.runner.experiment_name or cfg.task)


def create_run(cfg: TaskConfig) -> Path:
    """A new run folder with the resolved configuration and the state of the code.

    Raises:
        ConfigError: the folder can't be made or written.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    name = f"{stamp}_{cfg.train.runner.run_name}" if cfg.train.runner.run_name else stamp
    parent = experiment_folder(cfg)
    folder = parent / name
    for number in range(2, 100):
        try:
            folder.mkdir(parents=True)
            break
        except FileExistsError:  # two runs in one second
            if not folder.is_dir():
                raise ConfigError(f"{parent}: cannot make the log folder: there is a file of that name") from None
            folder = parent / f"{name}-{number}"
        except OSError as error:
            raise ConfigError(f"{folder}: cannot make the log folder ({error.strerror})") from error
    write_text(folder / CONFIG_FILE, to_yaml(cfg))
    write_text(folder / "code.diff", code_state())
    return folder


def write_text(path: Path, text: str) -> None:
    """Write a file that is whole or not there."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def code_state() -> str:
    """Commit, status and difference of the code that runs, if it lies in a git repository."""
    root = Path(__file__).resolve().parent

    def git(*args: str) -> str:
        result = subprocess.run(["git", "-C", str(root), *args], capture_output=True, check=True)
        return result.stdout.decode("utf-8", errors="replace")

    try:
        return f"commit {git('rev-parse', 'HEAD')}\n{git('status', '--short')}\n{git('diff', 'HEAD')}"
    except (OSError, subprocess.CalledProcessError):
        return "not in a git repository\n"


def find_run(cfg: TaskConfig, load_run: str | None) -> Path:
    """The run folder that `load_run` names (a name in the task's experiment, a path, or nothing for the newest).

    Raises:
        ConfigError: there is none.
    """
    parent = experiment_folder(cfg)
    runs = sorted((p for p in parent.glob("*") if checkpoints(p)), key=_last_saved)
    if load_run in (None, "-1"):
        if not runs:
            raise ConfigError(f"--load_run: there is no run with a checkpoint in {relative(parent)}; train one first")
        return runs[-1]
    for folder in (parent / str(load_run), Path(str(load_run))):
        if folder.is_dir():
            return folder
    raise ConfigError(f"--load_run: there is no run '{load_run}'{suggest(str(load_run), [p.name for p in runs], 'runs')}")


def find_checkpoint(folder: Path, checkpoint: int | None) -> Path:
    """The checkpoint of that iteration in a run folder, or the latest.

    Raises:
        ConfigError: there is none.
    """
    found = checkpoints(folder)
    if not found:
        raise ConfigError(f"--load_run: {relative(folder)} holds no checkpoint (model_<iteration>.pt)")
    if checkpoint is None or checkpoint == -1:
        return found[max(found)]
    if checkpoint not in found:
        have = ", ".join(str(i) for i in sorted(found))
        raise ConfigError(f"--checkpoint: {relative(folder)} has no checkpoint {checkpoint} (it has: {have})")
    return found[checkpoint]


def shipped_policy(task: str) -> Path | None:
    """The folder of the policy that comes with this package for a task, if there is one."""
    folder = data_folder("resources") / "policies" / task
    return folder if (folder / SHIPPED_MODEL).is_file() else None


def run_config(folder: Path) -> TaskConfig:
    """The configuration that a run was trained with.

    Raises:
        ConfigError: the folder has none, or it no longer fits the schema.
    """
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise ConfigError(f"--load_run: {relative(folder)} is no run folder (it has no {CONFIG_FILE})")
    return from_dict(read_yaml(path), source=str(path))


def _last_saved(folder: Path) -> float:
    """When the latest checkpoint of a run was written; evaluations and videos in its folder do not count."""
    return max(path.stat().st_mtime for path in checkpoints(folder).values())


def checkpoints(folder: Path) -> dict[int, Path]:
    """Checkpoints of a folder by iteration, in that order; the one of a shipped policy counts as 0."""
    found: dict[int, Path] = {}
    for path in folder.glob("model*.pt"):
        match = re.fullmatch(r"model_(\d+)\.pt", path.name)
        if match:
            found[int(match.group(1))] = path
        elif path.name == SHIPPED_MODEL:
            found[0] = path
    return dict(sorted(found.items()))
