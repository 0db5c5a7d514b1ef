"""Policies that others trained: observations by a layout, joints by name, and what they do in C MuJoCo."""

import json
import math

import numpy as np
import onnx
import pytest
from helpers import call
from onnx import TensorProto, helper, numpy_helper

from legged.cli.evaluate import onnx as command
from legged.errors import ConfigError
from legged.evaluation.playback import play
from legged.policies.foreign import ForeignPolicy, Layout, read_layout
from legged.robots.robot import load_robot

WIDTH = 12 + 3 + 1 + 2 + 2 + 12 + 12 + 3 + 2  # of holosoma's layout for twelve joints


@pytest.fixture
def policy_file(tmp_path):
    """policy_file(matrix, bias, metadata): an ONNX file that gives observation @ matrix + bias."""

    def write(matrix, bias, **metadata):
        width, count = matrix.shape
        tensors = [numpy_helper.from_array(value.astype(np.float32), name) for name, value in (("w", matrix), ("b", bias))]
        graph = helper.make_graph(
            [helper.make_node("Gemm", ["obs", "w", "b"], ["action"])],
            "policy",
            [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, width])],
            [helper.make_tensor_value_info("action", TensorProto.FLOAT, [1, count])],
            tensors,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
        helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
        path = tmp_path / "policy.onnx"
        onnx.save(model, path)
        return path

    return write


def test_columns_orders_and_scales_by_hand(policy_file):
    """The policy's joints are the robot's backwards; it gives back twice the columns of the joint velocities."""
    robot, layout = load_robot("anymal_c"), read_layout("holosoma", "--layout")
    matrix = np.zeros((WIDTH, 12))
    start = 12 + 3 + 1 + 2 + 2 + 12
    matrix[start : start + 12] = 2.0 * np.eye(12)
    backwards = list(robot.joint_names[::-1])
    gains = [float(i) for i in range(12)]
    policy = ForeignPolicy(policy_file(matrix, np.zeros(12), dof_names=backwards, kp=gains, kd=gains), layout, robot)
    assert policy.stiffness.tolist() == gains[::-1]
    rates, nothing = np.arange(12.0), np.zeros(3)
    targets = policy.act(np.array([0.5, 0.0, 0.0]), nothing, nothing, nothing, robot.default_dof_pos, rates)
    # dof_vel is scaled by 0.05, doubled by the policy, scaled by 0.25, and belongs to the joint of that name.
    np.testing.assert_allclose(targets, robot.default_dof_pos + 0.25 * 2.0 * 0.05 * rates, atol=1e-6)


def test_gains_that_nobody_states_are_the_robots_which_a_rule_may_choose(policy_file, tmp_path):
    stated = load_robot("anymal_c")
    (tmp_path / "dog").mkdir()
    (tmp_path / "dog" / stated.file.model).write_text(stated.model_path.read_text())
    lines = (stated.folder / "robot.yaml").read_text().splitlines()
    own = "\n".join(line for line in lines if not line.startswith(("stiffness", "damping")))
    (tmp_path / "dog" / "robot.yaml").write_text(own)
    by_rule = load_robot(str(tmp_path / "dog"))
    assert not by_rule.file.stiffness
    for robot in (stated, by_rule):
        path = policy_file(np.zeros((WIDTH, 12)), np.zeros(12))
        policy = ForeignPolicy(path, read_layout("holosoma", "--layout"), robot)
        np.testing.assert_array_equal(policy.stiffness, robot.stiffness)
        np.testing.assert_array_equal(policy.damping, robot.damping)
    assert by_rule.stiffness.min() > 0.0


def test_every_term_is_where_the_layout_has_it(policy_file):
    robot = load_robot("anymal_c")
    layout = Layout(
        observation={
            "phase_sin": 2.0,
            "command_yaw": 3.0,
            "projected_gravity": 1.0,
            "actions": 1.0,
            "command_xy": 1.0,
            "base_lin_vel": 0.5,
            "phase_cos": 1.0,
            "base_ang_vel": 1.0,
        },
        phase_offsets=(0.3, 0.9),
        phase_period_s=0.5,
    )
    policy = ForeignPolicy(policy_file(np.zeros((28, 12)), np.arange(12.0)), layout, robot)
    command, lin, ang, down = (
        np.array([1.0, 2.0, 3.0]),
        np.array([4.0, 5.0, 6.0]),
        np.array([7.0, 8, 9]),
        np.array([0, 0, -1.0]),
    )
    state = (command, lin, ang, down, robot.default_dof_pos, np.zeros(12))
    seen = policy._observe(*state)
    sines, cosines = [2 * math.sin(0.3), 2 * math.sin(0.9)], [math.cos(0.3), math.cos(0.9)]
    expected = [*sines, 9, 0, 0, -1, *[0] * 12, 1, 2, 2, 2.5, 3, *cosines, 7, 8, 9]
    np.testing.assert_allclose(seen, expected, atol=1e-12)
    policy.act(*state)
    later = 2.0 * math.pi * 0.02 / 0.5  # a control step of a turn of half a second
    expected = [2 * math.sin(0.3 + later), 2 * math.sin(0.9 + later)]
    np.testing.assert_allclose(policy._observe(*state)[:2], expected, atol=1e-12)
    np.testing.assert_allclose(policy._observe(*state)[6:18], np.arange(12.0))
    policy.reset()
    np.testing.assert_allclose(policy._observe(*state), seen)


def test_a_policy_that_does_nothing_stands_or_topples(policy_file):
    """ANYmal C stays where it is; G1, which does not stand by itself, falls, and has no velocity then."""
    layout = Layout(observation={"dof_pos": 1.0})
    robot = load_robot("anymal_c")
    policy = ForeignPolicy(policy_file(np.zeros((12, 12)), np.zeros(12)), layout, robot)
    (played,) = play(robot, policy, [(0.5, 0.0, 0.0)], 3.0, 0.8)
    assert played["fell_after"] is None
    assert max(map(abs, played["velocity"])) < 0.02
    assert 0.48 < played["lowest_base"] < 0.55
    robot = load_robot("g1")
    policy = ForeignPolicy(policy_file(np.zeros((29, 29)), np.zeros(29)), layout, robot)
    (played,) = play(robot, policy, [(0.5, 0.0, 0.0)], 8.0, 0.8)
    assert 1.0 < played["fell_after"] < 2.5
    assert played["velocity"] is None


def test_the_command(policy_file, capsys):
    path = policy_file(np.zeros((WIDTH, 12)), np.zeros(12))
    arguments = [str(path), "--robot", "anymal_c", "--layout", "holosoma", "--seconds", "2.5", "--command", "0.5,0,0"]
    assert call(command.main, arguments) == 0
    text = capsys.readouterr().out
    assert "0.50   0.00   0.00" in text
    assert "1.00   0.00   0.00" not in text


HERE = ["{policy}", "--robot", "anymal_c"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["p", "--layout", "holosoma"], "POLICY: there is no ONNX file 'p'"),
        (
            ["{policy}", "--robot", "anymal_cc", "--layout", "holosoma"],
            "--robot: there is no robot 'anymal_cc'; did you mean 'anymal_c'?",
        ),
        (["{policy}", "--layout", "holosoma"], "--robot: is missing; name a robot, because the layout 'holosoma' names none"),
        (["{policy}", "--robot", "anymal_c"], "there is no policy.json next to it"),
        (["{policy}", "--robot", "g1", "--layout", "holosoma"], "takes 49 numbers, but the layout's observation has 100"),
        ([*HERE, "--layout", "holosomo"], "--layout: there is no layout 'holosomo'"),
        ([*HERE, "--layout", "{other}"], "observation: there is no term 'base_linvel'; did you mean"),
        (["{broken}", "--robot", "anymal_c", "--layout", "holosoma"], "onnxruntime cannot read it"),
        ([*HERE, "--layout", "holosoma", "--seconds", "1"], "--seconds: must be above 2"),
        ([*HERE, "--layout", "holosoma", "--friction", "-1"], "--friction: must be from 0 to 10"),
        ([*HERE, "--layout", "holosoma", "--command", "nan,0,0"], "--command: expected three numbers"),
        ([*HERE, "--layout", "holosoma", "--command", "0.5,0"], "got '0.5,0'"),
    ],
)
def test_wrong_input_ends_with_one_line(policy_file, tmp_path, capsys, arguments, message):
    other = tmp_path / "layout.yaml"
    other.write_text("observation: {base_linvel: 1.0}\n")
    broken = tmp_path / "broken.onnx"
    broken.write_text("not a network")
    path = policy_file(np.zeros((WIDTH, 12)), np.zeros(12))
    assert call(command.main, [text.format(policy=path, other=other, broken=broken) for text in arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ")
    assert message in error
    assert "\n" not in error


def test_metadata_that_does_not_fit_the_robot(policy_file):
    robot, layout = load_robot("anymal_c"), read_layout("holosoma", "--layout")
    matrix, bias = np.zeros((WIDTH, 12)), np.zeros(12)
    for metadata, message in (
        ({"dof_names": ["LF_HAA", "knee"]}, "robot 'anymal_c' has no joint 'knee'"),
        ({"dof_names": ["LF_HAA", "LF_HFE"]}, "names 2 joints, but 'anymal_c' has 12"),
        ({"kp": [1.0, 2.0]}, "metadata kp/stiffness/joint_stiffness: expected 12 numbers"),
        ({"kd": 3}, "metadata kd: expected a list"),
    ):
        with pytest.raises(ConfigError, match=message):
            ForeignPolicy(policy_file(matrix, bias, **metadata), layout, robot)


def network(nodes, tensors) -> bytes:
    """An ONNX file: obs (1, WIDTH) -> actions (1, 12)."""
    numbers = [numpy_helper.from_array(value, name) for name, value in tensors.items()]
    obs, actions = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, size]) for name, size in (("obs", WIDTH), ("actions", 12))
    )
    graph = helper.make_graph(nodes, "policy", [obs], [actions], numbers)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()


def endless() -> bytes:
    """A network with a loop of 10^12 rounds."""
    state = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, WIDTH]) for name in ("s", "s2")]
    flags = [helper.make_tensor_value_info(name, TensorProto.BOOL, []) for name in ("c", "c2")]
    nodes = [helper.make_node("Identity", ["c"], ["c2"]), helper.make_node("Add", ["s", "s"], ["s2"])]
    count = helper.make_tensor_value_info("i", TensorProto.INT64, [])
    body = helper.make_graph(nodes, "body", [count, flags[0], state[0]], [flags[1], state[1]])
    tensors = {"n": np.array(10**12), "on": np.array(True), "w": np.zeros((WIDTH, 12), np.float32)}
    loop = helper.make_node("Loop", ["n", "on", "obs"], ["looped"], body=body)
    return network([loop, helper.make_node("MatMul", ["looped", "w"], ["actions"])], tensors)


def huge() -> bytes:
    """A network that computes with 2 GiB."""
    tensors = {"shape": np.array([2**16, 2**13]), "w": np.zeros((WIDTH, 12), np.float32)}
    nodes = [
        helper.make_node("ReduceMax", ["obs"], ["one"], keepdims=1),
        helper.make_node("Expand", ["one", "shape"], ["much"]),
        helper.make_node("ReduceMax", ["much"], ["again"], keepdims=1),
        helper.make_node("MatMul", ["obs", "w"], ["product"]),
        helper.make_node("Add", ["product", "again"], ["actions"]),
    ]
    return network(nodes, tensors)


@pytest.mark.parametrize(("content", "words"), [(endless, "longer than 0.05 s"), (huge, "[Mm]emory")])
def test_a_network_that_takes_all_time_or_memory_is_refused(content, words, tmp_path, monkeypatch):
    monkeypatch.setattr("legged.deploy.policy.WARM_UP_S", 0.05 if content is endless else 600.0)
    path = tmp_path / "policy.onnx"
    path.write_bytes(content())
    with pytest.raises(ConfigError, match=rf"policy\.onnx: 20 trial runs of the network failed .* 1 GiB\): .*{words}"):
        ForeignPolicy(path, read_layout("holosoma", "--layout"), load_robot("anymal_c"))
