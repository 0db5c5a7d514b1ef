"""Recorded episodes, in memory and as files: episodes.npz, and episodes.json, which says what its arrays are."""

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
"""The files: numbers; what they are; the configuration of the task that the robots were in."""
MADE_OF_THEM = ("episodes.md", "episodes.parquet", "episode_[0-9]*.html", "joint_statistics.*")
"""Patterns of the files that others make of a recording, beside it."""
TIME_UP, NO_NUMBERS = "time", "non_finite"
"""How an episode ended that no term has ended."""


DAMAGES = (OSError, ValueError, RecursionError, zipfile.BadZipFile, EOFError, KeyError, NotImplementedError, MemoryError)
"""What json, zipfile and NumPy raise at files that are not what they should be."""


@dataclass(frozen=True)
class Episodes:
    """E whole episodes of R control steps in all. Row k of an episode is its state at the end of control step k + 1, with the
    action, the command and the reward of that step.
    """

    arrays: dict[str, np.ndarray]
    about: dict[str, Any]
    """Names, units, limits, task, checkpoint: what episodes.json holds."""

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
        """(E,) steps."""
        return np.diff(self.arrays["episode_start"])

    def rows(self, number: int) -> slice:
        """Return where an episode lies among the rows."""
        start = self.arrays["episode_start"]
        return slice(int(start[number]), int(start[number + 1]))

    def of(self, number: int) -> dict[str, np.ndarray]:
        """Return the arrays of one episode, (T, ...) each."""
        rows = self.rows(number)
        return {name: array[rows] for name, array in self.arrays.items() if name not in PER_EPISODE}

    def columns(self, name: str) -> list[str]:
        """Return what lies along the second axis of an array."""
        return list(self.about["arrays"][name]["columns"])

    def ended(self, number: int) -> list[str]:
        """Return the terms that ended an episode: their names, TIME_UP, or NO_NUMBERS where physics blew up."""
        terms = self.about["terminations"]
        found = [term for term, mine in zip(terms, self.arrays["ended_by"][number], strict=True) if mine]
        return found or [NO_NUMBERS if self.arrays["failed"][number] else TIME_UP]


def save_episodes(episodes: Episodes, cfg: TaskConfig, folder: Path) -> None:
    """Write the three files into `folder`; arrays as they are, with `time` [s] and `episode` beside them. They take the place
    of an earlier recording, and what was made of that goes.

    Raises:
        ConfigError, RunError: a file can't be written.
    """
    make_folder(folder)
    with replacing(folder / ARRAYS) as part:
        np.savez(part, **clock_of(episodes), **episodes.arrays)  # type: ignore[arg-type]
        # Now that there is room for the numbers. Without the old description, nobody takes them for those of the old policy
        # if the new one can't be written.
        for name in (ABOUT, CONFIG, *MADE_OF_THEM):
            for path in folder.glob(name):
                path.unlink()
    write_text(folder / CONFIG, to_yaml(cfg))
    write_text(folder / ABOUT, json.dumps(episodes.about, indent=1, allow_nan=False))


def clock_of(episodes: Episodes) -> dict[str, np.ndarray]:
    """Return `episode` (T,), which one each row is of, and `time` (T,), how long it has lasted [s]."""
    lengths = episodes.lengths
    steps = np.concatenate([np.arange(1, count + 1) for count in lengths])
    return {
        "episode": np.repeat(np.arange(len(lengths), dtype=np.int32), lengths),
        "time": (steps * episodes.dt).astype(np.float32),
    }


def load_episodes(folder: Path, where: str) -> Episodes:
    """Read what `save_episodes` wrote; `where` is the flag that names the folder.

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
    """Return the configuration of the task that stored episodes are of.

    Raises:
        ConfigError: the file is not there, or no longer fits the schema.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise ConfigError(f"{where}: {relative(folder)} holds no {CONFIG}")
    data = read_yaml(path)
    return from_dict(data, source=str(path), schema=task_schema(str(data.get("task", ""))))
