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
from legged.paths import write_text
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
    """
    task: LeggedRobot = runner.env  # type: ignore[assignment]
    folder.mkdir(parents=True, exist_ok=True)
    metadata = describe(task)
    policy = runner.alg.get_policy()
    device = next(policy.parameters()).device
    observations = torch.randn(CHECKED_OBSERVATIONS, task.observation_groups["actor"].buffer.shape[1])
    # Written beside their names and renamed once they have been read back and agree.
    script, network = folder / "policy.pt.part", folder / "policy.onnx.part"
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
    session = onnxruntime.InferenceSession(network.read_bytes(), providers=["CPUExecutionProvider"])
    (from_onnx,) = session.run(None, {"obs": observations.numpy()})
    differences = {}
    for path, found in ((script, from_script), (network, np.asarray(from_onnx))):
        difference = float(np.abs(found - wanted).max())
        if not difference <= LARGEST_DIFFERENCE:
            script.unlink()
            network.unlink()
            raise ExportError(f"{path.stem}: differs from the policy by {difference:.1e} (allowed: {LARGEST_DIFFERENCE})")
        differences[path.stem] = difference
    for path in (script, network):
        os.replace(path, path.with_suffix(""))
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


def _write_torchscript(policy: Any, path: Path) -> None:
    torch.jit.script(policy.as_jit().to("cpu")).save(str(path))


def _write_onnx(policy: Any, path: Path, metadata: dict[str, Any]) -> None:
    """rsl-rl's ONNX model with a free batch size and the metadata as JSON strings, one property a key."""
    module = policy.as_onnx(verbose=False).to("cpu").eval()
    torch.onnx.export(
        module,
        module.get_dummy_inputs(),
        str(path),
        opset_version=18,
        input_names=["obs"],
        output_names=["actions"],
        dynamic_axes={"obs": {0: "batch"}, "actions": {0: "batch"}},
        dynamo=False,
    )
    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
