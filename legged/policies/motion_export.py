"""Trackers: ONNX files that hold a policy and one motion, with the inputs, outputs and metadata of mjlab's trackers."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from legged.config.networks import groups_of
from legged.envs.motion_tracking import MotionTracking
from legged.mdp.control import action_scales
from legged.mdp.reference_motion import Frames

TIME_STEP = "time_step"
"""Input (1, 1) with the number of a frame."""
OUTPUTS = {
    "joint_pos": "joint_pos",
    "joint_vel": "joint_vel",
    "body_pos_w": "pos",
    "body_quat_w": "quat",
    "body_lin_vel_w": "lin_vel",
    "body_ang_vel_w": "ang_vel",
}
"""Output of the file -> attribute of `Frames` that it shows."""
MJLAB_TERMS = {
    "reference": "command",
    "anchor_pos": "motion_anchor_pos_b",
    "anchor_ori": "motion_anchor_ori_b",
    "dof_pos": "joint_pos",
    "dof_vel": "joint_vel",
}
"""Term of an observation -> mjlab's name, where it differs."""


def metadata_of(task: MotionTracking, run: str) -> dict[str, str]:
    """Return the metadata that mjlab's trackers have, as text, and the frames per second. Lists have commas. `run` is the
    path of the run. The names of observations are mjlab's.
    """
    control, motion = task.control, task.cfg.motion
    terms = [term.name for name in groups_of(task.cfg, "actor") for term in task.observation_groups[name].terms]
    return {
        "run_path": run,
        "joint_names": _listing(task.robot.joint_names),
        "joint_stiffness": _listing(control.nominal["p_gain"].cpu().numpy()),
        "joint_damping": _listing(control.nominal["d_gain"].cpu().numpy()),
        "default_joint_pos": _listing(control.default_dof_pos.cpu().numpy()),
        "command_names": "motion",
        "observation_names": _listing(MJLAB_TERMS.get(name, name) for name in terms),
        "action_scale": _listing(action_scales(task.robot, task.cfg.control)),
        "anchor_body_name": motion.anchor,
        "body_names": _listing(motion.bodies),
        "fps": f"{1.0 / task.dt:g}",
    }


def with_motion(policy: bytes, frames: Frames, metadata: dict[str, str]) -> bytes:
    """Return the ONNX file of a tracker: the ONNX file `policy`, for one robot, and the `frames` of a motion.

    The input `time_step` (1, 1) is the number of a frame, from 0. Numbers beyond the last frame count as the last one. The
    outputs after `actions` are joint angles and velocities (1, D) of this frame [rad, rad/s], and positions, orientations (w
    first), linear and angular velocities of B bodies (1, B, 3 or 4), in the world frame [m, m/s, rad/s].
    """
    model = onnx.load_from_string(policy)
    graph = model.graph
    for value in (*graph.input, *graph.output, *graph.value_info):
        for size in value.type.tensor_type.shape.dim:
            if size.dim_param == "batch":
                size.dim_value = 1
    last = np.float32(len(frames.rows) - 1)
    constants = {"motion/first": np.float32(0.0), "motion/last": last, "motion/flat": np.array([-1])}
    nodes = [
        helper.make_node("Clip", [TIME_STEP, "motion/first", "motion/last"], ["motion/kept"]),
        helper.make_node("Cast", ["motion/kept"], ["motion/whole"], to=TensorProto.INT64),
        helper.make_node("Reshape", ["motion/whole", "motion/flat"], ["motion/frame"]),
    ]
    for output, table in tables_of(frames).items():
        constants[f"motion/{output}"] = table
        nodes.append(helper.make_node("Gather", [f"motion/{output}", "motion/frame"], [output], axis=0))
        graph.output.append(helper.make_tensor_value_info(output, TensorProto.FLOAT, [1, *table.shape[1:]]))
    graph.input.insert(1, helper.make_tensor_value_info(TIME_STEP, TensorProto.FLOAT, [1, 1]))
    graph.node.extend(nodes)
    graph.initializer.extend(numpy_helper.from_array(np.asarray(values), name) for name, values in constants.items())
    helper.set_model_props(model, metadata)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def tables_of(frames: Frames) -> dict[str, np.ndarray]:
    """Return for each output of a tracker its values (T, ...) in all frames."""
    return {output: getattr(frames, name).cpu().numpy() for output, name in OUTPUTS.items()}


def run_tracker(content: bytes, observations: Tensor, frames: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return what a tracker gives for M observations (M, width) and numbers of frames (M,), one after the other: the actions
    (M, A), and its other outputs (M, ...). For a recurrent policy, an episode begins with each observation.
    """
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    hidden = [entry for entry in session.get_inputs() if entry.name not in ("obs", TIME_STEP)]
    zeros = {entry.name: np.zeros(entry.shape, dtype=np.float32) for entry in hidden}
    rows = [
        session.run(["actions", *OUTPUTS], {"obs": row[None], TIME_STEP: np.array([[step]], dtype=np.float32), **zeros})
        for step, row in zip(frames, observations.numpy(), strict=True)
    ]
    actions, *others = (np.concatenate(values) for values in zip(*rows, strict=True))
    return actions, dict(zip(OUTPUTS, others, strict=True))


def _listing(values: Iterable[Any]) -> str:
    return ",".join(str(value) for value in values)
