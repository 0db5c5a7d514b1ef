"""Contracts of mjlab and Unitree: what the robot's program makes of them, by hand, and which ones it refuses."""

import sys
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
import yaml
from helpers import CALM, ENGINE
from onnx import TensorProto, helper, numpy_helper
from still_robot import BLIND, SMALL, WALKS, Stage

from legged.deploy.interface import Reading, RobotFacts
from legged.deploy.policy import Policy
from legged.deploy.unitree import KINDS
from legged.errors import ConfigError
from legged.learning.runner import Runner
from legged.policies.formats import export_as
from legged.registry import make_task, task_config

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
GO2 = KINDS["go2"].facts
# Hips first, then thighs, then calves, as Isaac Lab sorts them. Motors: FR 0 to 2, FL 3 to 5, RR 6 to 8, RL 9 to 11.
PLACES = [3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8]
NAMES = [f"{leg}_{part}_joint" for part in ("hip", "thigh", "calf") for leg in ("FL", "FR", "RL", "RR")]
POSE = [0.1, -0.1, 0.1, -0.1, 0.8, 0.8, 1.0, 1.0, -1.5, -1.5, -1.6, -1.6]
UNITREE = """
joint_ids_map: [3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8]
step_dt: 0.02
stiffness: [20.0, 21.0, 22.0, 23.0, 24.0, 25.0, 26.0, 27.0, 28.0, 29.0, 30.0, 31.0]
damping: [1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1.8, 1.9, 2.0, 2.1]
default_joint_pos: [0.1, -0.1, 0.1, -0.1, 0.8, 0.8, 1.0, 1.0, -1.5, -1.5, -1.6, -1.6]
commands:
  base_velocity:
    ranges:
      lin_vel_x: [-0.5, 1.0]
      lin_vel_y: [-0.3, 0.3]
      ang_vel_z: [-1, 1]
      heading: null
actions:
  JointPositionAction:
    clip: null
    joint_names:
    - .*
    scale: [0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.5]
    offset: [0.1, -0.1, 0.1, -0.1, 0.8, 0.8, 1.0, 1.0, -1.5, -1.5, -1.6, -1.6]
    joint_ids: null
observations:
  velocity_commands:
    params: {command_name: base_velocity}
    clip: null
    scale: [2.0, 2.0, 0.25]
    history_length: 2
  joint_pos_rel:
    params: {}
    clip: null
    scale: null
    history_length: 2
"""


def network(path, weights, metadata=None):
    """An ONNX file of the network actions = weights @ observation, for one robot, with other names than ours."""
    rows, columns = np.shape(weights)
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["input", "weights"], ["output"])],
        "linear",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, [1, columns])],
        [helper.make_tensor_value_info("output", TensorProto.FLOAT, [1, rows])],
        [numpy_helper.from_array(np.asarray(weights, dtype=np.float32).T.copy(), "weights")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    helper.set_model_props(model, metadata or {})
    onnx.save(model, path)


def reading(positions, velocities=None):
    still = np.zeros(len(positions))
    return Reading(0.0, 0.0, UPRIGHT, np.zeros(3), np.array(positions), still if velocities is None else velocities)


def unitree_policy(folder, by_frame=False, **changes):
    """Action i is 10 times the older, plus the newer angle of joint i from its default; action 0 has 100 times vx besides."""
    said = yaml.safe_load(UNITREE)
    for key, value in changes.items():
        said = {**said, key: value}
    text = yaml.safe_dump(said, sort_keys=False) if changes or by_frame else UNITREE
    if by_frame:
        text = yaml.safe_dump({**said, "observations": {**said["observations"], "use_gym_history": True}}, sort_keys=False)
    (folder / "deploy.yaml").write_text(text)
    weights = np.zeros((12, 30))
    old, new, vx = (3, 18, 15) if by_frame else (6, 18, 3)
    weights[:, old : old + 12] += 10.0 * np.eye(12)
    weights[:, new : new + 12] += np.eye(12)
    weights[0, vx] = 100.0
    network(folder / "policy.onnx", weights)
    return Policy(folder)


@pytest.mark.parametrize("by_frame", [False, True], ids=["by term", "by frame"])
def test_deploy_yaml_of_another_joint_order_by_hand(by_frame, tmp_path):
    policy = unitree_policy(tmp_path, by_frame)
    policy.fit(GO2)
    contract = policy.contract
    assert contract.joint_names == GO2.joint_names
    by_name = dict(zip(contract.joint_names, zip(contract.stiffness, contract.damping, strict=True), strict=True))
    assert by_name["FR_hip_joint"] == (20.0, 1.0)
    assert by_name["FL_hip_joint"] == (23.0, 1.3)
    assert by_name["RL_calf_joint"] == (31.0, 2.1)
    np.testing.assert_array_equal(contract.torque_limits, GO2.torque_limits)
    np.testing.assert_array_equal(contract.position_limits, GO2.position_limits)
    np.testing.assert_array_equal(contract.command_ranges, [[-0.5, 1.0], [-0.3, 0.3], [-1.0, 1.0]])
    assert (contract.control_dt, contract.imu_body, contract.robot) == (0.02, "base", "go2")

    pose = dict(zip(NAMES, POSE, strict=True))
    first = {name: pose[name] + 0.001 * i for i, name in enumerate(NAMES)}
    second = {name: pose[name] + 0.002 * i for i, name in enumerate(NAMES)}
    for angles, share in ((first, 11 * 0.001), (second, 10 * 0.001 + 0.002)):
        targets = policy.act(reading([angles[name] for name in GO2.joint_names]), np.array([0.3, 0.0, 0.0]))
        found = dict(zip(GO2.joint_names, targets, strict=True))
        for i, name in enumerate(NAMES):
            action = share * i + (100.0 * 2.0 * 0.3 if i == 0 else 0.0)
            assert found[name] == pytest.approx(pose[name] + (0.5 if i == 11 else 0.25) * action, abs=1e-6), name


def test_deploy_yaml_may_lie_where_unitrees_programs_have_it(tmp_path):
    unitree_policy(tmp_path)
    for folder, name in (("exported", "policy.onnx"), ("params", "deploy.yaml")):
        (tmp_path / folder).mkdir()
        (tmp_path / name).rename(tmp_path / folder / name)
    assert Policy(tmp_path / "exported").contract.width == 30


MJLAB = {
    "run_path": "none",
    "joint_names": "a_hip,a_knee",
    "joint_stiffness": "40.000,60.500",
    "joint_damping": "1.500,2.250",
    "default_joint_pos": "0.100,-0.800",
    "action_scale": "0.500,0.250",
    "command_names": "twist",
    "observation_names": "command,joint_vel,actions",
    "observation_terms_scale": "2.000;2.000;0.250,0.050,1.000",
    "observation_terms_clip": "-inf;inf,-inf;inf,-inf;inf",
    "observation_terms_history_length": "0.000,2.000,0.000",
    "observation_terms_flatten_history_dim": "1.000,1.000,1.000",
}
LEG = RobotFacts(
    "leg", ("a_knee", "a_hip"), np.array([[-2.0, 0.0], [-np.inf, np.inf]]), np.full(2, 20.0), np.full(2, 30.0), "b"
)


def mjlab_policy(folder, **changes):
    """Actions: yaw rate + older speed of the hip; newer speed of the knee + the hip's last action."""
    said = {key: value for key, value in {**MJLAB, **changes}.items() if value is not None}
    weights = np.zeros((2, 9))
    weights[0, [2, 3]] = weights[1, [6, 7]] = 1.0
    network(folder / "policy.onnx", weights, said)
    return Policy(folder)


def test_mjlabs_metadata_by_hand(tmp_path):
    policy = mjlab_policy(tmp_path)
    policy.fit(LEG)
    contract = policy.contract
    assert contract.joint_names == ("a_knee", "a_hip")
    assert contract.stiffness.tolist() == [60.5, 40.0]
    assert contract.damping.tolist() == [2.25, 1.5]
    assert contract.default.tolist() == [-0.8, 0.1]
    assert np.isinf(contract.position_limits[1]).all()
    assert contract.control_dt == 0.02
    assert contract.command_ranges.tolist() == [[-0.5, 0.5], [-0.3, 0.3], [-0.5, 0.5]]
    turn = np.array([0.0, 0.0, 0.8])
    targets = policy.act(reading([0.0, 0.0], np.array([4.0, 2.0])), turn)  # the knee's speed is 4 rad/s
    hip, knee = 0.25 * 0.8 + 0.05 * 2.0, 0.05 * 4.0
    np.testing.assert_allclose(targets, [-0.8 + 0.25 * knee, 0.1 + 0.5 * hip], atol=1e-6)
    targets = policy.act(reading([0.0, 0.0], np.array([-6.0, 8.0])), turn)
    hip, knee = 0.25 * 0.8 + 0.05 * 2.0, 0.05 * -6.0 + hip
    np.testing.assert_allclose(targets, [-0.8 + 0.25 * knee, 0.1 + 0.5 * hip], atol=1e-6)


def test_rate_and_ranges_in_the_metadata_count(tmp_path):
    contract = mjlab_policy(tmp_path, fps="100", command_ranges="-0.600;1.100,-0.400;0.400,-1.000;1.000").contract
    assert contract.control_dt == pytest.approx(0.01)
    assert contract.command_ranges.tolist() == [[-0.6, 1.1], [-0.4, 0.4], [-1.0, 1.0]]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (
            {"observation_names": "command,joint_vel,phase"},
            r"observation_names: 'phase' cannot be observed here \(allowed: act",
        ),
        ({"observation_names": "command,joint_vel,action"}, r"'action' cannot be observed here; did you mean 'actions'\?"),
        (
            {"observation_terms_clip": "-inf;inf,-5.000;5.000,-inf;inf"},
            r"'joint_vel': clip: this program clips only at 100 and beyond, .* got \[-5\.0",
        ),
        ({"observation_terms_flatten_history_dim": "1.000,0.000,1.000"}, r"flatten_history_dim: must be 1 for 'joint_vel'"),
        ({"anchor_body_name": "torso_link"}, r"anchor_body_name: the policy tracks motions"),
        ({"joint_damping": None}, r"is no ONNX file with mjlab's metadata \(KeyError: 'joint_damping'\)"),
        ({"joint_stiffness": "40.000,much"}, r"is no ONNX file with mjlab's metadata \(ValueError"),
        (
            {"joint_stiffness": "40.000"},
            r"is no ONNX file with mjlab's metadata \(ValueError: stiffness: 2 numbers are wanted",
        ),
        ({"joint_damping": "0.000,1.000"}, r"damping: must be above 0, because damping stops the robot, got 0 at 'a_hip'"),
        ({"observation_terms_scale": "1.000,1.000"}, r"is no ONNX file with mjlab's metadata \(ValueError"),
        ({"observation_terms_history_length": "0.000,3.000,0.000"}, r"has the inputs .*9.*but policy\.onnx says .*11"),
        (
            {"observation_names": None},
            r"POLICY: there is no .*policy\.json, no deploy\.yaml, and policy\.onnx has no metadata",
        ),
    ],
)
def test_metadata_that_cannot_be_run_are_refused(changes, says, tmp_path):
    with pytest.raises(ConfigError, match=says):
        mjlab_policy(tmp_path, **changes)


ACTION = yaml.safe_load(UNITREE)["actions"]["JointPositionAction"]
PLAIN = {"params": {}, "clip": None, "scale": None, "history_length": 1}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"stiffness": [20.0] * 27}, r"stiffness: has 27 motors, but this program knows robots of 12 \(go2\), 29 \(g1\)"),
        ({"joint_ids_map": [0] * 12}, r"joint_ids_map: must name each of 12 motors once, got \[0, 0"),
        ({"joint_ids_map": PLACES[:6]}, r"joint_ids_map: must name each of 12 motors once"),
        ({"actions": {"JointVelocityAction": {}}}, r"actions: must be JointPositionAction alone, got JointVelocityAction"),
        (
            {"actions": {"JointPositionAction": {**ACTION, "clip": [-1.0, 1.0]}}},
            r"JointPositionAction: clip: this program clips only",
        ),
        (
            {"actions": {"JointPositionAction": {**ACTION, "offset": [0.0] * 12}}},
            r"offset: must be default_joint_pos, 12 num",
        ),
        ({"observations": {"gait_phase": PLAIN}}, r"observations: 'gait_phase' cannot be observed here"),
        ({"observations": {"base_lin_vel": PLAIN}}, r"observations: 'base_lin_vel' cannot be observed here"),
        (
            {"observations": {"last_action": {**PLAIN, "clip": [-1, 1]}}},
            r"'last_action': clip: this program clips only at 100",
        ),
        (
            {
                "observations": {
                    "use_gym_history": True,
                    "last_action": PLAIN,
                    "joint_vel_rel": {**PLAIN, "history_length": 2},
                }
            },
            r"observations\.use_gym_history: needs one history_length, got several",
        ),
        ({"step_dt": 20}, r"control_dt: must be between 0\.001 and 1, got 20"),
        ({"commands": {}}, r"is no deploy\.yaml \(KeyError: 'base_velocity'\)"),
        ({"damping": "much"}, r"is no deploy\.yaml \(IndexError"),
    ],
)
def test_a_deploy_yaml_that_cannot_be_run_is_refused(changes, says, tmp_path):
    with pytest.raises(ConfigError, match=says):
        unitree_policy(tmp_path, **changes)


def test_limits_that_are_never_reached_are_no_obstacle(tmp_path):
    wide = {"actions": {"JointPositionAction": {**ACTION, "clip": [[-100.0, 100.0]] * 12}}}
    observed = {name: {**entry, "clip": [-100, 100]} for name, entry in yaml.safe_load(UNITREE)["observations"].items()}
    assert unitree_policy(tmp_path, **wide, observations=observed).contract.width == 30


@pytest.mark.parametrize("text", ["", "[]", "a: [", "[" * 2000, "\x00"])
def test_a_file_that_is_no_deploy_yaml_is_refused(text, tmp_path):
    unitree_policy(tmp_path)
    (tmp_path / "deploy.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"deploy\.yaml: is no deploy\.yaml \("):
        Policy(tmp_path)


def test_without_pyyaml_the_program_says_what_it_needs(tmp_path, monkeypatch):
    unitree_policy(tmp_path)
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(ConfigError, match=r"deploy\.yaml: to read it, install PyYAML"):
        Policy(tmp_path)


def test_a_robot_with_other_joints_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"joint_names: 'g1' has no joint 'FL_hip_joint'"):
        unitree_policy(tmp_path).fit(KINDS["g1"].facts)


def test_a_default_pose_outside_the_robots_limits_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"default_joint_angles: must be within position_limits, got -0\.8 at 'a_knee'"):
        mjlab_policy(tmp_path).fit(replace(LEG, position_limits=np.array([[-0.5, 0.0]] * 2)))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "form"), [("anymal_c_flat", "mjlab"), ("go2_flat", "unitree")])
def test_the_program_does_with_an_export_what_the_policy_does(name, form, tmp_path):
    changes = [("env.num_envs", 1), ("init_state.yaw", [-3.0, 3.0]), ("train.algorithm.num_mini_batches", 1)]
    task = make_task(task_config(name, [*ENGINE, *CALM, *SMALL, *BLIND, *changes], on_cpu=True))
    runner = Runner(task)
    export_as(task, runner.alg.get_policy(), tmp_path, form)
    policy, act, robot = Policy(tmp_path), runner.get_inference_policy("cpu"), task.robot
    facts = RobotFacts(
        name, robot.joint_names, robot.dof_pos_limits, robot.dof_vel_limits, robot.torque_limits, robot.file.base
    )
    policy.fit(facts)
    command = torch.tensor([[0.5, 0.2, -0.3]])
    task.reset()
    observations = task.hold_commands(command)
    for _ in range(20):
        with torch.inference_mode():
            actions = act(observations)
        task.control.set_actions(actions)
        qpos, qvel = (tensor[0].double().numpy() for tensor in (task.physics._qpos, task.physics._qvel))
        targets = policy.act(Reading(0.0, 0.0, qpos[3:7], qvel[3:6], qpos[7:], qvel[6:]), command[0].double().numpy())
        np.testing.assert_allclose(targets, task.control._target[0], rtol=0.0, atol=1e-5)
        observations, _, dones, _ = task.step(actions)
        assert not dones.any()


def test_the_whole_program_runs_a_policy_of_unitree(tmp_path):
    unitree_policy(tmp_path, actions={"JointPositionAction": {**ACTION, "scale": 0.01}})
    by_name = dict(zip(NAMES, POSE, strict=True))
    pose = np.array([by_name[name] for name in GO2.joint_names])
    stage = Stage(tmp_path, GO2)
    stage.robot.positions = pose + 0.1
    program = stage.run(WALKS, seconds=4.0)
    assert not program.stops
    assert program.walked_s > 0.5
    np.testing.assert_allclose(stage.robot.positions, pose, rtol=0.0, atol=1e-3)
