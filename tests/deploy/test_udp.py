"""A robot behind UDP: packets there and back, what gets lost, comes late or is none of ours."""

import itertools
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import HANG_S, until
from still_robot import facts_for

from legged.deploy import udp
from legged.deploy.contract import read_contract
from legged.deploy.interface import Reading
from legged.deploy.safety import braking
from legged.deploy.udp import (
    BYE,
    COMMAND,
    FACTS,
    HELLO,
    STATE,
    UdpRobot,
    open_packet,
    pack_command,
    pack_facts,
    pack_sources,
    pack_state,
    packet,
    unpack_command,
    unpack_facts,
    unpack_sources,
    unpack_state,
)
from legged.errors import ConfigError, RunError


def state(time=1.5, **sources):
    ramp = np.arange(12.0)
    upright, gyro = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.1, 0.2, 0.3])
    return Reading(time, 0.0, upright, gyro, ramp, 2.0 * ramp, 3.0 * ramp, sources=sources)


def test_a_state_comes_out_as_it_went_in():
    sent = state(heights=np.array([-0.5, 0.25]), base_lin_vel=np.array([1.0, 2.0, 4.0]))
    found = unpack_state(pack_state(sent), 2.5)
    assert (found.time, found.received) == (1.5, 2.5)
    for name in ("quaternion", "gyro", "positions", "velocities", "torques"):
        np.testing.assert_allclose(getattr(found, name), getattr(sent, name), rtol=1e-6)
    assert found.sources.keys() == {"heights", "base_lin_vel"}
    np.testing.assert_array_equal(found.sources["heights"], [-0.5, 0.25])


def test_no_other_bytes_are_a_state_or_a_command():
    whole = pack_state(state(heights=np.array([1.0, 2.0])))
    for length in range(len(whole)):
        with pytest.raises(ValueError, match=r"."):
            unpack_state(whole[:length], 0.0)
    with pytest.raises(ValueError, match="length"):
        unpack_state(whole + b"x", 0.0)
    command = pack_command(7, *np.ones((3, 12)))
    assert unpack_command(command)[0] == 7
    for length in range(len(command)):
        with pytest.raises(ValueError, match=r"."):
            unpack_command(command[:length])
    with pytest.raises(ValueError, match="numbers"):
        unpack_command(pack_command(7, np.full(12, np.nan), *np.ones((2, 12))))
    assert open_packet(b"") is None
    assert open_packet(b"something else, long enough") is None


def test_facts_come_out_as_they_went_in(policy_folder):
    limits = read_contract(policy_folder / "policy.json").position_limits.copy()
    limits[3] = -np.inf, np.inf
    facts = facts_for(read_contract(policy_folder / "policy.json"), position_limits=limits, offers=frozenset({"heights"}))
    found = unpack_facts(pack_facts(facts))
    assert (found.name, found.joint_names, found.imu_body, found.offers) == ("still", facts.joint_names, "base", {"heights"})
    np.testing.assert_array_equal(found.position_limits, limits)
    np.testing.assert_array_equal(found.torque_limits, facts.torque_limits)


@pytest.mark.parametrize(
    "changes",
    [
        {"torque_limits": [1.0]},
        {"position_limits": [[0.0, 1.0]]},
        {"joint_names": 3},
        {"velocity_limits": None},
        {"name": {}},
    ],
    ids=["torques", "positions", "names", "velocities", "none"],
)
def test_what_are_no_facts_is_refused(policy_folder, changes):
    said = json.loads(pack_facts(facts_for(read_contract(policy_folder / "policy.json"))))
    said |= changes
    if "name" in changes:
        del said["imu_body"]
    with pytest.raises((ValueError, KeyError, TypeError)):
        unpack_facts(json.dumps(said).encode())


def test_a_greeting_comes_out_as_it_went_in():
    found = unpack_sources(pack_sources({"heights": np.array([[0.5, 0.0]]), "base_lin_vel": None}))
    assert found["base_lin_vel"] is None
    np.testing.assert_array_equal(found["heights"], [[0.5, 0.0]])


HUGE, DEEP = b"1" * 400, b"[" * 25_000


@pytest.mark.parametrize("body", [DEEP, b"[]", b'{"sources": %s}' % HUGE, b'{"sources": {"x": [[%s, 1]]}}' % HUGE])
@pytest.mark.parametrize("unpack", [unpack_sources, unpack_facts])
def test_numbers_and_depth_of_a_packet_end_in_errors_that_are_expected(unpack, body):
    """One packet once ended the simulated robot: nested too deeply, or with numbers beyond float64."""
    with pytest.raises((ValueError, KeyError, TypeError, AttributeError)):
        unpack(body)


@pytest.mark.parametrize("point", ["NaN", "Infinity", "1e999"])
def test_points_that_are_not_finite_are_refused(point):
    with pytest.raises(ValueError, match="heights: its points are not finite"):
        unpack_sources(b'{"sources": {"heights": [[0.0, %s]]}}' % point.encode())


class Answers:
    """What greets back, and then sends what the test tells it to."""

    def __init__(self, facts):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.02)
        self.address = f"127.0.0.1:{self.socket.getsockname()[1]}"
        self.facts, self.heard, self.client, self.ends = facts, [], None, False
        self.thread = threading.Thread(target=self.listen)
        self.thread.start()

    def listen(self):
        while True:
            if self.ends:
                self.socket.settimeout(0.0)  # what has arrived by then is heard, though this thread may come late to it
            try:
                data, self.client = self.socket.recvfrom(60_000)
            except TimeoutError:
                continue
            except BlockingIOError:
                return
            opened = open_packet(data)
            self.heard.append(opened)
            if opened[0] == HELLO:
                self.socket.sendto(packet(FACTS, 0, pack_facts(self.facts)), self.client)

    def send(self, *packets):
        for data in packets:
            self.socket.sendto(data, self.client)
        time.sleep(0.01)

    def end(self):
        self.ends = True
        self.thread.join()
        self.socket.close()


@pytest.fixture
def link(policy_folder):
    """The program's side and the robot's."""
    there = Answers(facts_for(read_contract(policy_folder / "policy.json"), offers=frozenset({"heights"})))
    robot = UdpRobot(there.address)
    yield robot, there
    robot.close()
    there.end()


def test_readings_are_the_newest_states_in_order(link):
    robot, there = link
    assert robot.read() == []
    later = packet(STATE, 5, pack_state(state(2.0)))
    there.send(packet(STATE, 3, pack_state(state(1.0))), later, packet(STATE, 4, pack_state(state(1.5))), later)
    assert [reading.time for reading in robot.read()] == [1.0, 2.0], "what comes too late or twice is left out"
    there.send(b"noise", packet(STATE, 6, b"cut short"), packet(STATE, 7, pack_state(state(3.0))))
    (reading,) = robot.read()
    assert reading.time == 3.0
    np.testing.assert_array_equal(reading.torques, 3.0 * np.arange(12.0))


def test_a_reading_is_as_old_as_its_arrival_not_as_its_reading(link):
    robot, there = link
    late = []
    for number in range(1, 100):  # the machine may be busy between two looks at the clock, but not each time
        there.send(packet(STATE, number, pack_state(state())))
        sent = time.perf_counter()
        time.sleep(0.1)
        (reading,) = robot.read()
        late.append(abs(sent - reading.received))
        if late[-1] < 0.05:
            return
    pytest.fail(f"readings are {late} s older or younger than their packets")


def test_a_robot_with_other_joints_gives_no_reading(link):
    robot, there = link
    four = np.zeros(4)
    there.send(packet(STATE, 1, pack_state(Reading(1.0, 0.0, four, np.zeros(3), four, four, four))))
    assert robot.read() == []


@pytest.mark.parametrize("seconds", [[1e5, 0.0], [-0.5, 0.2]])
def test_the_time_of_day_may_be_set_while_packets_come(link, monkeypatch, seconds):
    """As when a robot's computer hears of the time: ages are neither below 0, nor is what has just come old."""
    robot, there = link
    set_back = [0.0]
    monkeypatch.setattr(udp, "time", SimpleNamespace(perf_counter=time.perf_counter, time=lambda: time.time() - set_back[0]))
    for number, set_back[0] in enumerate(seconds, 1):
        there.send(packet(STATE, number, pack_state(state())))
        (reading,) = robot.read()
        assert 0.0 <= time.perf_counter() - reading.received < HANG_S


@pytest.mark.slow
@pytest.mark.parametrize("times", [(1.0, 1.1, 1.3), (0.0, 0.0, 0.0), (1000.0, 0.1, 0.3)], ids=["ticks", "none", "set back"])
def test_a_source_is_kept_until_it_is_too_old_whatever_the_robots_clock_says(link, times, monkeypatch):
    robot, there = link
    monkeypatch.setattr(udp, "SOURCE_AGE_S", HANG_S)
    robot.ask({"heights": np.array([[0.5, 0.0]])})
    there.send(packet(STATE, 1, pack_state(state(times[0], heights=np.array([-0.4])))))
    assert robot.read()[0].sources["heights"] == pytest.approx(-0.4)
    there.send(packet(STATE, 2, pack_state(state(times[1]))))
    assert "heights" in robot.read()[0].sources
    before = len(there.heard)
    monkeypatch.setattr(udp, "SOURCE_AGE_S", 0.01)
    time.sleep(0.02)
    there.send(packet(STATE, 3, pack_state(state(times[2]))))
    assert "heights" not in robot.read()[0].sources
    until(lambda: [opened for opened in there.heard[before:] if opened[0] == HELLO])
    asked = [opened for opened in there.heard[before:] if opened[0] == HELLO]
    assert json.loads(asked[0][2]) == {"sources": {"heights": [[0.5, 0.0]]}}, "it asks again: the question may be lost"


def test_a_command_says_what_was_written(link):
    robot, there = link
    robot.write(np.full(12, 0.5), np.full(12, 90.0), np.full(12, 4.0))
    until(lambda: there.heard[-1][0] == COMMAND)
    kind, sequence, body = there.heard[-1]
    assert (kind, sequence) == (COMMAND, 1)
    np.testing.assert_allclose(unpack_command(body)[1].mean(axis=1), [0.5, 90.0, 4.0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGHUP", "SIGTSTP"])
def test_a_program_that_is_asked_to_end_brakes_the_robot_for_a_second_and_says_goodbye(name, policy_folder, tmp_path):
    """The command as a process, whose terminal is closed, or in which somebody types Ctrl-Z."""
    contract = read_contract(policy_folder / "policy.json")
    there = Answers(facts_for(contract))
    (tmp_path / "lie.txt").write_text("0 damping\n")
    command = [sys.executable, "-m", "legged.deploy", str(policy_folder), "--robot", f"udp:{there.address}"]
    with open(tmp_path / "out", "w") as out:
        command += ["--commands", "lie.txt", "--log", "log.npz"]
        program = subprocess.Popen(command, cwd=tmp_path, stdout=out, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            for i in itertools.count(1):
                assert program.poll() is None, (tmp_path / "out").read_text()
                if there.client is not None:
                    there.send(packet(STATE, i, pack_state(state(0.01 * i))))
                if sum(opened[0] == COMMAND for opened in there.heard) == 20:
                    break
                time.sleep(0.002)
            asked, before = time.perf_counter(), len(there.heard)
            program.send_signal(getattr(signal, name))
            assert program.wait(HANG_S) == 0, (tmp_path / "out").read_text()
            assert time.perf_counter() - asked > 0.9
        finally:
            program.kill()
            there.end()
    assert there.heard[-1][0] == BYE
    braked = [unpack_command(body)[1] for kind, _, body in there.heard[before:] if kind == COMMAND]
    assert len(braked) > 1
    for asked_for in braked:
        assert not asked_for[1].any()
        np.testing.assert_allclose(asked_for[2], braking(contract), rtol=1e-6)
    assert (tmp_path / "log.npz").is_file()


def test_whoever_interrupts_a_program_that_waits_for_a_robot_does_not_wait(policy_folder, tmp_path):
    (tmp_path / "lie.txt").write_text("0 damping\n")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        silent.settimeout(HANG_S)
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        command = [sys.executable, "-m", "legged.deploy", str(policy_folder), "--robot", f"udp:{address}"]
        program = subprocess.Popen([*command, "--commands", "lie.txt"], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
        try:
            silent.recv(100)
            program.send_signal(signal.SIGINT)
            said = program.communicate(timeout=HANG_S)[1]
        finally:
            program.kill()
    assert (program.returncode, said) == (130, "interrupted\n")  # it does not wait for an answer, nor say that none came


@pytest.mark.parametrize("address", ["", "here", "127.0.0.1:", "127.0.0.1:0", "127.0.0.1:99999", ":80"])
def test_what_is_no_address_is_refused(address):
    with pytest.raises(ConfigError, match="expected udp:HOST:PORT"):
        UdpRobot(address)


def test_somebody_who_answers_with_something_else_is_no_robot(monkeypatch):
    monkeypatch.setattr(udp, "ANSWER_S", 0.4)
    monkeypatch.setattr(f"{__name__}.pack_facts", lambda _: b'{"joint_names": ["one"]}')
    there = Answers(None)
    with pytest.raises(RunError, match="no robot answers"):
        UdpRobot(there.address)
    there.end()


def test_a_robot_that_does_not_answer_is_named(monkeypatch):
    monkeypatch.setattr(udp, "ANSWER_S", 0.2)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        with pytest.raises(RunError, match=r"no robot answers at udp:127\.0\.0\.1:\d+ within 0\.2 s"):
            UdpRobot(f"127.0.0.1:{silent.getsockname()[1]}")
