"""The contract of an exported policy: the contents of policy.json, and their comparison with a robot."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from legged.deploy.interface import RobotFacts
from legged.errors import ConfigError

CONTRACT_VERSION = 1
"""Version of policy.json that this package writes and reads."""
SENSORS = {
    "base_ang_vel": "gyro",
    "projected_gravity": "quaternion",
    "commands": "command",
    "dof_pos": "joint positions",
    "dof_vel": "joint velocities",
    "actions": "memory",
}
"""Observation term -> sensor, command or memory that it needs, for the terms that every robot can provide."""
SOURCE = "source "
"""Prefix of the needs of all other terms: a source of that name, such as an estimator or a map."""
SCANS = ("lowest", "own", "highest")
"""Values that a point of the heights can read: the lowest of its cell and the next cells in x and y, its own cell's, or the
highest of the three."""
TOLERANCE = 1e-3
"""Largest difference, absolute or relative, at which limits count as equal."""


def need_of(term: str) -> str:
    """Return the need of an observation term: a value of SENSORS, or a source of the term's name."""
    return SENSORS.get(term, f"{SOURCE}{term}")


@dataclass(frozen=True)
class Term:
    """A term of the observation in the columns `start` to `start + size` of one observation of its group."""

    name: str
    group: str
    start: int
    size: int
    scale: np.ndarray
    """(size,) factors."""
    needs: str
    """A value of `SENSORS`, or `SOURCE` and a name."""
    points: np.ndarray | None
    """(P, 2) points at which a height map is read, x forward and y left of the base [m]; None for other terms."""
    offset: float
    """Distance below the base from which observed heights are measured [m]."""
    limit: float
    """Largest observed height [m]."""
    deepest: float
    """Largest observed depth of low ground [m]."""
    scan: str
    """Value that a point reads of a map of cells, one of `SCANS`."""

    @property
    def source(self) -> str | None:
        """Return the source that the term needs; None if sensors suffice."""
        return self.needs.removeprefix(SOURCE) if self.needs.startswith(SOURCE) else None


@dataclass(frozen=True)
class Group:
    """A group of terms: `history` observations of `size` numbers each, oldest first, from column `start` on."""

    name: str
    start: int
    size: int
    history: int


@dataclass(frozen=True)
class Memory:
    """The hidden state of a recurrent policy: inputs and outputs of the ONNX file, in the same order, and their shape."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    layers: int
    width: int


@dataclass(frozen=True)
class Contract:
    """Requirements of a policy for a robot with D joints, A of which have an action; SI units."""

    path: Path
    task: str
    robot: str
    imu_body: str
    """Body in whose frame angular velocity and gravity are observed."""
    joint_names: tuple[str, ...]
    acted: np.ndarray
    """(A,) joint index of each action."""
    default: np.ndarray
    """(D,) angles at action 0 [rad]."""
    crouch: np.ndarray | None
    """(D,) intermediate pose for standing up from the ground [rad]; None without one."""
    stiffness: np.ndarray
    """(D,) P gains [N m/rad], and D gains [N m s/rad]."""
    damping: np.ndarray
    position_limits: np.ndarray
    """(D, 2) [rad]; infinite where the model has no limit."""
    velocity_limits: np.ndarray
    """(D,) [rad/s]."""
    torque_limits: np.ndarray
    """(D,) [N m]."""
    action_scale: np.ndarray
    """(A,) [rad]."""
    action_clip: float
    observation_clip: float
    terms: tuple[Term, ...]
    groups: tuple[Group, ...]
    command_ranges: np.ndarray
    """(3, 2) lowest and highest vx, vy [m/s] and yaw rate [rad/s]."""
    dead_zone: float
    """Smallest horizontal command of the training other than zero [m/s]."""
    control_dt: float
    """Time for which an action is held [s]."""
    sim_dt: float
    """Physics step of the training; the unit of the actuator's delay [s]."""
    actuator: Mapping[str, Any]
    """Section control.actuator of the training's configuration; empty for exports without it."""
    memory: Memory | None

    @property
    def width(self) -> int:
        """Return the width of the policy's observation."""
        return sum(group.size * group.history for group in self.groups)

    @property
    def sources(self) -> dict[str, Term]:
        """Return source -> the first term that needs it."""
        found: dict[str, Term] = {}
        for term in self.terms:
            if term.source is not None:
                found.setdefault(term.source, term)
        return found

    def check_fits(self, robot: RobotFacts) -> None:
        """Compare with a robot.

        Raises:
            ConfigError: the robot's joints have other names or another order, or are weaker, slower or stop earlier than in
                the training; its IMU is in another body; or it lacks a source that an observation needs.
        """
        if self.joint_names != robot.joint_names:
            raise ConfigError(f"{self.path}: joint_names: {_difference(self.joint_names, robot.joint_names, robot.name)}")
        if self.imu_body != robot.imu_body:
            raise ConfigError(
                f"{self.path}: imu_frame: the policy observes in the frame of '{self.imu_body}',"
                f" the IMU of '{robot.name}' measures in that of '{robot.imu_body}'"
            )
        for name, unit, own, there in (
            ("torque_limits", "N m", self.torque_limits, robot.torque_limits),
            ("velocity_limits", "rad/s", self.velocity_limits, robot.velocity_limits),
        ):
            for joint, mine, its in zip(self.joint_names, own, there, strict=True):
                if not mine <= its * (1.0 + TOLERANCE):  # also true for a limit of NaN
                    raise ConfigError(
                        f"{self.path}: {name}: the policy was trained with {mine:g} {unit} at '{joint}',"
                        f" '{robot.name}' has {its:g}"
                    )
        for joint, mine, its in zip(self.joint_names, self.position_limits, robot.position_limits, strict=True):
            if mine[0] < its[0] - TOLERANCE or mine[1] > its[1] + TOLERANCE:
                raise ConfigError(
                    f"{self.path}: position_limits: the policy was trained with {mine[0]:g} to {mine[1]:g} rad at '{joint}',"
                    f" '{robot.name}' has {its[0]:g} to {its[1]:g}"
                )
        for source, term in self.sources.items():
            if source not in robot.offers:
                offered = ", ".join(sorted(robot.offers)) or "none"
                raise ConfigError(
                    f"{self.path}: observation: '{robot.name}' has nothing that gives '{term.name}', which no sensor measures"
                    f" (sources it offers: {offered})"
                )


def read_contract(path: Path) -> Contract:
    """Return the contract in a policy.json.

    Raises:
        ConfigError: the file cannot be read, has another version, describes a policy that this program cannot run, or has
            invalid values.
    """
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: is no policy.json of an export ({' '.join(str(error).split())})") from error
    if not isinstance(said, dict) or "observation" not in said:
        raise ConfigError(f"{path}: is no policy.json of an export (observation is missing)")
    if "joint_names" not in said or "command_ranges" not in said:
        raise ConfigError(f"{path}: task: '{said.get('task')}' is no task of a legged robot that follows commands")
    version = said.get("contract_version")
    if version != CONTRACT_VERSION:
        was = "none: an older version of this package wrote it" if version is None else f"{version!r}"
        raise ConfigError(
            f"{path}: contract_version: got {was}; this program reads {CONTRACT_VERSION}: export the policy again"
            f" (legged play {said.get('task')} --no-video)"
        )
    if (control := said.get("control_type")) != "P":
        raise ConfigError(f"{path}: control_type: got {control!r}; a robot takes joint angles ('P') only")
    try:
        contract = _contract(path, said)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise ConfigError(f"{path}: is no policy.json of an export ({type(error).__name__}: {error})") from error
    _check_sizes(contract)
    return contract


def _contract(path: Path, said: Mapping[str, Any]) -> Contract:
    joints, acted = tuple(said["joint_names"]), said["action_joints"]
    count = len(joints)
    scale = said["action_scale"]
    limits = [(-np.inf, np.inf) if pair is None else pair for pair in said["position_limits"]]
    return Contract(
        path=path,
        task=str(said["task"]),
        robot=str(said["robot"]),
        imu_body=str(said["imu_frame"]["body"]),
        joint_names=joints,
        acted=np.array([joints.index(name) for name in acted]),
        default=_numbers(said, "default_joint_angles", count),
        crouch=None if said["crouch_joint_angles"] is None else _numbers(said, "crouch_joint_angles", count),
        stiffness=_numbers(said, "stiffness", count),
        damping=_numbers(said, "damping", count),
        position_limits=np.array(limits, dtype=float).reshape(count, 2),
        velocity_limits=_numbers(said, "velocity_limits", count),
        torque_limits=_numbers(said, "torque_limits", count),
        action_scale=np.broadcast_to(np.asarray(scale, dtype=float), (len(acted),)).copy(),
        action_clip=float(said["action_clip"]),
        observation_clip=float(said["observation_clip"]),
        terms=tuple(_term(term) for term in said["observation"]),
        groups=tuple(
            Group(str(group["name"]), int(group["start"]), int(group["size"]), int(group["history"]))
            for group in said["observation_groups"]
        ),
        command_ranges=np.array([said["command_ranges"][name] for name in ("vx", "vy", "yaw_rate")], dtype=float).reshape(
            3, 2
        ),
        dead_zone=float(said["command_dead_zone"]),
        control_dt=float(said["control_dt"]),
        sim_dt=float(said.get("sim_dt", said["control_dt"])),
        actuator=dict(said.get("actuator", {})),
        memory=_memory(said["recurrent"]),
    )


def _numbers(said: Mapping[str, Any], key: str, count: int) -> np.ndarray:
    values = np.array(said[key], dtype=float)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"{key}: {count} numbers are wanted, one for each of joint_names")
    return values


def _term(said: Mapping[str, Any]) -> Term:
    points = said.get("points")
    return Term(
        name=str(said["name"]),
        group=str(said["group"]),
        start=int(said["start"]),
        size=int(said["size"]),
        scale=np.array(said["scale"], dtype=float),
        needs=str(said["needs"]),
        points=None if points is None else np.array(points, dtype=float).reshape(-1, 2),
        offset=float(said.get("offset", 0.0)),
        limit=float(said.get("limit", np.inf)),
        deepest=float(said.get("deepest", said.get("limit", np.inf))),
        scan=str(said.get("scan", SCANS[0])),
    )


def _memory(said: Mapping[str, Any] | None) -> Memory | None:
    if said is None:
        return None
    layers, _, width = said["shape"]
    return Memory(tuple(said["onnx_inputs"]), tuple(said["onnx_outputs"]), int(layers), int(width))


def _check_sizes(contract: Contract) -> None:
    """Check that the terms and groups of a contract are consistent.

    Raises:
        ConfigError: they are not.
    """
    path, groups = contract.path, {group.name: group for group in contract.groups}
    joints = len(contract.joint_names)
    sizes = {"base_ang_vel": 3, "projected_gravity": 3, "commands": 3, "dof_pos": joints, "dof_vel": joints}
    sizes["actions"] = len(contract.acted)
    if not 1e-3 <= contract.control_dt <= 1.0:
        raise ConfigError(f"{path}: control_dt: must be between 0.001 and 1, got {contract.control_dt:g}")
    for term in contract.terms:
        group = groups.get(term.group)
        if group is None or not group.start <= term.start <= group.start + group.size - term.size:
            raise ConfigError(f"{path}: observation: '{term.name}' lies outside its group '{term.group}'")
        if term.source is None and term.needs != SENSORS.get(term.name):
            raise ConfigError(f"{path}: observation: '{term.name}' needs '{term.needs}', which it is not made of")
        if term.source is None and term.size != sizes[term.name]:
            raise ConfigError(f"{path}: observation: '{term.name}' has {term.size} numbers, a robot gives {sizes[term.name]}")
        if len(term.scale) != term.size:
            raise ConfigError(f"{path}: observation: '{term.name}' has {term.size} numbers and {len(term.scale)} scales")
        if term.source == "heights" and (term.points is None or len(term.points) != term.size):
            raise ConfigError(f"{path}: observation: 'heights' has {term.size} numbers and no point for each")
        if term.scan not in SCANS:
            raise ConfigError(
                f"{path}: observation: scan of '{term.name}': must be one of {', '.join(SCANS)}, got '{term.scan}'"
            )
    _check_numbers(contract)
    filled = {name: sum(term.size for term in contract.terms if term.group == name) for name in groups}
    for name, group in groups.items():
        if filled[name] != group.size:
            raise ConfigError(f"{path}: observation_groups: '{name}' has {group.size} numbers, its terms {filled[name]}")
        place = group.start
        for term in sorted((term for term in contract.terms if term.group == name), key=lambda term: term.start):
            if term.start != place:
                raise ConfigError(f"{path}: observation: '{term.name}' must start at column {place}, got {term.start}")
            place += term.size
    low, high = contract.position_limits.T
    outside = (contract.default < low - TOLERANCE) | (contract.default > high + TOLERANCE)
    if outside.any():
        joint = contract.joint_names[int(outside.argmax())]
        raise ConfigError(f"{path}: default_joint_angles: that of '{joint}' lies outside its position_limits")


def _check_numbers(contract: Contract) -> None:
    """Check the ranges of a contract's numbers.

    Raises:
        ConfigError: a number is outside its range.
    """
    low, high = contract.command_ranges.T
    for key, values, allowed, right in (
        ("sim_dt", contract.sim_dt, "above 0, and at most control_dt", 0.0 < contract.sim_dt <= contract.control_dt + 1e-9),
        ("stiffness", contract.stiffness, "0 or more", contract.stiffness >= 0.0),
        ("damping", contract.damping, "above 0: it is what stops a robot", contract.damping > 0.0),
        ("torque_limits", contract.torque_limits, "above 0", contract.torque_limits > 0.0),
        ("velocity_limits", contract.velocity_limits, "above 0", contract.velocity_limits > 0.0),
        ("position_limits", contract.position_limits[:, 0], "below the upper ones", np.less(*contract.position_limits.T)),
        ("action_scale", contract.action_scale, "finite", np.isfinite(contract.action_scale)),
        ("action_clip", contract.action_clip, "above 0 and finite", 0.0 < contract.action_clip < np.inf),
        ("observation_clip", contract.observation_clip, "above 0 and finite", 0.0 < contract.observation_clip < np.inf),
        ("command_dead_zone", contract.dead_zone, "0 or more", 0.0 <= contract.dead_zone < np.inf),
        ("command_ranges", low, "finite, and not above the upper ones", np.isfinite(low) & np.isfinite(high) & (low <= high)),
        *((f"scale of {t.name}", t.scale, "finite", np.isfinite(t.scale)) for t in contract.terms),
    ):
        wrong = np.atleast_1d(~np.asarray(right))
        if wrong.any():
            value = np.atleast_1d(values)[int(wrong.argmax())]
            raise ConfigError(f"{contract.path}: {key}: must be {allowed}, got {value:g}")
    if len(set(contract.joint_names)) < len(contract.joint_names):
        raise ConfigError(f"{contract.path}: joint_names: must differ from each other")
    if any(group.history < 1 or group.size < 1 for group in contract.groups):
        raise ConfigError(f"{contract.path}: observation_groups: each must have a history and a size of at least 1")
    starts = np.cumsum([0, *(group.size * group.history for group in contract.groups)])[:-1].tolist()
    if [group.start for group in contract.groups] != starts:
        raise ConfigError(f"{contract.path}: observation_groups: must lie side by side, starting at {starts}")


def _difference(wanted: Sequence[str], there: Sequence[str], robot: str) -> str:
    """Return the first difference between two lists of joints, in words."""
    missing = [name for name in wanted if name not in there]
    if missing:
        return f"'{robot}' has no joint '{missing[0]}' (its joints: {', '.join(there)})"
    more = [name for name in there if name not in wanted]
    if more:
        return f"the policy knows no joint '{more[0]}', which '{robot}' has"
    place = next(i for i, (a, b) in enumerate(zip(wanted, there, strict=True)) if a != b)
    return f"joint {place} is '{wanted[place]}' for the policy and '{there[place]}' for '{robot}': another order"
