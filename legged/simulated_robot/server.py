"""A simulated robot in real time, reached by UDP over a link with latency and losses."""

import json
import random
import socket
import time
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from legged.deploy.udp_packets import (
    BYE,
    COMMAND,
    FACTS,
    HELLO,
    LARGEST,
    STATE,
    facts_as_json,
    open_packet,
    pack_json,
    pack_state,
    packet,
    unpack_command,
)
from legged.simulated_robot.robot import SimulatedRobot

STATE_S = 0.004
"""Interval between states, rounded to physics steps [s]."""
POSE_S = 0.04
"""Interval between the poses that are kept for a film, at most `MOST_POSES` [s]."""
MOST_POSES = 750
SOURCE_S = 0.02
"""Interval between the sources that are sent with states, rounded to states [s]."""
HOLD_S = 0.2
"""Time without a command after which motors brake with their present D gains [s]."""
BEHIND_S = 0.1
"""Largest delay of the simulated time that is made up for [s]."""


class Link:
    """One direction of a link, which delays packets by `latency_s` and loses some."""

    def __init__(self, latency_s: float, loss: float, seed: int) -> None:
        """Lose a share `loss` of the packets, drawn from `seed`."""
        self._latency_s, self._loss = latency_s, loss
        self._random = random.Random(seed)
        self._waiting: deque[tuple[float, bytes]] = deque()
        self.sent = self.lost = 0

    def put(self, now: float, packet: bytes) -> None:
        """Send a packet at the time `now` [s]."""
        self.sent += 1
        if self._random.random() < self._loss:
            self.lost += 1
        else:
            self._waiting.append((now + self._latency_s, packet))

    def take(self, now: float) -> list[bytes]:
        """Return the packets that have arrived at the time `now` [s], in their order of sending."""
        found = []
        while self._waiting and self._waiting[0][0] <= now:
            found.append(self._waiting.popleft()[1])
        return found


@dataclass
class Server:
    """Real-time loop that steps a robot, sends its states and applies commands."""

    robot: SimulatedRobot
    latency_s: float = 0.0
    """Latency of each direction [s]."""
    loss: float = 0.0
    """Share of lost packets in each direction."""
    seed: int = 1
    poses: list[np.ndarray] = field(default_factory=list)
    """Time [s] and MuJoCo's generalised positions, (1 + nq,) each."""
    _socket: socket.socket = field(init=False)

    def __post_init__(self) -> None:
        """Take a free port of this machine."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self._out, self._in = Link(self.latency_s, self.loss, self.seed), Link(self.latency_s, self.loss, self.seed + 1)
        self._client: tuple[str, int] | None = None
        self._sources: dict[str, np.ndarray | None] = {}
        self._sequence = self._newest = 0
        self._told: float | None = None
        self._gone = False
        self.skipped_s = 0.0
        """Time by which the simulation fell behind and which it gave up [s]."""

    def run(self, seconds: float) -> dict[str, float | bool]:
        """Run until the program says goodbye, or for so long [s]; return the robot's report and that of the link. Time stands
        still until the first command has come.
        """
        dt = self.robot.model.opt.timestep
        state_steps, pose_steps = (max(1, round(each / dt)) for each in (STATE_S, POSE_S))
        source_steps = state_steps * max(1, round(SOURCE_S / (state_steps * dt)))
        began = time.perf_counter()
        due, steps = began, 0
        while not self._gone and (now := time.perf_counter()) - began < seconds:
            self._listen(now)
            if self._told is None:
                due = now + dt
                time.sleep(0.002)
                self._send_state(now, {})
                self._deliver(now)
                continue
            if now - due > BEHIND_S:
                self.skipped_s += now - due
                due = now
            while due <= now:
                self._brake_if_alone()
                self.robot.step()
                steps += 1
                due += dt
                if steps % state_steps == 0:
                    self._send_state(now, self._sources if steps % source_steps == 0 else {})
                if steps % pose_steps == 0 and len(self.poses) < MOST_POSES:
                    self.poses.append(np.array([self.robot.data.time, *self.robot.data.qpos]))
            self._deliver(now)
            time.sleep(max(0.0, min(due - time.perf_counter(), dt)))
        self._socket.close()
        link = {"sent": self._out.sent, "received": self._in.sent, "lost": self._out.lost + self._in.lost}
        return {**self.robot.report(), **link, "skipped_s": self.skipped_s}

    def _listen(self, now: float) -> None:
        """Process the packets that have arrived."""
        while True:
            try:
                data, client = self._socket.recvfrom(LARGEST)
            except OSError:  # no more packets, or the receiver has closed
                break
            opened = open_packet(data)
            if opened is None:
                continue
            if opened[0] == HELLO:
                self._greet(client, opened[2])
            elif client == self._client and opened[0] == BYE:  # not subject to the link, so that the simulation always ends
                self._gone = True
            elif client == self._client:
                self._in.put(now, data)
        for data in self._in.take(now):
            opened = open_packet(data)
            assert opened is not None, "only packets of ours are put into the link"
            self._obey(*opened)

    def _greet(self, client: tuple[str, int], body: bytes) -> None:
        """Answer a greeting; its sender receives the states from now on."""
        try:
            sources = json.loads(body)["sources"]
            wanted = {name: None if p is None else np.array(p, dtype=float).reshape(-1, 2) for name, p in sources.items()}
        except (ValueError, KeyError, TypeError, AttributeError):
            return
        if client != self._client:
            self._newest = 0
        self._client, self._sources = client, wanted
        self._send(packet(FACTS, 0, pack_json(facts_as_json(self.robot.facts))))

    def _obey(self, kind: int, sequence: int, body: bytes) -> None:
        """Apply a command packet unless a later one has arrived before."""
        if kind != COMMAND or sequence <= self._newest:
            return
        try:
            _, asked = unpack_command(body)
        except ValueError:
            return
        if asked.shape == self.robot.asked.shape:
            self._newest = sequence
            self.robot.asked = asked
            self._told = self.robot.data.time

    def _brake_if_alone(self) -> None:
        """Set the P gains to zero if commands have stopped."""
        if self._told is not None and self.robot.data.time - self._told > HOLD_S:
            self.robot.asked[1] = 0.0

    def _send_state(self, now: float, sources: dict[str, np.ndarray | None]) -> None:
        """Put a state into the link."""
        self._sequence += 1
        self._out.put(now, packet(STATE, self._sequence, pack_state(self.robot.state(sources))))

    def _deliver(self, now: float) -> None:
        """Send the packets that have passed the link."""
        for data in self._out.take(now):
            self._send(data)

    def _send(self, data: bytes) -> None:
        if self._client is not None:
            try:
                self._socket.sendto(data, self._client)
            except OSError:  # the receiver has closed
                return
