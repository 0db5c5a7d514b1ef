"""Of a log what an actuator is fitted to: samples at even times, in runs without gaps, while the motors follow targets."""

from collections.abc import Mapping

import numpy as np

from legged.deploy.contract import Contract

SHORTEST = 20
"""Samples of a run, at least."""
UNEVEN = 0.75
"""Share of a time step by which the time between two samples may differ from it: a clock may count milliseconds, and 400 Hz
are 2 and 3 of them in turn; a sample that is missing makes it a whole step more."""


def actuator_arrays(log: Mapping[str, np.ndarray], contract: Contract) -> dict[str, np.ndarray] | None:
    """Return of the readings of a log (arrays as `Log.save` has them) those with the policy's gains and with torques, in runs
    that end where a reading is missing; one that was sent again is left out: `joint_names` (D,), `run` (T,), `dt` [s],
    `target`, `position` [rad], `velocity` [rad/s], `torque` [N m] (T, D), and the gains `stiffness`, `damping` (D,). None if
    there are none.
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
