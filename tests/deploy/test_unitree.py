"""Unitree's messages, field by field, and a robot behind a stand-in for their SDK."""

import ctypes
import struct
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import until

from legged.deploy import unitree
from legged.deploy.unitree import GO_COMMAND, HG_COMMAND, KINDS, UnitreeRobot, crc
from legged.errors import ConfigError, RunError
from legged.robots.robot import load_robot

U8, U16, U32, FLOAT = ctypes.c_uint8, ctypes.c_uint16, ctypes.c_uint32, ctypes.c_float


class GoMotor(ctypes.Structure):
    _fields_ = [("mode", U8), *((name, FLOAT) for name in ("q", "dq", "tau", "kp", "kd")), ("reserve", U32 * 3)]


class Bms(ctypes.Structure):
    _fields_ = [("off", U8), ("reserve", U8 * 3)]


class GoCommand(ctypes.Structure):
    """LowCmd of unitree_go, as a C compiler lays it out."""

    _fields_ = [
        ("head", U8 * 2),
        ("level_flag", U8),
        ("frame_reserve", U8),
        ("sn", U32 * 2),
        ("version", U32 * 2),
        ("bandwidth", U16),
        ("motor_cmd", GoMotor * 20),
        ("bms_cmd", Bms),
        ("wireless_remote", U8 * 40),
        ("led", U8 * 12),
        ("fan", U8 * 2),
        ("gpio", U8),
        ("reserve", U32),
        ("crc", U32),
    ]


class HgMotor(ctypes.Structure):
    _fields_ = [("mode", U8), *((name, FLOAT) for name in ("q", "dq", "tau", "kp", "kd")), ("reserve", U32)]


class HgCommand(ctypes.Structure):
    """LowCmd of unitree_hg."""

    _fields_ = [
        ("mode_pr", U8),
        ("mode_machine", U8),
        ("motor_cmd", HgMotor * 35),
        ("reserve", U32 * 4),
        ("crc", U32),
    ]


COMMANDS = {"go2": GoCommand, "g1": HgCommand}


def crc_bit_by_bit(words):
    """CRC-32/MPEG-2 of 32-bit words, the highest bit first, by its definition."""
    register = 0xFFFFFFFF
    for word in words:
        for bit in range(31, -1, -1):
            top = (register >> 31) ^ (word >> bit & 1)
            register = (register << 1 & 0xFFFFFFFF) ^ (0x04C11DB7 if top else 0)
    return register


def plain(value):
    """What the SDK's objects are made of: attributes, lists and numbers."""
    if isinstance(value, ctypes.Structure):
        return SimpleNamespace(**{name: plain(getattr(value, name)) for name, _ in value._fields_})
    return [plain(part) for part in value] if isinstance(value, ctypes.Array) else value


def packed(message, structure):
    """The bytes of an SDK's object, as C has them."""

    def put(target, source):
        for name, kind in target._fields_:
            value = getattr(source, name)
            if isinstance(value, list):
                assert len(value) == kind._length_, name
                for i, part in enumerate(value):
                    if isinstance(part, SimpleNamespace):
                        put(getattr(target, name)[i], part)
                    else:
                        getattr(target, name)[i] = part
            elif isinstance(value, SimpleNamespace):
                put(getattr(target, name), value)
            else:
                setattr(target, name, value)

    found = structure()
    put(found, message)
    return bytes(found)


def state_of(kind, q, dq, tick=1234, mode_machine=5, remote=()):
    """A LowState_ of a robot whose motors, in their own order, are at q and dq."""
    count = 20 if kind.command is GO_COMMAND else 35
    motors = []
    for i in range(count):
        own = i < len(q)
        warm = 30 + i if kind.command is GO_COMMAND else [30 + i, 31 + i]
        motors.append(SimpleNamespace(q=q[i] if own else 9.0, dq=dq[i] if own else 9.0, tau_est=0.1 * i, temperature=warm))
    keys = bytearray(40)
    for byte, bit in remote:
        keys[byte] |= 1 << bit
    imu = SimpleNamespace(quaternion=[0.5, 0.5, 0.5, 0.5], gyroscope=[0.1, 0.2, 0.3])
    more = {} if kind.command is GO_COMMAND else {"mode_machine": mode_machine}
    return SimpleNamespace(imu_state=imu, motor_state=motors, tick=tick, wireless_remote=list(keys), **more)


class StandIn:
    """A wire that checks every command as the robot would."""

    def __init__(self, name, states=()):
        self.kind, self.structure = KINDS[name], COMMANDS[name]
        self.states, self.sent, self.closed, self.taken, self.refusal = list(states), [], False, False, None

    def new_command(self):
        return plain(self.structure())

    def listen(self, heard):
        self.heard = heard
        for state in self.states:
            threading.Thread(target=heard, args=(state,)).start()

    def take_over(self):
        if self.refusal is not None:
            raise self.refusal
        self.taken = True

    def send(self, command):
        data = packed(command, self.structure)
        words = struct.unpack(f"<{len(data) // 4}I", data)
        assert crc_bit_by_bit(words[:-1]) == words[-1]
        self.sent.append(self.structure.from_buffer_copy(data))

    def close(self):
        self.closed = True


@pytest.fixture(params=["go2", "g1"])
def robot(request):
    """A robot behind the stand-in, whose motor i is at angle i / 100."""
    kind = KINDS[request.param]
    count = len(kind.motors)
    wire = StandIn(request.param, [state_of(kind, 0.01 * np.arange(count), -0.1 * np.arange(count))])
    robot = UnitreeRobot(request.param, wire, repeat_s=1e-3)
    yield robot, wire
    robot.close()
    assert wire.closed


def test_the_check_sum_is_the_one_of_the_catalogue():
    """CRC-32/MPEG-2 of the text 123456789 is 0x0376E6E7; of whole words, by its definition."""

    def bytewise(data):
        register = 0xFFFFFFFF
        for byte in data:
            register ^= byte << 24
            for _ in range(8):
                register = (register << 1 & 0xFFFFFFFF) ^ (0x04C11DB7 if register >> 31 else 0)
        return register

    assert bytewise(b"123456789") == 0x0376E6E7
    words = np.random.default_rng(0).integers(0, 2**32, 50, dtype=np.uint32)
    in_memory = words.astype("<u4").tobytes() + b"crc!"
    assert crc(in_memory) == bytewise(words.astype(">u4").tobytes()) == crc_bit_by_bit(words.tolist())


def test_layouts_are_those_of_a_c_compiler():
    for record, structure, size in ((GO_COMMAND, GoCommand, 812), (HG_COMMAND, HgCommand, 1004)):
        assert record.itemsize == ctypes.sizeof(structure) == size
        for name, _ in structure._fields_:
            assert record.fields[name][1] == getattr(structure, name).offset, name


@pytest.mark.parametrize("name", ["go2", "g1"])
def test_robots_are_those_of_this_package(name):
    own, facts = load_robot(name), KINDS[name].facts
    assert facts.joint_names == own.joint_names
    assert facts.imu_body == own.file.base
    np.testing.assert_allclose(facts.position_limits, own.dof_pos_limits, atol=1e-3)
    np.testing.assert_allclose(facts.velocity_limits, own.dof_vel_limits)
    np.testing.assert_allclose(facts.torque_limits, own.torque_limits, rtol=1e-2)


def test_the_motors_of_go2_come_front_right_first():
    legs = ["FR", "FL", "RR", "RL"]
    order = [f"{leg}_{part}_joint" for leg in legs for part in ("hip", "thigh", "calf")]
    kind = KINDS["go2"]
    assert [order[motor] for motor in kind.motors] == list(kind.facts.joint_names)
    assert KINDS["g1"].motors == tuple(range(29))


def test_what_is_measured_comes_in_the_order_of_joints(robot):
    robot, _wire = robot
    (reading,) = robot.read()
    motors = np.array(robot.kind.motors)
    np.testing.assert_allclose(reading.positions, 0.01 * motors)
    np.testing.assert_allclose(reading.velocities, -0.1 * motors)
    np.testing.assert_allclose(reading.torques, 0.1 * motors)
    np.testing.assert_allclose(reading.temperatures, (30 if robot.facts.name == "go2" else 31) + motors)
    np.testing.assert_array_equal(reading.quaternion, [0.5] * 4)
    np.testing.assert_array_equal(reading.gyro, [0.1, 0.2, 0.3])
    assert reading.time == pytest.approx(1.234)
    assert not reading.stop
    assert robot.read() == []


def test_every_field_of_a_command(robot):
    robot, wire = robot
    count = len(robot.kind.motors)
    targets, kp, kd = 0.01 * np.arange(count), 20.0 + np.arange(count), 0.5 + 0.01 * np.arange(count)
    robot.write(targets, kp, kd)
    command = wire.sent[0]
    for joint, motor in enumerate(robot.kind.motors):
        found = command.motor_cmd[motor]
        assert found.mode == 1
        assert (found.q, found.kp, found.kd) == pytest.approx((targets[joint], kp[joint], kd[joint]))
        assert (found.dq, found.tau, list(found.reserve) if robot.facts.name == "go2" else found.reserve) == (
            0.0,
            0.0,
            [0, 0, 0] if robot.facts.name == "go2" else 0,
        )
    others = [command.motor_cmd[i] for i in range(len(command.motor_cmd)) if i not in robot.kind.motors]
    if robot.facts.name == "go2":
        assert (list(command.head), command.level_flag, command.gpio) == ([0xFE, 0xEF], 0xFF, 0)
        assert (list(command.sn), list(command.version), command.bandwidth, command.reserve) == ([0, 0], [0, 0], 0, 0)
        assert (bytes(command.wireless_remote), bytes(command.led), bytes(command.fan)) == (bytes(40), bytes(12), bytes(2))
        assert (command.frame_reserve, command.bms_cmd.off, bytes(command.bms_cmd.reserve)) == (0, 0, bytes(3))
        expected = (1, pytest.approx(2.146e9), 16000.0, 0.0, 0.0, 0.0)
    else:
        assert (command.mode_pr, command.mode_machine, list(command.reserve)) == (0, 5, [0, 0, 0, 0])
        expected = (0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert len(others) == (8 if robot.facts.name == "go2" else 6)
    for found in others:
        assert (found.mode, found.q, found.dq, found.tau, found.kp, found.kd) == expected


def test_a_command_is_repeated_and_joints_are_braked_when_the_program_is_silent(robot, monkeypatch):
    robot, wire = robot
    now = [100.0]
    monkeypatch.setattr(unitree, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    count = len(robot.kind.motors)
    robot.write(np.ones(count), np.full(count, 20.0), np.full(count, 0.5))
    motor = robot.kind.motors[0]
    until(lambda: len(wire.sent) > 3)  # one command each control step is too few for motors
    assert all((command.motor_cmd[motor].q, command.motor_cmd[motor].kp) == (1.0, 20.0) for command in list(wire.sent))
    now[0] += 1.01 * unitree.HOLD_S
    until(lambda: wire.sent[-1].motor_cmd[motor].kp == 0.0)
    braked = len(wire.sent)
    until(lambda: len(wire.sent) > braked + 3)
    assert all(command.motor_cmd[motor].kd == unitree.BRAKING for command in wire.sent[braked:])
    robot.write(np.ones(count), np.full(count, 20.0), np.full(count, 0.5))
    assert wire.sent[-1].motor_cmd[motor].kp == 20.0


def test_a_message_that_cannot_be_sent_does_not_end_what_watches_over_the_program(robot, monkeypatch):
    robot, wire = robot
    count = len(robot.kind.motors)
    send = wire.send

    failed = []

    def fail(_):
        if threading.current_thread() is not threading.main_thread():
            failed.append(True)
        raise OSError("no buffer space")

    robot.write(np.ones(count), np.full(count, 20.0), np.full(count, 0.5))
    monkeypatch.setattr(wire, "send", fail)
    with pytest.raises(OSError, match="no buffer space"):
        robot.write(np.ones(count), np.full(count, 20.0), np.full(count, 0.5))
    until(lambda: failed)  # the thread that repeats the command has met it, too
    monkeypatch.setattr(wire, "send", send)
    until(lambda: wire.sent and wire.sent[-1].motor_cmd[robot.kind.motors[0]].kd == unitree.BRAKING)


@pytest.mark.parametrize(
    ("keys", "stops"), [([(2, 3)], True), ([(2, 5), (3, 1)], True), ([(2, 5)], False), ([(3, 1)], False)]
)
def test_select_and_l2_with_b_of_the_remote_control_stop_it(keys, stops):
    kind = KINDS["go2"]
    robot = UnitreeRobot("go2", StandIn("go2", [state_of(kind, np.zeros(12), np.zeros(12), remote=keys)]))
    assert robot.read()[0].stop == stops
    robot.close()


def test_a_g1_with_fewer_joints_is_refused_before_anything_is_sent():
    kind = KINDS["g1"]
    for code, says in ((4, "23 joints"), (6, "a locked waist")):
        wire = StandIn("g1", [state_of(kind, np.zeros(29), np.zeros(29), mode_machine=code)])
        with pytest.raises(ConfigError, match=f"g1: mode_machine is {code}: this robot has {says}, not 29 joints"):
            UnitreeRobot("g1", wire)
        assert (wire.closed, wire.sent) == (True, [])
        assert not wire.taken  # it stands by its own controller, and goes on to


@pytest.mark.parametrize("refusal", [RunError("still on"), KeyboardInterrupt()])
def test_a_robot_that_keeps_its_controller_is_sent_nothing(refusal):
    wire = StandIn("go2", [state_of(KINDS["go2"], np.zeros(12), np.zeros(12))])
    wire.refusal = refusal
    with pytest.raises(type(refusal)):
        UnitreeRobot("go2", wire)
    assert (wire.closed, wire.sent) == (True, [])


def test_what_a_robot_told_while_it_let_go_of_its_controller_is_not_read_late():
    kind = KINDS["go2"]
    wire = StandIn("go2", [state_of(kind, np.zeros(12), np.zeros(12), tick=1)])
    wire.take_over = lambda: [wire.heard(state_of(kind, np.zeros(12), np.zeros(12), tick=tick)) for tick in (2, 3)]
    robot = UnitreeRobot("go2", wire)
    assert [reading.time for reading in robot.read()] == [0.003]
    robot.close()


def test_a_robot_that_says_nothing_is_named(monkeypatch):
    monkeypatch.setattr(unitree, "FIRST_STATE_S", 0.05)
    wire = StandIn("g1")
    with pytest.raises(RunError, match=r"--robot: g1: no state came within 0\.05 s"):
        UnitreeRobot("g1", wire)
    assert wire.closed
