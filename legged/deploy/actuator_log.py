"""Samples of a log for fitting actuators: evenly spaced, in runs without gaps, while the motors follow targets."""

from collections.abc import Mapping

import numpy as np

from legged.deploy.contract import Contract

SHORTEST = 20
"""Smallest number of samples in a run."""
UNEVEN = 0.75
"""Largest deviation of the time between two samples, as a share of a time step. A clock with a resolution of 1 ms alternates
between 2 and 3 ms at 400 Hz; a missing sample adds a whole step."""


def actuator_arrays(log: Mapping[str, np.ndarray], contract: Contract) -> dict[str, np.ndarray] | None:
    """Return the readings of a log (arrays of `Log.save`) that have the policy's gains and torques; None without such
    readings.

    A missing reading ends a run; repeated readings are left out. The arrays are `joint_names` (D,), `run` (T,), `dt` [s],
    `target`, `position` [rad], `velocity` [rad/s], `torque` [N m] (T, D), and the gains `stiffness`, `damping` (D,).
    """
    if "times" not in log:
        return None
    measured = ("positions", "velocities", "torques")
    usable = (log["stiffness"] == contract.stiffness).all(axis=1) & (log["damping"] == contract.damping).all(axis=1)
    for name in measured:
        usable &= np.isfinite(log[name]).all(axis=1)
    new = np.concatenate([[True], np.diff(log["times"]) != 0.0])
    rows, left_out = np.flatnonzero(usable & new), np.cumsum(new & ~usable)
    if len(rows) < SHORTEST:  # or the robot has no clock
        return None
    steps = np.diff(log["times"][rows])
    usual = float(np.median(steps))
    if not usual > 0.0:
        return None
    apart = (np.diff(left_out[rows]) > 0) | (np.abs(steps - usual) > UNEVEN * usual)
    if apart.all():
        return None
    dt = float(np.mean(steps[~apart]))
    run = np.concatenate([[0], np.cumsum(apart)])
    long = np.bincount(run)[run] >= SHORTEST
    if not long.any():
        return None
    rows, run = rows[long], run[long]
    return {
        "joint_names": np.array(contract.joint_names),
        "dt": np.array(dt),
        "run": np.unique(run, return_inverse=True)[1],
        "target": log["targets"][rows],
        **{name: log[given][rows] for name, given in zip(("position", "velocity", "torque"), measured, strict=True)},
        "stiffness": contract.stiffness,
        "damping": contract.damping,
    }
