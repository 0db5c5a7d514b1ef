"""Export of a policy as TorchScript and ONNX, with what a robot's controller needs to know, checked against torch."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch

from legged.envs import LeggedRobot
from legged.rl.runner import Runner

CHECKED_OBSERVATIONS = 1000
LARGEST_DIFFERENCE = 1e-4
"""Exports that differ from the policy by more than this, in actions, are refused."""


class ExportError(RuntimeError):
    """An exported policy does not compute what the policy does."""


def export(runner: Runner, folder: Path) -> dict[str, float]:
    """Write policy.pt (TorchScript) and policy.onnx to `folder`; returns the largest difference of each to the policy.

    Both take one flat observation (batch, width) and give actions (batch, joints), without noise. The metadata is in
    the ONNX file and beside it in policy.json.

    Raises:
        ExportError: a file computes something else.
    """
    task: LeggedRobot = runner.env  # type: ignore[assignment]
    folder.mkdir(parents=True, exist_ok=True)
    metadata = describe(task)
    script, network = folder / "policy.pt", folder / "policy.onnx"
    policy = runner.alg.get_policy()
    device = next(policy.parameters()).device
    observations = torch.randn(CHECKED_OBSERVATIONS, task.observation_groups["actor"].buffer.shape[1])
    try:
        policy.to("cpu").eval()
        with torch.inference_mode():
            wanted = policy.as_jit()(observations).numpy()
        _write_torchscript(policy, script)
        _write_onnx(policy, network, metadata)
    finally:
        policy.to(device)
    with torch.inference_mode():
        from_script = torch.jit.load(str(script))(observations).numpy()
    session = onnxruntime.InferenceSession(str(network), providers=["CPUExecutionProvider"])
    (from_onnx,) = session.run(None, {"obs": observations.numpy()})
    found = {script.name: from_script, network.name: np.asarray(from_onnx)}
    differences = {name: float(np.abs(value - wanted).max()) for name, value in found.items()}
    for name, difference in differences.items():
        if not difference <= LARGEST_DIFFERENCE:
            raise ExportError(f"{folder / name}: differs from the policy by {difference:.1e} (allowed: {LARGEST_DIFFERENCE})")
    _replace(folder / "policy.json", json.dumps(metadata, indent=1).encode())
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


def _write_torchscript(policy: Any, path: Path) -> None:
    part = path.with_name(path.name + ".part")
    torch.jit.script(policy.as_jit().to("cpu")).save(str(part))
    os.replace(part, path)


def _write_onnx(policy: Any, path: Path, metadata: dict[str, Any]) -> None:
    """rsl-rl's ONNX model with a free batch size and the metadata as JSON strings, one property a key."""
    module = policy.as_onnx(verbose=False).to("cpu").eval()
    part = path.with_name(path.name + ".part")
    torch.onnx.export(
        module,
        module.get_dummy_inputs(),
        str(part),
        opset_version=18,
        input_names=["obs"],
        output_names=["actions"],
        dynamic_axes={"obs": {0: "batch"}, "actions": {0: "batch"}},
        dynamo=False,
    )
    model = onnx.load(str(part))
    onnx.helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
    onnx.checker.check_model(model)
    part.unlink()
    _replace(path, model.SerializeToString())


def _replace(path: Path, data: bytes) -> None:
    part = path.with_name(path.name + ".part")
    part.write_bytes(data)
    os.replace(part, path)
