"""A live view without its page: time, commands, pushes, ground, and checkpoints that come while it looks."""

import shutil
from pathlib import Path

import pytest
import torch
from helpers import ENGINE, POLICY, POLICY_ITERATION, TASK

from legged.learning.checkpoint import read_checkpoint, write_checkpoint
from legged.learning.run_folder import BEST, BEST_MODEL, CONFIG_FILE, SHIPPED_MODEL, run_config
from legged.math import quat_rotate
from legged.play.live.session import (
    BEHIND_S,
    HARDEST_PUSH,
    NEWEST,
    OWN,
    PLANE,
    Session,
    Watched,
    ago,
    changes_for,
    check_ground,
)

SHIPPED = POLICY.parent


def session_of(folder: Path, robots: int = 2) -> Session:
    """A session of the policy in a folder, on the ground that its task asks for."""
    torch.set_num_threads(1)
    cfg = run_config(folder)
    return Session(Watched(cfg, folder), changes_for(cfg, robots, ENGINE), check_ground(cfg, None, None))


@pytest.fixture(scope="module")
def shared() -> Session:
    return session_of(SHIPPED / TASK)


@pytest.fixture
def session(shared: Session) -> Session:
    """Two robots on a plane that have just been reset."""
    shared.running, shared.speed, shared.problem = True, 1.0, ""
    shared.stand()
    shared.select(0)
    shared.reset()
    return shared


@pytest.mark.slow
def test_robots_do_what_they_are_asked_within_what_they_were_trained_for(session):
    assert session.ranges == [[pytest.approx(-1.1), pytest.approx(1.1)]] * 2 + [[pytest.approx(-1.3), pytest.approx(1.3)]]
    session.ask(0, 0.8)
    session.ask(2, 99.0)
    assert session.command == [0.8, 0.0, pytest.approx(1.3)]
    session.ask(2, 0.0)
    for _ in range(200):
        session.step()
    assert torch.allclose(session.task.commands[:, :3], torch.tensor([0.8, 0.0, 0.0]))
    reached = session.history.curves()["actual"][:, -100:].mean(axis=1)
    assert reached == pytest.approx([0.8, 0.0, 0.0], abs=0.1)
    session.stand()
    assert session.command == [0.0, 0.0, 0.0]


def test_time_passes_as_fast_as_it_is_told_to(session):
    assert session.task.dt == 0.02
    begin = session.time
    assert session.pass_time(0.1) == 5
    assert session.time == pytest.approx(begin + 0.1)
    assert [session.pass_time(0.03), session.pass_time(0.03)] == [1, 2]  # what is left over is not lost
    session.set_speed(2.0)
    assert session.pass_time(0.1) == 10
    session.set_speed(0.5)
    assert session.pass_time(0.08) == 2
    session.set_speed(1000.0)
    assert session.speed == 4.0
    session.set_speed(1.0)
    assert session.pass_time(60.0) == round(BEHIND_S / 0.02)  # a machine that was busy does not race afterwards
    session.running = False
    assert session.pass_time(0.1) == 0
    session.running = True
    assert session.pass_time(0.0) == 0


@pytest.mark.slow
def test_a_machine_that_is_too_slow_is_noticed(session):
    for _ in range(30):
        session.pass_time(0.1)
    assert session.pace == pytest.approx(1.0, abs=0.02)
    for _ in range(9):
        session.pass_time(2.0 * BEHIND_S)  # half of which is never made up for
    assert session.pace == pytest.approx(0.5, abs=0.05)


def test_slow_motion_makes_steps_that_are_longer_than_a_picture(session):
    session.set_speed(0.1)
    assert sum(session.pass_time(1.0 / 30.0) for _ in range(60)) == 10  # 2 s, a tenth of it, in steps of 0.02 s


@pytest.mark.parametrize("everybody", [False, True])
def test_a_push_changes_the_velocity_of_the_base_towards_where_it_was_told(session, everybody):
    session.ask(2, 1.0)
    for _ in range(40):
        session.step()
    session.select(1)
    physics = session.task.physics
    before, pushed = physics.qvel.clone(), [1] if not everybody else [0, 1]
    session.push(90.0, 0.7, everybody)
    change = physics.qvel - before
    left = quat_rotate(physics.qpos[:, 3:7], torch.tensor([[0.0, 1.0, 0.0]]).expand(2, 3))
    for robot in range(2):
        assert float(change[robot, 2:].abs().max()) == 0.0
        asked = 0.7 if robot in pushed else 0.0
        assert float(change[robot, :2].norm()) == pytest.approx(asked, abs=1e-5)
        assert float(change[robot, :2] @ left[robot, :2]) == pytest.approx(asked, abs=0.02)  # it leans a little
    session.push(0.0, 1000.0)
    assert float((physics.qvel - before - change)[1, :2].norm()) == pytest.approx(HARDEST_PUSH, abs=1e-4)


def test_another_robot_has_a_history_of_its_own(session):
    for _ in range(5):
        session.step()
    assert len(session.history.rows) == 5
    session.select(7)
    assert session.followed == 1
    assert len(session.history.rows) == 0


def put(folder: Path, name: str, iteration: int, factor: float = 1.0) -> None:
    """Write the shipped policy as a checkpoint of that iteration, its actor's weights times `factor`."""
    saved = read_checkpoint(POLICY / SHIPPED_MODEL)
    saved["iter"] = iteration
    saved["actor_state_dict"] = {key: factor * value for key, value in saved["actor_state_dict"].items()}
    write_checkpoint(folder / name, saved)


@pytest.fixture
def run(tmp_path) -> Path:
    """A run that has just begun."""
    shutil.copy(POLICY / CONFIG_FILE, tmp_path)
    return tmp_path


@torch.no_grad()
def test_a_training_is_followed_from_before_its_first_checkpoint(run):
    session = session_of(run, 1)
    assert session.iteration is None
    assert "no checkpoint yet" in session.title()
    session.step()
    assert float(session.task.actions.abs().max()) == 0.0  # the default pose
    assert not session.look()

    put(run, "model_50.pt", 50)
    assert session.look()
    assert (session.iteration, session.checkpoint) == (51, run / "model_50.pt")
    assert "iteration 51, written 0 s ago" in session.title()
    session.step()
    before = session.act(session.observations)
    assert float(before.abs().max()) > 0.01
    assert not session.look()

    put(run, "model_100.pt", 100, factor=0.5)
    assert session.look()
    assert session.iteration == 101
    assert not torch.allclose(session.act(session.observations), before)


def test_a_damaged_checkpoint_is_named_and_the_policy_before_stays(run):
    put(run, "model_50.pt", 50)
    session = session_of(run, 1)
    (run / "model_60.pt").write_bytes(b"no checkpoint")
    assert not session.look()
    assert "model_60.pt" in session.problem
    assert session.iteration == 51
    assert not session.look()  # and is not tried again and again
    put(run, "model_70.pt", 70)
    assert session.look()
    assert (session.iteration, session.problem) == (71, "")


def test_the_best_checkpoint_can_be_chosen_and_is_read_again_when_it_is_a_better_one(run):
    put(run, "model_50.pt", 50)
    session = session_of(run, 1)
    assert not session.watched.has_best
    put(run, BEST_MODEL, 20)
    assert session.watched.has_best
    assert not session.look()
    session.follow(BEST)
    assert session.iteration == 21
    put(run, BEST_MODEL, 40, factor=0.9)
    assert session.look()
    assert session.iteration == 41
    session.follow(NEWEST)
    assert session.iteration == 51


def test_a_checkpoint_that_was_asked_for_stays(run):
    put(run, "model_50.pt", 50)
    put(run, "model_60.pt", 60)
    cfg = run_config(run)
    session = Session(Watched(cfg, run, 50), changes_for(cfg, 1, ENGINE), PLANE)
    assert session.iteration == 51
    put(run, BEST_MODEL, 20)
    assert not session.look()
    assert not session.watched.has_best


@pytest.mark.slow
def test_robots_are_put_onto_chosen_tiles_and_keep_their_policy(session):
    assert session.grounds[0] == PLANE
    session.go_to("lava", 0.5)
    assert "'lava'" in session.problem
    assert session.place() == PLANE
    session.go_to("stairs_up", 0.7)
    try:
        assert session.place() == "stairs_up, step height 0.176 m"  # 0.05 + 0.18 * 0.7
        assert session.iteration == POLICY_ITERATION + 1
        tiles = torch.tensor(session.task.terrain.origins[0, :, :2], dtype=torch.float32)
        away = torch.cdist(session.task.base_pos[:, :2], tiles).min(dim=1).values
        assert float(away.max()) < 0.5
        session.step()
        assert len(session.history.rows) == 1
    finally:
        session.go_to(PLANE, None)
    assert session.task.terrain is None
    assert session.place() == PLANE


def test_a_rough_task_begins_on_its_own_types():
    session = session_of(SHIPPED / "anymal_c", 1)
    assert session.grounds[:2] == [OWN, "flat"]
    assert session.place().startswith("stairs_up, step height 0.14 m")
    assert set(session.task.terrain.types) == {k for k, v in session.watched.cfg.terrain.proportions.items() if v > 0.0}


def test_what_makes_no_sense_for_a_task_is_not_there():
    cheetah = session_of(SHIPPED / "half_cheetah", 1)
    assert (cheetah.has_commands, cheetah.can_be_pushed, cheetah.grounds, cheetah.ranges) == (False, False, [OWN], [])
    before = cheetah.task.physics.qvel.clone()
    cheetah.push(0.0, 1.0)
    assert torch.equal(cheetah.task.physics.qvel, before)
    cheetah.step()
    assert cheetah.history.feet == ()
    humanoid = session_of(SHIPPED / "humanoid", 1)
    assert (humanoid.has_commands, humanoid.can_be_pushed, humanoid.grounds) == (False, True, [OWN])
    step = session_of(SHIPPED / "anymal_c_step", 1)
    assert step.grounds == [OWN]
    assert step.command == [pytest.approx(0.6), 0.0, 0.0]  # it never learned to stand
    assert step.task.terrain.types == ("step",)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "0 s ago"), (119.0, "119 s ago"), (600.0, "10 min ago"), (7200.0, "2 h ago"), (8.64e5, "10 days ago")],
)
def test_ages_in_words(seconds, text):
    assert ago(seconds) == text
