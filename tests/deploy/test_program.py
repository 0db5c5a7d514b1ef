"""The robot's program in virtual time: states, ramps and clamps, and what it logs."""

import numpy as np
import pytest
from still_robot import WALKS, spoil, tilted, with_one

from legged.deploy.log import actuator_arrays
from legged.deploy.operators import Event
from legged.deploy.safety import Limits, braking, clamp_targets

DAMPING, STAND, WALK, QUIT = Event.DAMPING, Event.STAND, Event.WALK, Event.QUIT


def test_it_stands_up_walks_and_lies_down_and_is_never_stopped(stage):
    contract = stage.policy.contract
    outcome = stage.run({**WALKS, 5.0: DAMPING, 6.0: QUIT})
    assert outcome.stops == ()
    assert outcome.walked_s == pytest.approx(2.0, abs=0.05)
    assert stage.program.log.notes == ["idle -> damping", "damping -> stand", "stand -> walk", "walk -> damping"]
    assert (outcome.pace.missed, stage.robot.closed, stage.operator.closed) == (0, True, True)
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
    """A second to halt, then 0.3 s to the default pose: after 0.14 s a share of 3 x^2 - 2 x^3 = 0.450 with x = 0.467."""
    stage.run({**WALKS, 4.0: STAND, 5.2: WALK, 5.4: WALK, 7.5: QUIT})
    contract = stage.policy.contract
    at = {round(moment - 100.0, 2): asked for moment, *asked in stage.robot.written}
    np.testing.assert_allclose(at[5.14][0], 0.55 * at[4.98][0] + 0.45 * contract.default, atol=1e-3)
    np.testing.assert_allclose(at[5.3][0], contract.default, atol=1e-9)
    assert stage.program.log.notes[-3:-1] == ["refused: walk: the robot first stands up, for 0.3 s", "stand -> walk"]


def test_a_robot_in_its_default_pose_need_not_stand_up(stage):
    """All its joints are within 0.05 rad of it: no crouch, and walking is possible after 0.3 s, before two legs tip over."""
    contract = stage.policy.contract
    stage.robot.positions = contract.default + 0.04
    stage.run({0.0: DAMPING, 0.1: STAND, 0.3: WALK, 0.44: WALK, 1.0: QUIT})
    asked = {round(moment - 100.0, 2): asked for moment, *asked in stage.robot.written}
    way = np.array([asked[round(moment, 2)][0] - contract.default for moment in np.arange(0.1, 0.43, 0.02)])
    assert (np.abs(way) <= 0.04 + 1e-9).all()
    np.testing.assert_allclose(asked[0.4][0], contract.default, atol=1e-9)
    said = ["damping -> stand", "refused: walk: the robot first stands up, for 0.3 s", "stand -> walk"]
    assert stage.program.log.notes[1:4] == said


def test_it_does_not_walk_when_it_does_not_stand(stage):
    stage.robot.change = with_one("positions", 1.1)  # a leg that is caught
    stage.run({**WALKS, 4.0: QUIT})
    wanted = stage.policy.contract.default[1]
    assert stage.program.log.notes[2] == (
        f"refused: walk: the robot does not stand: LF_HFE is {1.1 - wanted:.2f} rad from its default (allowed: 0.6)"
    )


def test_one_that_has_walked_stands_up_from_its_targets_not_from_its_joints(stage):
    """What carries a robot is how far its targets are from its joints; at its joints they would let it drop."""

    def sag():
        stage.robot.change = spoil(positions=lambda reading: reading.positions - 0.2)

    stage.run({**WALKS, 4.0: STAND, 7.5: QUIT}, {3.5: sag})
    at = {round(moment - 100.0, 2): asked for moment, *asked in stage.robot.written}
    np.testing.assert_allclose(at[5.0][0], at[4.98][0], atol=1e-9)


def test_one_that_walks_halts_before_it_stands(stage):
    """From 0.5 m/s in half a second, and a second more without a command."""
    stage.run({**WALKS, 3.1: (0.5, 0.0, 0.0), 5.0: STAND, 8.9: QUIT})
    cycles = stage.program.log._cycles
    times, commands, states = (np.array(cycles[name]) for name in ("times", "command", "state"))
    np.testing.assert_allclose(commands[np.searchsorted(times, [4.99, 5.25, 5.55]), 0], [0.5, 0.25, 0.0], atol=0.03)
    assert times[np.flatnonzero(states == 3)[-1]] == pytest.approx(6.5, abs=0.05)
    assert stage.program.log.notes[3:5] == ["walk: the robot halts, and then stands", "walk -> stand"]


def test_one_that_halts_can_walk_on_and_can_be_stopped(stage):
    plan = {**WALKS, 3.1: (0.5, 0.0, 0.0), 5.0: STAND, 5.2: WALK, 7.0: STAND, 7.2: Event.STOP, 8.0: QUIT}
    stage.run(plan)
    said = [
        "walk: the robot halts, and then stands",
        "walk: the robot walks on",
        "walk: the robot halts, and then stands",
        "stop: operator: stop",
    ]
    assert stage.program.log.notes[3:7] == said
    cycles = stage.program.log._cycles
    assert cycles["command"][np.searchsorted(cycles["times"], 6.9)][0] == pytest.approx(0.5)


def test_it_does_not_walk_before_it_stands_nor_stand_up_when_something_is_wrong(stage):
    stage.robot.change = tilted(2.0)

    def right():
        stage.robot.change = lambda reading: reading

    stage.run({0.0: STAND, 0.1: DAMPING, 0.5: STAND, 2.0: STAND, 3.0: WALK, 5.0: QUIT}, {1.0: right})
    assert stage.program.log.notes[:5] == [
        "refused: 'stand' is not possible in the state idle",
        "idle -> damping",
        "refused: stand: tilt: 2.00 rad (allowed: 1)",
        "damping -> stand",
        "refused: walk: the robot first stands up, for 2 s",
    ]


def test_before_anything_was_read_it_cannot_stand_up(stage):
    stage.robot.silent = True
    stage.run({0.0: DAMPING, 0.1: STAND, 0.5: QUIT})
    assert stage.program.log.notes[1] == "refused: stand: no data: no reading has arrived yet"


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


def test_a_policy_that_was_never_asked_to_stand_still_can_be_halted(stage):
    """It knows 0.3 to 1 m/s: who asks for less gets the slowest, and from there it takes 0.3 s to no command."""
    stage.policy.contract.command_ranges[0] = [0.3, 1.0]
    stage.run({**WALKS, 3.2: (0.1, 0.0, 0.0), 4.0: (0.0, 0.0, 0.0), 5.0: (0.1, 0.0, 0.0), 6.0: STAND, 8.0: QUIT})
    cycles = stage.program.log._cycles
    times, commands, states = (np.array(cycles[name]) for name in ("times", "command", "state"))
    forward = commands[np.searchsorted(times, [3.1, 3.9, 4.15, 4.9, 5.9]), 0]
    np.testing.assert_allclose(forward, [0.0, 0.3, 0.15, 0.0, 0.3], atol=0.03)
    assert times[np.flatnonzero(states == 3)[-1]] == pytest.approx(7.3, abs=0.05)
    assert stage.program.log.notes[3:5] == ["walk: the robot halts, and then stands", "walk -> stand"]


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


def test_the_log_for_fitting_is_even_and_cut_where_a_reading_is_lost(stage, tmp_path):
    """It follows targets from 0.5 s to 4 s, 50 readings a second; that at 2 s and all from 3.1 to 3.3 s are lost."""
    lost = {100, *range(155, 166)}
    stage.robot.change = lambda reading: [] if round((reading.time - 100.0) / 0.02) in lost else reading
    stage.policy.contract.stiffness[:] = 60.0
    stage.run({**WALKS, 4.0: DAMPING, 5.0: QUIT}, limits=Limits(max_age_s=0.4))
    stage.program.log.save(tmp_path / "log.npz")
    log = np.load(tmp_path / "log_actuators.npz", allow_pickle=False)
    assert set(log.files) == {
        *("joint_names", "dt", "run", "target", "position", "velocity", "torque", "stiffness", "damping")
    }
    assert log["dt"] == pytest.approx(0.02)
    # A reading counts when the gains were told before it: from 0.52 s to 4.00 s.
    np.testing.assert_array_equal(np.bincount(log["run"]), [99 - 26 + 1, 154 - 101 + 1, 200 - 166 + 1])
    assert log["target"].shape == log["torque"].shape == (len(log["run"]), 12)
    np.testing.assert_allclose(log["position"], log["target"], atol=1e-12)  # as this robot does
    assert (log["stiffness"] == 60.0).all()


@pytest.mark.parametrize(
    ("milliseconds", "dt", "runs"),
    [
        (np.floor(2.5 * np.arange(400)), 0.0025, [400]),  # 400 Hz by a clock that counts milliseconds: 2 and 3 in turn
        (np.repeat(4.0 * np.arange(200), 2), 0.004, [200]),  # each measurement sent twice
        (4.0 * np.delete(np.arange(400), 100), 0.004, [100, 299]),
    ],
    ids=["coarse clock", "sent twice", "one lost"],
)
def test_the_step_of_the_log_for_fitting_is_that_of_the_measurements(stage, milliseconds, dt, runs):
    contract = stage.policy.contract
    rows = np.zeros((len(milliseconds), 12))
    log = {name: rows for name in ("positions", "velocities", "torques", "targets")}
    log |= {"stiffness": rows + contract.stiffness, "damping": rows + contract.damping, "times": 1e-3 * milliseconds}
    found = actuator_arrays(log, contract)
    assert found["dt"] == pytest.approx(dt, rel=1e-3)
    np.testing.assert_array_equal(np.bincount(found["run"]), runs)


def test_a_robot_that_never_stood_up_leaves_nothing_to_fit_to(stage, tmp_path):
    (tmp_path / "log_actuators.npz").write_bytes(b"of the run before")
    stage.run({0.0: DAMPING, 1.0: QUIT})
    stage.program.log.save(tmp_path / "log.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["log.npz"]


def test_the_log_has_what_an_actuator_can_be_fitted_to(stage, tmp_path):
    def warm():
        stage.robot.change = spoil(temperatures=lambda _: np.full(12, 40.0))

    stage.run({**WALKS, 4.0: QUIT}, {3.5: warm})
    stage.program.log.save(tmp_path / "new" / "log.npz")
    log = np.load(tmp_path / "new" / "log.npz", allow_pickle=False)
    length = len(log["times"])
    for name in ("targets", "positions", "velocities", "torques", "stiffness", "damping"):
        assert log[name].shape == (length, 12)
    assert np.isnan(log["temperatures"][0]).all()
    assert (log["temperatures"][-1] == 40.0).all()
    assert log["state"].shape == (length,)
    assert [str(log["states"][i]) for i in np.unique(log["state"])] == ["idle", "damping", "stand", "walk"]
    walking = log["state"] == list(log["states"]).index("walk")
    # Of this robot joints are at once where they were asked to be: a reading's target is the last one before it.
    np.testing.assert_allclose(log["positions"][walking], log["targets"][walking], atol=1e-12)
    assert log["cycle_observation"].shape == (len(log["cycle_times"]), 90)
    assert list(log["notes"][:2]) == ["idle -> damping", "damping -> stand"]
    assert list(log["joint_names"]) == list(stage.policy.contract.joint_names)
