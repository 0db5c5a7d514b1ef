"""The league's random streams, and what follows from a run's id: its waypoints, punches and motions of the arms."""

from collections import deque

import mujoco
import numpy as np
import pytest

from legged.evaluation.league.protocol import Arm, arm_goals, league_frames, punches, reach, waypoints
from legged.evaluation.league.robot import HEAD, arm_of, arms_of, league_robot, servo_gains
from legged.evaluation.league.streams import Stream, spread
from legged.robots.robot import Robot, load_robot

STANCE = np.array([0.2, 0.2, 0.0, 0.6, 0.0, 0.0, 0.0])
"""Angles of the G1's left arm at the start."""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """The league's robot."""
    return league_robot("g1", tmp_path_factory.mktemp("robot"))


@pytest.fixture(scope="module")
def arm(robot: Robot) -> Arm:
    return arm_of(robot)


@pytest.fixture(scope="module")
def goals(arm: Arm) -> np.ndarray:
    """Goals of the left arm in the runs 0 to 3."""
    return arm_goals(range(4), arm)


def test_the_streams_of_a_run_differ_and_repeat():
    assert len(set(spread((0, 2)).tolist())) > 600
    again = [Stream(run, number).units(5).tolist() for run, number in ((0, 2), (0, 2), (0, 3), (1, 2))]
    assert again[0] == again[1]
    assert again[1] != again[2] != again[3] != again[1]


def test_units_are_upper_24_bits_and_words_are_drawn_again_where_integers_would_be_uneven():
    class Words:
        def __init__(self, *words: int) -> None:
            self.words = deque(words)

        def random_raw(self, count: int | None = None) -> int | np.ndarray:
            return (
                self.words.popleft() if count is None else np.array([self.words.popleft() for _ in range(count)], np.uint64)
            )

    stream = Stream(0, 0)
    stream._twister = Words(0xFFFFFFFF, 0x80000000, 0xFF)  # type: ignore[assignment]
    assert stream.units(3).tolist() == [1.0 - 2.0**-24, 0.5, 0.0]
    # 2^32 = 29 * 148102320 + 16: the 16 largest words are drawn again.
    stream._twister = Words(2**32 - 1, 2**32 - 16, 2**32 - 17)  # type: ignore[assignment]
    assert stream.below(29) == 28
    stream._twister = Words(148102319, 148102320)  # type: ignore[assignment]
    assert [stream.below(29), stream.below(29)] == [0, 1]


def test_waypoints_are_those_of_the_league():
    assert waypoints(0)[:2] == pytest.approx(np.array([(0.6622, 0.6081, 3.1227), (0.4210, 0.4248, -1.5942)]), abs=5e-5)
    assert waypoints(1)[0] == pytest.approx([0.2979, -0.6507, 2.3195], abs=5e-5)
    every = np.concatenate([waypoints(run) for run in range(50)])
    assert (np.hypot(every[:, 0] - 0.3, every[:, 1]) <= 0.75).all()
    assert (np.abs(every[:, 2]) <= np.pi).all()


def test_punches_are_those_of_the_league(robot):
    first = punches(0, robot.num_dof)
    assert [robot.joint_names[i] for i in first.joint[:2]] == ["right_shoulder_roll_joint", "left_elbow_joint"]
    assert first.of_child[:2].tolist() == [True, False]
    assert first.force[:2] == pytest.approx(np.array([(48.04, -88.54, -128.50), (-110.34, -26.25, -62.36)]), abs=5e-3)


def test_punches_grow_for_a_minute(robot):
    sizes = np.array([np.linalg.norm(punches(run, robot.num_dof).force, axis=1) for run in range(300)])
    most = 500.0 * np.minimum(1.0 / 3.0 + np.arange(18) / 18.0, 1.0)  # 2/3 in 12 steps of 5 s
    assert (sizes <= most + 1e-9).all()
    assert (sizes >= 0.5 * most - 1e-9).all()
    assert sizes.mean(axis=0) == pytest.approx(0.75 * most, rel=0.03)  # 300 values of a uniform distribution


def test_arms_are_those_of_the_league(goals):
    assert (goals[:, 0] == STANCE).all()
    # A twenty-fifth of the way to the next goal has passed when a control step begins to move there.
    after = [goals[0, k] + (goals[0, k + 1] - goals[0, k]) / 25 for k in (1, 2)]
    assert after[0] == pytest.approx([0.1525, 0.2293, 0.1700, 0.7370, -0.1044, -0.3497, 0.2206], abs=5e-5)
    assert after[1] == pytest.approx([-0.0906, 0.3764, -0.1810, 1.0628, -0.2044, -0.5872, 0.0080], abs=5e-5)


def test_hands_stay_in_front_of_the_body_and_below_the_head(arm, goals):
    back, up = reach(arm, goals.reshape(-1, 7))
    assert back.min() >= reach(arm, STANCE[None])[0][0]
    assert up.max() <= HEAD
    assert np.abs(np.diff(goals, axis=1)).max() <= 25 * 0.06


def test_arms_of_an_h1_move_within_its_limits_and_in_front_of_it():
    robot = load_robot("h1")
    left, right = arms_of(robot)
    assert [robot.joint_names[i].removeprefix("left_") for i in left] == [
        *("shoulder_pitch_joint", "shoulder_roll_joint", "shoulder_yaw_joint", "elbow_joint")
    ]
    assert [robot.joint_names[i] for i in right] == [robot.joint_names[i].replace("left", "right") for i in left]
    arm = arm_of(robot)
    goals = arm_goals(range(4), arm)
    assert goals.shape == (4, 181, 4)
    assert (goals[:, 0] == 0.0).all()
    assert (goals >= robot.dof_pos_limits[left, 0]).all()
    assert (goals <= robot.dof_pos_limits[left, 1]).all()
    assert goals[:, 20:].std(axis=(0, 1)).min() > 0.3  # they do move
    back, up = reach(arm, goals.reshape(-1, 4))
    assert back.min() >= 0.0185 + 0.31  # the forearm points forward at the start
    assert up.max() <= 0.64 - 0.08


@pytest.mark.parametrize("name", ["g1", "h1"])
def test_the_arm_of_the_check_is_the_robots(name, tmp_path):
    """The hand as C MuJoCo places it, on both sides of the robot."""
    robot = league_robot(name, tmp_path)
    model, arm, arms = mujoco.MjModel.from_xml_path(str(robot.model_path)), arm_of(robot), arms_of(robot)
    data, signs = mujoco.MjData(model), np.array(robot.mirror.signs)[arms[0]]
    angles = arm_goals(range(4), arm)[:, ::20].reshape(-1, len(arm.stance))
    back, up = reach(arm, angles)
    for i, left in enumerate(angles):
        for joints, own in zip(arms, (left, signs * left), strict=True):
            data.qpos[[robot.qpos_columns[joint] for joint in joints]] = own
        mujoco.mj_kinematics(model, data)
        torso = data.body("torso_link")
        for joints, sign in zip(arms, (1.0, -1.0), strict=True):
            hand = data.body(int(model.joint(robot.joint_names[joints[-1]]).bodyid[0]))
            corners = hand.xpos + arm.hand * (1.0, sign, 1.0) @ hand.xmat.reshape(3, 3).T
            seen = (corners - torso.xpos) @ torso.xmat.reshape(3, 3)
            assert seen[:, 0].min() == pytest.approx(back[i], abs=1e-3)
            assert seen[:, 2].max() == pytest.approx(up[i], abs=1e-3)


def test_the_hand_of_an_h1_is_the_end_of_its_forearm():
    model = mujoco.MjModel.from_xml_path(str(load_robot("h1").model_path))
    forearm = model.geom("left_forearm")
    axis = np.zeros(3)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), forearm.quat)
    ends = [forearm.pos + sign * (forearm.size[0] + forearm.size[1]) * axis for sign in (-1.0, 1.0)]
    assert arm_of(load_robot("h1")).hand[0] == pytest.approx(max(ends, key=lambda end: end[0]), abs=1e-3)


def test_the_robot_is_the_leagues(robot):
    assert robot.mass == pytest.approx(35.112, abs=5e-4)
    of = dict(zip(robot.joint_names, robot.torque_limits, strict=True))
    assert [of[f"left_{name}_joint"] for name in ("hip_roll", "knee", "wrist_roll", "wrist_yaw")] == [88.0, 139.0, 25.0, 5.0]
    assert robot.armature[robot.joint_names.index("left_hip_pitch_joint")] == 0.0251
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.body("torso_link").xpos - data.body("pelvis").xpos == pytest.approx([-0.0039635, 0.0, 0.054])
    ours = load_robot("g1")
    before = mujoco.MjModel.from_xml_path(str(ours.model_path))
    old = mujoco.MjData(before)
    mujoco.mj_forward(before, old)
    for name in ("head", "torso", "left_hand"):  # the shapes have not moved
        assert data.geom(name).xpos == pytest.approx(old.geom(name).xpos, abs=1e-6)
    assert (model.dof_damping[6:] == 0.01).all()
    assert (model.dof_frictionloss[6:] == 0.01).all()
    assert 0.793 - robot.height == pytest.approx(0.036, abs=5e-4)  # height of the soles under the crane
    stiffness, damping = servo_gains(robot)
    assert [stiffness[15], damping[15], stiffness[-1], damping[-1]] == pytest.approx([14.25, 0.907, 16.8, 1.07], rel=2e-3)


def test_frames_of_the_league_lean_with_their_joints(robot):
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    frames = league_frames(model)
    for name, quat in (  # of `g1_29dof.xml`; the frames of shoulder and hip roll follow that of the body
        ("left_hip_roll_link", (0.996179, 0.0, -0.0873386, 0.0)),
        ("right_shoulder_pitch_link", (0.990264, -0.139201, 0.0, 0.0)),
        ("left_knee_link", (1.0, 0.0, 0.0, 0.0)),
    ):
        assert frames[model.body(name).id] == pytest.approx(quat, abs=2e-4)
