"""Log of a run: every reading with the targets at that time, and every cycle of the program."""

import json
import tempfile
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from legged.deploy.actuator_log import actuator_arrays
from legged.deploy.contract import Contract
from legged.deploy.interface import Reading
from legged.deploy.states import State
from legged.errors import ConfigError, RunError

STATES = tuple(state.value for state in State)
ACTUATORS = "_actuators"
MOST_READINGS, MOST_CYCLES = 300_000, 60_000
"""Rows that are kept, the newest ones: twenty minutes at 250 readings and 50 cycles per second, a few hundred megabytes."""


class Log:
    """Collector of readings, cycles and notes, which are written as one .npz file."""

    def __init__(self, contract: Contract) -> None:
        """Start an empty log."""
        self._contract = contract
        self._said = json.dumps(json.loads(contract.path.read_text(encoding="utf-8")))
        self._readings: dict[str, deque[Any]] = {}
        self._cycles: dict[str, deque[Any]] = {}
        self._notes: list[tuple[float, str]] = []

    def add_reading(
        self, reading: Reading, state: State, targets: np.ndarray, stiffness: np.ndarray, damping: np.ndarray
    ) -> None:
        """Add a reading with the targets and gains in force at its arrival."""
        nothing = np.full(len(targets), np.nan)
        row = {
            "times": reading.time,
            "received": reading.received,
            "targets": targets,
            "stiffness": stiffness,
            "damping": damping,
            "positions": reading.positions,
            "velocities": reading.velocities,
            "torques": nothing if reading.torques is None else reading.torques,
            "temperatures": nothing if reading.temperatures is None else reading.temperatures,
            "quaternions": reading.quaternion,
            "gyro": reading.gyro,
            "state": STATES.index(state.value),
        }
        for name, value in row.items():
            self._readings.setdefault(name, deque(maxlen=MOST_READINGS)).append(value)

    def add_cycle(self, state: State, **row: float | np.ndarray) -> None:
        """Add a cycle of the program: its state, and values by name; all cycles have the same names."""
        for name, value in {"state": STATES.index(state.value), **row}.items():
            self._cycles.setdefault(name, deque(maxlen=MOST_CYCLES)).append(np.copy(value))

    def note(self, seconds: float, text: str) -> None:
        """Add a note, such as a change of state, at a time after the start [s]."""
        self._notes.append((seconds, text))

    @property
    def notes(self) -> list[str]:
        """Return the notes so far."""
        return [text for _, text in self._notes]

    @staticmethod
    def check(path: Path) -> None:
        """Check before a run that its log can be written to `path`.

        Raises:
            ConfigError: the path is a folder or not writable.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_dir() or path.suffix != ".npz":
                raise ConfigError(f"--log: {path}: the name of an .npz file is wanted")
            with tempfile.TemporaryFile(dir=path.parent):
                return
        except (OSError, ValueError) as error:
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"--log: {path}: cannot be written ({getattr(error, 'strerror', None) or error})") from error

    def save(self, path: Path) -> None:
        """Write the log.

        Arrays by reading: `times` of the robot's clock [s], `received` of this machine's clock [s], `targets` (T, D) [rad],
        `stiffness`, `damping`, `positions` [rad], `velocities` [rad/s], `torques` [N m] and `temperatures` [degrees Celsius],
        both NaN if unknown, `quaternions` (T, 4), `gyro` (T, 3), and `state` (T,), an index into `states`. Arrays by cycle:
        the values of `add_cycle`, with the prefix `cycle_`. The rest: `joint_names`, `states`, `notes`, `note_times` [s] and
        `contract` (JSON). Samples for fitting actuators, if there are any, go to a second file with the suffix `ACTUATORS`.

        Raises:
            RunError: a file cannot be written.
        """
        arrays = {name: np.array(rows) for name, rows in self._readings.items()}
        arrays |= {f"cycle_{name}": np.array(rows) for name, rows in self._cycles.items()}
        arrays |= {
            "joint_names": np.array(self._contract.joint_names),
            "states": np.array(STATES),
            "notes": np.array([text for _, text in self._notes], dtype=str),
            "note_times": np.array([seconds for seconds, _ in self._notes]),
            "contract": np.array(self._said),
        }
        _write(path, arrays)
        beside, of_actuators = path.with_stem(f"{path.stem}{ACTUATORS}"), actuator_arrays(arrays, self._contract)
        if of_actuators is not None:
            _write(beside, of_actuators)
            return
        try:
            beside.unlink(missing_ok=True)  # left by another run
        except OSError as error:
            raise RunError(f"{beside}: {error.strerror or error}") from error


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a file atomically.

    Raises:
        RunError: the file cannot be written.
    """
    part = path.with_name(f".{path.name}.part.npz")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(part, allow_pickle=False, **arrays)  # type: ignore[arg-type]
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise RunError(f"{path}: {error.strerror or error}") from error
