"""Of a log what an actuator is fitted to: samples at even times, in runs without gaps, while the motors follow targets."""

from collections.abc import Mapping

import numpy as np

from legged.deploy.contract import Contract

SHORTEST = 20
"""Samples of a run, at least."""


def actuator_arrays(log: Mapping[str, np.ndarray], contract: Contract) -> dict[str, np.ndarray] | None:
    """Return of the readings of a log (arrays as `Log.save` has them) those with the policy's gains and with torques, in runs
    that end where a reading is missing: `joint_names` (D,), `run` (T,), `dt` [s], `target`, `position` [rad], `velocity`
    [rad/s], `torque` [N m] (T, D), and the gains `stiffness`, `damping` (D,). None if there are none.
    """
    if "times" not in log:
        return None
    measured = ("positions", "velocities", "torques")
    usable = (log["stiffness"] == contract.stiffness).all(axis=1) & (log["damping"] == contract.damping).all(axis=1)
    for name in measured:
        usable &= np.isfinite(log[name]).all(axis=1)
    rows = np.flatnonzero(usable)
    if len(rows) < SHORTEST:
        return None
    steps = np.diff(log["times"][rows])
    dt = float(np.median(steps))
    if not dt > 0.0:  # the robot has no clock
        return None
    run = np.concatenate([[0], np.cumsum((np.diff(rows) > 1) | (np.abs(steps - dt) > 0.5 * dt))])
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
