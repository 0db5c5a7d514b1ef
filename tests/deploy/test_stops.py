"""What stops the robot's program, in virtual time, and that it says why; what stops nothing; and how it ends."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from helpers import HANG_S
from still_robot import BLIND, WALKS, Stage, exported, facts_for, spoil, tilted, with_one

from legged.deploy.operators import TRANSITIONS, Event, State
from legged.deploy.pace import StatusMessages
from legged.deploy.policy import Policy
from legged.deploy.safety import Limits, braking

DAMPING, STAND, WALK, STOP, QUIT = Event.DAMPING, Event.STAND, Event.WALK, Event.STOP, Event.QUIT


CHANGES = {
    "tilt: 1.10 rad (allowed: 1)": tilted(1.1),
    "non-finite data: quaternion": with_one("quaternion", np.nan),
    "non-finite data: gyro": with_one("gyro", np.inf),
    "non-finite data: joint positions": with_one("positions", np.nan),
    "non-finite data: joint velocities": with_one("velocities", -np.inf),
    "quaternion: its norm is 0, not 1": spoil(quaternion=lambda _: np.zeros(4)),
    "joint speed: LF_HFE turns at -48.1 rad/s (allowed: 24.0 rad/s for 40 ms)": with_one("velocities", -48.1),
    "joint position: LF_HFE is at 9.64 rad (its limits: -9.42 to 9.42)": with_one("positions", 9.64),
    "non-finite data: joint positions ": with_one("positions", np.inf),
    "temperature: LF_HFE has 95 degrees (allowed: 90)": spoil(temperatures=lambda _: np.array([20.0, 95.0] + [20.0] * 10)),
    "remote control: the operator asks for a stop": spoil(stop=lambda _: True),
}


@pytest.mark.slow
@pytest.mark.parametrize("moment", [1.0, 4.0], ids=["standing up", "walking"])
@pytest.mark.parametrize("reason", CHANGES)
def test_what_it_reads_stops_it_and_it_says_why(stage, reason, moment):
    def begin():
        stage.robot.change = CHANGES[reason]

    outcome = stage.run({**WALKS, 6.0: QUIT}, {moment: begin})
    assert outcome.stops == (reason.rstrip(),)
    assert any(text.endswith(f"stop: {reason.rstrip()}") for text in stage.told)
    after = [asked for at, *asked in stage.robot.written if at > 100.0 + moment + 0.03]
    assert not any(stiffness.any() for _, stiffness, _ in after), "joints are braked, not moved"
    assert all((damping == braking(stage.policy.contract)).all() for _, _, damping in after)
    assert all(np.isfinite(positions.astype(np.float32)).all() for positions, _, _ in after), "0 times infinity is no torque"


@pytest.mark.parametrize("reason", [reason for reason in CHANGES if "tilt" in reason or "joint speed" in reason])
def test_what_is_just_allowed_stops_nothing(stage, reason):
    def begin():
        stage.robot.change = tilted(0.99) if "tilt" in reason else with_one("velocities", -23.9)

    assert stage.run({**WALKS, 5.0: QUIT}, {4.0: begin}).stops == ()


@pytest.mark.parametrize(
    ("pattern", "stops"),
    [("x", True), ("x.........", False), ("xx..", True), ("x.", True)],
    ids=["always", "for an instant", "half of the time in pairs", "every other reading: it hums"],
)
def test_a_joint_that_is_too_fast_for_more_than_an_instant_stops_it(stage, pattern, stops):
    """1.2 times 20 rad/s are allowed, and 24.1 for 40 ms; an instant is taken back four times as slowly as it passed."""
    count = 0

    def changed(reading):
        nonlocal count
        count += 1
        return with_one("velocities", 24.1)(reading) if pattern[count % len(pattern)] == "x" else reading

    def begin():
        stage.robot.change = changed

    outcome = stage.run({**WALKS, 5.5: QUIT}, {4.0: begin})
    assert outcome.stops == (("joint speed: LF_HFE has been faster for too long (allowed: 24.0 rad/s for 40 ms)",) * stops)


def test_a_measurement_that_is_sent_again_and_again_is_as_old_as_the_first_time(stage):
    """A robot whose sensors have died may go on sending what they said last."""

    def freeze():
        last = stage.time.now
        stage.robot.change = lambda reading: replace(reading, time=last)

    stage.run({**WALKS, 5.0: QUIT}, {4.0: freeze})
    assert stage.program.stops == ("stale data: the newest reading is 60 ms old (allowed: 50 ms)",)


def test_a_robot_without_a_clock_can_walk(stage):
    stage.robot.change = lambda reading: replace(reading, time=0.0)
    assert stage.run({**WALKS, 4.0: QUIT}).stops == ()
    assert stage.program.walked_s > 0.9


def test_a_stop_that_one_reading_of_a_cycle_asks_for_is_heard(stage):
    def press():
        def pressed(reading):
            stage.robot.change = lambda reading: reading
            before = replace(reading, time=reading.time - 0.01, received=reading.received - 0.01)
            return [replace(before, stop=True), reading]

        stage.robot.change = pressed

    assert stage.run({**WALKS, 5.0: QUIT}, {4.0: press}).stops == ("remote control: the operator asks for a stop",)


def test_silence_stops_it(stage):
    def begin():
        stage.robot.silent = True

    stage.run({**WALKS, 5.0: QUIT}, {4.0: begin})
    # The last reading came at 4.00 s; at 4.06 s it is older than 50 ms.
    assert stage.program.stops == ("stale data: the newest reading is 60 ms old (allowed: 50 ms)",)


@pytest.mark.parametrize(("count", "stops"), [(5, True), (4, False)])
def test_deadlines_missed_in_a_row_stop_it(stage, count, stops):
    def slow():
        stage.time.now += 0.021  # of a cycle of 20 ms

    does = {4.0 + 0.021 * i: slow for i in range(count)}
    outcome = stage.run({**WALKS, 6.0: QUIT}, does)
    assert outcome.pace.missed == count
    assert max(outcome.pace.took) == pytest.approx(0.021)
    assert outcome.stops == (("missed deadlines: 5 in a row (allowed: 4)",) if stops else ())


def test_one_long_hang_is_as_many_deadlines_as_it_takes(stage):
    """0.11 s in one cycle of 20 ms: five other cycles should have begun."""

    def hang():
        stage.time.now += 0.11

    outcome = stage.run({**WALKS, 6.0: QUIT}, {4.0: hang})
    assert outcome.stops == ("missed deadlines: 5 in a row (allowed: 4)",)
    assert outcome.pace.missed == 5


def test_an_operator_who_is_gone_stops_it(stage):
    def unplug():
        stage.operator.lost = "/dev/input/js0 is closed"

    assert stage.run({**WALKS, 5.0: QUIT}, {4.0: unplug}).stops == ("operator lost: /dev/input/js0 is closed",)


def test_an_output_that_is_no_number_stops_it(stage, monkeypatch):
    def begin():
        monkeypatch.setattr(stage.policy, "act", lambda *_: np.full(12, np.nan))

    assert stage.run({**WALKS, 5.0: QUIT}, {4.0: begin}).stops == ("non-finite output of the policy",)
    assert all(np.isfinite(asked).all() for _, *row in stage.robot.written for asked in row)


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_an_infinite_action_is_not_taken_for_the_largest_one(stage, monkeypatch, value):
    def begin():
        monkeypatch.setattr(stage.policy._network, "run", lambda _: np.array([value] + [0.0] * 11, dtype=np.float32))

    assert stage.run({**WALKS, 5.0: QUIT}, {4.0: begin}).stops == ("non-finite output of the policy",)
    assert not any(stiffness.any() for moment, _, stiffness, _ in stage.robot.written if moment > 103.99)


def test_the_operator_stops_it_and_it_goes_on_only_by_damping(stage):
    plan = {**WALKS, 4.0: STOP, 4.5: WALK, 5.0: STAND, 5.5: DAMPING, 6.0: STAND, 8.5: WALK, 9.0: QUIT}
    outcome = stage.run(plan)
    assert outcome.stops == ("operator: stop",)
    assert stage.program.log.notes[3:] == [
        "stop: operator: stop",
        "walk -> stop",
        "refused: 'walk' is not possible in the state stop",
        "refused: 'stand' is not possible in the state stop",
        "stop -> damping",
        "damping -> stand",
        "stand -> walk",
        "walk -> damping",
    ]


def test_every_state_leads_to_stop_and_stop_only_to_damping():
    assert all(STOP in TRANSITIONS[state] for state in State)
    assert {*TRANSITIONS[State.STOP]} == {STOP, DAMPING}
    assert [state for state, events in TRANSITIONS.items() if WALK in events] == [State.STAND]


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
    failed = [asked for moment, *asked in stage.robot.written if moment > 103.99]
    assert len(failed) == 50, "one command may get lost: it is braked for a second"
    for _, stiffness, damping in failed:
        assert not stiffness.any()
        np.testing.assert_array_equal(damping, braking(stage.policy.contract))


def test_a_robot_that_takes_nothing_any_more_is_let_go_of(stage, monkeypatch):
    def begin():
        monkeypatch.setattr(stage.robot, "write", lambda *_: 1 / 0)

    with pytest.raises(ZeroDivisionError):
        stage.run({**WALKS, 5.0: QUIT}, {4.0: begin})
    assert stage.robot.closed
    assert stage.operator.closed


def test_a_terminal_that_is_held_or_closed_holds_nothing_up():
    held, said = threading.Event(), []

    def say(line):
        assert held.wait(HANG_S)
        said.append(line)
        if line == "b":
            raise BrokenPipeError

    tell = StatusMessages(say)
    for line in "abc":
        tell(line)
    assert said == []  # the terminal is held still
    held.set()
    tell.close()
    assert said == ["a", "b", "c"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("after", "says"),
    [(lambda reading: reading, ""), (spoil(sources=lambda _: {"base_lin_vel": np.zeros(2)}), " has 2 numbers, not 3")],
    ids=["silent", "too short"],
)
def test_a_policy_that_needs_a_source_stops_when_it_gives_nothing_more(tmp_path, after, says):
    folder = exported(
        tmp_path, ("observations.groups.actor.terms", ["base_lin_vel", *dict(BLIND)["observations.groups.actor.terms"]])
    )
    facts = facts_for(Policy(folder).contract, offers=frozenset({"base_lin_vel"}))
    stage = Stage(folder, facts)
    speaks = spoil(sources=lambda _: {"base_lin_vel": np.array([0.3, 0.0, 0.0])})
    stage.robot.change = speaks

    def change():
        stage.robot.change = after

    outcome = stage.run({**WALKS, 5.0: QUIT}, {4.0: change})
    assert stage.robot.asked == {"base_lin_vel": None}
    assert outcome.stops == (f"missing data: source base_lin_vel{says}",)
    seen = next(row for row in stage.program.log._cycles["observation"] if np.isfinite(row).all())
    np.testing.assert_allclose(seen[:3], [0.6, 0.0, 0.0], atol=1e-6)
