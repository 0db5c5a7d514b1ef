"""Export of a policy as TorchScript, ONNX and plain numbers with a description, checked against torch."""

import io
import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config import TaskConfig
from legged.config.actuator import MOTORS
from legged.deploy.weights import NumpyNetwork
from legged.envs import BaseTask, LeggedRobot
from legged.errors import RunError
from legged.policies.description import describe
from legged.policies.weights_file import weights_of
from legged.process.paths import make_folder, write_bytes, write_text

EXPORTED = "exported"
"""Folder of the exported files, inside that of a film or a checkpoint."""
CHECKED_OBSERVATIONS = 1000
CHECKED_SEQUENCE = (100, 3)
"""Steps and robots of the check of a recurrent policy."""
NEW_EPISODES = ((40, 1), (70, 0), (70, 2))
"""Steps and robots at which episodes begin during that check."""
LARGEST_DIFFERENCE = 1e-4
"""Largest allowed difference between an export and the policy, in actions or relative to the largest action."""


class ExportError(RunError):
    """An exported policy computes other actions than the policy."""


def export(
    task: BaseTask,
    policy: Any,
    folder: Path,
    training: Mapping[str, Any] | None = None,
    trained: TaskConfig | None = None,
) -> dict[str, float]:
    """Write `policy`, rsl-rl's actor network, to `folder` as policy.pt (TorchScript), policy.onnx and policy.weights (plain
    numbers, legged.deploy.weights); return the largest difference of each file's actions from the policy's.

    All map a flat observation (batch, width) to actions (batch, joints), without noise. The observation has the policy's
    groups side by side; a group with a history of H steps has H observations, oldest first. The TorchScript of a recurrent
    policy keeps the hidden state for a batch of 1 until its reset(); the ONNX has it as inputs and outputs. The metadata,
    with the entries of `training`, is in the ONNX file and in policy.json. `trained` is the configuration of the training if
    it is not the task's. A network of the motors is copied to the folder.

    Raises:
        ExportError: a file computes other actions.
        RunError: a file cannot be written.
    """
    metadata = {**describe(task, trained), **(training or {})}
    device = next(policy.parameters()).device
    widths = {name: task.observation_groups[name].buffer.shape[1] for name in policy.obs_groups}
    # A sequence of batches; its order matters only to recurrent policies.
    length, batch = CHECKED_SEQUENCE if policy.is_recurrent else (1, CHECKED_OBSERVATIONS)
    observations = torch.randn(length, batch, sum(widths.values()))
    begins = torch.zeros(length, batch, dtype=torch.bool)
    begins[0] = True
    if policy.is_recurrent:
        for step, robot in NEW_EPISODES:
            begins[step, robot] = True
    # Files are checked in memory before they are written; torch aborts the process when the disk is full.
    hidden = policy.get_hidden_state()
    try:
        policy.to("cpu").eval()
        wanted = _run_policy(policy, observations, begins, widths)
        script, network = _torchscript(policy), _onnx(policy, metadata)
        weights = weights_of(policy, task.cfg.train.policy.activation, task.num_actions)
    finally:
        policy.to(device)
        policy.reset(hidden_state=hidden)
    if policy.is_recurrent:
        by_script = [
            (_run_script(script, observations[:, i : i + 1], begins[:, i]), wanted[:, i : i + 1]) for i in range(batch)
        ]
    else:
        by_script = [(_run_script(script, observations, begins[:, 0]), wanted)]
    by_onnx = [(_run_onnx(network, observations, begins, metadata["recurrent"]), wanted)]
    by_weights = [(_run_weights(weights, observations, begins), wanted)]
    differences = {}
    for name, pairs in (("policy.pt", by_script), ("policy.onnx", by_onnx), ("policy.weights", by_weights)):
        difference = float(np.max([np.abs(found - right).max() / max(1.0, np.abs(right).max()) for found, right in pairs]))
        if not difference <= LARGEST_DIFFERENCE:
            raise ExportError(f"{name}: differs from the policy by {difference:.1e} (allowed: {LARGEST_DIFFERENCE})")
        differences[name] = difference
    make_folder(folder)
    write_bytes(folder / "policy.pt", script)
    write_bytes(folder / "policy.onnx", network)
    write_bytes(folder / "policy.weights", weights)
    if isinstance(task, LeggedRobot) and (motors := task.cfg.control.actuator.network):
        write_bytes(folder / MOTORS, Path(motors).read_bytes())
    write_text(folder / "policy.json", json.dumps(metadata, indent=1))
    return differences


@torch.inference_mode()
def _run_policy(policy: Any, observations: Tensor, begins: Tensor, widths: dict[str, int]) -> np.ndarray:
    """Return the policy's actions (T, batch, D) for observations (T, batch, width) of groups with these `widths`; episodes
    begin before the steps in the mask `begins` (T, batch).
    """
    policy.reset()
    actions = []
    for step, new in zip(observations, begins, strict=True):
        policy.reset(new)
        groups = dict(zip(widths, step.split([*widths.values()], dim=1), strict=True))
        actions.append(policy(TensorDict(groups, batch_size=[len(step)])))
    return torch.stack(actions).numpy()


@torch.inference_mode()
def _run_script(content: bytes, observations: Tensor, begins: Tensor) -> np.ndarray:
    """Return the actions of the TorchScript file, which is reset before the steps in the mask `begins` (T,)."""
    script = torch.jit.load(io.BytesIO(content))
    script(observations[0])
    actions = []
    for step, new in zip(observations, begins, strict=True):
        if new:
            script.reset()
        actions.append(script(step))
    return torch.stack(actions).numpy()


def _run_onnx(content: bytes, observations: Tensor, begins: Tensor, memory: dict[str, Any] | None) -> np.ndarray:
    """Return the actions of the ONNX file; a hidden state, described by `memory`, is passed on and cleared before the steps
    in the mask `begins` (T, batch).
    """
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    hidden: dict[str, np.ndarray] = {}
    if memory is not None:
        layers, _, width = memory["shape"]
        size = (layers, observations.shape[1], width)
        hidden = {name: np.ones(size, dtype=np.float32) for name in memory["onnx_inputs"]}
    actions = []
    for step, new in zip(observations, begins.numpy(), strict=True):
        for state in hidden.values():
            state[:, new] = 0.0
        action, *states = session.run(None, {"obs": step.numpy(), **hidden})
        hidden = {name: np.array(state) for name, state in zip(hidden, states, strict=True)}
        actions.append(np.asarray(action))
    return np.stack(actions)


def _run_weights(content: bytes, observations: Tensor, begins: Tensor) -> np.ndarray:
    """Return the actions of the file of weights, whose hidden state is cleared before the steps in `begins` (T, batch)."""
    network = NumpyNetwork(content)
    network.run(observations[0].numpy())
    actions = []
    for step, new in zip(observations.numpy(), begins.numpy(), strict=True):
        network.restart(new)
        actions.append(network.run(step))
    return np.stack(actions)


def _torchscript(policy: Any) -> bytes:
    """Return the TorchScript file of a policy."""
    buffer = io.BytesIO()
    torch.jit.save(torch.jit.script(policy.as_jit().to("cpu")), buffer)
    return buffer.getvalue()


def _onnx(policy: Any, metadata: dict[str, Any]) -> bytes:
    """Return the file of rsl-rl's ONNX model with a free batch size and the metadata as JSON strings, one per key."""
    module = policy.as_onnx(verbose=False).to("cpu").eval()
    buffer = io.BytesIO()
    inputs, outputs = module.input_names, module.output_names
    hidden = {name: {1: "batch"} for name in (*inputs[1:], *outputs[1:])}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=torch.jit.TracerWarning)  # checks of shapes
        warnings.filterwarnings("ignore", message="Exporting a model to ONNX with a batch_size other than 1")
        torch.onnx.export(
            module,
            module.get_dummy_inputs(),
            buffer,  # type: ignore[arg-type]
            opset_version=18,
            input_names=inputs,
            output_names=outputs,
            dynamic_axes={"obs": {0: "batch"}, "actions": {0: "batch"}, **hidden},
            dynamo=False,
        )
    model = onnx.load_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
    onnx.checker.check_model(model)
    return model.SerializeToString()
