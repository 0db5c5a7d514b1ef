"""An exported policy for one robot: policy.onnx and its contract."""

import json
from pathlib import Path

import numpy as np
import onnxruntime

from legged.deploy.contract import Contract, read_contract
from legged.deploy.interface import Reading
from legged.deploy.observations import Observer
from legged.errors import ConfigError

WARM_UP = 20
"""Runs of the network at the start, because the first ones take ten times as long."""
COMPARED = (
    *("contract_version", "joint_names", "action_joints", "imu_frame", "control_dt", "observation", "observation_groups"),
    *("observation_clip", "default_joint_angles", "action_scale", "action_clip", "stiffness", "damping", "recurrent"),
)
"""Keys whose values in the ONNX file's metadata must equal those of policy.json."""


class Network:
    """A policy.onnx: observation -> actions; it keeps the hidden state of a recurrent policy."""

    def __init__(self, path: Path, contract: Contract) -> None:
        """Load the file.

        Raises:
            ConfigError: the file cannot be read, has other sizes than the contract, or comes from another export.
        """
        try:
            options = onnxruntime.SessionOptions()
            options.intra_op_num_threads = options.inter_op_num_threads = 1  # too small for several threads
            options.log_severity_level = 3
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # errors of onnxruntime have no common class
            raise ConfigError(f"{path}: onnxruntime cannot read it: {' '.join(str(error).split())}") from error
        self._path, self._memory = path, contract.memory
        self._check(contract)
        self._hidden: dict[str, np.ndarray] = {}
        self.restart()
        for _ in range(WARM_UP):
            actions = self.run(np.zeros(contract.width, dtype=np.float32))
        if actions.shape != contract.acted.shape:
            raise ConfigError(f"{path}: gives {actions.size} actions, policy.json says {len(contract.acted)}")
        self.restart()

    def _check(self, contract: Contract) -> None:
        """Compare with the contract.

        Raises:
            ConfigError: something differs.
        """
        memory = contract.memory
        inputs = {given.name: given.shape for given in self._session.get_inputs()}
        wanted = ["obs", *(memory.inputs if memory else ())]
        if list(inputs) != wanted:
            raise ConfigError(f"{self._path}: takes {', '.join(inputs)}; policy.json says {', '.join(wanted)}")
        if inputs["obs"][-1] != contract.width:
            raise ConfigError(f"{self._path}: takes {inputs['obs'][-1]} numbers, policy.json says {contract.width}")
        inside = self._session.get_modelmeta().custom_metadata_map
        beside = json.loads(contract.path.read_text(encoding="utf-8"))
        for key in COMPARED:
            if key in inside and json.loads(inside[key]) != beside[key]:
                raise ConfigError(f"{contract.path}: {key}: is not that of {self._path}: they are of different exports")

    def restart(self) -> None:
        """Clear the hidden state."""
        if self._memory is not None:
            shape = (self._memory.layers, 1, self._memory.width)
            self._hidden = {name: np.zeros(shape, dtype=np.float32) for name in self._memory.inputs}

    def run(self, observation: np.ndarray) -> np.ndarray:
        """Return the actions (A,) for an observation (width,), float32 both."""
        actions, *hidden = self._session.run(None, {"obs": observation[None], **self._hidden})
        self._hidden = dict(zip(self._hidden, hidden, strict=False))
        return np.asarray(actions)[0]


class Policy:
    """A policy on one robot: readings and commands -> joint targets, once every `contract.control_dt`."""

    def __init__(self, folder: Path) -> None:
        """Load the export in `folder`, which may also be the path of its policy.onnx.

        Raises:
            ConfigError: there is no export, or this program cannot run it.
        """
        path = folder if folder.suffix == ".onnx" else folder / "policy.onnx"
        for needed in (path, path.with_name("policy.json")):
            if not needed.is_file():
                raise ConfigError(f"POLICY: there is no {needed}: a folder with policy.onnx and policy.json is wanted")
        self.contract = read_contract(path.with_name("policy.json"))
        self._network = Network(path, self.contract)
        self._observer = Observer(self.contract)
        self.actions = np.zeros(len(self.contract.acted))
        """(A,) last output, within plus and minus action_clip."""
        self.observation = np.zeros(self.contract.width, dtype=np.float32)
        """(width,) observation of the last call."""

    def restart(self) -> None:
        """Clear the hidden state, the last action and the history."""
        self._network.restart()
        self._observer.restart()
        self.actions = np.zeros(len(self.contract.acted))

    def act(self, reading: Reading, command: np.ndarray) -> np.ndarray:
        """Return the joint targets (D,) [rad]; they are not finite where the network's output is not.

        Raises:
            KeyError: a source that the policy needs is missing.
        """
        contract = self.contract
        self.observation = self._observer.observe(reading, command, self.actions)
        given = self._network.run(self.observation).astype(float)
        actions = np.clip(given, -contract.action_clip, contract.action_clip)
        self.actions = np.where(np.isfinite(given), actions, np.nan)  # clipping would make an infinite output finite
        targets = contract.default.copy()
        targets[contract.acted] += contract.action_scale * self.actions
        return targets
