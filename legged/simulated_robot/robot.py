"""One robot in C MuJoCo, with sensors and with the motor model of training. Commands may arrive at any time.

`legged.mdp.actuators` computes the motors of thousands of robots in torch, with one command per control step. This file has
the same formulas in numpy. For one robot they take 0.02 ms per physics step, but 0.1 ms in torch. MuJoCo's own step takes
about 0.02 ms.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
import torch

from legged.config import has_robot, override
from legged.config.actuator import ActuatorConfig
from legged.config.loader import from_dict
from legged.config.world import SimConfig
from legged.deploy.contract import SCANS, Contract
from legged.deploy.interface import Reading, RobotFacts
from legged.errors import ConfigError, RunError
from legged.mdp.actuators.actuator import check_actuator, one_robot
from legged.mdp.actuators.friction import friction_numbers
from legged.mdp.actuators.model import JointStep, modelled_joints, registered_models
from legged.mdp.actuators.motor_curve import check_motor_model, motor_numbers
from legged.mdp.actuators.network import ActuatorNetwork, NetworkWeights
from legged.physics import RobotScene
from legged.robots.robot import Robot
from legged.terrain import Terrain

OFFERS = frozenset({"base_lin_vel", "heights"})
"""Observations that the simulator knows. A real robot has no sensors for them and would have to estimate them."""
UNSTABLE = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC")]
"""MuJoCo's warnings that a state is unstable, after which MuJoCo resets the state."""
FALLEN = 1.2
"""The robot has fallen if its base tilts by more than this [rad]."""
OURS = "control.actuator"
"""Section of the configuration that sets the motors."""


def motors_config(
    robot: Robot, contract: Contract | None, ideal: bool, changes: Iterable[tuple[str, Any]], dt: float
) -> tuple[ActuatorConfig, float]:
    """Return the configuration of the motors, and the time unit of their delay [s]. The motors are those with
    which the policy of `contract` was trained. They are ideal if there is no contract or `ideal` is True. Then `changes` to
    control.actuator are made. The time unit is the physics step of the training, or `dt` [s] without a contract.

    Raises:
        ConfigError: a change concerns another section, or the motors do not fit the robot or the physics step.
    """
    changes = list(changes)
    for key, _ in changes:
        if key != OURS and not key.startswith(f"{OURS}."):
            raise ConfigError(
                f"command line: {key}: a simulated robot takes only settings of {OURS}, e.g. {OURS}.model=dc_motor"
            )
    source, own = "command line", {}
    if contract is not None and not ideal:
        trained_with = dict(contract.actuator)
        if network := trained_with.get("network"):
            trained_with["network"] = str(contract.path.parent / str(network))
        source, own = f"{contract.path}: actuator", {"control": {"actuator": trained_with}}
    cfg = override(from_dict({"task": "simulated", "robot": str(robot.folder), **own}, source=source), changes)
    assert has_robot(cfg)
    try:
        check_actuator(robot, cfg.control, dt, cfg.origins)
    except ConfigError as error:
        raise ConfigError(str(error).replace("sim.dt", "--sim-dt")) from error
    check_motor_model(cfg.control.actuator, cfg.origins)
    return cfg.control.actuator, dt if contract is None else contract.sim_dt


class Motors:
    """Motors of D joints: delay, control law, torque limits and friction."""

    def __init__(self, robot: Robot, cfg: ActuatorConfig, dt: float, counted: float, seed: int = 1) -> None:
        """Create motors for steps of `dt` [s]. Delays in `cfg` are in units of `counted` [s]; `seed` is for random delays."""
        self._effort = robot.torque_limits
        self._stall, self._fastest = motor_numbers(robot, cfg)
        self._coulomb, breakaway, self._viscous = friction_numbers(robot, cfg)
        self._extra = breakaway - self._coulomb
        self._stribeck, self._smoothing = cfg.stribeck_velocity, cfg.friction_smoothing
        self._has_curve = cfg.model == "dc_motor"
        self._random, self._range, self._ratio = np.random.default_rng(seed), cfg.delay, counted / dt
        self._varies = cfg.delay_varies
        self.delay = self._draw()
        """Present delay of a command [steps]."""
        self._past: deque[np.ndarray] = deque([np.zeros((3, robot.num_dof))])  # the arrived command, then the delayed ones
        self._network: ActuatorNetwork | None = None
        if cfg.network:
            weights = NetworkWeights.load(cfg.network)
            self._network = ActuatorNetwork(weights, 1, robot.num_dof, dt, torch.device("cpu"))
            self._by_network = np.isin(np.arange(robot.num_dof), modelled_joints(robot, cfg))
        self._own = registered_models(one_robot(robot, cfg, dt)).values()

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
            # The network was fitted with the policy's gains. It does not apply to braking, where the stiffness is 0.
            torques = np.where(self._by_network & (stiffness > 0.0), self._learned(target - q, dq), torques)
        if self._has_curve:
            share = dq / self._fastest
            torques = np.minimum(np.maximum(torques, self._stall * (-1.0 - share)), self._stall * (1.0 - share))
        torques = np.clip(torques, -self._effort, self._effort)
        slow = np.exp(-np.square(dq / self._stribeck))
        friction = (self._coulomb + self._extra * slow) * np.tanh(dq / self._smoothing) + self._viscous * dq
        torques = np.clip(torques - friction, -self._effort, self._effort)
        return self._by_own_models(torques, target, q, dq) if self._own else torques

    def _arrived(self, command: np.ndarray) -> np.ndarray:
        """Return the newest command that has arrived; commands never overtake each other."""
        if self._varies and not np.array_equal(command, self._past[-1]):
            self.delay = self._draw()
        self._past.append(command.copy())
        while len(self._past) > self.delay + 1:
            self._past.popleft()
        return self._past[0]

    def _by_own_models(self, *joints: np.ndarray) -> np.ndarray:
        """Return the torques (D,) [N m] of the user-defined models, within the effort limits. `joints` are the torques of the
        built-in models [N m], targets [rad], angles [rad] and velocities [rad/s], (D,) each.
        """
        rows = (torch.tensor(each, dtype=torch.float32).unsqueeze(0) for each in (*joints, self._effort))
        torques, *step = rows
        with torch.inference_mode():
            for model in self._own:
                torques = model.torques(torques, JointStep(*step))
        return np.clip(torques[0].double().numpy(), -self._effort, self._effort)

    def _learned(self, error: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the torques (D,) of the network [N m]."""
        assert self._network is not None
        with torch.inference_mode():
            found = self._network.torques(*(torch.tensor(each, dtype=torch.float32).unsqueeze(0) for each in (error, dq)))
        return found[0].double().numpy()


class SimulatedRobot:
    """A robot that starts in its default pose on a plane, or in the middle of the first tile of a terrain."""

    def __init__(
        self, robot: Robot, terrain: Terrain | None, sim: SimConfig, motors: Motors | None = None, scan: str = SCANS[0]
    ) -> None:
        """Build the world with the solver options of `sim`. Motors are ideal by default. `scan` is the setting terrain.scan,
        for the source `heights`.
        """
        self.robot, self._terrain = robot, terrain
        self.model = RobotScene(robot, terrain).model(sim)
        self.data = mujoco.MjData(self.model)
        self._motors = Motors(robot, ActuatorConfig(), sim.dt, sim.dt) if motors is None else motors
        self._qpos, self._qvel = list(robot.qpos_columns), list(robot.qvel_columns)
        start = np.zeros(3) if terrain is None else terrain.origins[0, 0]
        self.data.qpos[:] = robot.default_qpos
        self.data.qpos[:3] = start + np.array([0.0, 0.0, robot.height])
        self._scan = None if terrain is None else terrain.height_map.scan_map(scan)
        mujoco.mj_forward(self.model, self.data)
        self.asked = np.zeros((3, robot.num_dof))
        """(3, D) targets [rad], P gains [N m/rad], D gains [N m s/rad]."""
        self._start = self.data.qpos[:3].copy()
        self.lowest, self.highest, self.steepest = float(self._start[2]), float(self._start[2]), 0.0
        """Smallest and largest height of the base so far [m], and its largest lean [rad]."""

    @property
    def facts(self) -> RobotFacts:
        """Return the robot's properties."""
        robot = self.robot
        return RobotFacts(
            name=robot.name,
            joint_names=robot.joint_names,
            position_limits=robot.dof_pos_limits,
            velocity_limits=robot.dof_vel_limits,
            torque_limits=robot.torque_limits,
            imu_body=robot.file.base,
            offers=OFFERS,
        )

    def step(self) -> None:
        """Make one physics step with the present torques of the motors.

        Raises:
            RunError: the simulation became unstable.
        """
        data, before = self.data, self.data.time
        data.ctrl[:] = self._motors.torques(self.asked, data.qpos[self._qpos], data.qvel[self._qvel])
        mujoco.mj_step(self.model, data)
        if any(data.warning[i].number for i in UNSTABLE):
            dt = self.model.opt.timestep
            raise RunError(f"the simulation became unstable after {before:.2f} s at steps of {dt:g} s (--sim-dt)")
        self.lowest, self.highest = min(self.lowest, data.qpos[2]), max(self.highest, data.qpos[2])
        _, x, y, _ = data.qpos[3:7]
        self.steepest = max(self.steepest, float(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))))

    def state(self, sources: Mapping[str, np.ndarray | None]) -> Reading:
        """Return the present measurements and the requested `sources` (name -> points (P, 2) [m] or None)."""
        data = self.data
        return Reading(
            time=float(data.time),
            received=0.0,
            quaternion=data.qpos[3:7].copy(),
            gyro=data.qvel[3:6].copy(),  # MuJoCo has the angular velocity of a floating base in the base's frame
            positions=data.qpos[self._qpos],
            velocities=data.qvel[self._qvel],
            torques=data.ctrl.copy(),
            sources={name: self._source(name, points) for name, points in sources.items() if name in OFFERS},
        )

    def _source(self, name: str, points: np.ndarray | None) -> np.ndarray:
        """Return the value of a source, as described at `legged.deploy.interface.Reading.sources`."""
        position, entries = self.data.qpos[:3], np.zeros(9)
        mujoco.mju_quat2Mat(entries, self.data.qpos[3:7])
        rotation = entries.reshape(3, 3)
        if name == "base_lin_vel":
            return rotation.T @ self.data.qvel[:3]
        points = np.zeros((0, 2)) if points is None else points
        if self._terrain is None or self._scan is None:
            return np.zeros(len(points)) - position[2]
        yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        places = position[:2] + points @ turn.T
        return self._scan[self._terrain.height_map.index(*places.T)] - position[2]

    def report(self) -> dict[str, float | bool]:
        """Return the time [s], distances moved and base heights [m], the largest lean [rad], and whether the robot fell."""
        moved = self.data.qpos[:3] - self._start
        return {
            "time": float(self.data.time),
            "forward": float(moved[0]),
            "distance": float(np.hypot(*moved[:2])),
            "climbed": float(moved[2]),
            "lowest_base": self.lowest,
            "highest_base": self.highest,
            "largest_lean": self.steepest,
            "fell": self.steepest > FALLEN,
        }
