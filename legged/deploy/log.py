"""Log of a run: readings with joint targets and gains, cycles of the program, and samples for fitting actuators."""

import json
import tempfile
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from legged.deploy.contract import Contract
from legged.deploy.errors import ConfigError, RunError
from legged.deploy.interface import Reading
from legged.deploy.operators import State

STATES = tuple(state.value for state in State)
ACTUATORS = "_actuators"
MOST_READINGS, MOST_CYCLES = 300_000, 60_000
"""Largest numbers of readings and cycles. At 250 readings and 50 cycles a second, a log covers its last 20 minutes."""
SHORTEST = 20
"""Smallest number of samples in an uninterrupted sequence. Shorter sequences are not used for fitting actuators."""
UNEVEN = 0.75
"""Largest deviation of the time between two consecutive samples from the usual time step, as a share of that step. At 400 Hz,
a clock with 1 ms resolution shows steps of 2 and 3 ms, which must be accepted. A missing sample adds a whole step."""
MEASURED = {"position": "positions", "velocity": "velocities", "torque": "torques"}
"""Name of an array of the samples for fitting -> name of the same array in the log."""


class Log:
    """Collector of readings, cycles and notes, which are written as one .npz file."""

    def __init__(self, contract: Contract) -> None:
        self._contract = contract
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
        """Add a cycle of the program: the program's state and named values. All cycles must have the same names."""
        for name, value in {"state": STATES.index(state.value), **row}.items():
            self._cycles.setdefault(name, deque(maxlen=MOST_CYCLES)).append(np.copy(value))

    def note(self, seconds: float, text: str) -> None:
        """Add a note, such as a change of state. `seconds` is the time since the start of the run [s]."""
        self._notes.append((seconds, text))

    @property
    def notes(self) -> list[str]:
        """Return the notes so far."""
        return [text for _, text in self._notes]

    def save(self, path: Path) -> None:
        """Write the log.

        Arrays with a row for each reading: `times` (robot's clock) and `received` (this machine's clock) (T,) [s]; `targets`
        and `positions` [rad], `stiffness`, `damping`, `velocities` [rad/s], `torques` [N m], `temperatures` [degrees Celsius]
        (T, D); `quaternions` (T, 4); `gyro` (T, 3); `state` (T,), an index into `states`. Unknown torques and temperatures
        are NaN. Arrays with a row for each cycle: the values of `add_cycle`, with the prefix `cycle_`. Further arrays:
        `joint_names`, `states`, `notes`, `note_times` [s] and `contract` (JSON).
        Samples for fitting actuators, if there are any, go to a second file, whose name has `ACTUATORS` before .npz.

        Raises:
            RunError: a file cannot be written.
        """
        arrays = {name: np.array(rows) for name, rows in self._readings.items()}
        arrays |= {f"cycle_{name}": np.array(rows) for name, rows in self._cycles.items()}
        arrays |= {
            "joint_names": np.array(self._contract.joint_names),
            "states": np.array(STATES),
            "notes": np.array(self.notes, dtype=str),
            "note_times": np.array([seconds for seconds, _ in self._notes]),
            "contract": np.array(json.dumps(self._contract.entries)),
        }
        beside, samples = path.with_stem(f"{path.stem}{ACTUATORS}"), actuator_arrays(arrays, self._contract)
        _write(path, arrays)
        if samples is not None:
            _write(beside, samples)
        else:
            beside.unlink(missing_ok=True)  # an earlier run may have left this file


def check_folder(folder: Path) -> None:
    """Make the folder of the log, and check before the robot moves that a file can be written there.

    Raises:
        ConfigError: no file can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder, buffering=0) as probe:
            probe.write(bytes(2**20))
    except OSError as error:
        raise ConfigError(f"--log: cannot write to the folder {folder}: {error.strerror or error}") from error


def _write(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write an .npz file under another name, and rename it when it is complete. A missing folder is made.

    Raises:
        RunError: the file cannot be written.
    """
    part = path.with_name(f".{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)  # type: ignore[arg-type]
        part.replace(path)
    except OSError as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error


def actuator_arrays(log: Mapping[str, np.ndarray], contract: Contract) -> dict[str, np.ndarray] | None:
    """Return the samples for fitting actuators, or None if the log has too few. The samples are readings with known torques
    and with the policy's gains. `log` has the arrays of `Log.save`.

    A gap between samples begins a new sequence. Repeated readings are left out. The arrays are `joint_names` (D,), `dt` [s],
    `run` (T,) (number of the sequence), `target` and `position` [rad], `velocity` [rad/s], `torque` [N m] (T, D), and the
    gains `stiffness` and `damping` (D,).
    """
    if "times" not in log:
        return None
    usable = (log["stiffness"] == contract.stiffness).all(axis=1) & (log["damping"] == contract.damping).all(axis=1)
    for name in MEASURED.values():
        usable &= np.isfinite(log[name]).all(axis=1)
    new = np.concatenate([[True], np.diff(log["times"]) != 0.0])
    rows, left_out = np.flatnonzero(usable & new), np.cumsum(new & ~usable)
    if len(rows) < SHORTEST:  # if the robot has no clock, all times are equal, and only the first is new
        return None
    steps = np.diff(log["times"][rows])
    usual = float(np.median(steps))
    apart = (np.diff(left_out[rows]) > 0) | (np.abs(steps - usual) > UNEVEN * usual)
    if not usual > 0.0 or apart.all():
        return None
    run = np.concatenate([[0], np.cumsum(apart)])
    long = np.bincount(run)[run] >= SHORTEST
    if not long.any():
        return None
    rows, run = rows[long], run[long]
    return {
        "joint_names": np.array(contract.joint_names),
        "dt": np.array(float(np.mean(steps[~apart]))),
        "run": np.unique(run, return_inverse=True)[1],
        "target": log["targets"][rows],
        **{name: log[given][rows] for name, given in MEASURED.items()},
        "stiffness": contract.stiffness,
        "damping": contract.damping,
    }
