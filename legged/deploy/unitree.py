"""Control of a Go2 or a G1 through Unitree's SDK 2. The robot is real, or runs in Unitree's simulator.

Messages have C's memory layout of the definitions (IDL) that Unitree publishes with its SDK 2. Their package is "unitree_go"
for Go2 and "unitree_hg" for G1. The checksum is CRC-32/MPEG-2 (polynomial 0x04C11DB7, start 0xFFFFFFFF, nothing reflected,
no final exclusive or). It covers all 32-bit words of a message but the last, and reads each word from its highest byte.
"""

import threading
import time
import zlib
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from legged.deploy.errors import ConfigError, RunError
from legged.deploy.interface import Interface, Reading, RobotFacts

COMMAND_TOPIC, STATE_TOPIC = "rt/lowcmd", "rt/lowstate"
SWITCHER = "unitree_sdk2py.comm.motion_switcher.motion_switcher_client"
SIMULATOR_DOMAIN = 1
"""DDS domain of Unitree's own simulator."""
REPEAT_S = 0.005
"""Interval at which the newest command is repeated [s]. Motors and simulators expect several commands per control step."""
HOLD_S = 0.1
"""Time without a new command after which the program counts as dead and joints are braked [s]."""
FIRST_STATE_S = 5.0
"""Time within which a robot must send its first state [s]."""
RELEASE_S = 10.0
"""Time within which a robot must switch off its own controller [s]."""
BRAKING = 2.0
"""D gain with which joints are braked after `HOLD_S` without a new command [N m s/rad]."""
FLOATS = [(name, "<f4") for name in ("q", "dq", "tau", "kp", "kd")]
GO_MOTOR = np.dtype([("mode", "u1"), *FLOATS, ("reserve", "<u4", (3,))], align=True)
GO_COMMAND = np.dtype(
    [
        ("head", "u1", (2,)),
        ("level_flag", "u1"),
        ("frame_reserve", "u1"),
        ("sn", "<u4", (2,)),
        ("version", "<u4", (2,)),
        ("bandwidth", "<u2"),
        ("motor_cmd", GO_MOTOR, (20,)),
        ("bms_cmd", [("off", "u1"), ("reserve", "u1", (3,))]),
        ("wireless_remote", "u1", (40,)),
        ("led", "u1", (12,)),
        ("fan", "u1", (2,)),
        ("gpio", "u1"),
        ("reserve", "<u4"),
        ("crc", "<u4"),
    ],
    align=True,
)
"""Layout of the message LowCmd of unitree_go (812 bytes)."""
HG_MOTOR = np.dtype([("mode", "u1"), *FLOATS, ("reserve", "<u4")], align=True)
HG_COMMAND = np.dtype(
    [
        ("mode_pr", "u1"),
        ("mode_machine", "u1"),
        ("motor_cmd", HG_MOTOR, (35,)),
        ("reserve", "<u4", (4,)),
        ("crc", "<u4"),
    ],
    align=True,
)
"""Layout of the message LowCmd of unitree_hg (1004 bytes)."""
NO_POSITION, NO_VELOCITY = 2.146e9, 16000.0
"""Values of `q` and `dq` that switch off position and velocity control of a Go2 motor."""
ENABLED = 1
"""Mode of a motor that is on."""
SERIES = 0
"""Value of `mode_pr` with which targets of G1's ankles and waist are pitch and roll angles, not angles of the motors."""
OTHER_G1 = {1: "23 joints", 3: "a locked waist", 4: "23 joints", 6: "a locked waist", 9: "no legs"}
"""`mode_machine` of a G1 with fewer than 29 joints -> what differs. Source: a table in Unitree's description of G1."""
BITS = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
"""Byte -> the byte with its bits in reverse order."""
SELECT, L2, B = (2, 3), (2, 5), (3, 1)
"""Keys of the remote control: (index of a byte in `wireless_remote`, index of the key's bit in this byte)."""
# Lowest and highest angle [rad], largest velocity [rad/s] and torque [N m] of each joint, from Unitree's models.
_GO2_LEG = {"hip": (-1.0472, 1.0472, 30.1, 23.7), "calf": (-2.7227, -0.83776, 20.07, 35.55)}
_GO2_THIGH = {"F": (-1.5708, 3.4907, 30.1, 23.7), "R": (-0.5236, 4.5379, 30.1, 23.7)}
_GO2 = {
    f"{leg}_{part}_joint": _GO2_THIGH[leg[0]] if part == "thigh" else _GO2_LEG[part]
    for leg in ("FL", "FR", "RL", "RR")
    for part in ("hip", "thigh", "calf")
}
_G1_LEG = {
    "hip_pitch": (-2.5307, 2.8798, 32.0, 88.0),
    "hip_roll": (-0.5236, 2.9671, 20.0, 139.0),
    "hip_yaw": (-2.7576, 2.7576, 32.0, 88.0),
    "knee": (-0.087267, 2.8798, 20.0, 139.0),
    "ankle_pitch": (-0.87267, 0.5236, 37.0, 50.0),
    "ankle_roll": (-0.2618, 0.2618, 37.0, 50.0),
}
_G1_WAIST = {"yaw": (-2.618, 2.618, 32.0, 88.0), "roll": (-0.52, 0.52, 37.0, 50.0), "pitch": (-0.52, 0.52, 37.0, 50.0)}
_G1_ARM = {
    "shoulder_pitch": (-3.0892, 2.6704, 37.0, 25.0),
    "shoulder_roll": (-1.5882, 2.2515, 37.0, 25.0),
    "shoulder_yaw": (-2.618, 2.618, 37.0, 25.0),
    "elbow": (-1.0472, 2.0944, 37.0, 25.0),
    "wrist_roll": (-1.97222, 1.97222, 37.0, 25.0),
    "wrist_pitch": (-1.61443, 1.61443, 22.0, 5.0),
    "wrist_yaw": (-1.61443, 1.61443, 22.0, 5.0),
}


def _side(side: str, parts: dict[str, tuple[float, float, float, float]]) -> dict[str, tuple[float, float, float, float]]:
    """Return joint -> limits for one side. On the right side, the limits of hip roll and shoulder roll are mirrored."""
    mirrored = ("hip_roll", "shoulder_roll") if side == "right" else ()
    return {
        f"{side}_{part}_joint": (-high, -low, speed, torque) if part in mirrored else (low, high, speed, torque)
        for part, (low, high, speed, torque) in parts.items()
    }


_G1 = {
    **_side("left", _G1_LEG),
    **_side("right", _G1_LEG),
    **{f"waist_{part}_joint": limits for part, limits in _G1_WAIST.items()},
    **_side("left", _G1_ARM),
    **_side("right", _G1_ARM),
}


@dataclass(frozen=True)
class UnitreeKind:
    """A Unitree robot: its messages, its joints, and the motor of each joint."""

    facts: RobotFacts
    motors: tuple[int, ...]
    """(D,) index of each joint in `motor_cmd` and `motor_state`."""
    command: np.dtype
    package: str
    """Package of the messages in Unitree's SDK."""


def _facts(name: str, imu_body: str, joints: dict[str, tuple[float, float, float, float]]) -> RobotFacts:
    numbers = np.array(list(joints.values()))
    return RobotFacts(name, tuple(joints), numbers[:, :2], numbers[:, 2], numbers[:, 3], imu_body)


KINDS = {
    # The leg order of Go2's motors is FR, FL, RR, RL. The leg order of the joints is FL, FR, RL, RR.
    "go2": UnitreeKind(_facts("go2", "base", _GO2), (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8), GO_COMMAND, "unitree_go"),
    "g1": UnitreeKind(_facts("g1", "pelvis", _G1), tuple(range(29)), HG_COMMAND, "unitree_hg"),
}


def crc(message: bytes) -> int:
    """Return the checksum of a message. Its last four bytes are left out, because they will hold the checksum.

    zlib computes the reflected CRC of the same polynomial, so the function reverses the bits of zlib's input and output.
    """
    words = np.frombuffer(message, "<u4")[:-1].astype(">u4").tobytes()
    reflected = zlib.crc32(words.translate(BITS)) ^ 0xFFFFFFFF
    return int(f"{reflected:032b}"[::-1], 2)


def command_of(
    kind: UnitreeKind, mode_machine: int, positions: np.ndarray, stiffness: np.ndarray, damping: np.ndarray
) -> np.ndarray:
    """Return a command as a NumPy record. `positions` [rad], `stiffness` [N m/rad] and `damping` [N m s/rad] are (D,) each.
    Target velocities and feedforward torques are zero, and motors without a joint get no torque. `mode_machine` is the value
    in the newest state of a G1.
    """
    message, places = np.zeros((), kind.command), list(kind.motors)
    motors = message["motor_cmd"]
    if kind.command is GO_COMMAND:
        message["head"], message["level_flag"] = (0xFE, 0xEF), 0xFF
        motors["mode"], motors["q"], motors["dq"] = ENABLED, NO_POSITION, NO_VELOCITY
    else:
        message["mode_pr"], message["mode_machine"] = SERIES, mode_machine
        motors["mode"][places] = ENABLED
    motors["q"][places], motors["kp"][places], motors["kd"][places] = positions, stiffness, damping
    motors["dq"][places] = 0.0
    message["crc"] = crc(message.tobytes())
    return message


def copy_into(message: np.ndarray, target: Any) -> None:
    """Copy the numbers of a record to an object of Unitree's SDK."""
    for name in message.dtype.names or ():
        value = message[name]
        if not value.dtype.names:
            setattr(target, name, value.tolist())
        elif value.shape:
            for part, place in zip(value, getattr(target, name), strict=True):
                copy_into(part, place)
        else:
            copy_into(value, getattr(target, name))


class SdkWire:
    """Connection to a robot through Unitree's SDK, which the extra `unitree-sdk2` installs."""

    def __init__(self, kind: UnitreeKind, network: str | None, domain: int) -> None:
        """Join the network through the interface `network`, such as eth0. The DDS `domain` is 0 for a robot, and
        `SIMULATOR_DOMAIN` for Unitree's simulator.

        Raises:
            ConfigError: the SDK is not installed, or cannot join the network.
        """
        try:
            channel = import_module("unitree_sdk2py.core.channel")
            default = import_module("unitree_sdk2py.idl.default")
            messages = import_module(f"unitree_sdk2py.idl.{kind.package}.msg.dds_")
            # Unitree's simulator has no controller that must be switched off.
            self._switcher = None if domain == SIMULATOR_DOMAIN else import_module(SWITCHER)
        except ImportError as error:
            raise ConfigError(
                f"--robot: Unitree's SDK cannot be imported ({' '.join(str(error).split())}); run `pip install"
                " 'legged[unitree-sdk2]'`, or install the SDK from Unitree's own sources (unitree_sdk2_python)"
            ) from error
        try:
            channel.ChannelFactoryInitialize(domain, network)
        except Exception as error:  # the SDK raises Exception itself
            raise ConfigError(f"--network: {network or 'none given'}: domain {domain} cannot be joined ({error})") from error
        self.new_command: Callable[[], Any] = getattr(default, f"{kind.package}_msg_dds__LowCmd_")
        """Function that returns a LowCmd_ of the robot's kind, filled with zeros."""
        self._publisher = channel.ChannelPublisher(COMMAND_TOPIC, messages.LowCmd_)
        self._publisher.Init()
        self._subscriber = channel.ChannelSubscriber(STATE_TOPIC, messages.LowState_)

    def listen(self, heard: Callable[[Any], None]) -> None:
        """Call `heard` in another thread for every LowState_ that arrives."""
        self._subscriber.Init(heard, 10)

    def take_over(self) -> None:
        """Switch off the robot's own controller before the first command, since two programs must never command one robot.

        Raises:
            RunError: the robot's controller stays on, or the robot does not answer.
        """
        if self._switcher is None:
            return
        client = self._switcher.MotionSwitcherClient()
        client.SetTimeout(RELEASE_S)
        client.Init()
        end, answered = time.perf_counter() + RELEASE_S, False
        while time.perf_counter() < end:
            code, mode = client.CheckMode()
            if code == 0 and not (mode or {}).get("name"):
                return
            answered |= code == 0
            client.ReleaseMode()
            time.sleep(1.0)
        if not answered:
            raise RunError("--robot: the robot does not say if its own controller is on; check --network")
        raise RunError(f"--robot: the robot's own controller is still on after {RELEASE_S:g} s; switch it off by hand")

    def send(self, command: Any) -> None:
        """Send a LowCmd_.

        Raises:
            RunError: the command was not sent.
        """
        if self._publisher.Write(command) is False:  # if sending fails, the SDK raises no error
            raise RunError("--robot: Unitree's SDK could not send a command")

    def close(self) -> None:
        """Release the connection."""
        self._subscriber.Close()
        self._publisher.Close()


class UnitreeRobot(Interface):
    """A Unitree robot. A thread repeats the newest command, and brakes the joints if no new command comes for `HOLD_S`."""

    def __init__(self, name: str, wire: SdkWire, repeat_s: float = REPEAT_S) -> None:
        """Wait for the robot's first state, and switch off the robot's own controller. `name` is a key of `KINDS`.

        Raises:
            ConfigError: the robot is a G1 with fewer than 29 joints.
            RunError: the robot sends no state, or its own controller stays on.
        """
        self.kind = KINDS[name]
        self.facts = self.kind.facts
        self._wire, self._repeat_s = wire, repeat_s
        self._lock = threading.Lock()
        self._heard: list[Reading] = []
        self._mode_machine = 0
        self._first = threading.Event()
        with ExitStack() as opened:
            opened.callback(wire.close)
            wire.listen(self._hear)
            if not self._first.wait(FIRST_STATE_S):
                raise RunError(
                    f"--robot: {name}: no state came within {FIRST_STATE_S:g} s; check --network, and that the robot is on"
                )
            if name == "g1" and (lacks := OTHER_G1.get(self._mode_machine)) is not None:
                raise ConfigError(f"--robot: g1: mode_machine is {self._mode_machine}: this robot has {lacks}, not 29 joints")
            wire.take_over()
            opened.pop_all()
        with self._lock:
            del self._heard[:-1]  # only the newest state counts
        self._command = wire.new_command()
        self._written: float | None = None
        self._braked = False
        self._closing = threading.Event()
        self._repeater = threading.Thread(target=self._repeat, name="unitree-commands", daemon=True)
        self._repeater.start()

    def _hear(self, state: Any) -> None:
        """Store a LowState_ as a `Reading`."""
        received = time.perf_counter()
        motors = [state.motor_state[place] for place in self.kind.motors]
        select, l2, b = (bool(int(state.wireless_remote[byte]) >> bit & 1) for byte, bit in (SELECT, L2, B))
        reading = Reading(
            time=1e-3 * float(state.tick),
            received=received,
            quaternion=np.array(state.imu_state.quaternion, dtype=float),
            gyro=np.array(state.imu_state.gyroscope, dtype=float),
            positions=np.array([motor.q for motor in motors], dtype=float),
            velocities=np.array([motor.dq for motor in motors], dtype=float),
            torques=np.array([motor.tau_est for motor in motors], dtype=float),
            temperatures=np.array([np.max(motor.temperature) for motor in motors], dtype=float),
            stop=select or (l2 and b),
        )
        with self._lock:
            self._heard.append(reading)
            self._mode_machine = int(getattr(state, "mode_machine", 0))
        self._first.set()

    def ask(self, sources: Mapping[str, np.ndarray | None]) -> None:
        """Do nothing: the robot offers no sources such as a height map. Policies that need a source are refused."""

    def read(self) -> list[Reading]:
        with self._lock:
            found, self._heard = self._heard, []
        return found

    def write(self, positions: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        with self._lock:
            copy_into(command_of(self.kind, self._mode_machine, positions, stiffness, damping), self._command)
            self._written, self._braked = time.perf_counter(), False
            self._wire.send(self._command)

    def _repeat(self) -> None:
        """Send the newest command repeatedly until `close`. If it is older than `HOLD_S`, send a braking command instead."""
        nothing = np.zeros(len(self.kind.motors))
        while not self._closing.wait(self._repeat_s):
            with self._lock:
                if self._written is None:
                    continue
                if not self._braked and time.perf_counter() - self._written > HOLD_S:
                    copy_into(command_of(self.kind, self._mode_machine, nothing, nothing, nothing + BRAKING), self._command)
                    self._braked = True
                with suppress(Exception):  # the next repetition may succeed, and `write` reports failures
                    self._wire.send(self._command)

    def close(self) -> None:
        self._closing.set()
        self._repeater.join()
        self._wire.close()
