"""The contract of an exported policy (policy.json), and checks that the exported files and a robot agree with it."""

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from legged.deploy.errors import ConfigError
from legged.deploy.interface import RobotFacts

CONTRACT_VERSION = 1
"""Version of policy.json that this package writes and reads."""
CHECKSUMS = "sha256"
"""Key of the checksums in policy.json: file of the export -> SHA-256 in hexadecimal digits. Older exports lack this key."""
NOT_COMPARED = {CHECKSUMS, "iterations", "wall_s"}
"""Keys of policy.json that may differ from the metadata of the ONNX file: the checksums, and the length of the training."""
SENSORS = {
    "base_ang_vel": "gyro",
    "projected_gravity": "quaternion",
    "commands": "command",
    "base_commands": "command",
    "dof_pos": "joint positions",
    "dof_vel": "joint velocities",
    "actions": "memory",
}
"""Observation term -> its input: a sensor, the command, or the last actions ("memory"). Every robot has these inputs."""
SOURCE = "source "
"""Prefix before the name of an additional source, as in "source heights". Terms that are not in SENSORS need a source."""
SCANS = ("lowest", "own", "highest")
"""Ways to read a height map at a point. "own" is the height of the point's cell; "lowest" and "highest" are taken from three
cells: the point's cell and its neighbours in +x and +y."""
TOLERANCE = 1e-3
"""Largest difference at which limits count as equal: absolute for joint angles [rad], relative for torques and speeds."""
DEEPEST, MOST_DIGITS = 20, 18
"""Deepest nesting, and largest number of digits of a whole number, in JSON from files and packets."""
COMMANDS, BASE_COMMANDS = ("vx", "vy", "yaw_rate"), ("height", "pitch")
NO_COMMANDS = {"command_ranges": dict.fromkeys(COMMANDS, (0.0, 0.0)), "command_dead_zone": 0.0}
"""Entries that policy.json lacks if the policy tracks motions."""
RULES: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "stiffness": ("0 or more", lambda x: x >= 0.0),
    "damping": ("above 0, because damping stops the robot", lambda x: x > 0.0),
    "torque_limits": ("above 0", lambda x: x > 0.0),
    "velocity_limits": ("above 0", lambda x: x > 0.0),
    "action_clip": ("above 0 and finite", lambda x: x > 0.0),
    "observation_clip": ("above 0 and finite", lambda x: x > 0.0),
    "command_dead_zone": ("0 or more", lambda x: x >= 0.0),
    "control_dt": ("between 0.001 and 1", lambda x: (x >= 1e-3) & (x <= 1.0)),
}
"""Key of policy.json -> allowed numbers, in words and as a function. Each number must also be finite."""


def plain_json(text: str | bytes) -> Any:
    """Return the value of a JSON text from outside this program, such as a file or a packet.

    Raises:
        ValueError: the text is no JSON, is nested too deeply, or has whole numbers that are too long.
    """

    def whole(digits: str) -> int:
        if len(digits) > MOST_DIGITS:
            raise ValueError(f"a whole number has {len(digits)} digits, more than {MOST_DIGITS}")
        return int(digits)

    try:
        value = json.loads(text, parse_int=whole)
    except RecursionError as error:
        raise ValueError("the JSON text is nested too deeply") from error
    level = [value]
    for _ in range(DEEPEST):
        parts = [part.values() if isinstance(part, dict) else part for part in level if isinstance(part, dict | list)]
        level = [inner for part in parts for inner in part]
    if level:
        raise ValueError("the JSON text is nested too deeply")
    return value


def need_of(term: str) -> str:
    """Return the input of an observation term: the entry in SENSORS or, without an entry, the source with the term's name."""
    return SENSORS.get(term, f"{SOURCE}{term}")


@dataclass(frozen=True)
class Term:
    """A term of the observation. `start` is the column of the term's first number in the oldest observation of its group."""

    name: str
    start: int
    size: int
    scale: np.ndarray
    """(size,) factors."""
    source: str | None
    """Source that the term needs; None if sensors suffice."""
    points: np.ndarray | None
    """(P, 2) points at which a height map is read, x forward and y left of the base [m]; None if the term reads no map."""
    offset: float
    """Observed heights are relative to a level that lies below the base by this distance [m]."""
    limit: float
    """Largest observed height [m]."""
    deepest: float
    """Largest observed depth of low ground [m]."""
    scan: str
    """Way to read the height map at a point, one of `SCANS`."""
    joints: np.ndarray | None
    """(size,) joints that the term shows, in its order; None: all joints in the contract's order, or no joints."""


@dataclass(frozen=True)
class Group:
    """A group of terms: `history` observations of `size` numbers each, oldest first, from column `start` on."""

    start: int
    size: int
    history: int
    terms: tuple[Term, ...]


@dataclass(frozen=True)
class Contract:
    """Requirements that a policy makes on a robot. The robot has D joints; A of them have an action. Units are SI."""

    path: Path
    entries: Mapping[str, Any]
    """Contents of policy.json, as plain data."""
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
    """(D,) intermediate pose for standing up from the ground [rad]; None if the robot has none."""
    stiffness: np.ndarray
    """(D,) P gains [N m/rad]; `damping` (D,) are the D gains [N m s/rad]."""
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
    groups: tuple[Group, ...]
    command_ranges: np.ndarray
    """(3, 2) lowest and highest vx, vy [m/s] and yaw rate [rad/s]."""
    dead_zone: float
    """Smallest horizontal speed that was commanded in training, apart from zero [m/s]."""
    base_commands: np.ndarray
    """(2, 3) lowest, usual and highest command of the base's height [m] and pitch [rad]; zeros for a policy that does not
    observe these commands."""
    control_dt: float
    """Time for which an action is held [s]."""
    sim_dt: float
    """Physics step in training [s]. The actuator's delay is a number of these steps."""
    actuator: Mapping[str, Any]
    """Section control.actuator of the training's configuration; empty if the export lacks it."""
    trackers: tuple[str, ...]
    """ONNX files beside policy.json with the policy and one motion each; empty for a policy that follows commands."""
    states: Mapping[str, tuple[int, int, int]]
    """Input of the ONNX file -> shape (layers, 1, width) of a hidden state; empty for a policy without memory."""
    complete: bool = True
    """False if the file states neither limits nor the IMU's body. `fitted` takes them from a robot."""

    @property
    def width(self) -> int:
        """Return the width of the policy's observation."""
        return sum(group.size * group.history for group in self.groups)

    @property
    def terms(self) -> list[Term]:
        """Return all terms of the observation in order."""
        return [term for group in self.groups for term in group.terms]

    @property
    def sources(self) -> dict[str, Term]:
        """Return a dictionary: source -> a term that needs this source."""
        return {term.source: term for term in self.terms if term.source is not None}

    def check_metadata(self, network: Path, metadata: Mapping[str, str]) -> None:
        """Compare all entries except NOT_COMPARED with the `metadata` (key -> JSON text) of the ONNX file `network`.

        Raises:
            ConfigError: the metadata are no contract, or come from another export.
        """
        try:
            inside = {key: plain_json(text) for key, text in metadata.items() if key not in NOT_COMPARED}
        except ValueError:
            inside = {}
        if "contract_version" not in inside:
            raise ConfigError(
                f"{network}: has no metadata of an export, so {self.path} cannot be checked; export the policy again"
            )
        for key in sorted({*inside, *self.entries} - NOT_COMPARED):
            if key not in inside or key not in self.entries or inside[key] != self.entries[key]:
                raise ConfigError(f"{self.path}: {key}: {network} has another value; the files are from different exports")

    def fitted(self, robot: RobotFacts) -> "Contract":
        """Return the contract after comparing it with a robot. If it is not complete, its joints are put into the robot's
        order, and limits and the IMU's body are the robot's.

        Raises:
            ConfigError: `check_fits` refuses the robot.
        """
        contract = self
        if not self.complete and set(self.joint_names) == set(robot.joint_names):
            order = [self.joint_names.index(name) for name in robot.joint_names]
            numbers = {"default_joint_angles": self.default, "stiffness": self.stiffness, "damping": self.damping}
            contract = contract_of(
                self.path,
                {
                    **self.entries,
                    **{key: values[order].tolist() for key, values in numbers.items()},
                    "position_limits": [x if math.isfinite(sum(x)) else None for x in robot.position_limits.tolist()],
                    "velocity_limits": robot.velocity_limits.tolist(),
                    "torque_limits": robot.torque_limits.tolist(),
                    "joint_names": list(robot.joint_names),
                    "robot": robot.name,
                    "imu_frame": {"body": robot.imu_body},
                },
            )
        contract.check_fits(robot)
        return contract

    def check_fits(self, robot: RobotFacts) -> None:
        """Compare the contract with a robot.

        Raises:
            ConfigError: joints of the robot differ in name or order, or have less torque, speed or range than in training;
                the robot's IMU is in another body; or the robot lacks a source that an observation needs.
        """
        if self.joint_names != robot.joint_names:
            raise ConfigError(f"{self.path}: joint_names: {_difference(self.joint_names, robot.joint_names, robot.name)}")
        if self.imu_body != robot.imu_body:
            raise ConfigError(
                f"{self.path}: imu_frame: the policy observes in the frame of '{self.imu_body}',"
                f" but the IMU of '{robot.name}' measures in that of '{robot.imu_body}'"
            )
        for name, unit in (("torque_limits", "N m"), ("velocity_limits", "rad/s")):
            for joint, mine, its in zip(self.joint_names, getattr(self, name), getattr(robot, name), strict=True):
                if not mine <= its * (1.0 + TOLERANCE):  # a limit of NaN is refused, too
                    trained = f"the policy was trained with {mine:g} {unit} at '{joint}'"
                    raise ConfigError(f"{self.path}: {name}: {trained}, but '{robot.name}' has {its:g}")
        for joint, mine, its in zip(self.joint_names, self.position_limits, robot.position_limits, strict=True):
            if mine[0] < its[0] - TOLERANCE or mine[1] > its[1] + TOLERANCE:
                raise ConfigError(
                    f"{self.path}: position_limits: the policy was trained with {mine[0]:g} to {mine[1]:g} rad at '{joint}',"
                    f" but '{robot.name}' has {its[0]:g} to {its[1]:g}"
                )
        for source, term in self.sources.items():
            if source not in robot.offers:
                offered = ", ".join(sorted(robot.offers)) or "none"
                raise ConfigError(
                    f"{self.path}: observation: no sensor measures '{term.name}', and '{robot.name}' has no source for it"
                    f" (sources: {offered})"
                )


def read_contract(path: Path, may_track: bool = False) -> Contract:
    """Return the contract in a policy.json. Check exported files in the same folder against the checksums in policy.json.
    If `may_track`, the policy may track motions instead of following commands. Its commands are 0.

    Raises:
        ConfigError: the file cannot be read, has another version, describes a policy that this program cannot run, or has
            invalid values; or the checksum of an exported file is wrong.
    """
    with refusing(path, "policy.json of an export"):
        said = plain_json(path.read_bytes())
        if not isinstance(said, dict) or "observation" not in said:
            raise ConfigError(f"{path}: is no policy.json of an export (observation is missing)")
        if "motion" in said and not may_track:
            raise ConfigError(
                f"{path}: task: '{said.get('task')}' tracks motions; a robot runs policies that follow commands"
                " (`legged evaluate onnx` replays trackers)"
            )
        if "joint_names" not in said or not {"command_ranges", "motion"} & set(said):
            raise ConfigError(f"{path}: task: '{said.get('task')}' is no task of a legged robot that follows commands")
        version = said.get("contract_version")
        if version != CONTRACT_VERSION:
            was = "none (an older version of legged wrote the file)" if version is None else f"{version!r}"
            raise ConfigError(
                f"{path}: contract_version: got {was}, but this program reads {CONTRACT_VERSION};"
                f" export the policy again with `legged play {said.get('task')} --no-video`"
            )
        if (control := said.get("control_type")) != "P":
            raise ConfigError(f"{path}: control_type: got {control!r}; a robot takes joint angles ('P') only")
        contract = contract_of(path, said)
        for name, digest in said.get(CHECKSUMS, {}).items():
            file = path.with_name(name)
            if file.is_file() and hashlib.sha256(file.read_bytes()).hexdigest() != digest:
                raise ConfigError(f"{file}: is not the file exported with {path} ({CHECKSUMS}); export the policy again")
        return contract


@contextmanager
def refusing(path: Path, what: str) -> Iterator[None]:
    """Turn the errors that a wrong file causes into the ConfigError that the file at `path` is no `what`."""
    try:
        yield
    except ConfigError:
        raise
    except (OSError, KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())
        raise ConfigError(f"{path}: is no {what} ({text})") from error


def contract_of(path: Path, entries: Mapping[str, Any]) -> Contract:
    """Return the contract with the entries of a policy.json, which an error calls `path`.

    Raises:
        ConfigError: an entry is invalid. Missing or malformed entries raise those errors that `refusing` turns into it.
    """
    said = {**NO_COMMANDS, **entries} if "motion" in entries else entries
    joints, acted, memory = tuple(said["joint_names"]), said["action_joints"], said["recurrent"] or {"onnx_inputs": ()}
    count, scale = len(joints), said["action_scale"]

    def check(key: str, allowed: str, right: Any, values: np.ndarray) -> None:
        wrong = ~np.ravel(right)
        if wrong.any():
            i = int(wrong.argmax())
            where = f" at '{joints[i]}'" if wrong.shape == (count,) else ""
            raise ConfigError(f"{path}: {key}: must be {allowed}, got {values.ravel()[i]:g}{where}")

    def numbers(key: str, *shape: int) -> np.ndarray:
        values = np.array(said[key], dtype=float)
        if values.shape != shape:
            raise ValueError(f"{key}: {math.prod(shape)} numbers are wanted")
        allowed, right = RULES.get(key, ("finite", np.isfinite))
        check(key, allowed, np.isfinite(values) & right(values), values)
        return values

    if len(set(joints)) < count:
        raise ConfigError(f"{path}: joint_names: must differ from each other")
    limits = np.array([(-np.inf, np.inf) if pair is None else pair for pair in said["position_limits"]], dtype=float)
    low, high = limits.reshape(count, 2).T
    check("position_limits", "below the upper limits", low < high, low)
    default = numbers("default_joint_angles", count)
    crouch = None if said["crouch_joint_angles"] is None else numbers("crouch_joint_angles", count)
    for key, pose in (("default_joint_angles", default), ("crouch_joint_angles", crouch)):
        if pose is not None:
            check(key, "within position_limits", (low - TOLERANCE <= pose) & (pose <= high + TOLERANCE), pose)
    ranges = np.array([said["command_ranges"][name] for name in COMMANDS], dtype=float).reshape(3, 2)
    right = np.isfinite(ranges).all(axis=1) & (ranges[:, 0] <= ranges[:, 1])
    check("command_ranges", "finite, and not above the upper limits", right, ranges[:, 0])
    given = said.get("base_commands", dict.fromkeys(BASE_COMMANDS, (0.0, 0.0, 0.0)))
    base = np.array([given[name] for name in BASE_COMMANDS], dtype=float).reshape(2, 3)
    right = np.isfinite(base).all(axis=1) & (np.diff(base) >= 0.0).all(axis=1)
    check("base_commands", "finite, and sorted: lowest, usual, highest", right, base[:, 1])
    control_dt, sim_dt = numbers("control_dt"), np.array(said.get("sim_dt", said["control_dt"]), dtype=float)
    check("sim_dt", "above 0, and at most control_dt", (sim_dt > 0.0) & (sim_dt <= control_dt + 1e-9), sim_dt)
    return Contract(
        path=path,
        entries=entries,
        task=str(said["task"]),
        robot=str(said["robot"]),
        imu_body=str(said["imu_frame"]["body"]),
        joint_names=joints,
        acted=np.array([joints.index(name) for name in acted]),
        default=default,
        crouch=crouch,
        stiffness=numbers("stiffness", count),
        damping=numbers("damping", count),
        position_limits=limits.reshape(count, 2),
        velocity_limits=numbers("velocity_limits", count),
        torque_limits=numbers("torque_limits", count),
        action_scale=np.broadcast_to(numbers("action_scale", *np.shape(scale)), (len(acted),)).copy(),
        action_clip=float(numbers("action_clip")),
        observation_clip=float(numbers("observation_clip")),
        groups=tuple(_groups(f"{path}: observation", said)),
        command_ranges=ranges,
        dead_zone=float(numbers("command_dead_zone")),
        base_commands=base,
        control_dt=float(control_dt),
        sim_dt=float(sim_dt),
        actuator=dict(said.get("actuator", {})),
        trackers=tuple(dict(said["motion"]["trackers"])) if "motion" in said else (),
        states={name: (int(memory["shape"][0]), 1, int(memory["shape"][2])) for name in memory["onnx_inputs"]},
    )


def _groups(where: str, said: Mapping[str, Any]) -> Iterator[Group]:
    """Yield the groups of terms. Refuse terms that do not fit the robot's joints, and gaps between columns."""
    joints = list(said["joint_names"])
    sizes = {"base_ang_vel": 3, "projected_gravity": 3, "commands": 3, "dof_pos": len(joints), "dof_vel": len(joints)}
    sizes |= {"actions": len(said["action_joints"]), "base_commands": len(BASE_COMMANDS)}
    names = [entry["name"] for entry in said["observation_groups"]]
    for entry in said["observation"]:
        if entry["group"] not in names:
            raise ConfigError(f"{where}: the group '{entry['group']}' of '{entry['name']}' does not exist")
    start = 0
    for entry in said["observation_groups"]:
        size, history, column = int(entry["size"]), int(entry["history"]), start
        if history < 1 or size < 1:
            raise ConfigError(f"{where}_groups: each must have a history and a size of at least 1")
        if entry["start"] != start:
            raise ConfigError(f"{where}_groups: '{entry['name']}' must start at column {start}, got {entry['start']}")
        own = [term for term in said["observation"] if term["group"] == entry["name"]]
        terms = sorted((_term(where, term, sizes, joints) for term in own), key=lambda term: term.start)
        for term in terms:
            if term.start != column:
                raise ConfigError(f"{where}: '{term.name}' must start at column {column}, got {term.start}")
            column += term.size
        if column != start + size:
            raise ConfigError(f"{where}_groups: '{entry['name']}' has {size} numbers, but its terms have {column - start}")
        yield Group(start, size, history, tuple(terms))
        start += size * history


def _term(where: str, entry: Mapping[str, Any], sizes: Mapping[str, int], joints: list[str]) -> Term:
    name, needs, size, limit = str(entry["name"]), str(entry["needs"]), int(entry["size"]), entry.get("limit", np.inf)
    source = needs.removeprefix(SOURCE) if needs.startswith(SOURCE) else None
    scale, points = np.array(entry["scale"], dtype=float), np.array(entry.get("points") or (), dtype=float).reshape(-1, 2)
    scan = str(entry.get("scan", SCANS[0]))
    if source is None and needs != SENSORS.get(name):
        raise ConfigError(f"{where}: '{name}' cannot be made from '{needs}'")
    shown = entry.get("joints") if name in ("dof_pos", "dof_vel") else None
    given = sizes.get(name) if shown is None else len(shown)
    if source is None and size != given:
        raise ConfigError(f"{where}: '{name}' has {size} numbers, but a robot gives {given}")
    if scale.shape != (size,) or not np.isfinite(scale).all():
        raise ConfigError(f"{where}: scale of '{name}': must be {size} finite numbers, got {entry['scale']}")
    if source == "heights" and len(points) != size:
        raise ConfigError(f"{where}: 'heights' has {size} numbers, but {len(points)} points")
    if scan not in SCANS:
        raise ConfigError(f"{where}: scan of '{name}': must be one of {', '.join(SCANS)}, got '{scan}'")
    return Term(
        name=name,
        start=int(entry["start"]),
        size=size,
        scale=scale,
        source=source,
        points=points if entry.get("points") else None,
        offset=float(entry.get("offset", 0.0)),
        limit=float(limit),
        deepest=float(entry.get("deepest", limit)),
        scan=scan,
        joints=None if shown is None else np.array([joints.index(joint) for joint in shown]),
    )


def _difference(wanted: Sequence[str], there: Sequence[str], robot: str) -> str:
    """Return the first difference between two lists of joints, in words."""
    if missing := [name for name in wanted if name not in there]:
        return f"'{robot}' has no joint '{missing[0]}' (its joints: {', '.join(there)})"
    if more := [name for name in there if name not in wanted]:
        return f"'{robot}' has a joint '{more[0]}' that the policy does not know"
    place = next(i for i, (a, b) in enumerate(zip(wanted, there, strict=True)) if a != b)
    return f"joint {place} is '{wanted[place]}' for the policy and '{there[place]}' for '{robot}'; their orders differ"
