"""Observations of a policy, computed from a robot's readings as policy.json describes."""

from collections.abc import Mapping

import numpy as np

from legged.deploy.contract import Contract, Term
from legged.deploy.interface import Reading


def gravity_in(quaternion: np.ndarray) -> np.ndarray:
    """Return the unit vector along gravity (3,) in the frame that `quaternion` (w, x, y, z) rotates to the world frame."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array([2.0 * (w * y - x * z), -2.0 * (y * z + w * x), 2.0 * (x * x + y * y) - 1.0])


class Observer:
    """Builder of observations: scaled and clipped terms, and the histories of their groups."""

    def __init__(self, contract: Contract) -> None:
        """Start with an empty history for the observation of `contract`."""
        self._contract = contract
        self._steps = {group.name: np.zeros((group.history, group.size)) for group in contract.groups}
        self._empty = True

    def restart(self) -> None:
        """Clear the histories; the next observation fills them, as the first one of an episode does in training."""
        self._empty = True

    def observe(self, reading: Reading, command: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Return the observation (width,) float32, with `command` (vx, vy, yaw rate) and the policy's last `actions` (A,).

        Raises:
            KeyError: a source that the policy needs is missing.
        """
        contract = self._contract
        values = self._values(reading, command, actions)
        for group in contract.groups:
            steps = self._steps[group.name]
            steps[:-1] = steps[1:]
            for term in contract.terms:
                if term.group == group.name:
                    start = term.start - group.start
                    steps[-1, start : start + term.size] = term.scale * self._value(term, values, reading)
            np.clip(steps[-1], -contract.observation_clip, contract.observation_clip, out=steps[-1])
            if self._empty:
                steps[:] = steps[-1]
        self._empty = False
        return np.concatenate([self._steps[group.name].ravel() for group in contract.groups]).astype(np.float32)

    def _values(self, reading: Reading, command: np.ndarray, actions: np.ndarray) -> Mapping[str, np.ndarray]:
        """Return the terms that need no source, by name."""
        return {
            "base_ang_vel": reading.gyro,
            "projected_gravity": gravity_in(reading.quaternion),
            "commands": command,
            "dof_pos": reading.positions - self._contract.default,
            "dof_vel": reading.velocities,
            "actions": actions,
        }

    def _value(self, term: Term, values: Mapping[str, np.ndarray], reading: Reading) -> np.ndarray:
        """Return the value (size,) of one term, before its scale."""
        if term.source is None:
            return values[term.name]
        given = reading.sources[term.source]
        if term.source == "heights":
            return np.clip(-given - term.offset, -term.limit, term.deepest)
        return given
