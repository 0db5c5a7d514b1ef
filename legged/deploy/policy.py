"""An exported policy for one robot: readings and commands -> observations -> policy.onnx -> joint targets."""

import ast
import threading
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from legged.deploy.contract import Contract, read_contract
from legged.deploy.errors import ConfigError
from legged.deploy.interface import Reading, RobotFacts
from legged.deploy.other_formats import read_other

WARM_UP = 20
"""Number of trial runs after the network is loaded. The first runs of a network take ten times as long as later runs."""
WARM_UP_S = 10.0
"""Longest time of all trial runs [s]."""
MOST_BYTES = 2**30
"""Largest memory of networks for what they compute; their weights do not count [bytes]."""


def gravity_in(quaternion: np.ndarray) -> np.ndarray:
    """Return the unit vector (3,) along gravity in the body frame. `quaternion` (w, x, y, z) rotates from body to world."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array([2.0 * (w * y - x * z), -2.0 * (y * z + w * x), 2.0 * (x * x + y * y) - 1.0])


def open_onnx(path: Path) -> onnxruntime.InferenceSession:
    """Return an onnxruntime session with one thread, because a policy of one robot is too small for several threads.

    Raises:
        ConfigError: the file cannot be read.
    """
    try:
        _limit_memory()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        options.add_session_config_entry("session.use_env_allocators", "1")
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises errors without a common class
        raise ConfigError(f"{path}: onnxruntime cannot read it: {' '.join(str(error).split())}") from error


@cache
def _limit_memory() -> None:
    """Make an allocator with the limit MOST_BYTES, for all sessions of `open_onnx` together."""
    kind = onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR
    memory = onnxruntime.OrtMemoryInfo("Cpu", kind, 0, onnxruntime.OrtMemType.DEFAULT)
    onnxruntime.create_and_register_allocator(memory, onnxruntime.OrtArenaCfg({"max_mem": MOST_BYTES}))


def listed(path: Path, metadata: Mapping[str, str], keys: Sequence[str]) -> list[Any] | None:
    """Return the list under the first of `keys` in the `metadata` of the ONNX file at `path`; None without such a key.

    Raises:
        ConfigError: the value is no list.
    """
    key = next((key for key in keys if key in metadata), None)
    if key is None:
        return None
    try:
        value = ast.literal_eval(metadata[key])
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        value = [part.strip() for part in metadata[key].split(",")]
    if not isinstance(value, list | tuple) or not value:
        raise ConfigError(f"{path}: metadata {key}: expected a list")
    return list(value)


def warm_up(path: Path, session: onnxruntime.InferenceSession, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Run the network of the file `path` WARM_UP times with the same `inputs`. Return its last outputs.

    Raises:
        ConfigError: the network fails. It may take more than WARM_UP_S or need more than MOST_BYTES.
    """
    options = onnxruntime.RunOptions()
    options.log_severity_level = 4
    timer = threading.Timer(WARM_UP_S, setattr, [options, "terminate", True])
    timer.daemon = True
    timer.start()
    try:
        return [session.run(None, inputs, options) for _ in range(WARM_UP)][-1]  # type: ignore[no-any-return]
    except Exception as error:  # onnxruntime raises errors without a common class
        why = f"longer than {WARM_UP_S:g} s" if options.terminate else " ".join(str(error).split())
        limits = f"it may use {WARM_UP_S:g} s and {MOST_BYTES / 2**30:g} GiB"
        raise ConfigError(f"{path}: {WARM_UP} trial runs of the network failed ({limits}): {why}") from error
    finally:
        timer.cancel()


class Network:
    """The network in policy.onnx: observation -> actions. The hidden state of a recurrent policy is kept between calls."""

    def __init__(self, path: Path, contract: Contract) -> None:
        """Load the file.

        Raises:
            ConfigError: the file cannot be read, has other sizes than the contract, comes from another export than the
                contract, gives actions that are not finite, or needs too much time or memory.
        """
        self._session, self._states, said = open_onnx(path), contract.states, contract.path.name
        if contract.complete:
            contract.check_metadata(path, self._session.get_modelmeta().custom_metadata_map)
        inputs = self._session.get_inputs()
        self._input = "obs" if contract.complete else inputs[0].name
        wanted: dict[str, tuple[int, ...]] = {self._input: (contract.width,)}
        wanted |= {name: (layers, width) for name, (layers, _, width) in contract.states.items()}
        # The batch size is the first axis of an observation. In a hidden state it is a name, and no number.
        found = {each.name: tuple(n for n in each.shape[len(each.shape) == 2 :] if isinstance(n, int)) for each in inputs}
        if list(found.items()) != list(wanted.items()):
            raise ConfigError(f"{path}: has the inputs {found}, but {said} says {wanted}")
        self.restart()
        zeros = np.zeros((1, contract.width), dtype=np.float32)
        actions = np.asarray(warm_up(path, self._session, {self._input: zeros, **self._hidden})[0])[0]
        if actions.shape != contract.acted.shape:
            raise ConfigError(f"{path}: gives {actions.size} actions, but {said} says {len(contract.acted)}")
        if not np.isfinite(actions).all():
            raise ConfigError(f"{path}: gives actions that are not finite for an observation of zeros")

    def restart(self) -> None:
        """Clear the hidden state."""
        self._hidden = {name: np.zeros(shape, dtype=np.float32) for name, shape in self._states.items()}

    def run(self, observation: np.ndarray) -> np.ndarray:
        """Return the actions (A,) float32 for an observation (width,) float32."""
        actions, *hidden = self._session.run(None, {self._input: observation[None], **self._hidden})
        self._hidden = dict(zip(self._hidden, hidden, strict=False))
        return np.asarray(actions)[0]


class Policy:
    """A policy that controls one robot. Every `contract.control_dt` it converts a reading and a command to joint targets."""

    def __init__(self, folder: Path) -> None:
        """Load the export in `folder`, which may also be the path of its policy.onnx. Without a policy.json, the contract is
        Unitree's deploy.yaml, or the metadata that mjlab gives its ONNX files.

        Raises:
            ConfigError: there is no export, or this program cannot run it.
        """
        path = folder if folder.suffix == ".onnx" else folder / "policy.onnx"
        said = path.with_name("policy.json")
        if not path.is_file():
            raise ConfigError(f"POLICY: there is no {path}; name a folder with policy.onnx and policy.json")
        if said.is_file():
            contract = read_contract(said)
        else:
            contract = read_other(path, open_onnx(path).get_modelmeta().custom_metadata_map)
        self.contract = contract
        self._network = Network(path, contract)
        self._steps = [np.zeros((group.history, group.size)) for group in contract.groups]
        self.observation = np.zeros(contract.width, dtype=np.float32)
        """(width,) observation of the last call of `act`."""
        self.restart()

    def fit(self, robot: RobotFacts) -> None:
        """Take from a robot what the contract leaves open.

        Raises:
            ConfigError: the policy does not fit the robot.
        """
        self.contract = self.contract.fitted(robot)

    def restart(self) -> None:
        """Clear the hidden state, the last action and the histories. The next observation then fills each history, as
        the first observation of an episode does in training.
        """
        self._network.restart()
        self._begins = True
        self.actions = np.zeros(len(self.contract.acted))
        """(A,) last output of the network, clipped to plus and minus action_clip; NaN where the output is not finite."""

    def act(self, reading: Reading, command: np.ndarray, base: np.ndarray | None = None) -> np.ndarray:
        """Return the joint targets (D,) [rad]. `command` (3,) is vx, vy [m/s] and yaw rate [rad/s], `base` (2,) is height [m]
        and pitch [rad] of the base, by default the usual ones. Targets are NaN where the network's output is not finite.

        Raises:
            KeyError: the reading lacks a source that the policy needs.
        """
        contract = self.contract
        self.observation = self._observe(reading, command, contract.base_commands[:, 1] if base is None else base)
        given = self._network.run(self.observation).astype(float)
        actions = np.clip(given, -contract.action_clip, contract.action_clip)
        self.actions = np.where(np.isfinite(given), actions, np.nan)  # clipping has made infinite outputs finite
        targets = contract.default.copy()
        targets[contract.acted] += contract.action_scale * self.actions
        return targets

    def _observe(self, reading: Reading, command: np.ndarray, base: np.ndarray) -> np.ndarray:
        """Return the observation (width,) float32: each group's history with the newest scaled, clipped terms at the end."""
        contract = self.contract
        values = {
            "base_ang_vel": reading.gyro,
            "projected_gravity": gravity_in(reading.quaternion),
            "commands": command,
            "base_commands": base,
            "dof_pos": reading.positions - contract.default,
            "dof_vel": reading.velocities,
            "actions": self.actions,
        }
        for group, steps in zip(contract.groups, self._steps, strict=True):
            steps[:-1] = steps[1:]
            for term in group.terms:
                value = values[term.name] if term.source is None else reading.sources[term.source]
                if term.joints is not None:
                    value = value[term.joints]
                if term.source == "heights":
                    value = np.clip(-value - term.offset, -term.limit, term.deepest)
                begin = term.start - group.start
                steps[-1, begin : begin + term.size] = term.scale * value
            np.clip(steps[-1], -contract.observation_clip, contract.observation_clip, out=steps[-1])
            if self._begins:
                steps[:] = steps[-1]
        self._begins = False
        return np.concatenate([steps.ravel() for steps in self._steps]).astype(np.float32)
