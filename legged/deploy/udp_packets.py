"""Packets between the program and a robot reached by UDP.

A packet is `HEADER` (magic, kind, sequence number) and a body, all little-endian. The program sends a greeting with the
sources that it needs, and the robot answers with its facts, both as JSON. Then the robot sends states to the last sender of a
greeting, and the program sends commands. Each side numbers its packets in increasing order.
"""

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from legged.deploy.interface import RobotFacts

HEADER = struct.Struct("<4sBxxxI")
MAGIC = b"LGD1"
HELLO, FACTS, STATE, COMMAND, BYE = range(1, 6)
STATE_HEAD = struct.Struct("<dHHB")
"""Head of a state: time [s], D, flags, number of sources. Float32 w, x, y, z, gyro (3), q (D), dq (D) and torques (D) follow,
and for each source its name (length as a byte, ASCII) and its numbers (count as uint16, float32)."""
COMMAND_HEAD = struct.Struct("<IH")
"""Head of a command: sequence number of the answered state, D. Float32 targets, P gains and D gains (D each) follow."""
LARGEST = 60_000
"""Largest size of a packet [bytes]."""


@dataclass(frozen=True)
class RobotState:
    """Contents of a state packet."""

    time: float
    quaternion: np.ndarray
    gyro: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray
    torques: np.ndarray
    sources: Mapping[str, np.ndarray]


def packet(kind: int, sequence: int, body: bytes = b"") -> bytes:
    """Return a packet."""
    return HEADER.pack(MAGIC, kind, sequence & 0xFFFFFFFF) + body


def open_packet(data: bytes) -> tuple[int, int, bytes] | None:
    """Return kind, sequence number and body of a packet; None for other data."""
    if len(data) < HEADER.size:
        return None
    magic, kind, sequence = HEADER.unpack_from(data)
    return (kind, sequence, data[HEADER.size :]) if magic == MAGIC else None


def pack_json(value: Any) -> bytes:
    """Return the body of a greeting or of its answer."""
    return json.dumps(value).encode()


def facts_as_json(facts: RobotFacts) -> dict[str, Any]:
    """Return facts as plain data; null stands for no limit."""
    return {
        "name": facts.name,
        "joint_names": list(facts.joint_names),
        "position_limits": [[x if np.isfinite(x) else None for x in pair] for pair in facts.position_limits.tolist()],
        "velocity_limits": facts.velocity_limits.tolist(),
        "torque_limits": facts.torque_limits.tolist(),
        "imu_body": facts.imu_body,
        "offers": sorted(facts.offers),
    }


def facts_of_json(said: Mapping[str, Any]) -> RobotFacts:
    """Return the facts that `facts_as_json` wrote.

    Raises:
        ValueError, KeyError, TypeError: the data are no facts.
    """
    count = len(said["joint_names"])
    limits = np.array([[np.nan if x is None else x for x in pair] for pair in said["position_limits"]], dtype=float).reshape(
        count, 2
    )
    return RobotFacts(
        name=str(said["name"]),
        joint_names=tuple(said["joint_names"]),
        position_limits=np.where(np.isnan(limits), [-np.inf, np.inf], limits),
        velocity_limits=np.array(said["velocity_limits"], dtype=float).reshape(count),
        torque_limits=np.array(said["torque_limits"], dtype=float).reshape(count),
        imu_body=str(said["imu_body"]),
        offers=frozenset(said["offers"]),
    )


def pack_state(state: RobotState) -> bytes:
    """Return the body of a state."""
    rows = (state.quaternion, state.gyro, state.positions, state.velocities, state.torques)
    parts = [
        STATE_HEAD.pack(state.time, len(state.positions), 0, len(state.sources)),
        np.concatenate(rows, dtype="<f4").tobytes(),
    ]
    for name, values in state.sources.items():
        encoded = name.encode("ascii")
        parts += [struct.pack("<B", len(encoded)), encoded, struct.pack("<H", len(values))]
        parts.append(np.asarray(values, dtype="<f4").tobytes())
    return b"".join(parts)


def unpack_state(body: bytes) -> RobotState:
    """Return the state in a body.

    Raises:
        ValueError: the body is too short or too long.
    """
    try:
        time, count, _, sources = STATE_HEAD.unpack_from(body)
        place = STATE_HEAD.size
        numbers = np.frombuffer(body, "<f4", 7 + 3 * count, place).astype(float)
        place += 4 * len(numbers)
        found = {}
        for _ in range(sources):
            (length,) = struct.unpack_from("<B", body, place)
            name = body[place + 1 : place + 1 + length].decode("ascii")
            (size,) = struct.unpack_from("<H", body, place + 1 + length)
            found[name] = np.frombuffer(body, "<f4", size, place + 3 + length).astype(float)
            place += 3 + length + 4 * size
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(str(error)) from error
    if place != len(body):
        raise ValueError("its length is another")
    q, dq, torques = numbers[7:].reshape(3, count)
    return RobotState(time, numbers[:4], numbers[4:7], q, dq, torques, found)


def pack_command(answers: int, positions: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> bytes:
    """Return the body of a command."""
    return (
        COMMAND_HEAD.pack(answers & 0xFFFFFFFF, len(positions))
        + np.concatenate((positions, stiffness, damping), dtype="<f4").tobytes()
    )


def unpack_command(body: bytes) -> tuple[int, np.ndarray]:
    """Return the sequence number of the state that a command answers, and its targets, P gains and D gains (3, D).

    Raises:
        ValueError: the body is too short or too long, or its numbers are not finite.
    """
    if len(body) < COMMAND_HEAD.size:
        raise ValueError("it is cut short")
    answers, count = COMMAND_HEAD.unpack_from(body)
    numbers = np.frombuffer(body, "<f4", offset=COMMAND_HEAD.size).astype(float)
    if len(numbers) != 3 * count or not np.isfinite(numbers).all():
        raise ValueError("its numbers are others")
    return answers, numbers.reshape(3, count)
