"""A robot that is reached by UDP, and its packets. The robot is a simulator in another process, or a bridge to a real robot.

A packet is `HEADER` (magic, kind, sequence number) and a body, all little-endian. The program begins the handshake with
HELLO, whose body lists the requested sources. The robot answers with FACTS. Both bodies are JSON. Then the robot sends
states to the last sender of a HELLO, and the program sends commands. States and commands have increasing sequence numbers.
"""

import json
import socket
import struct
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from legged.deploy.contract import plain_json
from legged.deploy.errors import ConfigError, RunError
from legged.deploy.interface import Interface, Reading, RobotFacts

HEADER = struct.Struct("<4sBxxxI")
MAGIC = b"LGD1"
HELLO, FACTS, STATE, COMMAND, BYE = range(1, 6)
STATE_HEAD = struct.Struct("<dHHB")
"""Head of a state: time [s], number D of joints, flags (0), number of sources. Then come float32 numbers:
quaternion (4), gyro (3), joint angles (D), joint velocities (D) and torques (D). Then each source has the length of its name
(uint8), the name (ASCII), the count of its numbers (uint16) and the numbers (float32)."""
COMMAND_HEAD = struct.Struct("<IH")
"""Head of a command: sequence number of the newest state, D. Then come float32 targets (D), P gains (D) and D gains (D)."""
LARGEST = 60_000
"""Largest size of a packet [bytes]."""
ANSWER_S = 10.0
"""Time within which a robot must answer a HELLO [s]."""
ASK_EVERY_S = 0.1
SO_TIMESTAMP = getattr(socket, "SO_TIMESTAMP", 29)
"""Linux's socket option that adds a message with the arrival time to each packet. The message's type is the same number."""
MOMENT = struct.Struct("@ll")
"""Arrival time in a message of SO_TIMESTAMP, by the clock of `time.time`: seconds and microseconds."""
SET_S = 0.01
"""If the difference of `time.perf_counter` and `time.time` changes by more than this, the time of day counts as reset [s]."""
SOURCE_AGE_S = 0.2
"""Age at which the value of a source expires [s]. This machine's clock measures it, because a robot may have no clock."""


def packet(kind: int, sequence: int, body: bytes = b"") -> bytes:
    """Return a packet."""
    return HEADER.pack(MAGIC, kind, sequence & 0xFFFFFFFF) + body


def open_packet(data: bytes) -> tuple[int, int, bytes] | None:
    """Return kind, sequence number and body of a packet; None for other data."""
    if len(data) < HEADER.size:
        return None
    magic, kind, sequence = HEADER.unpack_from(data)
    return (kind, sequence, data[HEADER.size :]) if magic == MAGIC else None


def pack_sources(sources: Mapping[str, np.ndarray | None]) -> bytes:
    """Return the body of a HELLO. `sources` has the points (P, 2) [m] of each source, or None for a source without points."""
    wanted = {name: None if points is None else points.tolist() for name, points in sources.items()}
    return json.dumps({"sources": wanted}).encode()


def unpack_sources(body: bytes) -> dict[str, np.ndarray | None]:
    """Return the sources of a HELLO.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: the body is no HELLO, or has points that are not finite.
    """
    found: dict[str, np.ndarray | None] = {}
    for name, given in plain_json(body)["sources"].items():
        points = None if given is None else np.array(given, dtype=float).reshape(-1, 2)
        if points is not None and not np.isfinite(points).all():
            raise ValueError(f"{name}: its points are not finite")
        found[name] = points
    return found


def pack_facts(facts: RobotFacts) -> bytes:
    """Return the body of FACTS. An infinite position limit is written as null."""
    limits = [[x if np.isfinite(x) else None for x in pair] for pair in facts.position_limits.tolist()]
    said = {**vars(facts), "position_limits": limits, "offers": sorted(facts.offers)}
    return json.dumps(said, default=np.ndarray.tolist).encode()


def unpack_facts(body: bytes) -> RobotFacts:
    """Return the facts in the body of FACTS.

    Raises:
        ValueError, KeyError, TypeError: the body has no facts.
    """
    said: Mapping[str, Any] = plain_json(body)
    count = len(said["joint_names"])
    limits = np.array(said["position_limits"], dtype=float).reshape(count, 2)  # null becomes NaN
    return RobotFacts(
        name=str(said["name"]),
        joint_names=tuple(said["joint_names"]),
        position_limits=np.where(np.isnan(limits), [-np.inf, np.inf], limits),
        velocity_limits=np.array(said["velocity_limits"], dtype=float).reshape(count),
        torque_limits=np.array(said["torque_limits"], dtype=float).reshape(count),
        imu_body=str(said["imu_body"]),
        offers=frozenset(said["offers"]),
    )


def pack_state(state: Reading) -> bytes:
    """Return the body of a STATE packet. `state.torques` must not be None."""
    assert state.torques is not None
    rows = (state.quaternion, state.gyro, state.positions, state.velocities, state.torques)
    parts = [STATE_HEAD.pack(state.time, len(state.positions), 0, len(state.sources))]
    parts.append(np.concatenate(rows, dtype="<f4").tobytes())
    for name, values in state.sources.items():
        encoded = name.encode("ascii")
        parts += [struct.pack("<B", len(encoded)), encoded, struct.pack("<H", len(values))]
        parts.append(np.asarray(values, dtype="<f4").tobytes())
    return b"".join(parts)


def unpack_state(body: bytes, received: float) -> Reading:
    """Return the state in a body that arrived at the time `received` [s].

    Raises:
        ValueError: the body is too short or too long.
    """
    try:
        moment, count, _, sources = STATE_HEAD.unpack_from(body)
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
        raise ValueError("the length of the state is larger than its head says")
    q, dq, torques = numbers[7:].reshape(3, count)
    return Reading(moment, received, numbers[:4], numbers[4:7], q, dq, torques, sources=found)


def pack_command(answers: int, positions: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> bytes:
    """Return the body of a command; `answers` is the sequence number of the newest state."""
    numbers = np.concatenate((positions, stiffness, damping), dtype="<f4")
    return COMMAND_HEAD.pack(answers & 0xFFFFFFFF, len(positions)) + numbers.tobytes()


def unpack_command(body: bytes) -> tuple[int, np.ndarray]:
    """Return the contents of a command: the sequence number in its head, and targets, P gains and D gains (3, D).

    Raises:
        ValueError: the body is too short or too long, or its numbers are not finite.
    """
    if len(body) < COMMAND_HEAD.size:
        raise ValueError("the command is shorter than its head")
    answers, count = COMMAND_HEAD.unpack_from(body)
    numbers = np.frombuffer(body, "<f4", offset=COMMAND_HEAD.size).astype(float)
    if len(numbers) != 3 * count or not np.isfinite(numbers).all():
        raise ValueError("the numbers of the command are too few, too many or not finite")
    return answers, numbers.reshape(3, count)


class UdpRobot(Interface):
    """A robot that sends and receives the packets of this module."""

    def __init__(self, address: str) -> None:
        """Connect to the robot at `address` ("host:port") and receive its facts.

        Raises:
            ConfigError: the address is invalid.
            RunError: no robot answers.
        """
        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
            raise ConfigError(f"--robot: udp:{address}: expected udp:HOST:PORT")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, int(port)))
        except OSError as error:
            self._socket.close()
            raise ConfigError(f"--robot: udp:{address}: {error.strerror or error}") from error
        self._socket.setblocking(False)
        if sys.platform == "linux":
            self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMP, 1)
        self._sent = self._newest = 0
        self._behind = time.perf_counter() - time.time()
        self._seen: dict[str, tuple[float, np.ndarray]] = {}
        self._asked: set[str] = set()
        self._greeting = packet(HELLO, 0, pack_sources({}))
        self.facts = self._greet(address)

    def _greet(self, address: str) -> RobotFacts:
        end = time.perf_counter() + ANSWER_S
        while time.perf_counter() < end:
            self._send(self._greeting)
            time.sleep(ASK_EVERY_S)
            for _, body, _ in self._received(FACTS):
                with suppress(ValueError, KeyError, TypeError):  # the packet may not come from a robot
                    return unpack_facts(body)
        self._socket.close()
        raise RunError(f"--robot: no robot answers at udp:{address} within {ANSWER_S:g} s")

    def _send(self, data: bytes) -> None:
        """Send a packet; a failure counts as a lost packet."""
        with suppress(OSError):
            self._socket.send(data)

    def _received(self, kind: int) -> list[tuple[int, bytes, float]]:
        """Return sequence number, body and time of arrival (by `time.perf_counter` [s]) of each new packet of a kind. If the
        time of day was reset since the last call, the present time replaces the times of arrival.
        """
        found: list[tuple[int, bytes, float]] = []
        now, behind = time.perf_counter(), time.perf_counter() - time.time()
        was_set, self._behind = abs(behind - self._behind) > SET_S, behind
        while True:
            try:
                data, notes, _, _ = self._socket.recvmsg(LARGEST, socket.CMSG_SPACE(MOMENT.size))
            except OSError:  # there are no more packets, or the last sent packet had no receiver
                return found
            came = time.time()
            for level, name, value in notes:
                if (level, name, len(value)) == (socket.SOL_SOCKET, SO_TIMESTAMP, MOMENT.size):
                    seconds, microseconds = MOMENT.unpack(value)
                    came = seconds + 1e-6 * microseconds
            opened = open_packet(data)
            if opened is not None and opened[0] == kind:
                found.append((*opened[1:], now if was_set else came + behind))

    def ask(self, sources: Mapping[str, np.ndarray | None]) -> None:
        self._greeting = packet(HELLO, 1, pack_sources(sources))
        self._asked = set(sources)
        self._send(self._greeting)

    def read(self) -> list[Reading]:
        found = []
        for number, body, came in self._received(STATE):
            try:
                state = unpack_state(body, came)
            except ValueError:
                continue
            if number <= self._newest or len(state.positions) != len(self.facts.joint_names):
                continue
            self._newest = number
            self._seen |= {name: (came, values) for name, values in state.sources.items()}
            fresh = {name: values for name, (at, values) in self._seen.items() if came - at <= SOURCE_AGE_S}
            found.append(replace(state, sources=fresh))
        if found and not self._asked <= found[-1].sources.keys():
            self._send(self._greeting)  # the previous HELLO may be lost
        return found

    def write(self, positions: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        self._sent += 1
        self._send(packet(COMMAND, self._sent, pack_command(self._newest, positions, stiffness, damping)))

    def close(self) -> None:
        self._send(packet(BYE, self._sent + 1))
        self._socket.close()
