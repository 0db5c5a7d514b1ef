"""Recorded episodes, in memory and as files: arrays in episodes.npz, their description in episodes.json, and a flat table for
tools that read Parquet. Files may come from anywhere, so they are checked when they are read.
"""

import json
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from legged.config import TaskConfig, from_dict, to_yaml
from legged.config.yaml_files import read_yaml
from legged.errors import ConfigError
from legged.evaluation.json_forms import INDEX, NUMBER, POSITIVE, TEXT, OrNull, check_form, wrong_form
from legged.process.paths import make_folder, relative, replacing, write_text
from legged.registry import task_schema

ARRAYS, ABOUT, CONFIG, TABLE = "episodes.npz", "episodes.json", "episodes.yaml", "episodes.parquet"
"""Names of the files: arrays, their description, the configuration of the task, and the flat table."""
MADE_OF_THEM = ("episodes.md", TABLE, "episode_[0-9]*.html", "joint_statistics.*")
"""Patterns of the files that are made from a recording, in the same folder."""
TIME_UP, NO_NUMBERS = "time", "non_finite"
"""Names of ends without a termination term: the time was up, or physics blew up."""
AXES = ("x", "y", "z")
DAMAGES = (OSError, ValueError, RecursionError, zipfile.BadZipFile, EOFError, KeyError, NotImplementedError, MemoryError)
"""Errors that json, zipfile and NumPy raise for damaged files."""
FORMAT = 1
"""Version of episodes.json. A new version means that older files can no longer be read."""
PER_EPISODE = ("episode_start", "robot", "failed", "timed_out", "ended_by", "first_qpos", "first_qvel")
"""Arrays with a row for each episode. All other arrays have a row for each control step, one episode after another.
`episode_start` is the row of an episode's first step in the other arrays; an extra last entry is the total number of steps.
`robot` is the index of the robot. `failed` is True if the episode ended in a failure, `timed_out` if it ended by time or by a
term that is no failure. `ended_by` has a flag for each of `terminations`. `first_qpos` and `first_qvel` are the state before
the first step.
"""
ALWAYS = ("qpos", "qvel", "action", "reward", "reward_parts")
JOINTS = ("joint_pos", "joint_vel", "torque")
JOINT = {
    "name": TEXT,
    "unit": {"rad", "m"},
    **dict.fromkeys(("qpos", "qvel"), INDEX),
    "range": OrNull((NUMBER, NUMBER)),
    **dict.fromkeys(("max_velocity", "max_torque"), OrNull(POSITIVE)),
}
FORM: dict[str, Any] = {
    "format": {FORMAT},
    **dict.fromkeys(("task", "checkpoint", "run"), TEXT),
    **dict.fromkeys(("dt", "reward_unit"), POSITIVE),
    "terminations": [TEXT],
    "joints": [JOINT],
    "ground?": OrNull({"terrain?": OrNull(TEXT), "difficulty?": OrNull(NUMBER)}),
    "changes?": {},
    "held_command?": OrNull([NUMBER]),
}
"""Form of episodes.json."""
LEGGED_FORM = {"contact_threshold": POSITIVE, "feet": [TEXT, ...], "contacts": [TEXT]}
"""Form of those parts of episodes.json that only legged robots have."""


@dataclass(frozen=True)
class Episodes:
    """E whole episodes, with R control steps in total. Row k of an episode, counted from 0, holds the state at the end of its
    control step k + 1, with the action, the command and the reward of that step.
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
        """Length of a control step [s]."""
        return float(self.about["dt"])

    @cached_property
    def lengths(self) -> np.ndarray:
        """(E,) lengths of the episodes [control steps]."""
        return np.diff(self.arrays["episode_start"])

    def rows(self, number: int) -> slice:
        """Return the rows of an episode in the arrays with a row for each step."""
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
        """Return the terms that ended an episode. If no term did, return NO_NUMBERS if physics blew up, else TIME_UP."""
        terms = self.about["terminations"]
        found = [term for term, mine in zip(terms, self.arrays["ended_by"][number], strict=True) if mine]
        return found or [NO_NUMBERS if self.arrays["failed"][number] else TIME_UP]


def joint_unit(array: str, of_position: str) -> str:
    """Return the unit of the array `array` for a joint whose position has the unit `of_position`, rad or m."""
    turning = of_position == "rad"
    return {"joint_pos": of_position, "joint_vel": f"{of_position}/s", "torque": "N m" if turning else "N"}[array]


def save_episodes(episodes: Episodes, cfg: TaskConfig, folder: Path) -> None:
    """Write arrays, description and configuration into `folder`. The arrays of `clock_of` are added. An earlier
    recording is replaced, and files that were made from it are removed.

    Raises:
        ConfigError, RunError: a file can't be written.
    """
    make_folder(folder)
    with replacing(folder / ARRAYS) as part:
        np.savez(part, **clock_of(episodes), **episodes.arrays)  # type: ignore[arg-type]
        # The old description is removed before the old arrays are replaced, so that it never describes the new arrays.
        for name in (ABOUT, CONFIG, *MADE_OF_THEM):
            for path in folder.glob(name):
                path.unlink()
    write_text(folder / CONFIG, to_yaml(cfg))
    write_text(folder / ABOUT, json.dumps(episodes.about, indent=1, allow_nan=False))


def clock_of(episodes: Episodes) -> dict[str, np.ndarray]:
    """Return `episode` (R,), the number of each row's episode, and `time` (R,), the time since the episode's start [s]."""
    lengths = episodes.lengths
    steps = np.concatenate([np.arange(1, count + 1) for count in lengths])
    return {
        "episode": np.repeat(np.arange(len(lengths), dtype=np.int32), lengths),
        "time": (steps * episodes.dt).astype(np.float32),
    }


def load_episodes(folder: Path, where: str) -> Episodes:
    """Read the files that `save_episodes` wrote. `where` is the option that names the folder, for error messages.

    Raises:
        ConfigError: the folder holds no episodes, or damaged ones.
    """
    for name in (ARRAYS, ABOUT):
        if not (folder / name).is_file():
            raise ConfigError(f"{where}: {relative(folder)} holds no {name}; the command `legged episodes record` writes it")
    try:
        about = json.loads((folder / ABOUT).read_text(encoding="utf-8"))
        with np.load(folder / ARRAYS, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files if name not in ("time", "episode")}
    except DAMAGES as error:
        raise ConfigError(f"{where}: {relative(folder)}: the episodes there are damaged ({error})") from error
    check_stored(about, arrays, f"{where}: {relative(folder)}")
    return Episodes(arrays, about)


def load_config(folder: Path, where: str) -> TaskConfig:
    """Return the configuration of the task whose episodes are stored in `folder`.

    Raises:
        ConfigError: the file is missing, or does not fit the present schema.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise ConfigError(f"{where}: {relative(folder)} holds no {CONFIG}")
    data = read_yaml(path)
    return from_dict(data, source=str(path), schema=task_schema(str(data.get("task", ""))))


def check_stored(about: Any, arrays: dict[str, np.ndarray], where: str) -> None:
    """Check the contents of episodes.json, and check that the arrays in episodes.npz have the described names and shapes.
    `where` names the folder.

    Raises:
        ConfigError: something is missing, has another type, or does not fit the rest.
    """
    damaged, legged = f"{where}: the episodes there are damaged", "command" in arrays
    of_steps = [name for name in arrays if name not in PER_EPISODE]
    described = {"arrays": {name: {"columns": [TEXT]} for name in of_steps}}
    check_form(about, FORM | (LEGGED_FORM if legged else {}) | described, damaged)
    shapes: dict[str, tuple[int, ...]] = {"ended_by": (len(about["terminations"]),)}
    shapes |= {name: (len(about["joints"]),) for name in JOINTS if legged or name in arrays}
    if legged:
        feet = len(about["feet"])
        shapes |= dict.fromkeys(("base_lin_vel", "base_ang_vel", "command"), (3,))
        shapes |= dict.fromkeys(("feet_pos", "feet_force"), (feet, 3))
        shapes |= {"ground": (), "feet_contact": (feet,), "contact_force": (len(about["contacts"]),)}
    missing = [name for name in (*PER_EPISODE, *ALWAYS, *shapes) if name not in arrays]
    if missing:
        raise ConfigError(f"{damaged}: {', '.join(missing)} missing")
    start, failed = arrays["episode_start"], arrays["failed"]
    count = len(failed) if failed.ndim == 1 else 0
    whole = start.shape == (count + 1,) and start.dtype.kind in "iu" and count > 0
    if not whole or start[0] != 0 or (start[1:] <= start[:-1]).any():
        raise ConfigError(f"{damaged}: episode_start does not hold the first rows of {count} episodes")
    for name, array in arrays.items():
        wanted = count + (name == "episode_start") if name in PER_EPISODE else int(start[-1])
        if array.ndim == 0 or array.dtype.kind not in "biuf" or len(array) != wanted:
            got = f"shape {array.shape} of {array.dtype}"
            raise ConfigError(f"{damaged}: {name}: expected {wanted} rows of numbers, got {got}")
    for name in of_steps:
        columns, shape = about["arrays"][name]["columns"], arrays[name].shape[1:]
        named = (len(columns),) if columns or shape else ()
        if shape not in (named, (*named, 3)):
            raise wrong_form(damaged, f"arrays.{name}.columns", f"names for an array of shape {arrays[name].shape}", columns)
    for i, joint in enumerate(about["joints"]):
        for column in ("qpos", "qvel"):
            if joint[column] >= arrays[column].shape[1]:
                raise wrong_form(damaged, f"joints[{i}].{column}", f"a column of {column}", joint[column])
    if legged and arrays["qpos"].shape[1:] < (7,):
        raise ConfigError(f"{damaged}: qpos has no place for a floating base")
    for name, shape in shapes.items():
        if arrays[name].shape[1:] != shape:
            raise ConfigError(f"{damaged}: {name}: expected rows of shape {shape}, got {arrays[name].shape[1:]}")


def write_parquet(episodes: Episodes, folder: Path) -> None:
    """Write TABLE into `folder`, with a row for each control step. Its columns are episode, time [s], and the columns of all
    arrays, with names such as `torque.LF_HAA` and `feet_force.LF_FOOT.x`.

    Raises:
        RunError: the file can't be written.
    """
    import pyarrow
    from pyarrow import parquet

    flat = clock_of(episodes)
    for name in episodes.of(0):
        labels = [f"{name}.{column}" for column in episodes.columns(name)] or [name]
        if episodes[name].ndim == 3:
            labels = [f"{label}.{axis}" for label in labels for axis in AXES]
        flat |= dict(zip(labels, episodes[name].reshape(len(episodes[name]), -1).T, strict=True))
    with replacing(folder / TABLE) as part:
        parquet.write_table(pyarrow.table(flat), part)
    print(f"written: {relative(folder / TABLE)}")
