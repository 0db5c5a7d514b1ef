"""Export of a policy as TorchScript and ONNX, with what a robot's controller needs to know, checked against torch."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch

from legged.envs import LeggedRobot
from legged.paths import make_folder, write_bytes, write_text
from legged.rl.runner import Runner

CHECKED_OBSERVATIONS = 1000
LARGEST_DIFFERENCE = 1e-4
"""Exports that differ from the policy by more than this, in actions, are refused."""


class ExportError(RuntimeError):
    """An exported policy does not compute what the policy does."""


def export(runner: Runner, folder: Path) -> dict[str, float]:
    """Write policy.pt (TorchScript) and policy.onnx to `folder`; returns the largest difference of each to the policy.

    Both take one flat observation (batch, width) and give actions (batch, joints), without noise. With a history of H
    steps, width is H times that of the layout, oldest step first. The metadata is in the ONNX file and beside it in
    policy.json.

    Raises:
        ExportError: a file computes something else.
        RunError: a file can't be written.
    """
    task: LeggedRobot = runner.env  # type: ignore[assignment]
    metadata = describe(task)
    policy = runner.alg.get_policy()
    device = next(policy.parameters()).device
    observations = torch.randn(CHECKED_OBSERVATIONS, task.observation_groups["actor"].buffer.shape[1])
    # In memory first, written once they have been read back and agree: onto a full disk torch would abort the process.
    try:
        policy.to("cpu").eval()
        with torch.inference_mode():
            wanted = policy.as_jit()(observations).numpy()
        script, network = _torchscript(policy), _onnx(policy, metadata)
    finally:
        policy.to(device)
    with torch.inference_mode():
        from_script = torch.jit.load(io.BytesIO(script))(observations).numpy()
    session = onnxruntime.InferenceSession(network, providers=["CPUExecutionProvider"])
    (from_onnx,) = session.run(None, {"obs": observations.numpy()})
    differences = {}
    for name, found in (("policy.pt", from_script), ("policy.onnx", np.asarray(from_onnx))):
        difference = float(np.abs(found - wanted).max())
        if not difference <= LARGEST_DIFFERENCE:
            raise ExportError(f"{name}: differs from the policy by {difference:.1e} (allowed: {LARGEST_DIFFERENCE})")
        differences[name] = difference
    make_folder(folder)
    write_bytes(folder / "policy.pt", script)
    write_bytes(folder / "policy.onnx", network)
    write_text(folder / "policy.json", json.dumps(metadata, indent=1))
    return differences


def describe(task: LeggedRobot) -> dict[str, Any]:
    """What a controller must know to run the policy: observation layout, joints, gains, time step."""
    cfg, robot, control = task.cfg, task.robot, task.control
    layout = [
        {
            "name": term.name,
            "start": term.columns.start,
            "size": term.columns.stop - term.columns.start,
            "scale": [float(value) for value in term.scale],
        }
        for term in task.observation_groups["actor"].terms
    ]
    return {
        "task": cfg.task,
        "robot": robot.name,
        "observation": layout,
        "observation_history": task.observation_groups["actor"].history,
        "observation_clip": cfg.observations.clip,
        "joint_names": list(robot.joint_names),
        "default_joint_angles": control.default_dof_pos.tolist(),
        "control_type": cfg.control.control_type,
        "action_scale": cfg.control.action_scale,
        "action_clip": cfg.control.clip_actions,
        "stiffness": control.stiffness.tolist(),
        "damping": control.damping.tolist(),
        "torque_limits": control.torque_limits.tolist(),
        "control_dt": task.dt,
    }


def _torchscript(policy: Any) -> bytes:
    """The file of the TorchScript policy."""
    buffer = io.BytesIO()
    torch.jit.save(torch.jit.script(policy.as_jit().to("cpu")), buffer)
    return buffer.getvalue()


def _onnx(policy: Any, metadata: dict[str, Any]) -> bytes:
    """The file of rsl-rl's ONNX model with a free batch size and the metadata as JSON strings, one property a key."""
    module = policy.as_onnx(verbose=False).to("cpu").eval()
    buffer = io.BytesIO()
    torch.onnx.export(
        module,
        module.get_dummy_inputs(),
        buffer,  # type: ignore[arg-type]
        opset_version=18,
        input_names=["obs"],
        output_names=["actions"],
        dynamic_axes={"obs": {0: "batch"}, "actions": {0: "batch"}},
        dynamo=False,
    )
    model = onnx.load_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
    onnx.checker.check_model(model)
    return model.SerializeToString()
