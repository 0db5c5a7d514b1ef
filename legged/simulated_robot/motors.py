"""The motors of training, for one simulated robot whose commands arrive at any time.

`legged.mdp.actuator` has the same formulas for thousands of robots with one command per control step. For one robot the
operations of a physics step take 0.1 ms in torch and 0.02 ms in numpy, about as long as MuJoCo's own step.
"""

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch

from legged.config import LeggedConfig, override
from legged.config.loader import from_dict
from legged.config.schema import ActuatorConfig
from legged.deploy.contract import Contract
from legged.errors import ConfigError
from legged.mdp.actuator import check_actuator, check_motor_model, friction_numbers, modelled_joints, motor_numbers
from legged.mdp.actuator_network import ActuatorNetwork, NetworkWeights
from legged.robots.robot import Robot

OURS = "control.actuator"
"""Section of a configuration about the motors."""


def motors_config(
    robot: Robot, contract: Contract | None, ideal: bool, changes: Iterable[tuple[str, Any]], dt: float
) -> tuple[ActuatorConfig, float]:
    """Return the configuration of the motors and the time unit of their delay [s]. The motors are those of the training of
    `contract`'s policy, or ideal ones, with `changes` of control.actuator. Without a contract the unit is the motors' step
    `dt`.

    Raises:
        ConfigError: a change concerns another section, or the motors do not fit the robot or the step.
    """
    changes = list(changes)
    for key, _ in changes:
        if key != OURS and not key.startswith(f"{OURS}."):
            raise ConfigError(
                f"command line: {key}: only {OURS} can be changed of a simulated robot, e.g. {OURS}.model=dc_motor"
            )
    source, own = "command line", {}
    counted = dt if contract is None else contract.sim_dt
    if contract is not None and not ideal:
        trained_with = dict(contract.actuator)
        if network := trained_with.get("network"):
            trained_with["network"] = str(contract.path.parent / str(network))
        source, own = f"{contract.path}: actuator", {"control": {"actuator": trained_with}}
    cfg = override(from_dict({"task": "simulated", "robot": str(robot.folder), **own}, source=source), changes)
    assert isinstance(cfg, LeggedConfig)
    try:
        check_actuator(robot, cfg.control, dt, cfg.origins.where)
    except ConfigError as error:
        raise ConfigError(str(error).replace("sim.dt", "--sim-dt")) from error
    check_motor_model(cfg.control.actuator, cfg.origins)
    return cfg.control.actuator, counted


class Motors:
    """Motors of D joints: delay, control law, torque limits and friction."""

    def __init__(self, robot: Robot, cfg: ActuatorConfig, dt: float, counted: float, seed: int = 1) -> None:
        """Create motors with the step `dt` [s]; delays of `cfg` are in steps of `counted` [s] and drawn with `seed`."""
        self._effort = robot.torque_limits
        self._stall, self._fastest = motor_numbers(robot, cfg)
        self._coulomb, breakaway, self._viscous = friction_numbers(robot, cfg)
        self._extra = breakaway - self._coulomb
        self._stribeck, self._smoothing = cfg.stribeck_velocity, cfg.friction_smoothing
        self._has_curve = cfg.model == "dc_motor"
        self._has_friction = bool(self._coulomb.any() or self._extra.any() or self._viscous.any())
        self._random, self._range, self._ratio = np.random.default_rng(seed), cfg.delay, counted / dt
        self._varies = cfg.delay_varies
        self.delay = self._draw()
        """Present delay of a command [steps]."""
        self._past: deque[np.ndarray] = deque([np.zeros((3, robot.num_dof))])  # from the last arrived command on
        self._network: ActuatorNetwork | None = None
        if cfg.network:
            weights = NetworkWeights.load(cfg.network)
            self._network = ActuatorNetwork(weights, 1, robot.num_dof, dt, torch.device("cpu"))
            self._by_network = np.isin(np.arange(robot.num_dof), modelled_joints(robot, cfg))

    def _draw(self) -> int:
        low, high = self._range
        return round(int(self._random.integers(low, high + 1)) * self._ratio)

    def torques(self, command: np.ndarray, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the torques (D,) [N m] of a physics step at angles q [rad] and velocities dq [rad/s], (D,) each. `command`
        is the newest command: targets [rad], P gains [N m/rad] and D gains [N m s/rad], (3, D).
        """
        target, stiffness, damping = self._arrived(command)
        torques = stiffness * (target - q) - damping * dq
        if self._network is not None:
            # The network was fitted with the gains of the policy, not with those of braking.
            torques = np.where(self._by_network & (stiffness > 0.0), self._learned(target - q, dq), torques)
        if self._has_curve:
            share = dq / self._fastest
            torques = np.minimum(np.maximum(torques, self._stall * (-1.0 - share)), self._stall * (1.0 - share))
        torques = np.clip(torques, -self._effort, self._effort)
        return np.clip(torques - self._friction(dq), -self._effort, self._effort) if self._has_friction else torques

    def _arrived(self, command: np.ndarray) -> np.ndarray:
        """Return the newest command that has arrived; commands never overtake each other."""
        if self._varies and not np.array_equal(command, self._past[-1]):
            self.delay = self._draw()
        self._past.append(command.copy())
        while len(self._past) > self.delay + 1:
            self._past.popleft()
        return self._past[0]

    def _friction(self, dq: np.ndarray) -> np.ndarray:
        """Return the friction torques (D,) [N m]."""
        slow = np.exp(-np.square(dq / self._stribeck))
        return (self._coulomb + self._extra * slow) * np.tanh(dq / self._smoothing) + self._viscous * dq

    def _learned(self, error: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the torques (D,) of the network [N m]."""
        assert self._network is not None
        with torch.inference_mode():
            found = self._network.torques(*(torch.tensor(each, dtype=torch.float32).unsqueeze(0) for each in (error, dq)))
        return found[0].double().numpy()
