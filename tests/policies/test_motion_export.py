"""Trackers: files with a policy and a motion give the policy's actions and the motion's frames, and are read back."""

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from helpers import TINY_TRAINING, call, run_folders

import legged.policies.export as export_module
from legged.cli import main as commands
from legged.deploy.__main__ import main as robot_program
from legged.envs.motion_tracking import ERRORS
from legged.evaluation.measurement import Overflows
from legged.evaluation.motions import ENDLESS_S, measure_motion, on_the_motion
from legged.learning.runner import Runner
from legged.motion.kinematics import Skeleton
from legged.motion.readers import read_clip
from legged.policies.export import ExportError, export
from legged.policies.motion_export import OUTPUTS
from legged.policies.restore import nominal, undisturbed
from legged.process.paths import data_folder
from legged.registry import make_task, task_config
from legged.robots.robot import load_robot

pytestmark = pytest.mark.usefixtures("workplace")
CLIPS = data_folder("resources") / "motions" / "g1"
EXACT = {
    "env.num_envs": 4,
    "sim.physics": "mujoco",
    "observations.add_noise": False,
    "domain_rand.randomize_friction": False,
    "domain_rand.ranges": {"joint_offset": [0.0, 0.0], **{f"com_{axis}:torso_link": [0.0, 0.0] for axis in "xyz"}},
    "domain_rand.kicks": {},
    **{f"motion.{name}_noise": [0.0] * 6 for name in ("pose", "velocity")},
    "motion.joint_noise": [0.0, 0.0],
    "train.runner.num_steps_per_env": 4,
    "train.policy.actor_hidden_dims": [16],
    "train.policy.critic_hidden_dims": [8],
    "train.algorithm.num_mini_batches": 1,
}


def trained(clips, iterations=2, **settings) -> Runner:
    """A policy after a moment of training, without anything random in its task but the frames in which episodes begin."""
    changes = {"motion.files": [str(CLIPS / f"{name}.npz") for name in clips], **EXACT, **settings}
    runner = Runner(make_task(task_config("g1_tracking", [*changes.items()], on_cpu=True)))
    for _ in range(iterations):
        runner.learn(1)
    return runner


@pytest.fixture(scope="module")
def runner() -> Runner:
    return trained(["squat", "kick"])


@pytest.fixture(scope="module")
def folder(runner, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trackers")
    found = export(runner.env, runner.alg.get_policy(), folder, run="logs/g1_tracking/mine")
    assert set(found) == {"policy.pt", "policy.onnx", "policy.weights", "policy_squat.onnx", "policy_kick.onnx"}
    return folder


def session_of(path: Path) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


@pytest.fixture
def few_episodes(monkeypatch) -> None:
    """Trackers are measured with four robots."""
    monkeypatch.setattr("legged.cli.evaluate.EPISODES", 4)


def measured(clip: str, act, **settings) -> dict[str, float]:
    """How well a policy tracks a clip, by the task's own observations."""
    cfg = task_config("g1_tracking", [("sim.physics", "mujoco"), *settings.items()], on_cpu=True)
    clips = ("motion.files", [str(CLIPS / f"{clip}.npz")])
    task = make_task(nominal(cfg, [*undisturbed(cfg, 4, ENDLESS_S), *on_the_motion(), clips]))
    return figures(measure_motion(task, act, Overflows()))


def figures(found: dict) -> dict[str, float]:
    return {"lasted_s": found["whole"]["lasted_s"], **{key: found[key] for key in ("successes", *ERRORS)}}


def frame_of(session: onnxruntime.InferenceSession, step: float) -> dict[str, np.ndarray]:
    """Outputs of a tracker for a frame."""
    width = session.get_inputs()[0].shape[1]
    given = {"obs": np.zeros((1, width), dtype=np.float32), "time_step": np.array([[step]], dtype=np.float32)}
    return dict(zip(OUTPUTS, session.run([*OUTPUTS], given), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("clip", ["squat", "kick"])
def test_the_policy_and_its_tracker_do_the_same(runner, folder, clip):
    """A hundred steps of an episode: the same actions, and the frame that the observation shows."""
    task, session = runner.env, session_of(folder / f"policy_{clip}.onnx")
    first = 0 if clip == "squat" else len(task.motion.clips["squat"].rows)
    observations, act = task.start_at(torch.full_like(task.motion.frame, first)), runner.get_inference_policy("cpu")
    sizes = set()
    for _ in range(100):
        with torch.inference_mode():
            actions = act(observations)
            now = task.motion.now
            step = (task.motion.frame[:1] - first).float().view(1, 1)
            given = {"obs": observations["actor"][:1].numpy(), "time_step": step.numpy()}
            found, *frame = session.run(None, given)
            np.testing.assert_allclose(found, actions[:1], atol=1e-5)
            for values, name in zip(frame, OUTPUTS.values(), strict=True):
                np.testing.assert_array_equal(values, getattr(now, name)[:1])
            np.testing.assert_array_equal(np.hstack(frame[:2]), observations["actor"][:1, :58])
            sizes.add(round(float(found.sum()), 3))
            observations, *_ = task.step(actions)
            if task.reset_buf[0]:
                observations = task.start_at(torch.full_like(task.motion.frame, first))
    assert len(sizes) > 10


@pytest.mark.slow
@pytest.mark.parametrize("clip", ["squat", "kick"])
def test_frames_are_those_of_the_clip_and_the_last_one_stays(folder, clip):
    skeleton = Skeleton(load_robot("g1"))
    bodies = task_config("g1_tracking").motion.bodies
    own, session = read_clip(CLIPS / f"{clip}.npz", skeleton), session_of(folder / f"policy_{clip}.onnx")
    motion, last = skeleton.body_motion(own, bodies), len(own) - 1
    tables = [own.joint_pos, own.velocities().joint, *motion]
    for step, frame in ((0, 0), (1, 1), (last // 2, last // 2), (last, last), (last + 1, last), (1e9, last), (-3, 0)):
        for (name, values), table in zip(frame_of(session, step).items(), tables, strict=True):
            assert values.shape == (1, *table.shape[1:])
            np.testing.assert_allclose(values[0], table[frame], atol=1e-5, err_msg=f"{name} at {step}")


@pytest.mark.slow
def test_shapes_and_metadata_are_those_of_the_task(runner, folder):
    model, task = onnx.load(folder / "policy_kick.onnx"), runner.env

    def shapes(values):
        return {value.name: [size.dim_value for size in value.type.tensor_type.shape.dim] for value in values}

    assert list(shapes(model.graph.input).items()) == [("obs", [1, 160]), ("time_step", [1, 1])]
    bodies = {f"body_{name}_w": [1, 14, 4 if name == "quat" else 3] for name in ("pos", "quat", "lin_vel", "ang_vel")}
    joints = {"actions": [1, 29], "joint_pos": [1, 29], "joint_vel": [1, 29]}
    assert list(shapes(model.graph.output).items()) == [*joints.items(), *bodies.items()]

    said = {entry.key: entry.value for entry in model.metadata_props}
    numbers = {
        key: np.array(said.pop(key).split(","), dtype=float) for key in list(said) if "joint" in key and "names" not in key
    }
    scale = np.array(said.pop("action_scale").split(","), dtype=float)
    np.testing.assert_allclose(numbers.pop("joint_stiffness"), task.robot.stiffness, rtol=1e-6)
    np.testing.assert_allclose(numbers.pop("joint_damping"), task.robot.damping, rtol=1e-6)
    np.testing.assert_allclose(numbers.pop("default_joint_pos"), task.robot.default_dof_pos, rtol=1e-6)
    assert not numbers
    by_joint = dict(zip(task.robot.joint_names, scale, strict=True))
    assert by_joint["left_knee_joint"] == 0.351
    assert by_joint["right_wrist_yaw_joint"] == 0.0745
    anchor = "motion_anchor_pos_b,motion_anchor_ori_b"
    assert said == {
        "run_path": "logs/g1_tracking/mine",
        "joint_names": ",".join(task.robot.joint_names),
        "command_names": "motion",
        "observation_names": f"command,{anchor},base_lin_vel,base_ang_vel,joint_pos,joint_vel,actions",
        "anchor_body_name": "torso_link",
        "body_names": ",".join(task.cfg.motion.bodies),
        "fps": "50",
    }
    motion = json.loads((folder / "policy.json").read_text())["motion"]
    assert motion["trackers"] == {"policy_squat.onnx": 276, "policy_kick.onnx": len(task.motion.clips["kick"].rows)}


@pytest.mark.slow
def test_the_motion_is_read_back(folder, capsys):
    skeleton = Skeleton(load_robot("g1"))
    own, found = (read_clip(path, skeleton) for path in (CLIPS / "squat.npz", folder / "policy_squat.onnx"))
    assert found.fps == own.fps
    for name in ("joint_pos", "root_pos", "root_quat"):
        np.testing.assert_allclose(getattr(found, name), getattr(own, name), atol=1e-5)
    assert commands.main(["motion", str(folder / "policy_squat.onnx"), "--no-film"]) == 0
    assert "written: logs/motion/policy_squat.npz" in capsys.readouterr().out


@pytest.mark.slow
def test_a_replay_does_what_the_policy_does(runner, folder, few_episodes):
    """Both trackers of the folder are replayed. Each gives the errors of the policy in a task with this motion alone."""
    assert commands.main(["evaluate", "onnx", str(folder), "--out", "."]) == 0
    rows = json.loads(Path("onnx.json").read_text())["trackers"]
    assert [Path(row["file"]).name for row in rows] == ["policy_squat.onnx", "policy_kick.onnx"]
    act = runner.get_inference_policy("cpu")
    for row, clip in zip(rows, ("squat", "kick"), strict=True):
        assert figures(row) == pytest.approx(measured(clip, act), rel=1e-3)
    assert commands.main(["evaluate", "onnx", str(folder / "policy_kick.onnx"), "--out", "."]) == 0
    assert json.loads(Path("onnx.json").read_text())["trackers"] == rows[1:]


@pytest.mark.slow
def test_a_replay_takes_rates_and_bodies_from_the_export(few_episodes):
    """At 100 Hz, with observations that are scaled and clipped, and other bodies, without the base."""
    bodies = ["torso_link", "left_ankle_roll_link", "right_ankle_roll_link"]
    own = {"control.decimation": 2, "observations.scales": {"dof_vel": 0.05}, "observations.clip": 1.0}
    own |= {"motion.bodies": bodies, "motion.extremities": bodies[1:]}
    runner = trained(["squat"], iterations=1, **own)
    export(runner.env, runner.alg.get_policy(), Path("exported"))
    clip = read_clip(Path("exported/policy_squat.onnx"), Skeleton(runner.env.robot))
    assert (clip.fps, len(clip)) == (100.0, len(runner.env.motion.clips["squat"].rows))
    np.testing.assert_allclose(clip.root_pos, runner.env.motion.clips["squat"].root_pos, atol=1e-5)
    assert commands.main(["evaluate", "exported", "--out", "."]) == 0
    (row,) = json.loads(Path("onnx.json").read_text())["trackers"]
    assert figures(row) == pytest.approx(measured("squat", runner.get_inference_policy("cpu"), **own), rel=1e-3)
    assert row["seconds"] == pytest.approx(5.5, abs=0.02)


@pytest.mark.slow
def test_a_tracker_with_memory_begins_like_its_policy():
    """Its hidden state is further inputs and outputs. The export itself compares actions and frames."""
    runner = trained(["squat"], 0, **{"train.policy.rnn_type": "gru", "train.policy.rnn_hidden_dim": 8})
    differences = export(runner.env, runner.alg.get_policy(), Path("exported"))
    assert differences["policy_squat.onnx"] < 1e-5
    session = session_of(Path("exported/policy_squat.onnx"))
    assert [entry.name for entry in session.get_inputs()] == ["obs", "time_step", "h_in"]
    assert [entry.name for entry in session.get_outputs()][:2] == ["actions", "h_out"]


@pytest.mark.slow
def test_a_tracker_with_other_frames_is_refused(runner, monkeypatch):
    write = export_module.with_motion

    def write_another(policy, frames, metadata):
        rows = frames.rows.clone()
        rows[-1, 3] += 0.01
        return write(policy, type(frames)(rows, 29, 14), metadata)

    monkeypatch.setattr(export_module, "with_motion", write_another)
    with pytest.raises(ExportError, match=r"policy_squat\.onnx: joint_pos differs from the motion"):
        export(runner.env, runner.alg.get_policy(), Path("exported"))
    assert not Path("exported").exists()


@pytest.mark.slow
def test_a_robot_refuses_a_tracker(folder, capsys):
    for name in (folder, folder / "policy.onnx", folder / "policy_kick.onnx"):
        assert call(robot_program, [str(name), "--robot", "udp:127.0.0.1:9"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(
            f"error: {folder / 'policy.json'}: task: 'g1_tracking' tracks motions; a robot runs policies that"
        )
    assert commands.main(["deploy", "sim", str(folder)]) == 2
    assert "'g1_tracking' tracks motions" in capsys.readouterr().err


@pytest.mark.slow
def test_checkpoints_are_exported_with_their_motions(capsys):
    """Two clips of one name get two files."""
    for name in ("a", "b"):
        Path(name).mkdir()
        Path(name, "clip.npz").write_bytes((CLIPS / "squat.npz").read_bytes())
    flags = ["train", "g1_tracking", "--max-iterations", "1", "--num-envs", "4", "--sim-device", "cpu"]
    files = "motion.files=[a/clip.npz, b/clip.npz]"
    assert commands.main([*flags, files, *TINY_TRAINING, "train.algorithm.num_mini_batches=1"]) == 0
    assert commands.main(["export", "g1_tracking"]) == 0
    (folder,) = run_folders()
    exported = folder / "exported" / "00001"
    assert sorted(path.name for path in exported.glob("*.onnx")) == ["policy.onnx", "policy_clip.onnx", "policy_clip_.onnx"]
    said = {entry.key: entry.value for entry in onnx.load(exported / "policy_clip.onnx").metadata_props}
    assert said["run_path"] == str(folder)
