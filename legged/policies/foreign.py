"""Policies as ONNX files, from this package or other projects, with a layout that describes their observations and actions.

A layout is a YAML file, or the policy.json of an export.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from legged.config.actuator import ActuatorConfig
from legged.config.bounds import LARGEST, between, items, positive
from legged.config.checks import build
from legged.config.yaml_files import read_yaml
from legged.deploy.contract import Contract, read_contract
from legged.deploy.policy import listed, open_onnx, warm_up
from legged.errors import ConfigError, suggest
from legged.mdp.actuators.actuator import is_ideal
from legged.process.paths import data_folder, exists
from legged.robots.patterns import match_values
from legged.robots.robot import Robot

TERMS = {
    "base_lin_vel": "linear velocity of the base, base frame [m/s]",
    "base_ang_vel": "angular velocity of the base, base frame [rad/s]",
    "projected_gravity": "unit vector along gravity, base frame",
    "command_xy": "commanded vx and vy [m/s]",
    "command_yaw": "commanded yaw rate [rad/s]",
    "dof_pos": "joint angles less the default ones [rad]",
    "dof_vel": "joint velocities [rad/s]",
    "actions": "the policy's last output",
    "phase_sin": "sine of each clock's phase",
    "phase_cos": "cosine of each clock's phase",
    "reference": "joint angles [rad] and velocities [rad/s] of a tracker's motion",
    "anchor_pos": "position of the motion's anchor in the frame of the robot's anchor [m]",
    "anchor_ori": "its orientation in this frame: two columns of the matrix, row by row",
}
"""Terms of which an observation may consist."""
OF_TRACKERS = ("reference", "anchor_pos", "anchor_ori")
"""Terms that only trackers observe; `OF_WALKERS` are those that trackers do not observe."""
OF_WALKERS = ("command_xy", "command_yaw", "phase_sin", "phase_cos")
OF_TRACKER_LAYOUTS = ("task", "observation", "action_scale", "velocity_point")
"""Settings of a tracker's layout. The others come from its task and its file."""
COMMANDS = ("command_xy", "command_yaw")
"""Terms of a layout for the two parts of the term `commands` of policy.json: its first two columns, and its third column."""
JOINTS, STIFFNESS, DAMPING = (
    ("dof_names", "joint_names"),
    ("kp", "stiffness", "joint_stiffness"),
    ("kd", "damping", "joint_damping"),
)
"""Possible keys in an ONNX file's metadata for the joints in the network's order, for P gains, and for D gains."""


@dataclass(frozen=True)
class Layout:
    """The schema of a layout: a policy's observation, and the meaning of its output."""

    observation: dict[str, float] = field(metadata=between(-LARGEST, LARGEST))
    """Term -> its scale, in the order of the columns."""
    action_scale: float | dict[str, float] = field(default=0.25, metadata=positive(LARGEST))
    """Target = action_scale * action + default angle [rad]; one number, or joint-name pattern -> number."""
    action_clip: float = field(default=100.0, metadata=positive(LARGEST))
    """Absolute value at which actions are clipped."""
    joints: tuple[str, ...] = ()
    """Joints in the policy's order. If empty: those in the ONNX file's metadata, or else the robot's."""
    action_joints: tuple[str, ...] = ()
    """Joints that have an action, in the order of the actions. Joints without an action stay at their default angles. If
    empty: all joints."""
    default_joint_angles: dict[str, float] = field(default_factory=dict, metadata=between(-100, 100))
    """Joint-name pattern -> angle at action 0 [rad]. If empty: the robot's."""
    stiffness: dict[str, float] = field(default_factory=dict, metadata=between(0, LARGEST))
    """Joint-name pattern -> P gain [N m/rad]. If empty: the gains in the ONNX file's metadata, or else the robot's."""
    damping: dict[str, float] = field(default_factory=dict, metadata=between(0, LARGEST))
    """Joint-name pattern -> D gain [N m s/rad]. If empty: the gains in the ONNX file's metadata, or else the robot's."""
    torque_limits: dict[str, float] = field(default_factory=dict, metadata=positive(LARGEST))
    """Joint-name pattern -> largest torque [N m]. If empty: the robot's."""
    implicit_gains: bool = False
    """True: gains of MuJoCo's position actuators with the integrator implicitfast. False: gains of an explicit PD law."""
    observation_clip: float = field(default=LARGEST, metadata=positive(LARGEST))
    """Absolute value at which scaled observations are clipped."""
    velocity_point: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), metadata=between(-100, 100))
    """Point whose velocity the term `base_lin_vel` gives, such as the place of the IMU; base frame [m]."""
    phase_offsets: tuple[float, ...] = field(default=(0.0,), metadata=items(16, between(-100, 100)))
    """Phase of each clock at the start [rad]."""
    phase_period_s: float = field(default=1.0, metadata=positive(1000))
    """Period of a clock [s]."""
    phase_standing: float | None = field(default=None, metadata=between(-100, 100))
    """Phase of all clocks while the command is zero [rad]; null lets them run on."""
    control_dt: float = field(default=0.02, metadata=positive(1.0, low=1e-3))
    """Time for which an action is held [s]."""
    sim_dt: float = field(default=0.005, metadata=positive(0.1, low=1e-5))
    """Physics step [s]."""
    task: str = ""
    """Task with the anchor and the bodies of a tracker, which holds its motion. If empty: the policy follows commands."""
    contract: Contract | None = field(default=None, compare=False)
    """Contract of the export that the layout describes; None for a YAML file."""


def read_layout(name: str, where: str) -> Layout:
    """Return the layout in the file `name`, or the one with this name in resources/layouts/. An error about the name begins
    with `where`. A file that ends in .json is the policy.json of an export.

    Raises:
        ConfigError: there is no such file, or it is no layout.
    """
    folder = data_folder("resources") / "layouts"
    path = next(
        (path for path in (Path(name), folder / f"{name}.yaml") if path.name and exists(path) and path.is_file()), None
    )
    if path is None:
        known = suggest(name, [file.stem for file in folder.glob("*.yaml")])
        raise ConfigError(f"{where}: there is no layout '{name}', neither as a file nor in this package{known}")
    if path.suffix == ".json":
        layout = _layout_of(read_contract(path, may_track=True))
    else:
        data = read_yaml(path)
        if not data.get("observation"):
            raise ConfigError(f"{path}: observation: must name at least one term (allowed: {', '.join(TERMS)})")
        layout = build(Layout, data, str(path))
        for key in data if layout.task else ():
            if key not in OF_TRACKER_LAYOUTS:
                allowed = ", ".join(OF_TRACKER_LAYOUTS)
                raise ConfigError(f"{path}: {key}: has no effect in a layout with a task (allowed: {allowed})")
    for term in layout.observation:
        if term not in TERMS:
            raise ConfigError(f"{path}: observation: there is no term '{term}'{suggest(term, TERMS)}")
        if term in (OF_WALKERS if layout.task else OF_TRACKERS):
            why = "trackers do not observe it" if layout.task else "only trackers observe it, and their layout names a task"
            raise ConfigError(f"{path}: observation: {term}: {why}")
    return layout


def _layout_of(contract: Contract) -> Layout:
    """Return the layout of an exported policy. The policy must observe a single step and have one scale for each term."""
    path = contract.path
    if contract.states or any(group.history != 1 for group in contract.groups):
        raise ConfigError(f"{path}: the policy has a memory or a history; only policies with neither can be played here")
    observation: dict[str, float] = {}
    for term in contract.terms:
        if term.joints is not None and len(term.joints) < len(contract.joint_names):
            raise ConfigError(f"{path}: observation: '{term.name}' shows only some joints; evaluate the run instead")
        halves = dict(zip(COMMANDS, (term.scale[:2], term.scale[2:]), strict=True))
        for part, scales in halves.items() if term.name == "commands" else ((term.name, term.scale),):
            if (scales != scales[0]).any():
                text = f"the columns of '{term.name}' have different scales: {term.scale.tolist()}"
                raise ConfigError(f"{path}: observation: {text}")
            observation[part] = float(scales[0])
    joints = contract.joint_names
    acted = tuple(joints[i] for i in contract.acted)

    def by_joint(values: np.ndarray) -> dict[str, float]:
        return dict(zip(joints, values.tolist(), strict=True))

    return Layout(
        task=contract.task if contract.trackers else "",
        observation=observation,
        observation_clip=contract.observation_clip,
        joints=joints,
        action_joints=acted,
        action_scale=dict(zip(acted, contract.action_scale.tolist(), strict=True)),
        action_clip=contract.action_clip,
        default_joint_angles=by_joint(contract.default),
        stiffness=by_joint(contract.stiffness),
        damping=by_joint(contract.damping),
        torque_limits=by_joint(contract.torque_limits),
        control_dt=contract.control_dt,
        sim_dt=contract.sim_dt,
        contract=contract,
    )


def was_trained_with_other_motors(contract: Contract) -> bool:
    """Return whether a policy was trained with motors that a layout cannot describe: with a torque-speed line, friction, a
    delay, a learned actuator or rotor inertia (control.actuator).

    Raises:
        ConfigError: the contract's section about the actuator is invalid.
    """
    motors = build(ActuatorConfig, contract.actuator, f"{contract.path}: actuator")
    return not is_ideal(motors) or bool(motors.armature)


class ForeignPolicy:
    """A policy of robots with D joints. Arguments and results have the robot's joint order; the network has its own."""

    def __init__(self, path: Path, layout: Layout, robot: Robot) -> None:
        """Load the ONNX file at `path`. The attribute `metadata` holds the texts in the file's metadata by name.

        Raises:
            ConfigError: the file cannot be read, its joints are not the robot's, its sizes are not the layout's, the
                layout is the contract of another export, or the network needs too much time or memory.
        """
        self.layout, self._path, self._session = layout, path, open_onnx(path)
        self.metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        if layout.contract is not None:
            layout.contract.check_metadata(path, self.metadata)
        names = robot.joint_names
        joints = list(layout.joints or listed(path, self.metadata, JOINTS) or names)
        for name in (*joints, *layout.action_joints):
            if name not in names:
                raise ConfigError(f"{path}: robot '{robot.name}' has no joint '{name}'{suggest(str(name), names)}")
        if len(set(joints)) != len(joints) or len(joints) != robot.num_dof:
            raise ConfigError(
                f"{path}: its metadata or layout names {len(set(joints))} joints, but '{robot.name}' has {robot.num_dof}"
            )
        acted = list(layout.action_joints) or joints
        if len(set(acted)) != len(acted):
            raise ConfigError(f"{path}: action_joints: names a joint twice")
        self._order = np.array([names.index(name) for name in joints])
        self._acted = np.array([names.index(name) for name in acted])

        self.default = self._by_joint("default_joint_angles", robot.default_dof_pos, robot)
        self.torque_limits = self._by_joint("torque_limits", robot.torque_limits, robot)
        self.stiffness = self._by_joint("stiffness", robot.stiffness, robot, STIFFNESS)
        self.damping = self._by_joint("damping", robot.damping, robot, DAMPING)
        scale = layout.action_scale
        every = match_values(scale, acted, "layout: action_scale") if isinstance(scale, dict) else np.array(scale)
        self._scale = np.broadcast_to(every, (len(acted),))
        self.reset()
        self._check_sizes(robot)

    def _by_joint(self, key: str, of_robot: np.ndarray, robot: Robot, keys: Sequence[str] = ()) -> np.ndarray:
        """Return numbers (D,) in the robot's order: those of the layout, or else of the file's metadata under `keys`, or else
        `of_robot`.
        """
        if table := getattr(self.layout, key):
            return match_values(table, robot.joint_names, f"layout: {key}")
        values = listed(self._path, self.metadata, keys)
        if values is None:
            return of_robot
        if len(values) != robot.num_dof or not all(isinstance(value, int | float) for value in values):
            raise ConfigError(f"{self._path}: metadata {'/'.join(keys)}: expected {robot.num_dof} numbers")
        numbers = np.zeros(robot.num_dof)
        numbers[self._order] = values
        return numbers

    def _check_sizes(self, robot: Robot) -> None:
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 2 or len(outputs[0].shape) != 2:
            raise ConfigError(f"{self._path}: expected one input of shape (1, numbers), got {[i.shape for i in inputs]}")
        self._input, self._any_batch = inputs[0].name, not isinstance(inputs[0].shape[0], int)
        zeros = np.zeros(3)
        width = len(self._observe(zeros, zeros, zeros, zeros, self.default, self.default))
        if isinstance(inputs[0].shape[1], int) and inputs[0].shape[1] != width:
            raise ConfigError(f"{self._path}: takes {inputs[0].shape[1]} numbers, but the layout's observation has {width}")
        count = len(self._acted)
        if isinstance(outputs[0].shape[1], int) and outputs[0].shape[1] != count:
            raise ConfigError(f"{self._path}: gives {outputs[0].shape[1]} actions, but {count} joints have an action")
        warm_up(self._path, self._session, {self._input: np.zeros((1, width), dtype=np.float32)})

    def reset(self, *robots: int) -> None:
        """Start an episode of one robot, or of so many robots. The arguments and results of `act` then have as many rows."""
        self._actions = np.zeros((*robots, len(self._acted)))
        self._phase = np.broadcast_to(np.array(self.layout.phase_offsets), (*robots, len(self.layout.phase_offsets))).copy()

    def act(
        self,
        command: np.ndarray,
        lin_vel: np.ndarray,
        ang_vel: np.ndarray,
        gravity: np.ndarray,
        dof_pos: np.ndarray,
        dof_vel: np.ndarray,
    ) -> np.ndarray:
        """Return joint targets (D,) [rad] for the next `control_dt`. After `reset(N)`, targets and arguments have N rows.

        Raises:
            ConfigError: the network's output is not finite.

        Args:
            command: vx, vy [m/s] and yaw rate [rad/s].
            lin_vel: velocity of the base's origin, base frame [m/s].
            ang_vel: angular velocity of the base, base frame [rad/s].
            gravity: unit vector along gravity, base frame.
            dof_pos: joint angles (D,) [rad].
            dof_vel: joint velocities (D,) [rad/s].
        """
        standing = self.layout.phase_standing
        if standing is not None:
            self._phase[~np.any(command, axis=-1)] = standing
        observation = self._observe(command, lin_vel, ang_vel, gravity, dof_pos, dof_vel)
        rows = np.atleast_2d(observation).astype(np.float32)
        each = [rows] if self._any_batch else rows[:, None]
        outputs = [self._session.run(None, {self._input: part})[0] for part in each]
        actions = np.concatenate(outputs).reshape(self._actions.shape)
        if not np.isfinite(actions).all():
            raise ConfigError(f"{self._path}: gives actions that are not finite")
        self._actions = np.clip(actions, -self.layout.action_clip, self.layout.action_clip).astype(float)
        self._phase += 2.0 * np.pi * self.layout.control_dt / self.layout.phase_period_s
        targets = np.broadcast_to(self.default, np.shape(dof_pos)).copy()
        targets[..., self._acted] += self._scale * self._actions
        return targets

    def _observe(self, command: Any, lin_vel: Any, ang_vel: Any, gravity: Any, dof_pos: Any, dof_vel: Any) -> np.ndarray:
        """Return the observation, (width,) or (N, width)."""
        terms = {
            "base_lin_vel": lin_vel + np.cross(ang_vel, self.layout.velocity_point),
            "base_ang_vel": ang_vel,
            "projected_gravity": gravity,
            "command_xy": command[..., :2],
            "command_yaw": command[..., 2:],
            "dof_pos": (dof_pos - self.default)[..., self._order],
            "dof_vel": dof_vel[..., self._order],
            "actions": self._actions,
            "phase_sin": np.sin(self._phase),
            "phase_cos": np.cos(self._phase),
        }
        columns = np.concatenate([scale * terms[name] for name, scale in self.layout.observation.items()], axis=-1)
        return np.clip(columns, -self.layout.observation_clip, self.layout.observation_clip)
