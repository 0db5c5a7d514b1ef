"""Motion tracking: terms by numbers worked out elsewhere, frames and bins by hand, a training through the commands."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from legged.cli.main import main
from legged.errors import ConfigError
from legged.evaluation import motions
from legged.math import quat_from_angle_axis, quat_multiply, quat_rotate
from legged.motion.clip import Clip, make_clip, write_clip
from legged.process.paths import data_folder
from legged.registry import make_task, register_file, task_config
from legged.robots.robot import load_robot

pytestmark = pytest.mark.usefixtures("workplace")
HEIGHT = 0.76


def wave(seconds: float = 2.0, name: str = "wave") -> Clip:
    """A G1 that glides along, turns and swings all joints."""
    robot = load_robot("g1")
    t = np.arange(round(50 * seconds) + 1)[:, None] / 50.0
    joint = robot.default_dof_pos + 0.2 * np.sin(2 * np.pi * (0.5 * t + np.arange(29) / 29))
    pos = np.hstack([0.3 * t, 0.1 * np.sin(np.pi * t), 0.75 + 0.02 * np.cos(2 * np.pi * t)])
    half = 0.25 * np.sin(0.5 * np.pi * t)
    return make_clip(name, 50.0, pos, np.hstack([np.cos(half), 0 * t, 0 * t, np.sin(half)]), joint, name)


def still(name: str = "still") -> Clip:
    robot, frames = load_robot("g1"), 61
    pos, quat = np.tile([0.0, 0.0, HEIGHT], (frames, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1))
    return make_clip(name, 50.0, pos, quat, np.tile(robot.default_dof_pos, (frames, 1)), name)


def tracking(*clips: Clip, count: int = 1, **settings):
    for clip in clips:
        write_clip(clip, load_robot("g1"), Path(f"{clip.name}.npz"))
    files = ("motion.files", [f"{clip.name}.npz" for clip in clips])
    base = {"env.num_envs": count, "sim.physics": "mujoco", "observations.add_noise": False}
    return make_task(task_config("g1_tracking", [files, *(base | settings).items()], on_cpu=True))


def put(task, pos=(0.0, 0.0, HEIGHT), quat=(1.0, 0.0, 0.0, 0.0), joints=None) -> None:
    """Put all robots at rest into a state, without physics, and compare them with their frames."""
    task.reset_qpos[:, :3], task.reset_qpos[:, 3:7] = torch.tensor(pos), torch.tensor(quat)
    task.reset_qpos[:, 7:] = task.default_dof_pos if joints is None else joints
    task.reset_qvel.zero_()
    task.physics.write(torch.ones_like(task.reset_buf), task.reset_qpos, task.reset_qvel)
    task.sense()
    task.advance()


def about_torso(task, angle: float, axis: tuple[float, float, float]) -> None:
    """Turn all robots by an angle about an axis through the torso."""
    put(task)
    torso = task.bodies.pos[0, task._anchor]
    turn = quat_from_angle_axis(torch.tensor([angle]), torch.tensor(axis))[0]
    put(task, tuple((torso + quat_rotate(turn, torch.tensor([0.0, 0.0, HEIGHT]) - torso)).tolist()), tuple(turn.tolist()))


NAMES = ("anchor_pos", "anchor_ori", "body_pos", "body_ori", "body_lin_vel", "body_ang_vel")


def rewards(task) -> list[float]:
    return [float(getattr(task, f"_reward_{name}")()[0]) for name in NAMES]


E1 = math.exp(-1.0)


@pytest.mark.parametrize(
    ("place", "values", "errors"),
    [
        (lambda task: put(task, (0.3, 0.0, HEIGHT)), (E1, 1, 1, 1, 1, 1), (0.3, 0.0)),
        (lambda task: put(task, (0.0, 0.0, HEIGHT + 0.1)), (0.894839, 1, 0.894839, 1, 1, 1), (0.1, 0.1)),
        (lambda task: about_torso(task, 0.4, (0.0, 0.0, 1.0)), (1, E1, 1, 1, 1, 1), (0.054454, 0.0)),
        (lambda task: about_torso(task, 0.2, (1.0, 0.0, 0.0)), (1, 0.778801, 0.935926, 0.778801, 1, 1), (0.062524, 0.062524)),
        (lambda task: about_torso(task, 1.4, (0.0, 1.0, 0.0)), (1, 5e-6, 0.086722, 5e-6, 1, 1), None),
    ],
)
def test_rewards_of_a_robot_beside_its_reference(place, values, errors):
    """Displaced, lifted, turned, rolled, pitched. The numbers come from mjlab's functions."""
    task = tracking(still())
    place(task)
    assert rewards(task) == pytest.approx(values, abs=2e-4)
    if errors is not None:
        assert float(task._metric_world_error()) == pytest.approx(errors[0], abs=1e-4)
        assert float(task._metric_body_error()) == pytest.approx(errors[1], abs=1e-4)


def test_rewards_of_a_moving_reference():
    """1 m/s and 3.14 rad/s are the errors at which the rewards fall to 1/e."""
    task = tracking(still())
    put(task)
    task.motion.now.lin_vel[..., 0] = 1.0
    task.motion.now.ang_vel[..., 2] = 3.14
    assert rewards(task) == pytest.approx((1, 1, 1, 1, E1, E1), abs=1e-5)


def test_rewards_in_the_middle_of_a_motion():
    task = tracking(wave())
    task.motion.frame.fill_(24)
    task.motion.advance()
    put(task, (0.25, 0.05, HEIGHT), (math.cos(0.15), 0.0, 0.0, math.sin(0.15)))
    wanted = (0.861016, 0.589009, 0.931051, 0.313539, 0.856677, 0.895936)
    assert rewards(task) == pytest.approx(wanted, abs=3e-4)
    assert float(task._metric_world_error()) == pytest.approx(0.143294, abs=1e-4)
    assert float(task._metric_body_error()) == pytest.approx(0.065998, abs=1e-4)
    assert task._obs_anchor_pos()[0].tolist() == pytest.approx((-0.08073, 0.07779, -0.03), abs=1e-4)


def test_observations_of_a_turned_robot():
    """Widths are those of BeyondMimic. The anchor's columns are listed row by row."""
    task = tracking(still())
    assert {name: group.buffer.shape[1] for name, group in task.observation_groups.items()} == {"actor": 160, "critic": 286}
    about_torso(task, 0.4, (0.0, 0.0, 1.0))
    assert task._obs_anchor_ori()[0].tolist() == pytest.approx((0.92106, 0.38942, -0.38942, 0.92106, 0.0, 0.0), abs=1e-5)
    body = task._obs_body_ori().view(14, 6)
    assert body[task._anchor].tolist() == pytest.approx((1.0, 0.0, 0.0, 1.0, 0.0, 0.0), abs=1e-6)
    assert task._obs_body_pos().view(14, 3)[task._anchor].tolist() == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


def test_failures_are_those_of_height_and_tilt():
    task = tracking(still())
    names = ("anchor_height", "anchor_ori", "extremity_height")

    def found() -> tuple[bool, ...]:
        return tuple(bool(getattr(task, f"_terminate_{name}")()[0]) for name in names)

    put(task)
    assert found() == (False, False, False)
    put(task, (0.0, 0.0, HEIGHT + 0.26))
    assert found() == (True, False, True)
    about_torso(task, 1.4, (0.0, 1.0, 0.0))  # beyond 78.46 degrees, where gravity's z differs by 0.8
    assert found() == (False, True, True)
    about_torso(task, 1.36, (0.0, 1.0, 0.0))
    assert found()[1] is False


# ---- frames --------------------------------------------------------------------------------------------------------------


def test_an_observation_shows_the_frame_after_the_one_of_the_state():
    """A new episode begins on the drawn frame, without noise, and each step goes on by one; a clip's end is a time-out."""
    quiet = {"motion.pose_noise": [0.0] * 6, "motion.velocity_noise": [0.0] * 6, "motion.joint_noise": [0.0, 0.0]}
    task = tracking(wave(), count=8, **quiet, **{"terminations.failures": []})
    drawn, shown = task.motion.drawn.clone(), task.motion.frame.clone()
    assert torch.equal(shown, drawn + 1)
    torch.testing.assert_close(task.bodies.pos, task.motion.table.pos[drawn], atol=2e-5, rtol=0.0)
    torch.testing.assert_close(task.bodies.ang_vel, task.motion.table.ang_vel[drawn], atol=2e-3, rtol=0.0)
    torch.testing.assert_close(task.observation_groups["actor"].buffer[:, :29], task.motion.table.joint_pos[shown])
    for _ in range(100):
        before = task.motion.frame.clone()
        _, _, done, extras = task.step(torch.zeros(8, 29))
        assert torch.equal(done, before == 100)
        assert torch.equal(extras["time_outs"], done)
        assert torch.equal(task.motion.frame[~done], before[~done] + 1)
    assert int(task.terminated_buf.sum()) == 0


def test_noise_on_initial_states_stays_in_its_bounds():
    task = tracking(still(), count=64)
    put_at = task.reset_qpos[:, :3] - torch.tensor([0.0, 0.0, HEIGHT])
    assert (put_at.abs() <= torch.tensor([0.05, 0.05, 0.01]) + 1e-6).all()
    assert (put_at.abs().amax(dim=0) > torch.tensor([0.03, 0.03, 0.006])).all()
    low, high = task.dof_pos_limits.unbind(dim=1)
    joints = task.reset_qpos[:, 7:]
    assert ((joints >= low) & (joints <= high)).all()
    assert ((joints - task.default_dof_pos).abs() <= 0.1 + 1e-6).all()


def test_a_turned_start_keeps_the_velocities_in_the_world():
    """MuJoCo's angular velocity is in the base frame."""
    task = tracking(wave(), count=16, **{"motion.velocity_noise": [0.0] * 6})
    angular = quat_rotate(task.reset_qpos[:, 3:7], task.reset_qvel[:, 3:6])
    torch.testing.assert_close(angular, task.motion.start.root_ang_vel, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(task.reset_qvel[:, :3], task.motion.start.root_lin_vel)
    turn = quat_multiply(task.reset_qpos[:, 3:7], task.motion.start.root_quat * torch.tensor([1.0, -1.0, -1.0, -1.0]))
    assert (turn[:, 0] > 0.97).all()


def test_bins_with_failures_are_drawn_more_often():
    """345 frames at 50 Hz are 7 bins. Four failures in one step, in bins 1 and 4."""
    clip = wave(6.88)
    assert len(clip) == 345
    motion = tracking(clip, count=4).motion
    assert len(motion.failures) == 7
    motion.failures.zero_()
    motion.frame.copy_(torch.tensor([60, 70, 80, 200]))
    motion.count(torch.ones(4, dtype=torch.bool))
    assert motion.failures.tolist() == pytest.approx([0, 0.003, 0, 0, 0.001, 0, 0], abs=1e-7)
    wanted = [0.13736, 0.16621, 0.13736, 0.13736, 0.14698, 0.13736, 0.13736]
    assert motion.chances().tolist() == pytest.approx(wanted, abs=1e-5)


def test_episodes_begin_in_chosen_frames():
    quiet = {"motion.pose_noise": [0.0] * 6, "motion.velocity_noise": [0.0] * 6, "motion.joint_noise": [0.0, 0.0]}
    task = tracking(wave(), count=3, **quiet)
    frames = torch.tensor([0, 40, 99])
    task.start_at(frames)
    assert torch.equal(task.motion.frame, frames + 1)
    torch.testing.assert_close(task.bodies.pos, task.motion.table.pos[frames], atol=2e-5, rtol=0.0)
    task.reset()
    assert not torch.equal(task.motion.frame, frames + 1)


def test_failures_of_the_parts_of_a_motion_are_in_checkpoints():
    """They begin at 0. Those of another motion are not taken."""
    first, second, other = tracking(wave(), count=4), tracking(wave(), count=8), tracking(still("other"), count=4)
    assert float(first.motion.failures.sum()) == 0.0
    first.motion.failures.copy_(torch.tensor([0.1, 0.2, 0.3]))
    for task, found in ((second, [0.1, 0.2, 0.3]), (other, [0.0, 0.0])):
        task.load_progress(first.progress())
        assert task.motion.failures.tolist() == pytest.approx(found)
    first.reset_curricula()
    assert float(first.motion.failures.sum()) == 0.0


def test_paths_of_motions_start_at_the_file_that_names_them():
    """A folder stands for the motions in it; none counts twice."""
    folder = Path("mine")
    for name in ("a", "b"):
        write_clip(wave(name=name), load_robot("g1"), folder / "clips" / f"{name}.npz")
    (folder / "dance.yaml").write_text("extends: g1_tracking\nmotion: {files: [clips, clips/b.npz]}\n")
    name = register_file("mine/dance.yaml")
    task = make_task(task_config(name, [("env.num_envs", 1), ("sim.physics", "mujoco")], on_cpu=True))
    assert len(task.motion.table.rows) == 2 * len(wave())


def test_a_whole_motion_is_tracked_to_its_end():
    """Here nothing counts as a failure."""
    task = tracking(still(), **{"env.episode_length_s": 1e4, "terminations.failures": []})
    found = motions._from_the_beginning(task, lambda observations: torch.zeros(1, 29))
    assert found == {"success": True, "lasted_s": pytest.approx(1.2)}


def test_a_saved_state_goes_on_with_its_frames():
    """A task that loads the state of another makes the same next step."""
    first, second = (tracking(wave(), count=8) for _ in range(2))
    actions = 0.1 * torch.randn(12, 8, 29, generator=torch.Generator().manual_seed(1))
    for step in actions[:10]:
        first.step(step)
    second.load_state_dict(first.state_dict())
    found = [task.step(actions[10])[1] for task in (first, second)]
    assert torch.equal(*found)
    assert torch.equal(first.motion.frame, second.motion.frame)


def test_errors_are_those_of_a_displaced_robot():
    """0.3 m along x: only the error in the world. One knee bent by 0.1 rad: the root mean square over 29 joints, and the
    distance that the ankle below the knee moves.
    """
    task = tracking(still())
    put(task, (0.3, 0.0, HEIGHT))
    assert task.errors[0].tolist() == pytest.approx([0.3, 0.0, 0.0, 0.0, 0.0], abs=1e-6)
    joints = task.default_dof_pos.clone()
    joints[3] += 0.1
    put(task, joints=joints)
    assert float(task.errors[0, 3]) == pytest.approx(0.1 / math.sqrt(29), abs=1e-6)
    upper, lower = 0.30001, 0.017558  # from the knee to the pitch axis of the ankle, and on to the roll axis [m]
    shank = math.sqrt(upper**2 + lower**2 + 2.0 * upper * lower * math.cos(float(task.default_dof_pos[4])))
    assert float(task.errors[0, 4]) == pytest.approx(2.0 * math.sin(0.05) * shank, abs=1e-5)


def test_draws_have_their_chances_and_stay_in_the_clips():
    task = tracking(wave(), still(), count=4000, **{"sim.physics": "mujoco"})
    motion = task.motion
    motion.failures.zero_()
    motion.failures[1] = 0.3
    task.numbers.draw()
    motion.draw()
    counts = torch.bincount(motion._bin_of[motion.drawn], minlength=len(motion.failures)) / 4000
    assert counts.tolist() == pytest.approx(motion.chances().tolist(), abs=0.03)
    assert int(motion.drawn.min()) >= 0
    assert int(motion.drawn.max()) < len(wave()) + len(still()) - 1


# ---- commands and errors -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_tracker_is_trained_and_plays(capsys):
    small = ["env.num_envs=8", "train.runner.num_steps_per_env=4", "train.policy.actor_hidden_dims=[16]"]
    assert main(["train", "g1_tracking", "--max-iterations", "2", "--sim-device", "cpu", *small]) == 0
    assert "finished after 2 iterations" in capsys.readouterr().out
    assert main(["play", "g1_tracking", "--headless", "--no-video", "--sim-device", "cpu", "--num-envs", "4"]) == 0
    two = ["--episodes", "16", "--out", ".", "motion.files=[g1/squat.npz, g1/kick.npz]"]
    assert main(["evaluate", "motions", "g1_tracking", "--physics", "mujoco", *two]) == 0
    found = json.loads(Path("motions_mujoco.json").read_text())
    assert list(found["motions"]) == ["squat", "kick"]
    squat = found["motions"]["squat"]
    assert squat["episodes"] == sum(part["episodes"] for part in squat["by_second"]) == 16
    assert squat["share"] == squat["successes"] / 16 < 0.5  # it has hardly learned anything
    assert 0.0 < squat["whole"]["lasted_s"] < squat["seconds"]
    assert squat["seconds"] == pytest.approx(275 / 50)
    assert 0.0 < squat["body_error"] < squat["world_error"] < 1.0
    parts = squat["errors_by_second"]
    assert [part["second"] for part in parts] == list(range(6))
    assert min(part["body_error"] for part in parts) < squat["body_error"] < max(part["body_error"] for part in parts)
    assert all(part["body_error"] < part["largest_error"] for part in parts)


def test_packaged_motions_keep_their_names_and_own_motions_get_full_paths():
    """A run's configuration then finds packaged motions in any installation."""
    write_clip(still(), load_robot("g1"), Path("still.npz"))
    files = ["g1/kick.npz", str(data_folder("resources") / "motions" / "g1" / "walk.npz"), "still.npz"]
    cfg = task_config("g1_tracking", [("motion.files", files)], on_cpu=True)
    assert cfg.motion.files == ("g1/kick.npz", "g1/walk.npz", str(Path("still.npz").absolute()))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"motion.files": []}, "motion.files: name at least one file of a motion (.csv, .npz, .onnx)"),
        ({"motion.files": ["nowhere.npz"]}, "motion.files: nowhere.npz is no file of a motion"),
        ({"motion.extremities": []}, "motion.extremities: name at least one of motion.bodies"),
        ({"motion.anchor": "torso"}, "motion.anchor: 'torso' must be one of motion.bodies: pelvis,"),
        ({"motion.bodies": ["torso_lnk"]}, "motion.bodies: g1 has no body 'torso_lnk'; did you mean 'torso_link'?"),
        (
            {"terrain.mesh_type": "height_map", "terrain.proportions": {"slope_up": 1.0}},
            "terrain.mesh_type: motions are tracked on a plane, got 'height_map'",
        ),
        (
            {"robot": "cassie", "control.action_scale": 0.5},
            "robot: 'cassie' has joints without a motor, which no reference moves",
        ),
    ],
)
def test_a_wrong_setting_is_named(changes, message):
    with pytest.raises(ConfigError) as caught:
        task_config("g1_tracking", [*changes.items()], on_cpu=True)
    assert message in str(caught.value)
