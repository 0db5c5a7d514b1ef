"""Export of a policy as TorchScript, ONNX and plain numbers, with a description. Files are checked against the policy."""

import hashlib
import io
import json
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from legged.config import TaskConfig
from legged.config.actuator import MOTORS
from legged.config.tracking import tracks_motions
from legged.deploy import weights as kinds
from legged.deploy.contract import CHECKSUMS
from legged.deploy.weights import Layer, NumpyNetwork, pack
from legged.envs import BaseTask, is_robot_task
from legged.envs.motion_tracking import is_tracking_task
from legged.errors import RunError
from legged.learning.estimator import EstimatingModel
from legged.mdp.reference_motion import Frames
from legged.motion.readers import motion_files
from legged.policies.description import describe, tracker_name
from legged.policies.motion_export import metadata_of, run_tracker, tables_of, with_motion
from legged.process.paths import make_folder, write_bytes, write_text

EXPORTED = "exported"
"""Folder of the exported files, inside the folder of a film or a checkpoint."""
CHECKED_OBSERVATIONS = 1000
CHECKED_SEQUENCE = (100, 3)
"""Numbers of steps and robots with which the export of a recurrent policy is checked."""
NEW_EPISODES = ((40, 1), (70, 0), (70, 2))
"""Pairs (step, robot): in the check of a recurrent policy, an episode of this robot begins at this step."""
POLICY_MB, TRACKER_MB = 5.0, 2.0
"""Disk space for the files of one policy, and for each of its trackers [MiB]."""
LARGEST_DIFFERENCE = 1e-4
"""Largest allowed difference of a file's actions from the policy's, divided by the larger of 1 and the largest action."""


def megabytes(cfg: TaskConfig) -> float:
    """Return the disk space for the exported files of a policy [MiB].

    Raises:
        ConfigError: a motion of the task is not found.
    """
    if not tracks_motions(cfg):
        return POLICY_MB
    clips = motion_files(cfg.motion.files, cfg.origins.where("motion.files"))
    return POLICY_MB + TRACKER_MB * len(clips)


class ExportError(RunError):
    """Failure of an export: an exported file gives other actions than the policy, or another motion than the task's."""


def export(
    task: BaseTask,
    policy: Any,
    folder: Path,
    training: Mapping[str, Any] | None = None,
    trained: TaskConfig | None = None,
    run: str = "",
) -> dict[str, float]:
    """Write `policy`, rsl-rl's actor network, to `folder` as policy.pt (TorchScript), policy.onnx and policy.weights (plain
    numbers, legged.deploy.weights); return the largest difference of each file's actions from the policy's.

    All files map a flat observation (batch, width) to actions (batch, joints), without noise. The observation has the
    policy's groups side by side; a group with a history of H steps has H observations, oldest first. For a recurrent
    policy, policy.pt keeps the hidden state, for a batch of 1, until its method `reset` is called; policy.onnx has the hidden
    state as inputs and outputs. policy.onnx and policy.json contain the description and `training`; policy.json also has the
    files' checksums. `trained` is the configuration of the training if it differs from the task's. A learned actuator's
    network is copied to the folder. For a task that tracks motions, there is a tracker for each motion besides, as
    legged.policies.motion_export says; `run` is the path of the run in its metadata.

    Raises:
        ExportError: a file gives other actions than the policy, or another motion than the task's.
        RunError: a file cannot be written.
    """
    metadata = {**describe(task, trained), **(training or {})}
    device = next(policy.parameters()).device
    # A sequence of batches; its order matters only to recurrent policies.
    length, batch = CHECKED_SEQUENCE if policy.is_recurrent else (1, CHECKED_OBSERVATIONS)
    widths = {name: task.observation_groups[name].buffer.shape[1] for name in policy.obs_groups}
    observations = torch.randn(length, batch, sum(widths.values()))
    begins = torch.zeros(length, batch, dtype=torch.bool)
    begins[0] = True
    if policy.is_recurrent:
        for step, robot in NEW_EPISODES:
            begins[step, robot] = True

    def act(step: Tensor) -> Tensor:
        groups = dict(zip(widths, step.split([*widths.values()], dim=1), strict=True))
        return policy(TensorDict(groups, batch_size=[len(step)]))

    # Files are made and checked in memory, because torch aborts the process if the disk is full.
    texts = {key: json.dumps(value) for key, value in metadata.items()}
    hidden = policy.get_hidden_state()
    try:
        policy.to("cpu").eval()
        policy.reset()
        wanted = _actions(act, policy.reset, observations, begins)
        files = {"policy.pt": _torchscript(policy), "policy.onnx": onnx_of(policy, texts)}
        files["policy.weights"] = weights_of(policy, task.cfg.train.policy.activation, task.num_actions)
    finally:
        policy.to(device)
        policy.reset(hidden_state=hidden)
    trackers: dict[str, Frames] = {}
    if is_tracking_task(task):
        said = metadata_of(task, run)
        trackers = {tracker_name(name): frames for name, frames in task.motion.clips.items()}
        files |= {name: with_motion(files["policy.onnx"], frames, said) for name, frames in trackers.items()}
    found = {
        "policy.pt": _by_script(files["policy.pt"], observations, begins, 1 if policy.is_recurrent else batch),
        "policy.onnx": _by_onnx(files["policy.onnx"], observations, begins, metadata["recurrent"]),
        "policy.weights": _by_weights(files["policy.weights"], observations, begins),
    }
    found |= {name: _by_tracker(name, files[name], frames, observations) for name, frames in trackers.items()}
    differences = {}
    for name, actions in found.items():
        expected = wanted[:1] if name in trackers else wanted
        difference = float(np.abs(actions - expected).max() / max(1.0, np.abs(expected).max()))
        if not difference <= LARGEST_DIFFERENCE:
            raise ExportError(f"{name}: differs from the policy by {difference:.1e} (allowed: {LARGEST_DIFFERENCE})")
        differences[name] = difference
    if is_robot_task(task) and (motors := task.cfg.control.actuator.network):
        files[MOTORS] = Path(motors).read_bytes()
    make_folder(folder)
    for name, content in files.items():
        write_bytes(folder / name, content)
    checksums = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    write_text(folder / "policy.json", json.dumps({**metadata, CHECKSUMS: checksums}, indent=1))
    return differences


@torch.inference_mode()
def _actions(
    run: Callable[[Tensor], Any], restart: Callable[[Tensor], Any], observations: Tensor, begins: Tensor
) -> np.ndarray:
    """Return the actions (T, batch, D) for observations (T, batch, width), step by step. Before each
    step `restart` gets a row of `begins`, the mask (batch,) of the episodes that begin with this step.
    """
    actions = []
    for step, new in zip(observations, begins, strict=True):
        restart(new)
        actions.append(np.asarray(run(step)))
    return np.stack(actions)


@torch.inference_mode()
def _by_script(content: bytes, observations: Tensor, begins: Tensor, batch: int) -> np.ndarray:
    """Return the actions of the TorchScript file for batches of `batch` robots, whose episodes all begin at the same step."""
    script = torch.jit.load(io.BytesIO(content))

    def restart(new: Tensor) -> None:
        if new.any():
            script.reset()

    parts = []
    for columns, own in zip(observations.split(batch, dim=1), begins.split(batch, dim=1), strict=True):
        script(columns[0])
        parts.append(_actions(script, restart, columns, own))
    return np.concatenate(parts, axis=1)


def _by_onnx(content: bytes, observations: Tensor, begins: Tensor, memory: dict[str, Any] | None) -> np.ndarray:
    """Return the actions of the ONNX file. The hidden state that `memory` describes is passed from step to step."""
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    hidden: dict[str, np.ndarray] = {}
    if memory is not None:
        size = (memory["shape"][0], observations.shape[1], memory["shape"][2])
        hidden = {name: np.ones(size, dtype=np.float32) for name in memory["onnx_inputs"]}

    def restart(new: Tensor) -> None:
        for state in hidden.values():
            state[:, new.numpy()] = 0.0

    def run(step: Tensor) -> Any:
        action, *states = session.run(None, {"obs": step.numpy(), **hidden})
        hidden.update({name: np.array(state) for name, state in zip(hidden, states, strict=True)})
        return action

    return _actions(run, restart, observations, begins)


def _by_weights(content: bytes, observations: Tensor, begins: Tensor) -> np.ndarray:
    network = NumpyNetwork(content)
    network.run(observations[0].numpy())
    return _actions(lambda step: network.run(step.numpy()), lambda new: network.restart(new.numpy()), observations, begins)


def _by_tracker(name: str, content: bytes, frames: Frames, observations: Tensor) -> np.ndarray:
    """Return the actions (1, batch, D) of the tracker `name` for the first observations.

    Raises:
        ExportError: its frames are not `frames`.
    """
    last = len(frames.rows) - 1
    steps = np.linspace(0, last + 2, observations.shape[1]).round()
    actions, outputs = run_tracker(content, observations[0], steps)
    for output, table in tables_of(frames).items():
        if not np.array_equal(outputs[output], table[np.minimum(steps, last).astype(int)]):
            raise ExportError(f"{name}: {output} differs from the motion")
    return actions[None]


def _torchscript(policy: Any) -> bytes:
    buffer = io.BytesIO()
    torch.jit.save(torch.jit.script(policy.as_jit().to("cpu")), buffer)
    return buffer.getvalue()


def onnx_of(policy: Any, metadata: Mapping[str, str], free: bool = True) -> bytes:
    """Return the ONNX file of `policy`, rsl-rl's actor network, with texts as metadata. Its batch is `free`, or of size 1."""
    module = policy.as_onnx(verbose=False).to("cpu").eval()
    buffer = io.BytesIO()
    inputs, outputs = module.input_names, module.output_names
    hidden = {name: {1: "batch"} for name in (*inputs[1:], *outputs[1:])}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=torch.jit.TracerWarning)  # checks of shapes cause this warning
        warnings.filterwarnings("ignore", message="Exporting a model to ONNX with a batch_size other than 1")
        torch.onnx.export(
            module,
            module.get_dummy_inputs(),
            buffer,  # type: ignore[arg-type]
            opset_version=18,
            input_names=inputs,
            output_names=outputs,
            dynamic_axes={"obs": {0: "batch"}, "actions": {0: "batch"}, **hidden} if free else None,
            dynamo=False,
        )
    model = onnx.load_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model)
    return model.SerializeToString()


def weights_of(policy: Any, activation: str, num_actions: int) -> bytes:
    """Return the file of weights of `policy`, rsl-rl's actor network on the CPU. `activation` is rsl-rl's name for the
    activation of hidden layers. Only those outputs that are means of the actions are kept.
    """
    layers: list[Layer] = []
    if policy.obs_normalization:
        normaliser = policy.obs_normalizer
        mean, divisor = normaliser._mean.flatten(), (normaliser._std + normaliser.eps).flatten()
        layers.append(_layer(kinds.NORMALISE, len(mean), len(mean), mean, divisor))
    if policy.is_recurrent:
        layers += _recurrent(policy.rnn.rnn)
    if isinstance(policy, EstimatingModel):
        width = policy.obs_dim
        found = _dense(policy.estimator, activation)
        more = found[-1].outputs
        layers += [Layer(kinds.KEEP, 0, width, width, ()), *found, Layer(kinds.JOIN, 0, more, width + more, ())]
    return pack([*layers, *_dense(policy.mlp, activation, num_actions)])


def _dense(mlp: nn.Sequential, activation: str, outputs: int | None = None) -> list[Layer]:
    """Return the layers of an MLP. If `outputs` is given, the last layer keeps only its first `outputs` outputs."""
    layers: list[Layer] = []
    linear = [module for module in mlp if isinstance(module, nn.Linear)]
    for module in linear:
        rows = module.out_features if outputs is None or module is not linear[-1] else outputs
        layers.append(_layer(kinds.LINEAR, module.in_features, rows, module.weight[:rows], module.bias[:rows]))
        if module is not linear[-1]:
            layers.append(Layer(kinds.ACTIVATION, list(kinds.ACTIVATIONS).index(activation), rows, rows, ()))
    return layers


def _recurrent(module: nn.LSTM | nn.GRU) -> list[Layer]:
    kind, layers = kinds.LSTM if isinstance(module, nn.LSTM) else kinds.GRU, []
    for i in range(module.num_layers):
        names = (f"weight_ih_l{i}", f"weight_hh_l{i}", f"bias_ih_l{i}", f"bias_hh_l{i}")
        inputs = module.input_size if i == 0 else module.hidden_size
        layers.append(_layer(kind, inputs, module.hidden_size, *(getattr(module, name) for name in names)))
    return layers


@torch.no_grad()
def _layer(kind: int, inputs: int, outputs: int, *arrays: Tensor) -> Layer:
    return Layer(kind, 0, inputs, outputs, tuple(array.detach().float().numpy().copy() for array in arrays))
