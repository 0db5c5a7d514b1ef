"""Clips, their files, the motion of bodies, and checks: against formulas, against C MuJoCo, and by properties."""

from pathlib import Path

import mujoco
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from legged.cli.main import main
from legged.errors import ConfigError
from legged.motion.checks import quality_of
from legged.motion.clip import Clip, make_clip, write_clip
from legged.motion.kinematics import Skeleton
from legged.motion.readers import read_clip
from legged.robots.robot import Robot, load_robot

pytestmark = pytest.mark.usefixtures("workplace")
BODIES = ("torso_link", "left_ankle_roll_link", "right_wrist_yaw_link", "left_hip_roll_link")


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot("g1")


@pytest.fixture(scope="module")
def skeleton(robot) -> Skeleton:
    return Skeleton(robot)


def wave(robot: Robot, fps: float = 50.0, seconds: float = 2.0) -> Clip:
    """A G1 that glides along, turns and swings all joints."""
    t = np.arange(round(seconds * fps) + 1)[:, None] / fps
    phase = np.arange(29) / 29
    joint = robot.default_dof_pos + 0.2 * np.sin(2 * np.pi * (0.5 * t + phase))
    pos = np.hstack([0.3 * t, 0.1 * np.sin(np.pi * t), 0.75 + 0.02 * np.cos(2 * np.pi * t)])
    half = 0.25 * np.sin(0.5 * np.pi * t)
    quat = np.hstack([np.cos(half), 0 * half, 0 * half, np.sin(half)])
    return make_clip("wave", fps, pos, quat, joint, "wave")


# ---- motion ------------------------------------------------------------------------------------------------------------


def test_bodies_move_as_another_program_says(robot, skeleton):
    """The numbers were computed by hand-written kinematics in float64, on the same model; the wrist's within 0.1 mm."""
    motion = skeleton.body_motion(wave(robot), BODIES)
    found = {name: [values[25, i] for values in motion] for i, name in enumerate(BODIES)}
    wanted = {
        "torso_link": (
            (0.14610, 0.09928, 0.77400),
            (0.98564, -0.08478, -0.10696, 0.09946),
            (0.30017, -0.00090, 0.0),
            (-0.18522, -0.10196, 0.24423),
        ),
        "left_ankle_roll_link": (
            (-0.05360, 0.18462, 0.04996),
            (0.92628, 0.04107, 0.24504, 0.28333),
            (0.30681, -0.03305, -0.07006),
            (0.00020, -0.98411, 0.39458),
        ),
        "right_wrist_yaw_link": (
            (0.26909, -0.07954, 0.73353),
            (0.89074, -0.07627, 0.43886, 0.09037),
            (0.03944, 0.17948, -0.18127),
            (0.58631, 1.41495, 0.11828),
        ),
    }
    for name, parts in wanted.items():
        for value, correct, close in zip(found[name], parts, (1e-4, 1e-4, 3e-3, 4e-3), strict=True):
            np.testing.assert_allclose(value, correct, atol=close, err_msg=name)
    np.testing.assert_allclose(found["left_hip_roll_link"][0], (0.11287, 0.21043, 0.59703), atol=2e-5)
    np.testing.assert_allclose(found["left_hip_roll_link"][1], (0.97426, 0.10324, -0.03814, 0.19671), atol=2e-5)


def test_velocities_of_bodies_are_those_of_mujoco(robot, skeleton):
    """MuJoCo's own function gives the velocity of a body's origin in world axes."""
    clip = wave(robot)
    motion = skeleton.body_motion(clip, BODIES)
    for frame, data in enumerate(skeleton.frames(clip)):
        if frame % 20 == 7:
            for i, body in enumerate(skeleton.indices(BODIES, "test")):
                found = np.zeros(6)
                mujoco.mj_objectVelocity(skeleton.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, found, 0)
                np.testing.assert_allclose(motion.ang_vel[frame, i], found[:3], atol=1e-10)
                np.testing.assert_allclose(motion.lin_vel[frame, i], found[3:], atol=1e-10)


def test_resampling_interpolates(robot):
    """Frame 1 at 50 Hz lies 0.6 of the way from row 0 to row 1 at 30 Hz; 61 rows are 2 s, so 100 frames."""
    clip = wave(robot, fps=30.0)
    found = clip.resampled(50.0)
    assert (len(clip), len(found)) == (61, 100)
    knee = robot.joint_names.index("left_knee_joint")
    assert found.joint_pos[1, knee] == pytest.approx(0.799623, abs=1e-6)
    assert found.joint_pos[25, knee] == pytest.approx(0.828219, abs=1e-6)
    np.testing.assert_allclose(found.velocities().joint[[0, 25, 99], knee], (0.47940, -0.37955, 0.53054), atol=1e-5)
    np.testing.assert_allclose(found.velocities().root_ang[[0, 25, 99], 2], (0.78468, 0.55511, -0.78360), atol=1e-5)
    assert clip.resampled(30.0) is clip


def test_orientations_turn_the_short_way(robot):
    """q and -q are one orientation: a sign that flips between two frames is no turn."""
    clip = wave(robot)
    flipped = make_clip(
        "flipped", 50.0, clip.root_pos, clip.root_quat * (-1.0) ** np.arange(101)[:, None], clip.joint_pos, "x"
    )
    np.testing.assert_allclose(flipped.velocities().root_ang, clip.velocities().root_ang, atol=1e-12)
    halfway = [c.resampled(100.0).root_quat[1:-1:2] for c in (clip, flipped)]
    np.testing.assert_allclose(np.abs((halfway[0] * halfway[1]).sum(axis=1)), 1.0, atol=1e-12)


def test_the_root_follows_from_a_body(robot, skeleton):
    clip = wave(robot)
    motion = skeleton.body_motion(clip, ["torso_link"])
    pos, quat = skeleton.root_poses("torso_link", motion.pos[:, 0], motion.quat[:, 0], clip.joint_pos)
    np.testing.assert_allclose(pos, clip.root_pos, atol=1e-12)
    np.testing.assert_allclose(quat * np.sign(quat[:, :1]), clip.root_quat, atol=1e-12)


# ---- files -------------------------------------------------------------------------------------------------------------


def csv_file(robot: Robot, skeleton: Skeleton, clip: Clip) -> Path:
    rows = np.hstack([clip.root_pos, clip.root_quat[:, [1, 2, 3, 0]], clip.joint_pos])
    np.savetxt("clip.csv", rows, delimiter=",")
    return Path("clip.csv")


def own_file(robot: Robot, skeleton: Skeleton, clip: Clip) -> Path:
    write_clip(clip, robot, Path("clip.npz"))
    return Path("clip.npz")


def mjlab_file(robot: Robot, skeleton: Skeleton, clip: Clip) -> Path:
    """Arrays of all bodies without names; the first is the base."""
    motion = skeleton.body_motion(clip, skeleton.names[1:])
    arrays = {"body_pos_w": motion.pos, "body_quat_w": motion.quat, "joint_pos": clip.joint_pos, "fps": np.array([clip.fps])}
    np.savez("clip.npz", **arrays)
    return Path("clip.npz")


def holosoma_file(robot: Robot, skeleton: Skeleton, clip: Clip) -> Path:
    """Root and joints in one array, joints in another order, a world among the bodies."""
    order = np.random.default_rng(3).permutation(29)
    rows = np.hstack([clip.root_pos, clip.root_quat, clip.joint_pos[:, order]])
    names = np.array(robot.joint_names)[order]
    np.savez("clip.npz", joint_pos=rows, joint_names=names, body_names=np.array(["world", "pelvis"]), fps=clip.fps)
    return Path("clip.npz")


def tracker(arrays: dict[str, np.ndarray], **metadata: str) -> Path:
    """An ONNX file whose outputs are looked up by time step."""
    nodes = [helper.make_node("Cast", ["time_step"], ["step"], to=TensorProto.INT64)]
    nodes += [helper.make_node("Gather", [f"{name}_table", "step"], [name]) for name in arrays]
    tables = [numpy_helper.from_array(values.astype(np.float32), f"{name}_table") for name, values in arrays.items()]
    inputs = [helper.make_tensor_value_info("time_step", TensorProto.FLOAT, [1])]
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in arrays]
    model = helper.make_model(helper.make_graph(nodes, "tracker", inputs, outputs, tables))
    helper.set_model_props(model, metadata)
    onnx.save(model, "clip.onnx")
    return Path("clip.onnx")


def mjlab_tracker(robot: Robot, skeleton: Skeleton, clip: Clip) -> Path:
    motion = skeleton.body_motion(clip, ["torso_link", "pelvis"])
    arrays = {"joint_pos": clip.joint_pos, "body_pos_w": motion.pos, "body_quat_w": motion.quat}
    return tracker(arrays, joint_names=",".join(robot.joint_names), body_names="torso_link,pelvis")


def tracker_without_its_base(robot: Robot, skeleton: Skeleton, clip: Clip) -> Path:
    motion = skeleton.body_motion(clip, ["left_knee_link", "torso_link"])
    arrays = {"joint_pos": clip.joint_pos, "body_pos_w": motion.pos, "body_quat_w": motion.quat}
    return tracker(arrays, body_names="left_knee_link,torso_link", anchor_body_name="torso_link")


def holosoma_tracker(robot: Robot, skeleton: Skeleton, clip: Clip) -> Path:
    motion = skeleton.body_motion(clip, ["torso_link"])
    arrays = {
        "joint_pos": clip.joint_pos,
        "ref_pos_xyz": motion.pos[:, 0],
        "ref_quat_xyzw": motion.quat[:, 0][:, [1, 2, 3, 0]],
    }
    return tracker(arrays, dof_names=str(list(robot.joint_names)).replace("'", '"'))


@pytest.mark.parametrize(
    "write", [csv_file, own_file, mjlab_file, holosoma_file, mjlab_tracker, tracker_without_its_base, holosoma_tracker]
)
def test_a_file_gives_back_its_clip(robot, skeleton, write):
    clip = wave(robot)
    found = read_clip(write(robot, skeleton, clip), skeleton, csv_fps=50.0)
    assert (found.name, found.fps, len(found)) == ("clip", 50.0, 101)
    for values, correct in ((found.root_pos, clip.root_pos), (found.joint_pos, clip.joint_pos)):
        np.testing.assert_allclose(values, correct, atol=2e-6)
    np.testing.assert_allclose(np.abs((found.root_quat * clip.root_quat).sum(axis=1)), 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"fps": 50.0, "joint_po": np.zeros((5, 29))}, "clip.npz: has no array 'joint_pos'; did you mean 'joint_po'?"),
        ({"fps": 50.0, "joint_pos": np.zeros((5, 28))}, "clip.npz: expected rows of 29 numbers, got the shape (5, 28)"),
        ({"fps": 50.0, "joint_pos": np.zeros((5, 29))}, "clip.npz: holds no root pose: there is no 'body_pos_w'"),
        (
            {"fps": 50.0, "joint_pos": np.zeros((5, 8)), "joint_names": np.array(["left_knee"])},
            "clip.npz: has no joint 'left_hip_pitch_joint' of g1",
        ),
        (
            {
                "fps": 0.0,
                "joint_pos": np.zeros((5, 29)),
                "body_pos_w": np.zeros((5, 1, 3)),
                "body_quat_w": np.ones((5, 1, 4)),
            },
            "clip.npz: the rate must be positive, got 0 frames per second",
        ),
        (
            {
                "fps": 1.0,
                "joint_pos": np.zeros((2, 29)),
                "body_pos_w": np.zeros((2, 1, 3)),
                "body_quat_w": np.ones((2, 1, 4)),
            },
            "clip.npz: the clip has 2 frames; it needs at least 3",
        ),
        (
            {
                "fps": 1.0,
                "joint_pos": np.full((5, 29), np.nan),
                "body_pos_w": np.zeros((5, 1, 3)),
                "body_quat_w": np.ones((5, 1, 4)),
            },
            "clip.npz: frame 0 has a joint angle that is NaN or infinite",
        ),
        (
            {
                "fps": 1.0,
                "joint_pos": np.zeros((5, 29)),
                "body_pos_w": np.zeros((5, 1, 3)),
                "body_quat_w": np.zeros((5, 1, 4)),
            },
            "clip.npz: frame 0 has a root orientation that is no unit quaternion",
        ),
    ],
)
def test_a_wrong_file_is_named(skeleton, content, message):
    np.savez("clip.npz", **content)
    with pytest.raises(ConfigError) as caught:
        read_clip(Path("clip.npz"), skeleton)
    assert message in str(caught.value)


def test_arrays_of_different_lengths_are_named(skeleton):
    arrays = {"joint_pos": np.zeros((9, 29)), "body_pos_w": np.zeros((5, 1, 3)), "body_quat_w": np.ones((5, 1, 4))}
    np.savez("clip.npz", fps=50.0, **arrays)
    with pytest.raises(ConfigError, match="has 5 root positions, 5 orientations and 9 rows of joints"):
        read_clip(Path("clip.npz"), skeleton)


def test_a_rate_that_leaves_too_few_frames_is_named(robot):
    with pytest.raises(ConfigError, match="wave: has 2 frames at 1 frames per second; it needs at least 3"):
        wave(robot).resampled(1.0)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("clip.csv", b"1,2,3\n", "clip.csv: expected rows of 36 numbers, got the shape (1, 3)"),
        ("clip.csv", b"x,y\n", "clip.csv: can't be read as a motion"),
        ("clip.npz", b"nothing", "clip.npz: can't be read as a motion"),
        ("clip.onnx", b"nothing", "clip.onnx: onnx can't read it"),
        ("clip.npz", b"PK\x03\x04" + bytes(40), "clip.npz: can't be read as a motion"),
        ("clip.bvh", b"", "clip.bvh: motions are read from .csv, .npz, .onnx"),
    ],
)
def test_an_unreadable_file_is_named(skeleton, name, content, message):
    Path(name).write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        read_clip(Path(name), skeleton)
    assert message in str(caught.value)


def test_a_policy_without_a_motion_is_named(skeleton):
    with pytest.raises(ConfigError, match="holds no motion"):
        read_clip(tracker({"actions": np.zeros((5, 29))}), skeleton)


# ---- checks ------------------------------------------------------------------------------------------------------------


def standing(robot: Robot, frames: int = 20) -> Clip:
    pos = np.tile([0.0, 0.0, robot.height], (frames, 1))
    return make_clip(
        "stand", 50.0, pos, np.tile([1.0, 0, 0, 0], (frames, 1)), np.tile(robot.default_dof_pos, (frames, 1)), "x"
    )


def test_a_standing_robot_has_no_findings(robot, skeleton):
    quality = quality_of(standing(robot), skeleton)
    assert quality.findings() == []
    assert quality.supports == (1.0, 0.0, 0.0)
    np.testing.assert_allclose(quality.soles, 0.0, atol=1e-9)
    assert (quality.beyond_soft, quality.beyond_hard, quality.joint_speed) == (0.0, 0.0, 0.0)


def test_what_a_robot_can_not_do_is_found(robot, skeleton):
    clip = standing(robot)
    knee = robot.joint_names.index("left_knee_joint")
    clip.joint_pos[10:, knee] = robot.dof_pos_limits[knee, 1] + 0.25  # at once, so with a speed that no motor has
    clip.root_pos[15:, 0] += 0.5
    speed = 0.5 * 50.0 * (robot.dof_pos_limits[knee, 1] + 0.25 - robot.default_dof_pos[knee]) / robot.dof_vel_limits[knee]
    assert quality_of(clip, skeleton).findings() == [
        "left_knee_joint leaves its range by 0.250 rad",
        f"left_knee_joint moves at {100 * speed:.0f} % of its speed limit",
        "the root jumps before frame 15",
    ]


def test_the_ground_is_at_height_zero(robot, skeleton):
    low, high = standing(robot), standing(robot)
    low.root_pos[7, 2] -= 0.03
    high.root_pos[:, 2] += 0.1
    assert quality_of(low, skeleton).findings() == ["a sole is 30 mm below the ground in frame 7"]
    assert quality_of(high, skeleton).findings() == ["the feet stay 100 mm or more above the ground"]
    assert quality_of(high, skeleton).supports == (0.0, 0.0, 1.0)


# ---- command -----------------------------------------------------------------------------------------------------------


def test_the_command_checks_and_resamples(robot, skeleton, capsys):
    path = csv_file(robot, skeleton, wave(robot, fps=30.0))
    assert main(["motion", str(path), "--no-film", "--out", "out"]) == 0
    out = capsys.readouterr().out
    assert "clip: a sole is 50 mm below the ground in frame 30" in out
    assert read_clip(Path("out/clip.npz"), skeleton).joint_pos.shape == (100, 29)
    assert Path("out/clip.png").is_file()
    assert not Path("out/clip.mp4").exists()


def test_two_clips_of_one_name_are_refused(robot, skeleton, capsys):
    path = own_file(robot, skeleton, wave(robot))
    assert main(["motion", str(path), str(path), "--no-film"]) == 2
    assert "two files are named 'clip'" in capsys.readouterr().err


@pytest.mark.parametrize("folder", [".", "link"])
def test_a_clip_is_not_written_over_its_own_file(folder, robot, skeleton, capsys):
    path = own_file(robot, skeleton, wave(robot, fps=30.0))
    before = path.read_bytes()
    Path("link").symlink_to(".")
    assert main(["motion", str(path), "--no-film", "--out", folder]) == 2
    assert f"--out: {path} would be overwritten by its resampled clip; name another folder" in capsys.readouterr().err
    assert path.read_bytes() == before
