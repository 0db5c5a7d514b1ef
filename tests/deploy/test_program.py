"""The robot's program in virtual time: states, every stop and its reason, ramps and clamps, and what it logs."""

from dataclasses import replace

import numpy as np
import pytest
from still_robot import BLIND, Stage, exported, facts_for

from legged.deploy.policy import Policy
from legged.deploy.safety import Limits, braking, clamp_targets
from legged.deploy.states import TRANSITIONS, Event, State, next_state

DAMPING, STAND, WALK, STOP, QUIT, IDLE = Event.DAMPING, Event.STAND, Event.WALK, Event.STOP, Event.QUIT, Event.IDLE
WALKS = {0.0: DAMPING, 0.5: STAND, 3.0: WALK}
"""From 3 s on the policy acts."""


@pytest.fixture(scope="module")
def folder(policy_folder):
    return policy_folder


@pytest.fixture
def stage(folder):
    return Stage(folder)


def test_it_stands_up_walks_and_lies_down_and_is_never_stopped(stage):
    contract = stage.policy.contract
    outcome = stage.run({**WALKS, 5.0: DAMPING, 6.0: QUIT})
    assert outcome.stops == ()
    assert outcome.walked_s == pytest.approx(2.0, abs=0.05)
    assert stage.program.log.notes == ["idle -> damping", "damping -> stand", "stand -> walk", "walk -> damping"]
    assert (outcome.cycles.missed, stage.robot.closed, stage.operator.closed) == (0, True, True)
    at = {round(moment - 100.0, 2): asked for moment, *asked in stage.robot.written}
    np.testing.assert_array_equal(at[0.2][2], braking(contract))
    assert not at[0.2][1].any()
    # Of the 2 s that standing up takes, joints move to the crouch in the first half, and half way there in half of that.
    np.testing.assert_allclose(at[1.0][0], 0.5 * (contract.default + 0.1 + contract.crouch), atol=1e-9)
    np.testing.assert_allclose(at[1.5][0], contract.crouch, atol=1e-9)
    np.testing.assert_allclose(at[2.0][0], 0.5 * (contract.crouch + contract.default), atol=1e-9)
    np.testing.assert_allclose(at[2.5][0], contract.default, atol=1e-9)
    np.testing.assert_array_equal(at[2.5][1], contract.stiffness)
    np.testing.assert_array_equal(at[4.0][2], contract.damping)
    np.testing.assert_array_equal(stage.robot.written[-1][3], braking(contract))


def test_the_policy_gets_what_it_would_in_training_and_targets_follow_from_its_actions(stage):
    """With joints that are where they were asked to be, everything in the observation is known."""
    stage.run({**WALKS, 4.0: QUIT})
    contract, log = stage.policy.contract, stage.program.log
    walking = [i for i, state in enumerate(log._cycles["state"]) if state == 3]
    seen = [log._cycles["observation"][i] for i in walking[:2]]
    acted = [log._cycles["actions"][i] for i in walking[:2]]
    first = np.concatenate([np.zeros(3), [0.0, 0.0, -1.0], np.zeros(3), np.zeros(36)])
    np.testing.assert_allclose(seen[0], np.tile(first, 2), atol=1e-6)  # the first observation fills the history
    np.testing.assert_allclose(seen[1][:45], first, atol=1e-6)
    np.testing.assert_allclose(seen[1][-12:], acted[0], atol=1e-6)
    np.testing.assert_allclose(seen[1][45 + 9 : 45 + 21], 0.5 * acted[0], atol=1e-6)
    np.testing.assert_allclose(log._cycles["targets"][walking[0]], contract.default + 0.5 * acted[0], atol=1e-6)


def test_a_robot_that_has_walked_stands_without_a_crouch(stage):
    stage.run({**WALKS, 4.0: STAND, 6.5: QUIT})
    contract = stage.policy.contract
    at = {round(moment - 100.0, 2): asked for moment, *asked in stage.robot.written}
    np.testing.assert_allclose(at[5.0][0], 0.5 * (at[3.98][0] + contract.default), atol=1e-9)


def spoil(**changes):
    return lambda reading: replace(reading, **{name: make(reading) for name, make in changes.items()})


def tilted(angle):
    return spoil(quaternion=lambda _: np.array([np.cos(0.5 * angle), np.sin(0.5 * angle), 0.0, 0.0]))


def with_one(name, value):
    def make(reading):
        values = getattr(reading, name).copy()
        values[1] = value
        return values

    return spoil(**{name: make})


CHANGES = {
    "tilt: 1.10 rad (allowed: 1)": tilted(1.1),
    "non-finite data: quaternion": with_one("quaternion", np.nan),
    "non-finite data: gyro": with_one("gyro", np.inf),
    "non-finite data: joint positions": with_one("positions", np.nan),
    "non-finite data: joint velocities": with_one("velocities", -np.inf),
    "quaternion: its norm is 0, not 1": spoil(quaternion=lambda _: np.zeros(4)),
    "joint speed: LF_HFE turns at -24.1 rad/s (allowed: 24.0)": with_one("velocities", -24.1),
    "temperature: LF_HFE has 95 degrees (allowed: 90)": spoil(temperatures=lambda _: np.array([20.0, 95.0] + [20.0] * 10)),
    "remote control: the operator asks for a stop": spoil(stop=lambda _: True),
}


@pytest.mark.parametrize("moment", [1.0, 4.0], ids=["standing up", "walking"])
@pytest.mark.parametrize("reason", CHANGES)
def test_what_it_reads_stops_it_and_it_says_why(stage, reason, moment):
    def begin():
        stage.robot.change = CHANGES[reason]

    outcome = stage.run({**WALKS, 6.0: QUIT}, {moment: begin})
    assert outcome.stops == (reason,)
    assert any(text.endswith(f"stop: {reason}") for text in stage.told)
    after = [asked for at, *asked in stage.robot.written if at > 100.0 + moment + 0.03]
    assert not any(stiffness.any() for _, stiffness, _ in after), "joints are braked, not moved"
    assert all((damping == braking(stage.policy.contract)).all() for _, _, damping in after)
    assert all(np.isfinite(positions).all() for positions, _, _ in after)


@pytest.mark.parametrize("reason", [reason for reason in CHANGES if "tilt" in reason or "joint speed" in reason])
def test_what_is_just_allowed_stops_nothing(stage, reason):
    def begin():
        stage.robot.change = tilted(0.99) if "tilt" in reason else with_one("velocities", -23.9)

    assert stage.run({**WALKS, 5.0: QUIT}, {4.0: begin}).stops == ()


def test_silence_stops_it(stage):
    def begin():
        stage.robot.silent = True

    stage.run({**WALKS, 5.0: QUIT}, {4.0: begin})
    # The last reading came at 4.00 s; at 4.06 s it is older than 50 ms.
    assert stage.outcome.stops == ("stale data: the newest reading is 60 ms old (allowed: 50 ms)",)


@pytest.mark.parametrize(("count", "stops"), [(5, True), (4, False)])
def test_deadlines_missed_in_a_row_stop_it(stage, count, stops):
    def slow():
        stage.time.now += 0.025  # of a cycle of 20 ms

    does = {4.0 + 0.025 * i: slow for i in range(count)}
    outcome = stage.run({**WALKS, 6.0: QUIT}, does)
    assert outcome.cycles.missed == count
    assert outcome.cycles.longest == pytest.approx(0.025)
    assert outcome.stops == (("missed deadlines: 5 in a row (allowed: 4)",) if stops else ())


def test_an_operator_who_is_gone_stops_it(stage):
    def unplug():
        stage.operator.lost = "/dev/input/js0 is closed"

    assert stage.run({**WALKS, 5.0: QUIT}, {4.0: unplug}).stops == ("operator lost: /dev/input/js0 is closed",)


def test_an_output_that_is_no_number_stops_it(stage, monkeypatch):
    def begin():
        monkeypatch.setattr(stage.policy, "act", lambda *_: np.full(12, np.nan))

    assert stage.run({**WALKS, 5.0: QUIT}, {4.0: begin}).stops == ("non-finite output of the policy",)
    assert all(np.isfinite(asked).all() for _, *row in stage.robot.written for asked in row)


def test_the_operator_stops_it_and_it_goes_on_only_by_damping(stage):
    plan = {**WALKS, 4.0: STOP, 4.5: WALK, 5.0: STAND, 5.5: DAMPING, 6.0: STAND, 8.5: WALK, 9.0: QUIT}
    outcome = stage.run(plan)
    assert outcome.stops == ("operator: stop",)
    assert stage.program.log.notes[3:] == [
        "stop: operator: stop",
        "walk -> stop",
        "refused: 'walk' leads nowhere from stop",
        "refused: 'stand' leads nowhere from stop",
        "stop -> damping",
        "damping -> stand",
        "stand -> walk",
        "walk -> damping",
    ]


def test_it_does_not_walk_before_it_stands_nor_stand_up_when_something_is_wrong(stage):
    stage.robot.change = tilted(2.0)

    def right():
        stage.robot.change = lambda reading: reading

    stage.run({0.0: STAND, 0.1: DAMPING, 0.5: STAND, 2.0: STAND, 3.0: WALK, 5.0: QUIT}, {1.0: right})
    assert stage.program.log.notes[:5] == [
        "refused: 'stand' leads nowhere from idle",
        "idle -> damping",
        "refused: stand: tilt: 2.00 rad (allowed: 1)",
        "damping -> stand",
        "refused: walk: it stands up for 2 s first",
    ]


def test_before_anything_was_read_it_cannot_stand_up(stage):
    stage.robot.silent = True
    stage.run({0.0: DAMPING, 0.1: STAND, 0.5: QUIT})
    assert stage.program.log.notes[1] == "refused: stand: no data: nothing has been read yet"


def test_every_state_leads_to_stop_and_stop_only_to_damping():
    assert all(next_state(state, STOP) is State.STOP for state in State)
    assert {event for state, event in TRANSITIONS if state is State.STOP} == {STOP, DAMPING}
    assert {state for (state, event) in TRANSITIONS if event is WALK} == {State.STAND}


def test_commands_are_ramped_and_stay_within_what_the_policy_knows(stage):
    """Forward up to 1.1 m/s, to the right up to 0.4 m/s, turning up to 0.7 rad/s, and not below 0.1 m/s."""
    stage.run({**WALKS, 3.2: (5.0, -0.1, -9.0), 6.0: (0.05, 0.05, 0.0), 8.0: QUIT})
    cycles = stage.program.log._cycles
    walking = np.array(cycles["state"]) == 3
    times, commands = np.array(cycles["times"])[walking], np.array(cycles["command"])[walking]
    steps = np.abs(np.diff(commands, axis=0)).max(axis=0)
    assert (steps <= np.array([0.02, 0.02, 0.04]) + 1e-9).all()
    np.testing.assert_allclose(commands[np.searchsorted(times, 3.2 + 0.5) - 1], [0.5, -0.1, -0.7], atol=0.05)
    np.testing.assert_allclose(commands[np.searchsorted(times, 5.9)], [1.1, -0.1, -0.7], atol=1e-6)
    # Slower than the policy was ever asked to walk: nothing.
    np.testing.assert_allclose(commands[np.searchsorted(times, 7.9)], [0.0, 0.0, 0.0], atol=1e-9)


def test_targets_are_clamped_by_hand(stage):
    """ANYmal's joints: 90 N m/rad, 4 N m s/rad, 80 N m; the first turns from -0.72 to 0.49 rad."""
    contract = stage.policy.contract
    q, dq, wanted = np.zeros(12), np.zeros(12), np.zeros(12)
    wanted[0], wanted[1], wanted[2] = 0.6, 2.0, -2.0
    dq[2] = 5.0
    found = clamp_targets(wanted, q, dq, contract)
    assert found[0] == pytest.approx(0.49)
    assert found[1] == pytest.approx(80.0 / 90.0)
    assert found[2] == pytest.approx((4.0 * 5.0 - 80.0) / 90.0)
    np.testing.assert_array_equal(found[3:], 0.0)


def test_clamped_targets_never_ask_for_more_torque_than_there_is(stage):
    contract, rng = stage.policy.contract, np.random.default_rng(3)
    for _ in range(200):
        q, dq, wanted = rng.normal(0.0, [[1.0], [10.0], [3.0]], (3, 12))
        torques = contract.stiffness * (clamp_targets(wanted, q, dq, contract) - q) - contract.damping * dq
        assert (np.abs(torques) <= contract.torque_limits + 1e-9).all()


def test_limits_can_be_others(stage):
    def lean():
        stage.robot.change = tilted(0.5)

    assert stage.run({**WALKS, 5.0: QUIT}, {4.0: lean}, limits=Limits(max_tilt=0.4)).stops == (
        "tilt: 0.50 rad (allowed: 0.4)",
    )


def test_whatever_fails_the_robot_is_braked_and_let_go_of(stage, monkeypatch):
    def begin():
        monkeypatch.setattr(stage.policy, "act", lambda *_: 1 / 0)

    with pytest.raises(ZeroDivisionError):
        stage.run({**WALKS, 5.0: QUIT}, {4.0: begin})
    assert stage.robot.closed
    assert stage.operator.closed
    assert not stage.robot.written[-1][2].any()
    np.testing.assert_array_equal(stage.robot.written[-1][3], braking(stage.policy.contract))


def test_the_log_has_what_an_actuator_can_be_fitted_to(stage, tmp_path):
    stage.run({**WALKS, 4.0: QUIT})
    stage.program.log.save(tmp_path / "new" / "log.npz")
    log = np.load(tmp_path / "new" / "log.npz", allow_pickle=False)
    length = len(log["times"])
    for name in ("targets", "positions", "velocities", "torques", "stiffness", "damping"):
        assert log[name].shape == (length, 12)
    assert log["state"].shape == (length,)
    assert [str(log["states"][i]) for i in np.unique(log["state"])] == ["idle", "damping", "stand", "walk"]
    walking = log["state"] == list(log["states"]).index("walk")
    # Of this robot joints are at once where they were asked to be: a reading's target is the last one before it.
    np.testing.assert_allclose(log["positions"][walking], log["targets"][walking], atol=1e-12)
    assert log["cycle_observation"].shape == (len(log["cycle_times"]), 90)
    assert list(log["notes"][:2]) == ["idle -> damping", "damping -> stand"]
    assert list(log["joint_names"]) == list(stage.policy.contract.joint_names)


def test_a_policy_that_needs_a_source_stops_when_it_falls_silent(tmp_path):
    folder = exported(tmp_path, ("observations.actor", ["base_lin_vel", *dict(BLIND)["observations.actor"]]))
    facts = facts_for(Policy(folder).contract, offers=frozenset({"base_lin_vel"}))
    stage = Stage(folder, facts)
    speaks = spoil(sources=lambda _: {"base_lin_vel": np.array([0.3, 0.0, 0.0])})
    stage.robot.change = speaks

    def silence():
        stage.robot.change = lambda reading: reading

    outcome = stage.run({**WALKS, 5.0: QUIT}, {4.0: silence})
    assert stage.robot.asked == {"base_lin_vel": None}
    assert outcome.stops == ("missing data: source base_lin_vel",)
    seen = next(row for row in stage.program.log._cycles["observation"] if np.isfinite(row).all())
    np.testing.assert_allclose(seen[:3], [0.6, 0.0, 0.0], atol=1e-6)
