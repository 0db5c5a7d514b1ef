"""Commands by keyboard, gamepad and file."""

import os
import signal
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import call, kept_global_state

from legged.deploy.__main__ import ENDING, Interruptible, main
from legged.deploy.operators import Event, Gamepad, Keyboard, Orders, Ramp, Script
from legged.errors import ConfigError


@pytest.fixture
def terminal():
    """Both ends of a terminal: where somebody types, and where the program reads."""
    pty = pytest.importorskip("pty")
    typed, read = pty.openpty()
    yield typed, read
    for end in (typed, read):
        try:
            os.close(end)
        except OSError:
            continue


def test_keys_are_events_and_steps_of_the_command(terminal):
    typed, read = terminal
    keyboard = Keyboard(read)
    assert keyboard.poll(0.0).events == ()
    os.write(typed, b"123")
    assert keyboard.poll(0.0).events == (Event.DAMPING, Event.STAND, Event.WALK)
    os.write(typed, b"wwwaqee")
    orders = keyboard.poll(0.0)
    np.testing.assert_allclose(orders.velocity, [0.3, 0.1, -0.1])
    assert orders.shares
    os.write(typed, b"w" * 20)
    assert keyboard.poll(0.0).velocity[0] == pytest.approx(1.0)
    os.write(typed, b"r")
    np.testing.assert_array_equal(keyboard.poll(0.0).velocity, 0.0)
    os.write(typed, b"w ")
    orders = keyboard.poll(0.0)
    assert orders.events == (Event.STOP,)
    np.testing.assert_array_equal(orders.velocity, 0.0)
    os.write(typed, b"x")
    assert keyboard.poll(0.0).events == (Event.QUIT,)
    keyboard.close()


def test_escape_stops_and_an_arrow_does_not(terminal):
    typed, read = terminal
    keyboard = Keyboard(read)
    os.write(typed, b"\x1b[A")
    assert keyboard.poll(0.0).events == ()
    os.write(typed, b"\x1b")
    assert keyboard.poll(0.0).events == (Event.STOP,)
    keyboard.close()


@pytest.mark.parametrize("typed_at_once", [b"\x1b\x1b\x1b", b"\x1b[A ", b" \x1b[1;5C", b"\x1bOP\x1b", b"w\x1b"])
def test_nothing_that_comes_with_it_hides_a_stop(terminal, typed_at_once):
    """Keys that are hammered, or pressed with an arrow, come at once."""
    typed, read = terminal
    keyboard = Keyboard(read)
    os.write(typed, typed_at_once)
    assert Event.STOP in keyboard.poll(0.0).events
    keyboard.close()


def test_a_command_ends_when_nobody_types_any_more(terminal):
    typed, read = terminal
    keyboard = Keyboard(read)
    os.write(typed, b"www")
    assert keyboard.poll(5.0).velocity[0] == pytest.approx(0.3)
    assert keyboard.poll(14.9).velocity[0] == pytest.approx(0.3)
    os.write(typed, b"h")  # no key of ours, but somebody is there
    assert keyboard.poll(15.0).velocity[0] == pytest.approx(0.3)
    assert keyboard.poll(24.9).velocity[0] == pytest.approx(0.3)
    np.testing.assert_array_equal(keyboard.poll(25.1).velocity, 0.0)
    keyboard.close()


def test_a_closed_terminal_is_no_operator(terminal):
    typed, read = terminal
    keyboard = Keyboard(read)
    os.close(typed)
    assert keyboard.poll(0.0).lost == "the terminal is closed"
    keyboard.close()


def test_a_terminal_that_has_gone_unnoticed_is_let_go_of(terminal):
    typed, read = terminal
    keyboard = Keyboard(read)
    os.close(typed)
    keyboard.close()


def test_the_keyboard_needs_a_terminal():
    reads, writes = os.pipe()
    try:
        with pytest.raises(ConfigError, match="--input: the keyboard needs a terminal"):
            Keyboard(reads)
    finally:
        os.close(reads)
        os.close(writes)


@pytest.fixture
def device(tmp_path):
    """A named pipe in place of /dev/input/js0, and a function that sends it events (value, type, number)."""
    path = tmp_path / "js0"
    os.mkfifo(path)
    pad = Gamepad(path)
    end = os.open(path, os.O_WRONLY)

    def send(*events):
        os.write(end, b"".join(struct.pack("<IhBB", 17, *event) for event in events))

    yield pad, send, end
    pad.close()


def test_sticks_and_buttons_of_a_gamepad(device):
    pad, send, _ = device
    send((0, 0x81, 0), (0, 0x82, 1))  # what the device tells at the start
    orders = pad.poll(0.0)
    assert (orders.events, orders.shares, orders.lost) == ((), True, None)
    send((-32767, 2, 1), (16384, 2, 0), (-16384, 2, 3))  # up, right, and the right one to the left
    np.testing.assert_allclose(pad.poll(0.0).velocity, [1.0, -0.5, 0.5], atol=1e-3)
    send((3000, 2, 1))  # no stick rests at 0 exactly
    assert pad.poll(0.0).velocity[0] == 0.0
    send((1, 1, 3), (0, 1, 3), (1, 1, 0), (1, 1, 1), (1, 1, 15))
    assert pad.poll(0.0).events == (Event.STAND, Event.WALK, Event.STOP)


def test_events_may_come_in_parts(device):
    pad, _, end = device
    whole = struct.pack("<IhBB", 17, 1, 1, 1)
    os.write(end, whole[:5])
    assert pad.poll(0.0).events == ()
    os.write(end, whole[5:])
    assert pad.poll(0.0).events == (Event.STOP,)


def test_an_unplugged_gamepad_is_no_operator(device):
    pad, _, end = device
    os.close(end)
    assert "is closed" in pad.poll(0.0).lost


def test_a_gamepad_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"--input: there is no gamepad at .*js7 \(No such file"):
        Gamepad(tmp_path / "js7")


@pytest.mark.parametrize("name", ENDING)
def test_a_signal_asks_the_program_to_end_and_keeps_what_else_was_asked(tmp_path, name):
    path = tmp_path / "walk.txt"
    path.write_text("0 damping\n1 stand\n")
    kept = {number: signal.getsignal(number) for number in map(signal.Signals.__getitem__, ENDING)}
    with kept_global_state():
        operator = Interruptible(Script(path))
        with pytest.raises(KeyboardInterrupt):  # there is no robot that would have to be braked
            signal.raise_signal(getattr(signal, name))
        operator.take()
        assert operator.poll(0.0).events == (Event.DAMPING,)
        signal.raise_signal(getattr(signal, name))
        assert operator.poll(1.0).events == (Event.STAND, Event.QUIT)
    for number, handler in kept.items():
        signal.signal(number, handler)


def test_a_script_says_what_it_says_when_its_time_has_come(tmp_path):
    path = tmp_path / "walk.txt"
    path.write_text("# stairs\n0 damping\n0.5 stand\n\n3 walk   # slowly\n3 0.5 0 -0.2\n5 stop\n")
    script = Script(path)
    assert script.poll(0.0).events == (Event.DAMPING,)
    assert script.poll(0.4).events == ()
    orders = script.poll(3.5)
    assert orders.events == (Event.STAND, Event.WALK)
    np.testing.assert_array_equal(orders.velocity, [0.5, 0.0, -0.2])
    assert not orders.shares
    assert script.poll(9.0).events == (Event.STOP,)


def test_a_script_may_command_height_and_pitch(tmp_path):
    path = tmp_path / "walk.txt"
    path.write_text("0 walk\n1 0.2 0 0 0.6 0.3\n2 0.1 0 0\n")
    script = Script(path)
    assert script.poll(0.5).base is None
    orders = script.poll(1.0)
    np.testing.assert_array_equal(orders.velocity, [0.2, 0.0, 0.0])
    np.testing.assert_array_equal(orders.base, [0.6, 0.3])
    assert script.poll(2.0).base is None


def test_height_and_pitch_are_ramped_within_their_ranges_and_return_to_the_usual_ones():
    """In steps of 0.1 s, 0.2 m/s are 0.02 m and 0.5 rad/s are 0.05 rad."""
    base = np.array([[0.5, 0.7, 0.74], [-0.1, 0.0, 0.12]])
    ramp = Ramp(SimpleNamespace(command_ranges=np.ones((3, 2)), dead_zone=0.1, control_dt=0.1, base_commands=base))
    np.testing.assert_array_equal(ramp.base, [0.7, 0.0])
    found = [ramp.advance(Orders(np.zeros(3), base=np.array([0.65, 0.3]))) is ramp.command and ramp.base for _ in range(4)]
    np.testing.assert_allclose(found, [[0.68, 0.05], [0.66, 0.1], [0.65, 0.12], [0.65, 0.12]])
    ramp.advance(Orders(np.zeros(3)))
    np.testing.assert_allclose(ramp.base, [0.67, 0.07])
    ramp.restart()
    np.testing.assert_array_equal(ramp.base, [0.7, 0.0])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("0 wlak", r"line 1: there is no event 'wlak'; did you mean 'walk'\?"),
        (
            "0 damping\nnow stand",
            r"line 2: expected 'time event', 'time vx vy yaw_rate' or 'time vx .* pitch', got 'now stand'",
        ),
        ("0 1 2", "line 1: expected"),
        ("0 1 2 3 0.6", "line 1: expected"),
        ("0 1 nan 2", "line 1: expected"),
        ("1 stand\n0 damping", "its times must not decrease"),
        ("# nothing", "has no commands"),
    ],
)
def test_a_script_with_a_mistake_is_refused_by_its_line(tmp_path, text, says):
    path = tmp_path / "walk.txt"
    path.write_text(text)
    with pytest.raises(ConfigError, match=says):
        Script(path)


@pytest.mark.parametrize(
    ("flags", "code", "says"),
    [
        (["none"], 2, "error: POLICY: there is no none/policy.onnx"),
        (["--max-tilt", "0"], 2, "error: --max-tilt: must be between 0.1 and 1.6, got 0"),
        (["--max-tilt", "60"], 2, "error: --max-tilt: must be between 0.1 and 1.6, got 60"),
        (["--max-age", "50"], 2, "error: --max-age: must be between 0.005 and 0.5, got 50"),
        (["--stand-seconds", "0.1"], 2, "error: --stand-seconds: must be between 1 and 60, got 0.1"),
        (["--seconds", "nan"], 2, "error: --seconds: must be above 0, got nan"),
        (["--robot", "spot"], 2, "error: --robot: 'spot' is unknown"),
        (["--robot", "udp:here", "--commands", "walk.txt"], 2, "error: --robot: udp:here: expected udp:HOST:PORT"),
        (["--log", "walk.txt"], 2, "error: --log: must be the name of an .npz file, got 'walk.txt'"),
        (["--log", "walk.txt/log.npz"], 2, "error: --log: cannot write to the folder walk.txt: File exists"),
        (["--robot", "go2"], 2, "joint_names: 'go2' has no joint 'LF_HAA'"),
        (["--commands", "nothing.txt"], 2, "error: --commands: nothing.txt: cannot be read"),
        (["--input", "gamepad", "--gamepad", "js9"], 2, "error: --input: there is no gamepad at js9"),
    ],
)
def test_a_wrong_flag_ends_the_command_with_one_line(flags, code, says, tmp_path, monkeypatch, capsys, policy_folder):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "walk.txt").write_text("0 damping\n")
    given = [] if flags[0] == "none" else [str(policy_folder)]
    given += [] if "--robot" in flags else ["--robot", "udp:127.0.0.1:9"]
    with pytest.MonkeyPatch.context() as signals:
        signals.setattr("legged.deploy.__main__.signal.signal", lambda *_: None)
        signals.setattr("legged.deploy.__main__.take_priority", lambda: True)  # the tests go on without
        assert call(main, [*given, *flags]) == code
    shown = capsys.readouterr().err
    assert says in shown
    assert len(shown.splitlines()) == 1
