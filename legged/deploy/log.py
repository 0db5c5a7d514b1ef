"""Log of a run: readings with the targets at their time, cycles of the program, and samples for fitting actuators."""

import json
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from legged.deploy.contract import Contract
from legged.deploy.interface import Reading
from legged.deploy.operators import State
from legged.process.paths import make_folder, replacing

STATES = tuple(state.value for state in State)
ACTUATORS = "_actuators"
MOST_READINGS, MOST_CYCLES = 300_000, 60_000
"""Largest numbers of rows; older rows are dropped. They last for 20 minutes at 250 readings and 50 cycles per second."""
SHORTEST = 20
"""Smallest number of samples without a gap that is used for fitting."""
UNEVEN = 0.75
"""Largest deviation of the time between two samples, as a share of a time step. A clock with a resolution of 1 ms alternates
between 2 and 3 ms at 400 Hz; a missing sample adds a whole step."""
MEASURED = {"position": "positions", "velocity": "velocities", "torque": "torques"}
"""Array of the samples for fitting -> array of the log."""


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

    def save(self, path: Path) -> None:
        """Write the log.

        Arrays by reading: `times` of the robot's clock [s], `received` of this machine's clock [s], `targets` (T, D) [rad],
        `stiffness`, `damping`, `positions` [rad], `velocities` [rad/s], `torques` [N m] and `temperatures` [degrees Celsius],
        both NaN if unknown, `quaternions` (T, 4), `gyro` (T, 3), and `state` (T,), an index into `states`. Arrays by cycle:
        the values of `add_cycle`, with the prefix `cycle_`. Others: `joint_names`, `states`, `notes`, `note_times` [s] and
        `contract` (JSON). Samples for fitting actuators, if there are any, go to a second file with the suffix `ACTUATORS`.

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
        make_folder(path.parent)
        beside, samples = path.with_stem(f"{path.stem}{ACTUATORS}"), actuator_arrays(arrays, self._contract)
        with replacing(path) as part:
            np.savez_compressed(part, allow_pickle=False, **arrays)  # type: ignore[arg-type]
            beside.unlink(missing_ok=True)  # an earlier run may have left this file
        if samples is not None:
            with replacing(beside) as part:
                np.savez_compressed(part, allow_pickle=False, **samples)  # type: ignore[arg-type]


def actuator_arrays(log: Mapping[str, np.ndarray], contract: Contract) -> dict[str, np.ndarray] | None:
    """Return the samples for fitting from a log (arrays of `Log.save`); None if it has too few. They are the evenly spaced
    readings with the policy's gains and with torques.

    A missing reading ends a run; repeated readings are left out. The arrays are `joint_names` (D,), `run` (T,), `dt` [s],
    `target`, `position` [rad], `velocity` [rad/s], `torque` [N m] (T, D), and the gains `stiffness`, `damping` (D,).
    """
    if "times" not in log:
        return None
    usable = (log["stiffness"] == contract.stiffness).all(axis=1) & (log["damping"] == contract.damping).all(axis=1)
    for name in MEASURED.values():
        usable &= np.isfinite(log[name]).all(axis=1)
    new = np.concatenate([[True], np.diff(log["times"]) != 0.0])
    rows, left_out = np.flatnonzero(usable & new), np.cumsum(new & ~usable)
    if len(rows) < SHORTEST:  # also without a clock, when all readings have the same time
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
