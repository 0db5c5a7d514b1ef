"""Replay of a tracker: what a small network is given, and what the robot does with its actions."""

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from legged.cli.main import main
from legged.errors import ConfigError
from legged.evaluation.trackers import Tracker
from legged.policies.foreign import Layout, read_layout
from legged.process.paths import data_folder
from legged.robots.robot import load_robot

pytestmark = pytest.mark.usefixtures("workplace")
TERMS = dict.fromkeys(("actions", "base_ang_vel", "dof_pos", "dof_vel", "reference", "anchor_ori"), 1.0)


def tracker_file(
    gain: float = 0.0, others: float = 0.0, reverse: bool = False, inputs: tuple[str, ...] = ("obs", "time_step")
) -> Path:
    """An ONNX file of a G1 that holds the squat. Its actions are `gain` times the reference's angles, and `others` times the
    last actions, the angles and the velocities of the robot.
    """
    robot = load_robot("g1")
    with np.load(data_folder("resources") / "motions" / "g1" / "squat.npz") as file:
        rows = file["joint_pos"]
    order = np.arange(29)[::-1] if reverse else np.arange(29)
    tables = {"joint_pos": rows[:, 7:][:, order], "body_pos_w": rows[:, None, :3], "body_quat_w": rows[:, None, 3:7]}
    nodes = [helper.make_node("Cast", [inputs[1]], ["float_step"], to=TensorProto.INT64)]
    nodes += [helper.make_node("Squeeze", ["float_step"], ["step"])]
    nodes += [helper.make_node("Gather", [f"{name}_table", "step"], [name]) for name in tables]
    weights = np.zeros((154, 29), dtype=np.float32)
    weights[90:119] = gain * np.eye(29)  # after 29 actions, 3 angular velocities, 29 angles and 29 velocities
    for start in (0, 32, 61):
        weights[start : start + 29] = others * np.eye(29)
    nodes += [helper.make_node("MatMul", ["obs", "weights"], ["actions"])]
    constants = [numpy_helper.from_array(values.astype(np.float32), f"{name}_table") for name, values in tables.items()]
    constants += [numpy_helper.from_array(weights, "weights")]
    shapes = zip(inputs, ([1, 154], [1, 1]), strict=True)
    given = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes]
    found = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in ("actions", *tables)]
    graph = helper.make_graph(nodes, "tracker", given, found, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)])
    model.ir_version = 8
    names = [robot.joint_names[i] for i in order]
    gains = {"kp": robot.stiffness[order].tolist(), "kd": robot.damping[order].tolist()}
    said = {"dof_names": names, "body_names": ["pelvis"], **gains}
    helper.set_model_props(model, {key: json.dumps(value) for key, value in said.items()})
    onnx.save(model, "tracker.onnx")
    return Path("tracker.onnx")


def layout(**changes) -> Layout:
    return Layout(**{"task": "g1_tracking", "observation": TERMS, "action_scale": 1.0, **changes})


def test_the_robot_holds_the_pose_of_the_network_until_it_fails():
    """Actions 0: the default pose, with which a squat fails after about a second, and never reaches its end."""
    result = Tracker(tracker_file(), layout(), 2).measure()
    assert not result["whole"]["success"]
    assert result["seconds"] == pytest.approx(5.5)
    assert 0.5 < result["whole"]["lasted_s"] < 4.0
    assert result["successes"] == 0
    assert 0.0 < result["joint_error"] < 1.0


def test_the_network_sees_the_reference_of_the_step_and_moves_the_joints():
    """Actions that are the reference's angles: those of the frame to reach in this step."""
    tracker = Tracker(tracker_file(gain=1.0), layout(), 2)
    task, targets = tracker.task, []
    step = task.step

    def steps(actions):
        targets.append((actions.clone(), task.motion.now.joint_pos.clone()))
        return step(actions)

    task.step = steps
    tracker.measure()
    for actions, reference in targets:
        torch.testing.assert_close(actions, reference, atol=1e-5, rtol=0.0)
    for robot in (0, 1):  # each sees its own frame
        assert len({float(reference[robot, 3]) for _, reference in targets}) > 20  # the knee moves


def test_joints_may_have_another_order():
    """The same network with its joints in reverse: the robot does the same."""
    found = []
    for reverse in (False, True):
        task = (tracker := Tracker(tracker_file(0.2, 0.01, reverse=reverse), layout(), 1)).task
        observations, states = task.start_at(torch.zeros_like(task.motion.frame)), []
        for _ in range(25):
            observations, *_ = task.step(tracker._act(observations))
            states.append(task.dof_pos.clone())
        found.append(torch.cat(states))
    torch.testing.assert_close(*found, atol=1e-4, rtol=1e-3)


def test_the_command_prints_and_writes_what_it_found(capsys, monkeypatch):
    monkeypatch.setattr("legged.cli.evaluate.EPISODES", 4)
    tracker_file()
    Path("mine.yaml").write_text(f"task: g1_tracking\nobservation: {json.dumps(TERMS)}\naction_scale: 1.0\n")
    assert main(["evaluate", "onnx", "tracker.onnx", "--layout", "mine.yaml", "--out", "out"]) == 0
    assert "falls at" in (printed := capsys.readouterr().out)
    assert "4 episodes of 10 s" in printed
    (row,) = json.loads(Path("out/onnx.json").read_text())["trackers"]
    assert row["file"] == "tracker.onnx"
    assert row["episodes"] == 4
    assert not row["whole"]["success"]


@pytest.mark.parametrize(
    ("inputs", "changes", "message"),
    [
        (("obs", "time_step"), {"observation": {"actions": 1.0}}, "takes 154 numbers, but the layout's observation has 29"),
        (("obs", "time_step"), {"task": "g1_flat"}, "layout: task: 'g1_flat' tracks no motions"),
        (("obs", "clock"), {}, "a tracker has the inputs obs and time_step, this file has obs, clock"),
    ],
)
def test_a_file_that_does_not_fit_is_named(inputs, changes, message):
    with pytest.raises(ConfigError, match=message):
        Tracker(tracker_file(inputs=inputs), layout(**changes), 1)


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("observation: {reference: 1.0}", [], "reference: only trackers observe it, and their layout names a task"),
        ("task: g1_tracking\nobservation: {command_xy: 1.0}", [], "command_xy: trackers do not observe it"),
        (
            "task: g1_tracking\nobservation: {actions: 1.0}\ncontrol_dt: 0.01",
            [],
            "control_dt: has no effect in a layout with a task",
        ),
        ("task: g1_tracking\nobservation: {actions: 1.0}", ["--robot", "g1"], "--robot: has no effect on a tracker"),
    ],
)
def test_a_layout_or_an_option_that_does_not_fit_is_named(capsys, text, options, message):
    tracker_file()
    Path("mine.yaml").write_text(text)
    assert main(["evaluate", "onnx", "tracker.onnx", "--layout", "mine.yaml", *options]) == 2
    assert message in capsys.readouterr().err


def test_a_tracker_observes_the_velocity_at_its_imu():
    """Half a metre ahead of the base, a turn of 2 rad/s to the left adds 1 m/s to the left."""
    tracker = Tracker(tracker_file(), layout(velocity_point=(0.5, 0.0, 0.0)), 1)
    tracker.task.base_lin_vel.copy_(torch.tensor([[1.0, 0.0, 0.0]]))
    tracker.task.base_ang_vel.copy_(torch.tensor([[0.0, 0.0, 2.0]]))
    tracker._terms = {"base_lin_vel": 1.0}
    assert tracker._observe().tolist() == [pytest.approx([1.0, 1.0, 0.0])]


def test_layouts_of_the_package_name_trackers():
    for name in ("holosoma_tracker", "holosoma_tracker_fastsac", "mjlab_tracker"):
        assert read_layout(name, "--layout").task == "g1_tracking"
