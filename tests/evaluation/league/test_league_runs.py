"""Runs in the league: where they begin, what the robot is asked, what happens to it, and how it is scored."""

import json
from pathlib import Path

import mujoco
import numpy as np
import onnx
import pytest
import torch
from helpers import call
from onnx import TensorProto, helper, numpy_helper

from legged.cli.main import main
from legged.evaluation.league.measuring import gains_of, rules, run_tours, scores, with_ideal_motors
from legged.evaluation.league.protocol import league_frames, punches
from legged.evaluation.league.robot import league_robot, servo_gains
from legged.evaluation.league.task import STAGES, Course, LeagueTask, make_league
from legged.policies.foreign import ForeignPolicy, Layout
from legged.policies.restore import nominal
from legged.registry import task_config
from legged.robots.robot import Robot, load_robot

pytestmark = pytest.mark.usefixtures("workplace")
LIMITS = np.array([(-0.5, 1.0), (-0.3, 0.3), (-1.0, 1.0)])
HELD = ("shoulder", "elbow", "wrist")
STANCE, MIRROR = np.array([0.2, 0.2, 0.0, 0.6, 0.0, 0.0, 0.0]), np.array([1.0, -1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
"""Angles of the G1's left arm at the start, and signs of the right arm's angles."""


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    """The league's robot."""
    return league_robot("g1", tmp_path)


def league_task(robot: Robot, stage: str, runs: int = 2, task: str = "g1_flat", **changes) -> LeagueTask:
    cfg = with_ideal_motors(task_config(task, [("sim.physics", "mujoco"), *changes.items()]))
    course = Course.of(range(runs), robot, LIMITS)
    changes = rules(cfg, course, stage, (robot.stiffness, robot.damping))
    return make_league(course, stage, nominal(cfg, changes), torch.device("cpu"), False, None)


def zeros(task: LeagueTask) -> torch.Tensor:
    return torch.zeros(task.num_envs, task.num_actions)


def at(task: LeagueTask, step: int) -> None:
    """Pretend that `step` control steps have passed."""
    task.episode_length_buf = torch.full((task.num_envs,), step)


def test_a_run_begins_at_rest_above_the_ground(robot):
    task = league_task(robot, "own", **{"init_state.base_velocity": [-0.3, 0.3], "init_state.yaw": [-3.0, 3.0]})
    assert task.physics.qpos[1].tolist() == pytest.approx([0.0, 0.0, 0.793, 1.0, 0.0, 0.0, 0.0, *robot.default_dof_pos])
    assert not task.physics.qvel.any()
    assert task.feet_pos[..., 2].min() > 0.03


def test_gains_are_the_policys_but_for_arms_that_it_does_not_move(robot):
    own = robot.stiffness + 1.0, robot.damping + 1.0
    assert np.array_equal(gains_of("own", robot, own)[0], own[0])
    stiffness, _ = gains_of("held", robot, own)
    assert stiffness[:15] == pytest.approx(own[0][:15])
    assert stiffness[15:] == pytest.approx(servo_gains(robot)[0][15:])


def test_commands_lead_to_the_waypoint(robot):
    task = league_task(robot, "own")
    point = torch.tensor([1.0, 0.5, 2.0])
    task._points[:] = point

    def asked(x: float, y: float, yaw: float, step: int = 1) -> list[float]:
        at(task, step)
        task.base_pos[0, :2] = torch.tensor([x, y])
        task.base_quat[0] = torch.tensor([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        task.ask()
        return task.commands[0, :3].tolist()

    # 1.5 x the error in the frame of the yaw: here x points along the world's y.
    assert asked(0.9, 0.3, np.pi / 2) == pytest.approx([1.5 * 0.2, -1.5 * 0.1, 1.5 * (2.0 - np.pi / 2)], abs=1e-5)
    assert asked(-3.0, 4.5, 0.0) == pytest.approx([1.0, -0.3, 1.0], abs=1e-6)  # the policy's limits
    assert asked(0.905, 0.5, 1.96) == [0.0, 0.0, 0.0]  # within 0.1 m and 0.05 rad
    assert asked(0.81, 0.5, 1.89) == [0.0, 0.0, 0.0]  # within 0.2 m and 0.12 rad it stays there
    assert asked(0.799, 0.5, 1.87) == pytest.approx([0.3015 * np.cos(1.87), -0.3015 * np.sin(1.87), 0.195], abs=1e-5)
    assert asked(0.905, 0.5, 1.96) == [0.0, 0.0, 0.0]
    assert asked(0.81, 0.5, 1.89, step=250)[2] == pytest.approx(0.165, abs=1e-5)  # the next waypoint begins anew


def test_the_arms_follow_the_leagues_targets(robot):
    task = league_task(robot, "walking")
    arms = slice(15, 29)
    for step, left in (
        (0, STANCE),
        (25, [0.1525, 0.2293, 0.1700, 0.7370, -0.1044, -0.3497, 0.2206]),
        (50, [-0.0906, 0.3764, -0.1810, 1.0628, -0.2044, -0.5872, 0.0080]),
    ):
        at(task, step)
        task.actions.fill_(1.0)
        task.set_controls()
        assert task.control._target[0, arms].numpy() == pytest.approx([*left, *(MIRROR * left)], abs=6e-5)
        assert task.control._target[0, :15].numpy() == pytest.approx(robot.default_dof_pos[:15] + 0.5, abs=1e-6)


def test_arms_stay_where_they_were_at_the_start_while_they_are_held(robot):
    for stage, expected in (("held", STANCE), ("own", STANCE + 0.5)):
        task = league_task(robot, stage)
        at(task, 333)
        task.actions.fill_(1.0)
        task.set_controls()
        assert task.control._target[1, 15:22].numpy() == pytest.approx(expected, abs=1e-6)


def test_a_policy_that_does_not_move_the_arms_may_observe_their_targets(robot):
    groups = {"actor": {"terms": ["dof_pos", "held_targets"]}}
    changes = {"control.held": list(HELD), "control.actuator.delay": [0, 3], "observations.groups": groups}
    task = league_task(robot, "walking", **changes)
    assert task.num_actions == 15
    assert task.control.actuator is None  # motors are ideal
    at(task, 25)
    task.ask()
    task.set_controls()
    expected = [0.1525, 0.2293, 0.1700, 0.7370, -0.1044, -0.3497, 0.2206]
    assert task.control._target[0, 15:22].numpy() == pytest.approx(expected, abs=5e-5)
    assert task._obs_held_targets()[0, :7].numpy() == pytest.approx(expected - robot.default_dof_pos[15:22], abs=5e-5)
    task.step(zeros(task))
    assert not league_task(robot, "own", **changes)._obs_held_targets().any()


@pytest.mark.parametrize("name", ["h1_teleop", "h1_flat", "h1_real"])
@pytest.mark.parametrize("stage", STAGES)
def test_an_h1_runs_every_stage(name, stage):
    robot = load_robot("h1")
    task = league_task(robot, stage, task=name)
    assert task.physics.qpos[1].tolist() == pytest.approx([0.0, 0.0, 1.08, 1.0, 0.0, 0.0, 0.0, *robot.default_dof_pos])
    own = robot.stiffness + 1.0, robot.damping + 1.0
    assert gains_of(stage, robot, own) == own  # no gains are the league's
    assert (task.physics.forces is not None) == (stage == "punches")
    for _ in range(30):
        task.step(zeros(task))
    assert task.alive.all()
    assert task.base_pos[:, 2].min() > 0.8
    targets, moves = task.control._target[:, robot.joint_names.index("left_elbow_joint")], stage in ("walking", "punches")
    assert (targets.abs().min() > 1e-3) == moves
    assert targets.unique().numel() == (2 if moves else 1)


def test_height_and_pitch_are_the_usual_ones(robot):
    ranges = {"commands.ranges.base_height": [0.5, 0.7], "commands.ranges.base_pitch": [0.1, 0.3]}
    task = league_task(robot, "own", **ranges, **{"rewards.base_height_target": 0.66})
    assert task.base_commands.tolist() == [pytest.approx([0.66, 0.0])] * 2


def test_punches_last_four_control_steps(robot):
    task = league_task(robot, "punches")
    for step, pushed in ((4, False), (5, True), (8, True), (9, False), (254, False), (255, True)):
        at(task, step)
        task.apply_control()
        assert (task.physics.forces.abs().sum(dim=(1, 2)) > 0.0).tolist() == [pushed] * 2
    assert league_task(robot, "walking").physics.forces is None


def test_a_punch_is_a_force_at_the_anchor_of_the_joint(robot):
    task = league_task(robot, "punches")
    model, data = task.physics.model, mujoco.MjData(task.physics.model)
    rng = np.random.default_rng(0)
    data.qpos[2:7] = 0.8, *(rng.normal(size=4))
    data.qpos[7:] = rng.uniform(*model.jnt_range[1:].T)
    mujoco.mj_normalizeQuat(model, data.qpos)
    mujoco.mj_forward(model, data)
    without, frames = data.qfrc_smooth.copy(), league_frames(model)
    task.physics.qpos[:] = torch.from_numpy(data.qpos)
    task.dof_pos[:] = torch.from_numpy(data.qpos[7:])
    for slot in range(18):
        at(task, 250 * slot + 6)
        task.apply_control()
        for run in range(2):
            each = punches(run, 29)
            joint = model.joint(robot.joint_names[each.joint[slot]])
            link = int(joint.bodyid[0])
            frame = link if each.of_child[slot] else int(model.body_parentid[link])
            world, wanted = np.zeros(3), np.zeros(model.nv)
            mujoco.mju_rotVecQuat(world, each.force[slot], frames[frame])
            world = data.xmat[frame].reshape(3, 3) @ world
            mujoco.mj_applyFT(model, data, world, np.zeros(3), data.xanchor[joint.id], link, wanted)
            data.xfrc_applied[:] = task.physics.forces[run].numpy()
            mujoco.mj_forward(model, data)
            assert data.qfrc_smooth - without == pytest.approx(wanted, abs=1e-3)


def test_a_run_ends_when_the_pelvis_is_low(robot):
    task = league_task(robot, "own")
    low = []
    task.step_watcher = lambda: low.append((task.base_pos[:, 2] < 0.2).tolist())
    run_tours(task, lambda task, _: 3.0 * torch.ones_like(zeros(task)))
    found = scores(task)
    firsts = [next(k for k, now in enumerate(low, 1) if now[i]) for i in range(2)]
    assert [run["survival_s"] for run in found["runs"]] == [pytest.approx(0.02 * first) for first in firsts]
    assert found["survival_s"] == pytest.approx(0.02 * np.mean(firsts))
    assert found["completed"] == 0.0
    assert found["energy_j"] is None
    assert [run["slots"] for run in found["runs"]] == [int(0.02 * first // 5.0) for first in firsts]


def test_errors_are_those_at_the_ends_of_slots_that_were_reached(robot):
    task = league_task(robot, "own")
    task.missed[0] = torch.stack([torch.arange(18.0), 0.1 * torch.arange(18.0)], dim=1)
    task.missed[1] = 100.0
    task.alive[:] = torch.tensor([False, True])
    task.lasted[:] = torch.tensor([751, 4500])  # the fourth control step of the fourth slot
    found = scores(task)
    assert found["completed"] == 0.5
    assert [run["slots"] for run in found["runs"]] == [3, 18]
    assert found["position_error_m"] == pytest.approx((0.0 + 1.0 + 2.0 + 18 * 100.0) / 21)
    assert found["yaw_error_rad"] == pytest.approx((0.3 + 18 * 100.0) / 21)


def walker(rows: int | str) -> Path:
    """An ONNX file whose actions are the command's vx times the joint's number."""
    weights = np.zeros((61, 29), dtype=np.float32)
    weights[0] = np.arange(29)
    weights[3:32] = 0.1 * np.eye(29)
    given = helper.make_tensor_value_info("obs", TensorProto.FLOAT, [rows, 61])
    found = helper.make_tensor_value_info("actions", TensorProto.FLOAT, [rows, 29])
    node = helper.make_node("MatMul", ["obs", "weights"], ["actions"])
    graph = helper.make_graph([node], "walker", [given], [found], [numpy_helper.from_array(weights, "weights")])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)])
    model.ir_version = 8
    onnx.save(model, "walker.onnx")
    return Path("walker.onnx")


LAYOUT = {"command_xy": 1.0, "command_yaw": 1.0, "dof_pos": 1.0, "actions": 1.0}


@pytest.mark.parametrize("rows", [1, "batch"])
def test_an_onnx_policy_acts_for_many_robots_as_for_each_alone(robot, rows):
    layout = Layout(observation={**LAYOUT}, phase_standing=1.0)
    path = walker(rows)
    many, alone = ForeignPolicy(path, layout, robot), [ForeignPolicy(path, layout, robot) for _ in range(3)]
    many.reset(3)
    rng = np.random.default_rng(0)
    for step in range(3):
        command = rng.normal(size=(3, 3))
        command[step] = 0.0
        state = [rng.normal(size=(3, 3)) for _ in range(3)] + [rng.normal(size=(3, 29)) for _ in range(2)]
        found = many.act(command, *state)
        for i, one in enumerate(alone):
            assert found[i] == pytest.approx(one.act(command[i], *(values[i] for values in state)), abs=1e-5)
            assert np.array_equal(many._phase[i], one._phase)


def test_an_onnx_policy_is_measured_on_the_command_line(capsys):
    path = walker(1)
    Path("layout.yaml").write_text("observation: {command_xy: 1.0, command_yaw: 1.0, dof_pos: 1.0, actions: 1.0}\n")
    words = ["evaluate", "league", str(path), "--layout", "layout.yaml", "--runs", "2", "--stages", "held", "--out", "out"]
    assert call(main, [*words, "--physics", "mujoco"]) == 0
    result = json.loads(Path("out/league_mujoco.json").read_text())
    held = result["stages"]["held"]
    assert list(result["stages"]) == ["held"]
    assert len(held["runs"]) == 2
    assert 0.3 < held["survival_s"] < 10.0  # this policy does not walk
    assert "held" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["g1_flat", "--stages", "own,punch"], "--stages: there is no stage 'punch'; did you mean 'punches'?"),
        (["g1_flat", "--runs", "0"], "--runs"),
        (["g1_flat", "--layout", "holosoma"], "--layout: has no effect on a policy that is not an ONNX file"),
        (["go1_flat"], "POLICY: the league measures this package's 'g1' and 'h1', but 'go1_flat' has 'go1'"),
        (["g1_flat", "control.decimation=4"], "control.decimation: cannot be changed, because the league's rules set it"),
        (["g1_flat", "domain_rand.forces.pull.x=[1,2]"], "domain_rand.forces.pull.x: cannot be changed"),
        (["none.onnx"], "there is no ONNX file"),
    ],
)
def test_wrong_inputs_are_refused(words, message, capsys):
    assert call(main, ["evaluate", "league", *words]) == 2
    assert message in capsys.readouterr().err


def test_a_policy_with_another_control_step_is_refused(capsys):
    path = walker(1)
    Path("layout.yaml").write_text("observation: {command_xy: 1.0, command_yaw: 1.0, dof_pos: 1.0}\ncontrol_dt: 0.01\n")
    assert call(main, ["evaluate", "league", str(path), "--layout", "layout.yaml"]) == 2
    assert "control_dt: must be 0.02 in the league, got 0.01" in capsys.readouterr().err
