"""Unitree's low-level messages: their layout, their checksum, and their values for a Go2 and a G1.

Layouts are those of the message definitions (IDL) that Unitree publishes with its SDK 2, "unitree_go" for Go2 and
"unitree_hg" for G1, in C's memory layout. The checksum is CRC-32/MPEG-2 (polynomial 0x04C11DB7, start 0xFFFFFFFF, nothing
reflected, no final exclusive or) over all but the last of the message's 32-bit words, the highest byte of each word first.
"""

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from legged.deploy.interface import RobotFacts

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
"""LowCmd of unitree_go, 812 bytes."""
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
"""LowCmd of unitree_hg, 1004 bytes."""
NO_POSITION, NO_VELOCITY = 2.146e9, 16000.0
"""Targets for motors of Go2 without position or velocity control."""
ENABLED, DISABLED = 1, 0
"""Modes of a motor."""
SERIES = 0
"""`mode_pr` with which the ankles and the waist of G1 take pitch and roll angles instead of those of their two motors."""
OTHER_G1 = {
    1: "23 joints",
    3: "a locked waist",
    4: "23 joints",
    6: "a locked waist",
    9: "no legs",
}
"""`mode_machine` of a G1 without all 29 joints -> its joints (from the table of Unitree's description of G1)."""
BITS = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
"""Byte -> the byte with its bits in reverse order."""
SELECT, L2, B = (2, 3), (2, 5), (3, 1)
"""Keys of the remote control: byte of `wireless_remote` and bit in it."""


@dataclass(frozen=True)
class UnitreeKind:
    """A Unitree robot: its messages, its joints, and the motor of each joint."""

    facts: RobotFacts
    motors: tuple[int, ...]
    """(D,) index of each joint in `motor_cmd` and `motor_state`."""
    command: np.dtype
    package: str
    """Package of the messages in Unitree's SDK."""


def crc(message: bytes) -> int:
    """Return the checksum of a message, which belongs into its last four bytes.

    zlib computes the reflected CRC of the same polynomial, so the bits of input and output are reversed.
    """
    words = np.frombuffer(message, "<u4")[:-1].astype(">u4").tobytes()
    reflected = zlib.crc32(words.translate(BITS)) ^ 0xFFFFFFFF
    return int(f"{reflected:032b}"[::-1], 2)


def new_command(kind: UnitreeKind, mode_machine: int) -> np.ndarray:
    """Return a command, a record (), in which the joints' motors are on without torque and all others are off.

    `mode_machine` is the value in G1's state; Go2 has none.
    """
    message = np.zeros((), kind.command)
    motors = message["motor_cmd"]
    if kind.command is GO_COMMAND:
        message["head"], message["level_flag"] = (0xFE, 0xEF), 0xFF
        motors["mode"], motors["q"], motors["dq"] = ENABLED, NO_POSITION, NO_VELOCITY
    else:
        message["mode_pr"], message["mode_machine"] = SERIES, mode_machine
        motors["mode"][list(kind.motors)] = ENABLED
    return message


def fill_command(
    message: np.ndarray, kind: UnitreeKind, positions: np.ndarray, stiffness: np.ndarray, damping: np.ndarray
) -> None:
    """Set the targets (D,) [rad] and gains (D,) [N m/rad], [N m s/rad] of the joints, zero velocity and feedforward torque,
    and the checksum.
    """
    motors, places = message["motor_cmd"], list(kind.motors)
    motors["q"][places], motors["kp"][places], motors["kd"][places] = positions, stiffness, damping
    motors["dq"][places], motors["tau"][places] = 0.0, 0.0
    message["crc"] = crc(message.tobytes())


def copy_into(message: np.ndarray, target: Any) -> None:
    """Copy the numbers of a record to an object of Unitree's SDK."""
    for name in message.dtype.names or ():
        value = message[name]
        if value.dtype.names and value.shape:
            for part, place in zip(value, getattr(target, name), strict=True):
                copy_into(part, place)
        elif value.dtype.names:
            copy_into(value, getattr(target, name))
        elif value.shape:
            setattr(target, name, value.tolist())
        else:
            setattr(target, name, value.item())


def pressed(remote: Any, key: tuple[int, int]) -> bool:
    """Return whether a key of the remote control is pressed, from the bytes of `wireless_remote`."""
    byte, bit = key
    return bool(int(remote[byte]) >> bit & 1)


def _facts(name: str, imu_body: str, joints: dict[str, tuple[float, float, float, float]]) -> RobotFacts:
    numbers = np.array(list(joints.values()))
    return RobotFacts(name, tuple(joints), numbers[:, :2], numbers[:, 2], numbers[:, 3], imu_body)


# Lowest and highest angle [rad], largest velocity [rad/s] and torque [N m] by joint, as Unitree's models have them.
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
    """Return the joints of one side; on the right, rolls of hips and shoulders have the opposite sign."""
    return {
        f"{side}_{part}_joint": (-limits[1], -limits[0], *limits[2:])
        if side == "right" and part in ("hip_roll", "shoulder_roll")
        else limits
        for part, limits in parts.items()
    }


_G1 = {
    **_side("left", _G1_LEG),
    **_side("right", _G1_LEG),
    **{f"waist_{part}_joint": limits for part, limits in _G1_WAIST.items()},
    **_side("left", _G1_ARM),
    **_side("right", _G1_ARM),
}
KINDS = {
    # The motors of Go2 are ordered front right, front left, rear right, rear left; the joints begin with the left.
    "go2": UnitreeKind(_facts("go2", "base", _GO2), (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8), GO_COMMAND, "unitree_go"),
    "g1": UnitreeKind(_facts("g1", "pelvis", _G1), tuple(range(29)), HG_COMMAND, "unitree_hg"),
}
