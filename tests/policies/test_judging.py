"""One program that judges policies of all origins: a grid of commands, several checkpoints, and our own exports."""

import json
import math
import re

import numpy as np
import onnx
import pytest
import torch
from helpers import call, small_task, tiny_run
from onnx import TensorProto, helper, numpy_helper

from legged.cli.evaluate import evaluate
from legged.cli.evaluate import onnx as evaluate_onnx
from legged.cli.export import export
from legged.errors import ConfigError
from legged.evaluation.playback import Stage, follow
from legged.evaluation.velocity_grid import Grid
from legged.policies.description import describe
from legged.policies.foreign import ForeignPolicy, Layout, read_layout
from legged.robots.robot import load_robot


def write_policy(path, matrix, bias, **metadata):
    """Write an ONNX file that gives observation @ matrix + bias."""
    tensors = [
        numpy_helper.from_array(np.asarray(value, dtype=np.float32), name) for name, value in (("w", matrix), ("b", bias))
    ]
    graph = helper.make_graph(
        [helper.make_node("Gemm", ["obs", "w", "b"], ["action"])],
        "policy",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, len(matrix)])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, [1, len(bias)])],
        tensors,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, {key: str(value) for key, value in metadata.items()})
    onnx.save(model, path)
    return path


@pytest.fixture
def standing(tmp_path):
    """A policy that keeps the default pose of ANYmal C, whatever it is asked for."""
    return write_policy(tmp_path / "standing.onnx", np.zeros((12, 12)), np.zeros(12), wall_s=20.5, iterations=50)


STILL = Layout(observation={"dof_pos": 1.0})


def test_a_robot_that_stands_is_off_by_the_command(standing):
    """Its velocity is 0, so the error is the command: means and worst cells by hand."""
    robot = load_robot("anymal_c")
    grid = Grid(vx=[0.0, 0.6], vy=[0.0, 0.8], yaw=[0.5], robots=1, hold_s=1.5)
    figures = follow(robot, ForeignPolicy(standing, STILL, robot), grid, 1.0)
    assert figures["falls"] == 0.0
    assert figures["rmse_lin"]["mean"] == pytest.approx((0.0 + 0.8 + 0.6 + 1.0) / 4, abs=0.01)
    assert figures["rmse_lin"]["worst"] == pytest.approx(1.0, abs=0.01)
    assert figures["rmse_lin"]["worst_cell"] == [0.6, 0.8, 0.5]
    assert figures["rmse_ang"]["mean"] == pytest.approx(0.5, abs=0.01)
    assert [cell["fell"] for cell in figures["cells"]] == [False] * 4


def test_a_fall_before_the_measurement_has_no_error(tmp_path):
    robot = load_robot("anymal_c")
    over = Layout(observation={"dof_pos": 1.0}, default_joint_angles={"LF": 0.0, "LH": 0.0, "RF": 1.5, "RH": 1.5})
    policy = ForeignPolicy(write_policy(tmp_path / "p.onnx", np.zeros((12, 12)), np.zeros(12)), over, robot)
    stage = Stage(robot, policy, 1.0)
    stage._start[3:7] = math.cos(0.6), math.sin(0.6), 0.0, 0.0  # a roll of 1.2 rad
    moments = list(stage.walk(np.zeros(3), 2.0))
    assert moments[-1].fallen
    assert len(moments) < 10


def test_gains_of_position_actuators_stand_like_those_of_motors(standing):
    """In small steps, the same gains hold the same pose, in the integrator or outside of it; weak motors do so in neither."""
    robot = load_robot("anymal_c")
    heights = {}
    for servos in (False, True):
        for limits in ({}, dict.fromkeys(robot.joint_names, 1.0)):
            layout = Layout(observation={"dof_pos": 1.0}, implicit_gains=servos, torque_limits=limits, sim_dt=0.0005)
            stage = Stage(robot, ForeignPolicy(standing, layout, robot), 1.0)
            heights[servos, bool(limits)] = list(stage.walk(np.zeros(3), 0.5))[-1].height
    assert heights[True, False] == pytest.approx(heights[False, False], abs=2e-3)
    assert heights[False, True] < heights[False, False] - 0.1
    assert heights[True, True] < heights[True, False] - 0.1


def test_the_velocity_of_a_point_of_the_base(tmp_path):
    """v + w x r by hand: (1, 2, 3) + (0, 0, 2) x (0.5, 0, 0) = (1, 3, 3), clipped at 2."""
    robot = load_robot("anymal_c")
    layout = Layout(observation={"base_lin_vel": 1.0}, velocity_point=(0.5, 0.0, 0.0), observation_clip=2.5)
    policy = ForeignPolicy(write_policy(tmp_path / "p.onnx", np.zeros((3, 12)), np.zeros(12)), layout, robot)
    seen = policy._observe(
        np.zeros(3), np.array([1.0, 2, 3]), np.array([0, 0, 2.0]), np.zeros(3), policy.default, policy.default
    )
    np.testing.assert_allclose(seen, [1.0, 2.5, 2.5])


def test_joints_without_action_stay(tmp_path):
    robot = load_robot("anymal_c")
    acted = [robot.joint_names[5], robot.joint_names[2]]
    layout = Layout(observation={"actions": 1.0}, action_joints=tuple(acted), action_scale={acted[0]: 2.0, acted[1]: 3.0})
    policy = ForeignPolicy(write_policy(tmp_path / "p.onnx", np.zeros((2, 2)), [0.1, 0.2]), layout, robot)
    nothing = np.zeros(3)
    targets = policy.act(nothing, nothing, nothing, nothing, policy.default, policy.default) - policy.default
    expected = np.zeros(12)
    expected[5], expected[2] = 0.2, 0.6
    np.testing.assert_allclose(targets, expected, atol=1e-6)


@pytest.mark.slow
def test_our_own_checkpoints_are_judged_as_the_task_sees_them(tmp_path, monkeypatch, capsys):
    """A run's checkpoints, exported, act in playback as in their own task: observation and targets of the same state."""
    monkeypatch.chdir(tmp_path)
    folder = tiny_run("train.runner.save_interval=1")
    assert call(export.main, [f"anymal_c_flat/{folder.name}"]) == 0
    exported = sorted((folder / "exported").glob("*/policy.onnx"))
    assert [path.parent.name for path in exported] == ["00001", "00002"]
    description = json.loads((exported[0].parent / "policy.json").read_text())
    assert description["iterations"] == 1
    assert description["wall_s"] > 0.0
    robot = load_robot("anymal_c")
    layout = read_layout(str(exported[0].parent / "policy.json"), "--layout")
    task = small_task(("observations.add_noise", False), num_envs=1)
    policy = ForeignPolicy(exported[0], layout, robot)
    task.reset()
    torch.manual_seed(1)
    for _ in range(3):
        actions = torch.randn(1, 12)
        observation = task.step(actions)[0]["actor"][0].numpy()
    state = (task.commands, task.base_lin_vel, task.base_ang_vel, task.projected_gravity, task.dof_pos, task.dof_vel)
    command, *rest = (value[0].double().numpy() for value in state)
    policy._actions = actions[0].numpy()
    np.testing.assert_allclose(policy._observe(command[:3], *rest), observation, atol=1e-4)
    targets = policy.act(command[:3], *rest)
    np.testing.assert_allclose(targets, policy.default + task.control.action_scale * policy._actions, atol=1e-6)
    np.testing.assert_allclose(policy.stiffness, task.control.stiffness.numpy(), rtol=1e-6)
    out = tmp_path / "judged"
    arguments = list(map(str, reversed(exported)))
    axes = ["--vx=0:0.5:0.5", "--vy=0", "--yaw=0", "--seconds", "1.2", "--rmse", "50", "--out", str(out)]
    capsys.readouterr()
    assert call(evaluate_onnx.main, [*arguments, *axes]) == 0
    result = json.loads((out / "onnx.json").read_text())
    assert [row["iterations"] for row in result["policies"]] == [1.0, 2.0], "the earliest comes first"
    assert result["grid"] == {"vx": [0.0, 0.5], "vy": [0.0], "yaw": [0.0]}
    first = next((row for row in result["policies"] if row["falls"] == 0.0), None)
    assert (result["first"] or {}).get("file") == (first or {}).get("file")
    for name in (exported[0], exported[0].parent):  # `legged evaluate` does the same with a file and with its folder
        capsys.readouterr()
        assert call(evaluate.main, [str(name), "--out", str(tmp_path / "again")]) == 0
        assert "policy.onnx: velocities" in capsys.readouterr().out
        assert json.loads((tmp_path / "again" / "onnx.json").read_text())["robot"] == "anymal_c"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "warns"),
    [
        ([], False),
        ([("control.actuator.delay", [2, 4])], True),
        ([("control.actuator.armature", {"KFE": 0.1})], True),
    ],
)
def test_motors_that_are_not_simulated_are_told(changes, warns, tmp_path, capsys):
    """A layout knows ideal motors alone, so a policy that was trained with others is not judged as it was trained."""
    task = small_task(*changes, num_envs=1)
    description = describe(task)
    (tmp_path / "policy.json").write_text(json.dumps(description))
    metadata = {key: json.dumps(value) for key, value in description.items()}
    policy = write_policy(tmp_path / "policy.onnx", np.zeros((48, 12)), np.zeros(12), **metadata)
    command = ["--command", "0,0,0", "--seconds", "2.1"]
    assert call(evaluate_onnx.main, [str(policy), *command]) == 0
    said = capsys.readouterr().err
    assert ("policy.json: the policy was trained with other motors" in said) == warns


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "bias", "says"),
    [
        ({"stiffness": [900.0] * 12}, 0.0, r"policy\.json: stiffness: .*policy\.onnx has another value"),
        ({"damping": [0.0] * 12}, 0.0, "damping: must be above 0"),
        ({"control_dt": 0.0005}, 0.0, "control_dt: must be between 0.001 and 1, got 0.0005"),
        (
            {"joint_names": list(reversed(load_robot("anymal_c").joint_names))},
            0.0,
            r"policy\.json: joint_names: .*policy\.onnx has another value",
        ),
        ({}, math.nan, "policy.onnx: gives actions that are not finite"),
    ],
    ids=["gains", "damping", "control_dt", "joints", "NaN"],
)
def test_an_export_is_played_with_its_own_contract_alone(changes, bias, says, tmp_path, capsys):
    """These once changed what was measured without a word; a policy of NaN lay still."""
    description = describe(small_task(num_envs=1))
    (tmp_path / "policy.json").write_text(json.dumps({**description, **changes}))
    metadata = {key: json.dumps(value) for key, value in description.items()}
    policy = write_policy(tmp_path / "policy.onnx", np.zeros((48, 12)), np.full(12, bias), **metadata)
    assert call(evaluate_onnx.main, [str(policy), "--command", "0,0,0", "--seconds", "2.1"]) == 2
    assert re.search(says, capsys.readouterr().err)


def test_the_first_that_follows(standing, tmp_path, capsys):
    later = write_policy(tmp_path / "later.onnx", np.zeros((12, 12)), np.zeros(12), wall_s=40.0)
    layout = tmp_path / "layout.yaml"
    layout.write_text("observation: {dof_pos: 1.0}\n")
    arguments = [str(later), str(standing), "--robot", "anymal_c", "--layout", str(layout)]
    arguments += ["--vy=0", "--yaw=0", "--seconds", "1.1"]
    assert call(evaluate_onnx.main, [*arguments, "--vx=0.1", "--rmse", "0.2"]) == 0
    assert "standing.onnx after 20.5 s of training" in " ".join(capsys.readouterr().out.split())
    assert call(evaluate_onnx.main, [*arguments, "--vx=0.3", "--rmse", "0.2"]) == 0
    assert "without a fall: none" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rmse", "0.2"], "--rmse: has no effect without a grid"),
        (["--vx=0", "--rmse", "-1"], "--rmse: must be above 0"),
        (["--vx=0", "--command", "0,0,0"], "--command: cannot be combined with a grid"),
        (["--vx=1:0:0.5"], "--vx: '1:0:0.5' is not of the form"),
        (["--vx=0", "--seconds", "1"], "--seconds: must be above 1"),
        (["--vx=-1:1:0.01", "--vy=-1:1:0.01"], "commands; at most 10,000"),
        (["--out", "{file}"], "a_file: cannot make the folder"),
    ],
)
def test_wrong_grids_end_with_one_line(standing, tmp_path, capsys, arguments, message):
    layout = tmp_path / "layout.yaml"
    layout.write_text("observation: {dof_pos: 1.0}\n")
    (tmp_path / "a_file").write_text("mine")
    here = [str(standing), "--robot", "anymal_c", "--layout", str(layout)]
    assert call(evaluate_onnx.main, [*here, *(text.format(file=tmp_path / "a_file") for text in arguments)]) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ")
    assert message in error
    assert "\n" not in error


def test_policies_that_cannot_be_played(tmp_path):
    description = describe(small_task(num_envs=1))
    terms = description["observation"]
    uneven = [{**terms[0], "scale": [1.0, 2.0, 1.0]}, *terms[1:]]
    heights = {**terms[0], "name": "heights", "needs": "source heights", "points": [[0.0, 0.0]] * 3}
    memory = {"rnn_type": "lstm", "shape": [1, "batch", 8], "onnx_inputs": ["h_in", "c_in"]}
    (group,) = description["observation_groups"]
    for change, message in (
        ({"control_type": "V"}, "control_type: got 'V'"),
        ({"recurrent": memory}, "has a memory"),
        ({"observation_groups": [{**group, "history": 3}]}, "has a memory"),
        ({"observation": uneven}, "the columns of 'base_lin_vel' have different scales"),
        ({"observation": [heights, *terms[1:]]}, "there is no term 'heights'"),
        ({"damping": None}, "is no policy.json"),
    ):
        path = tmp_path / "policy.json"
        path.write_text(json.dumps(description | change))
        with pytest.raises(ConfigError, match=message):
            read_layout(str(path), "--layout")
    path.write_text("[")
    with pytest.raises(ConfigError, match=r"is no policy\.json"):
        read_layout(str(path), "--layout")
