"""A robot reached by UDP: the simulator in another process, or a bridge to a robot's computer."""

import json
import socket
import struct
import sys
import time
from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from legged.deploy.interface import Interface, Reading, RobotFacts
from legged.deploy.udp_packets import (
    BYE,
    COMMAND,
    FACTS,
    HELLO,
    LARGEST,
    STATE,
    facts_of_json,
    open_packet,
    pack_command,
    pack_json,
    packet,
    unpack_state,
)
from legged.errors import ConfigError, RunError

ANSWER_S = 10.0
"""Time within which a robot must answer a greeting [s]."""
ASK_EVERY_S = 0.1
SO_TIMESTAMP = getattr(socket, "SO_TIMESTAMP", 29)
"""Linux's socket option for arrival times of packets, as `time.time`, and the name of that information."""
MOMENT = struct.Struct("@ll")
"""Seconds and microseconds."""
SET_S = 0.01
"""Smallest change of the difference between this machine's two clocks that counts as a reset of its time of day [s]."""
SOURCE_AGE_S = 0.2
"""Age at which the value of a source expires, by this machine's clock, since a robot may have none [s]."""


class UdpRobot(Interface):
    """A robot that uses the packets of `udp_packets`."""

    def __init__(self, address: str) -> None:
        """Greet the robot at `address`, "host:port".

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
        self._greeting = packet(HELLO, 0, pack_json({"sources": {}}))
        self.facts = self._greet(address)

    def _greet(self, address: str) -> RobotFacts:
        end = time.perf_counter() + ANSWER_S
        while time.perf_counter() < end:
            self._send(self._greeting)
            time.sleep(ASK_EVERY_S)
            for data, _ in self._received():
                opened = open_packet(data)
                if opened is None or opened[0] != FACTS:
                    continue
                with suppress(ValueError, KeyError, TypeError, RecursionError):  # not from a robot
                    return facts_of_json(json.loads(opened[2]))
        self._socket.close()
        raise RunError(f"--robot: no robot answers at udp:{address} within {ANSWER_S:g} s")

    def _send(self, data: bytes) -> None:
        """Send a packet; a failure counts as a lost packet."""
        try:
            self._socket.send(data)
        except OSError:
            return

    def _received(self) -> list[tuple[bytes, float]]:
        """Return the new packets with their times of arrival, as `time.perf_counter` [s]. If the time of day was set in
        between, the present time replaces them.
        """
        found: list[tuple[bytes, float]] = []
        now, behind = time.perf_counter(), time.perf_counter() - time.time()
        was_set, self._behind = abs(behind - self._behind) > SET_S, behind
        while True:
            try:
                data, notes, _, _ = self._socket.recvmsg(LARGEST, socket.CMSG_SPACE(MOMENT.size))
            except OSError:  # no more packets, or the last one sent had no receiver
                return found
            came = time.time()
            for level, kind, value in notes:
                if (level, kind, len(value)) == (socket.SOL_SOCKET, SO_TIMESTAMP, MOMENT.size):
                    seconds, microseconds = MOMENT.unpack(value)
                    came = seconds + 1e-6 * microseconds
            found.append((data, now if was_set else came + behind))

    def ask(self, sources: Mapping[str, np.ndarray | None]) -> None:
        wanted = {name: None if points is None else points.tolist() for name, points in sources.items()}
        self._greeting = packet(HELLO, 1, pack_json({"sources": wanted}))
        self._asked = set(wanted)
        self._send(self._greeting)

    def read(self) -> list[Reading]:
        found = []
        for data, came in self._received():
            opened = open_packet(data)
            if opened is None or opened[0] != STATE or opened[1] <= self._newest:
                continue
            try:
                state = unpack_state(opened[2])
            except ValueError:
                continue
            if len(state.positions) != len(self.facts.joint_names):
                continue
            self._newest = opened[1]
            self._seen |= {name: (came, values) for name, values in state.sources.items()}
            fresh = {name: values for name, (at, values) in self._seen.items() if came - at <= SOURCE_AGE_S}
            found.append(
                Reading(
                    time=state.time,
                    received=came,
                    quaternion=state.quaternion,
                    gyro=state.gyro,
                    positions=state.positions,
                    velocities=state.velocities,
                    torques=state.torques,
                    sources=fresh,
                )
            )
        if found and not self._asked <= found[-1].sources.keys():
            self._send(self._greeting)  # the first greeting may be lost
        return found

    def write(self, positions: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        self._sent += 1
        self._send(packet(COMMAND, self._sent, pack_command(self._newest, positions, stiffness, damping)))

    def close(self) -> None:
        self._send(packet(BYE, self._sent + 1))
        self._socket.close()
