"""Export of a policy as TorchScript and ONNX, with what a robot's controller needs to know, checked against torch."""

import io
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from tensordict import TensorDict
from torch import Tensor

from legged.envs import LeggedRobot
from legged.errors import RunError
from legged.learning.runner import Runner
from legged.policies.description import describe
from legged.process.paths import make_folder, write_bytes, write_text

CHECKED_OBSERVATIONS = 1000
CHECKED_SEQUENCE = (100, 3)
"""Steps and robots on which a recurrent policy is checked."""
LARGEST_DIFFERENCE = 1e-4
"""Exports that differ from the policy by more than this, in actions or as a share of the largest, are refused."""


class ExportError(RunError):
    """An exported policy does not compute what the policy does."""


def export(runner: Runner, folder: Path) -> dict[str, float]:
    """Write policy.pt (TorchScript) and policy.onnx to `folder`; returns the largest difference of each to the policy.

    Both take one flat observation (batch, width) and give actions (batch, joints), without noise. With a history of H
    steps, width is H times that of the layout, oldest step first. Of a recurrent policy the TorchScript keeps the hidden
    state of a batch of 1 inside, until its reset(); the ONNX takes it and gives it back. The metadata is in the ONNX file
    and beside it in policy.json.

    Raises:
        ExportError: a file computes something else.
        RunError: a file can't be written.
    """
    task: LeggedRobot = runner.env  # type: ignore[assignment]
    metadata = describe(task)
    policy = runner.alg.get_policy()
    device = next(policy.parameters()).device
    width = task.observation_groups["actor"].buffer.shape[1]
    # A sequence of batches; only a policy with a memory cares which comes first.
    length, batch = CHECKED_SEQUENCE if policy.is_recurrent else (1, CHECKED_OBSERVATIONS)
    observations = torch.randn(length, batch, width)
    # In memory first, written once they have been read back and agree: onto a full disk torch would abort the process.
    hidden = policy.get_hidden_state()
    try:
        policy.to("cpu").eval()
        wanted = _run_policy(policy, observations)
        script, network = _torchscript(policy), _onnx(policy, metadata)
    finally:
        policy.to(device)
        policy.reset(hidden_state=hidden)
    if policy.is_recurrent:
        by_script = [(_run_script(script, observations[:, i : i + 1]), wanted[:, i : i + 1]) for i in range(batch)]
    else:
        by_script = [(_run_script(script, observations), wanted)]
    by_onnx = [(_run_onnx(network, observations, metadata["recurrent"]), wanted)]
    differences = {}
    for name, pairs in (("policy.pt", by_script), ("policy.onnx", by_onnx)):
        difference = float(np.max([np.abs(found - right).max() / max(1.0, np.abs(right).max()) for found, right in pairs]))
        if not difference <= LARGEST_DIFFERENCE:
            raise ExportError(f"{name}: differs from the policy by {difference:.1e} (allowed: {LARGEST_DIFFERENCE})")
        differences[name] = difference
    make_folder(folder)
    write_bytes(folder / "policy.pt", script)
    write_bytes(folder / "policy.onnx", network)
    write_text(folder / "policy.json", json.dumps(metadata, indent=1))
    return differences


@torch.inference_mode()
def _run_policy(policy: Any, observations: Tensor) -> np.ndarray:
    """The policy's own actions (T, batch, D) for observations (T, batch, width), from the start of an episode on."""
    policy.reset()
    (group,) = policy.obs_groups
    steps = [policy(TensorDict({group: step}, batch_size=[len(step)])) for step in observations]
    return torch.stack(steps).numpy()


@torch.inference_mode()
def _run_script(content: bytes, observations: Tensor) -> np.ndarray:
    """Those of the TorchScript file; it must begin anew by its reset()."""
    script = torch.jit.load(io.BytesIO(content))
    script(observations[0])
    script.reset()
    return torch.stack([script(step) for step in observations]).numpy()


def _run_onnx(content: bytes, observations: Tensor, memory: dict[str, Any] | None) -> np.ndarray:
    """Those of the ONNX file; a hidden state, as `memory` describes it, begins with zeros and is handed on."""
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    hidden: dict[str, np.ndarray] = {}
    if memory is not None:
        layers, _, width = memory["shape"]
        zeros = np.zeros((layers, observations.shape[1], width), dtype=np.float32)
        hidden = dict.fromkeys(memory["onnx_inputs"], zeros)
    actions = []
    for step in observations:
        action, *state = session.run(None, {"obs": step.numpy(), **hidden})
        hidden = dict(zip(hidden, state, strict=True))
        actions.append(np.asarray(action))
    return np.stack(actions)


def _torchscript(policy: Any) -> bytes:
    """The file of the TorchScript policy."""
    buffer = io.BytesIO()
    torch.jit.save(torch.jit.script(policy.as_jit().to("cpu")), buffer)
    return buffer.getvalue()


def _onnx(policy: Any, metadata: dict[str, Any]) -> bytes:
    """The file of rsl-rl's ONNX model with a free batch size and the metadata as JSON strings, one property a key."""
    module = policy.as_onnx(verbose=False).to("cpu").eval()
    buffer = io.BytesIO()
    inputs, outputs = module.input_names, module.output_names
    hidden = {name: {1: "batch"} for name in (*inputs[1:], *outputs[1:])}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=torch.jit.TracerWarning)  # of checks of shapes, which are fixed
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
