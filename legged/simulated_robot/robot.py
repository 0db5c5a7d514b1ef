"""One robot in C MuJoCo, with motors that are updated at every physics step, and sensors."""

from collections.abc import Mapping

import mujoco
import numpy as np

from legged.config.schema import ActuatorConfig, SimConfig
from legged.deploy.contract import SCANS
from legged.deploy.interface import RobotFacts
from legged.deploy.udp_packets import RobotState
from legged.errors import RunError
from legged.physics import RobotScene
from legged.robots.robot import Robot
from legged.simulated_robot.motors import Motors
from legged.terrain import Terrain

OFFERS = frozenset({"base_lin_vel", "heights"})
"""Additional sources, known to a simulator, which a robot would have to estimate."""
UNSTABLE = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC")]
"""Warnings of MuJoCo that accompany a reset of the state."""
FALLEN = 1.2
"""Tilt of the base above which the robot has fallen [rad]."""


class SimulatedRobot:
    """A robot that starts in its default pose on a plane, or in the middle of the first tile of a terrain."""

    def __init__(
        self,
        robot: Robot,
        terrain: Terrain | None,
        sim: SimConfig,
        motors: Motors | None = None,
        scan: str = SCANS[0],
    ) -> None:
        """Build the world with the solver options of `sim` and motors, by default ideal ones. `scan` is the setting
        terrain.scan for the heights.
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
        count = robot.num_dof
        self.asked = np.zeros((3, count))
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

    def state(self, sources: Mapping[str, np.ndarray | None]) -> RobotState:
        """Return the present measurements and the requested sources, `heights` at its points (P, 2)."""
        data = self.data
        return RobotState(
            time=float(data.time),
            quaternion=data.qpos[3:7].copy(),
            gyro=data.qvel[3:6].copy(),  # MuJoCo has the angular velocity of a floating base in the base's frame
            positions=data.qpos[self._qpos],
            velocities=data.qvel[self._qvel],
            torques=data.ctrl.copy(),
            sources={name: self._source(name, points) for name, points in sources.items() if name in OFFERS},
        )

    def _source(self, name: str, points: np.ndarray | None) -> np.ndarray:
        """Return a source in the form of `legged.deploy.interface.Reading.sources`."""
        position, quaternion = self.data.qpos[:3], self.data.qpos[3:7]
        entries = np.zeros(9)
        mujoco.mju_quat2Mat(entries, quaternion)
        rotation = entries.reshape(3, 3)
        if name == "base_lin_vel":
            return rotation.T @ self.data.qvel[:3]
        points = np.zeros((0, 2)) if points is None else points
        yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        return self._ground(position[:2] + points @ turn.T) - position[2]

    def _ground(self, places: np.ndarray) -> np.ndarray:
        """Return the heights of the ground at world points (P, 2) as in training [m]."""
        if self._terrain is None or self._scan is None:
            return np.zeros(len(places))
        return self._scan[self._terrain.height_map.index(*places.T)]

    def report(self) -> dict[str, float | bool]:
        """Return the distances moved [m], the largest lean [rad], and whether the robot fell."""
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
