"""Logs of actuators: .npz files of joint targets, positions, velocities and torques. A log has runs without gaps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from legged.errors import ConfigError, suggest
from legged.robots.patterns import match_names

MEASURED = ("target", "position", "velocity", "torque")
DRIVE = ("stiffness", "damping", "torque_limit")
NEEDED, OPTIONAL = ("joint_names", *MEASURED), ("dt", "time", "run", *DRIVE)
"""Required and optional arrays of a file."""
BLOCKS = 10
"""Number of equal blocks of time in a run. Every `HELD_OUT`th block is held out from the fit."""
HELD_OUT = 5
FEWEST_HELD_OUT = 0.1
"""Whole runs are held out only if these runs together have at least this share of all samples."""
UNEVEN = 0.01
"""Largest allowed deviation of a sample interval from the time step, as a share of the time step."""
SHORTEST = 200
"""Smallest number of samples of a joint."""


@dataclass(frozen=True)
class ActuatorLog:
    """T samples of D joints, `dt` [s] apart within a run."""

    joint_names: tuple[str, ...]
    dt: float
    run: np.ndarray
    """(T,) index of the run that a sample belongs to. Runs have no gaps."""
    target: np.ndarray
    """(T, D) target angles sent by the controller [rad]."""
    position: np.ndarray
    """(T, D) measured angles [rad]."""
    velocity: np.ndarray
    """(T, D) measured velocities [rad/s]."""
    torque: np.ndarray
    """(T, D) measured torques [N m]."""
    stiffness: np.ndarray | None = None
    """(D,) P gains of the drives [N m/rad], if known. `damping` (D,) holds the D gains [N m s/rad]."""
    damping: np.ndarray | None = None
    torque_limit: np.ndarray | None = None
    """(D,) torque limits of the drives [N m], if known."""

    @property
    def has_gains(self) -> bool:
        """Return whether both gains of the drives are known."""
        return self.stiffness is not None and self.damping is not None

    @property
    def held_out(self) -> np.ndarray:
        """Return the mask (T,) of the samples that are held out from the fit, about a fifth of all: whole runs or, if
        there are fewer than five runs or one run has nearly all samples, every fifth block of time in each run.
        """
        runs, lengths = np.unique(self.run, return_counts=True)
        if len(runs) >= HELD_OUT:
            chosen, share = _about_a_fifth(lengths)
            if share >= FEWEST_HELD_OUT:
                return np.isin(self.run, runs[chosen])
        held = np.zeros(len(self.run), dtype=bool)
        for number in runs:
            rows = np.flatnonzero(self.run == number)
            block = np.arange(len(rows)) * BLOCKS // len(rows)
            held[rows] = block % HELD_OUT == HELD_OUT - 1
        return held

    def only(self, patterns: Sequence[str]) -> "ActuatorLog":
        """Return the log of the joints whose names contain one of the patterns; without patterns, the whole log.

        Raises:
            ConfigError: a pattern matches no joint.
        """
        if not patterns:
            return self
        keep = list(match_names(tuple(patterns), self.joint_names, "--joints"))
        chosen = {name: getattr(self, name)[..., keep] for name in (*MEASURED, *DRIVE) if getattr(self, name) is not None}
        return replace(self, joint_names=tuple(self.joint_names[i] for i in keep), **chosen)

    def resampled(self, dt: float) -> "ActuatorLog":
        """Return the log resampled every `dt` [s]: measurements by linear interpolation, targets by a zero-order hold.

        Raises:
            ConfigError: the log's samples are further apart than `dt`.
        """
        if np.isclose(dt, self.dt, rtol=UNEVEN):
            return replace(self, dt=dt)
        if dt < self.dt:
            raise ConfigError(f"--dt: must be at least {self.dt:g} s (the time step of the log), got {dt:g}")
        parts: dict[str, list[np.ndarray]] = {name: [] for name in ("run", *MEASURED)}
        for number in np.unique(self.run):
            rows = np.flatnonzero(self.run == number)
            at = np.arange(0.0, (len(rows) - 1) * self.dt * (1.0 + 1e-9), dt) / self.dt
            before = np.minimum(np.floor(at + 1e-6).astype(int), len(rows) - 1)
            parts["run"].append(np.full(len(at), number))
            parts["target"].append(self.target[rows[before]])
            for name in MEASURED[1:]:
                joints = getattr(self, name)[rows].T
                parts[name].append(np.stack([np.interp(at, np.arange(len(rows)), values) for values in joints], axis=1))
        joined: dict[str, Any] = {name: np.concatenate(values) for name, values in parts.items()}
        return replace(self, dt=dt, **joined)


def _about_a_fifth(lengths: np.ndarray) -> tuple[list[int], float]:
    """Return indices of runs that together have about a fifth of all samples, and their exact share of the samples."""
    order = [i for first in reversed(range(HELD_OUT)) for i in range(first, len(lengths), HELD_OUT)]
    wanted, held, chosen = lengths.sum() / HELD_OUT, 0, []
    for i in order:
        if abs(held + lengths[i] - wanted) < abs(held - wanted):
            chosen.append(i)
            held += int(lengths[i])
    return chosen, held / lengths.sum()


def read_log(path: Path) -> ActuatorLog:
    """Read an .npz file. It must hold `joint_names` (D,) and `target`, `position`, `velocity` and `torque` (T, D), and either
    `dt` [s] or `time` (T,) [s]. It may hold `run` (T,), and the drives' `stiffness`, `damping` and `torque_limit`, each (D,)
    or one number for all joints.

    Raises:
        ConfigError: an array is missing, unknown, of a wrong shape or not finite, or the samples are not evenly spaced.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or 'is not an .npz file'}") from error
    except Exception as error:  # zipfile, numpy and zlib have exceptions of their own
        raise ConfigError(f"{path}: is not an .npz file of plain arrays") from error
    for name in arrays:
        if name not in NEEDED + OPTIONAL:
            raise ConfigError(f"{path}: unknown key '{name}'{suggest(name, NEEDED + OPTIONAL)}")
    for name in NEEDED:
        if name not in arrays:
            raise ConfigError(f"{path}: '{name}' is missing (keys: {', '.join(NEEDED)}, and dt or time)")

    def numbers(name: str, expected: str, *shapes: tuple[int, ...]) -> np.ndarray:
        if arrays[name].shape not in shapes:
            raise ConfigError(f"{path}: {name}: expected {expected}, got {arrays[name].shape}")
        if arrays[name].dtype.kind not in ("bfiu" if name == "run" else "fiu") or not np.isfinite(arrays[name]).all():
            raise ConfigError(f"{path}: {name}: expected finite numbers")
        return arrays[name].astype(np.float64)

    names = tuple(str(name) for name in np.atleast_1d(arrays["joint_names"]))
    if len(set(names)) < len(names):
        raise ConfigError(f"{path}: joint_names: must differ from each other, got {', '.join(names)}")
    count, shape = (len(names),), arrays["target"].shape
    if len(shape) != 2 or shape[1:] != count:
        raise ConfigError(f"{path}: target: expected (samples, {len(names)} joints), got {shape}")
    found = {name: numbers(name, f"{shape} as target", shape) for name in MEASURED}
    if shape[0] < SHORTEST:
        raise ConfigError(f"{path}: target: {shape[0]} samples are too few; at least {SHORTEST} are needed")
    arrays.setdefault("run", np.zeros(shape[0]))
    run = numbers("run", f"({shape[0]},)", shape[:1])
    # If a run number comes back after another one, as in concatenated logs, it counts as a new run.
    run = np.concatenate([[0], np.cumsum(run[1:] != run[:-1])])
    for name in (name for name in DRIVE if name in arrays):
        values = numbers(name, f"a number or ({len(names)},)", (), (1,), count)
        if values.min() < 0.0 or (name == "torque_limit" and values.min() == 0.0):
            allowed = "above 0" if name == "torque_limit" else "0 or more"
            raise ConfigError(f"{path}: {name}: must be {allowed}, got {values.min():g}")
        found[name] = np.broadcast_to(values, count).copy()
    steps = [float(numbers("dt", "a number", (), (1,)).item())] if "dt" in arrays else []
    if "time" in arrays:
        steps.append(_even_step(numbers("time", f"{run.shape}", run.shape), run, path))
    if not steps:
        raise ConfigError(f"{path}: 'dt' is missing; add the time between two samples [s], or the 'time' of each sample [s]")
    if not steps[0] > 0.0:
        raise ConfigError(f"{path}: dt: must be above 0, got {steps[0]:g}")
    if not np.isclose(steps[-1], steps[0], rtol=UNEVEN):
        raise ConfigError(f"{path}: dt: got {steps[0]:g} s, but 'time' says {steps[1]:g} s; leave one of them out")
    return ActuatorLog(names, steps[0], run, **found)


def check_alike(log: ActuatorLog, path: Path) -> None:
    """Check that one drive can be fitted to a log: its torques vary, and its joints have the same gains and torque limits.

    Raises:
        ConfigError: the torques are constant, or the joints differ in a gain or in the torque limit.
    """
    fitted_to = log.torque[~log.held_out]
    if fitted_to.min() == fitted_to.max():
        raise ConfigError(f"{path}: torque: is {fitted_to[0, 0]:g} N m throughout; nothing can be fitted to that")
    for name in DRIVE if log.has_gains else DRIVE[2:]:  # the fit uses gains only if both are known
        values = getattr(log, name)
        if values is None or np.allclose(values, values[0], rtol=1e-4, atol=0.0):
            continue
        low, high = int(values.argmin()), int(values.argmax())
        raise ConfigError(
            f"{path}: {name}: {values[low]:.4g} at {log.joint_names[low]}, {values[high]:.4g} at {log.joint_names[high]}; one"
            " drive is fitted to all joints, so use --joints to select joints with equal values"
        )


def _even_step(time: np.ndarray, run: np.ndarray, path: Path) -> float:
    """Return the time step [s] of samples taken at `time` (T,) [s]. The time step must be constant within each run."""
    steps = np.diff(time)[np.diff(run) == 0]
    if not len(steps):
        raise ConfigError(f"{path}: run: no two consecutive samples have the same run, so 'time' does not give a time step")
    dt = float(np.median(steps))
    if dt <= 0.0 or np.abs(steps - dt).max() > max(UNEVEN * dt, 1e-9):
        worst = float(np.abs(steps - dt).max())
        raise ConfigError(
            f"{path}: time: samples are not evenly spaced (median step {dt:g} s, one is off by {worst:g} s); cut the log into"
            " runs at its gaps (key 'run'), or interpolate it"
        )
    return dt
