"""Recorded episodes, in memory and as files: the arrays in episodes.npz, their description in episodes.json."""

import json
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from legged.config import TaskConfig, from_dict, to_yaml
from legged.config.yaml_files import read_yaml
from legged.episodes.stored_check import PER_EPISODE, check_stored
from legged.errors import ConfigError
from legged.process.paths import make_folder, relative, replacing, write_text
from legged.registry import task_schema

ARRAYS, ABOUT, CONFIG = "episodes.npz", "episodes.json", "episodes.yaml"
"""Files: arrays, their description, and the configuration of their task."""
MADE_OF_THEM = ("episodes.md", "episodes.parquet", "episode_[0-9]*.html", "joint_statistics.*")
"""Patterns of the files that are made from a recording, in the same folder."""
TIME_UP, NO_NUMBERS = "time", "non_finite"
"""Names for ends without a term: out of time, and physics that blew up."""


DAMAGES = (OSError, ValueError, RecursionError, zipfile.BadZipFile, EOFError, KeyError, NotImplementedError, MemoryError)
"""Errors that json, zipfile and NumPy raise for damaged files."""


@dataclass(frozen=True)
class Episodes:
    """E whole episodes of R control steps in all. Row k of an episode holds the state at the end of control step k + 1, with
    the action, the command and the reward of that step.
    """

    arrays: dict[str, np.ndarray]
    about: dict[str, Any]
    """Contents of episodes.json: names, units, limits, task, checkpoint."""

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]

    def __contains__(self, name: str) -> bool:
        return name in self.arrays

    def __len__(self) -> int:
        return len(self.arrays["failed"])

    @property
    def dt(self) -> float:
        """Control step [s]."""
        return float(self.about["dt"])

    @cached_property
    def lengths(self) -> np.ndarray:
        """(E,) lengths in steps."""
        return np.diff(self.arrays["episode_start"])

    def rows(self, number: int) -> slice:
        """Return the rows of an episode."""
        start = self.arrays["episode_start"]
        return slice(int(start[number]), int(start[number + 1]))

    def of(self, number: int) -> dict[str, np.ndarray]:
        """Return the arrays of one episode, (T, ...) each."""
        rows = self.rows(number)
        return {name: array[rows] for name, array in self.arrays.items() if name not in PER_EPISODE}

    def columns(self, name: str) -> list[str]:
        """Return the names of an array's columns."""
        return list(self.about["arrays"][name]["columns"])

    def ended(self, number: int) -> list[str]:
        """Return the names of the terms that ended an episode, TIME_UP, or NO_NUMBERS if physics blew up."""
        terms = self.about["terminations"]
        found = [term for term, mine in zip(terms, self.arrays["ended_by"][number], strict=True) if mine]
        return found or [NO_NUMBERS if self.arrays["failed"][number] else TIME_UP]


def save_episodes(episodes: Episodes, cfg: TaskConfig, folder: Path) -> None:
    """Write the three files into `folder`; the arrays also hold `time` [s] and `episode`. An earlier recording is replaced,
    and files made from it are removed.

    Raises:
        ConfigError, RunError: a file can't be written.
    """
    make_folder(folder)
    with replacing(folder / ARRAYS) as part:
        np.savez(part, **clock_of(episodes), **episodes.arrays)  # type: ignore[arg-type]
        # Once the new arrays are written, the old description must not describe them if a later write fails.
        for name in (ABOUT, CONFIG, *MADE_OF_THEM):
            for path in folder.glob(name):
                path.unlink()
    write_text(folder / CONFIG, to_yaml(cfg))
    write_text(folder / ABOUT, json.dumps(episodes.about, indent=1, allow_nan=False))


def clock_of(episodes: Episodes) -> dict[str, np.ndarray]:
    """Return `episode` (R,), the episode of each row, and `time` (R,), the time since its start [s]."""
    lengths = episodes.lengths
    steps = np.concatenate([np.arange(1, count + 1) for count in lengths])
    return {
        "episode": np.repeat(np.arange(len(lengths), dtype=np.int32), lengths),
        "time": (steps * episodes.dt).astype(np.float32),
    }


def load_episodes(folder: Path, where: str) -> Episodes:
    """Read the files of `save_episodes`; `where` is the flag that names the folder.

    Raises:
        ConfigError: the folder holds no episodes, or damaged ones.
    """
    for name in (ARRAYS, ABOUT):
        if not (folder / name).is_file():
            raise ConfigError(f"{where}: {relative(folder)} holds no {name}; legged episodes record writes it")
    try:
        about = json.loads((folder / ABOUT).read_text(encoding="utf-8"))
        with np.load(folder / ARRAYS, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files if name not in ("time", "episode")}
    except DAMAGES as error:
        raise ConfigError(f"{where}: {relative(folder)}: the episodes there are damaged ({error})") from error
    check_stored(about, arrays, f"{where}: {relative(folder)}")
    return Episodes(arrays, about)


def load_config(folder: Path, where: str) -> TaskConfig:
    """Return the configuration of the task of stored episodes.

    Raises:
        ConfigError: the file is missing, or no longer fits the schema.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise ConfigError(f"{where}: {relative(folder)} holds no {CONFIG}")
    data = read_yaml(path)
    return from_dict(data, source=str(path), schema=task_schema(str(data.get("task", ""))))
