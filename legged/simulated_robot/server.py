"""A simulated robot in real time, reached by UDP over a network connection with latency and packet loss."""

import random
import socket
import time
from collections import deque
from contextlib import suppress
from typing import Any

import numpy as np

from legged.deploy import udp
from legged.simulated_robot.robot import SimulatedRobot

STATE_S = 0.004
"""Interval between states that are sent, rounded to whole physics steps [s]."""
POSE_S = 0.04
"""Interval between the poses that are kept for a film [s]. At most `MOST_POSES` poses are kept."""
MOST_POSES = 750
SOURCE_S = 0.02
"""Interval between states that include `Reading.sources` [s], rounded to a multiple of the interval between states."""
HOLD_S = 0.2
"""Time without a command after which motors brake with their present D gains [s]."""
BEHIND_S = 0.1
"""Largest lag behind real time that the simulation catches up with [s]. It skips a larger lag."""


class Link:
    """One direction of a network connection. It delays packets by `latency_s` [s] and loses a random share `loss` of them."""

    def __init__(self, latency_s: float, loss: float, seed: int) -> None:
        self._latency_s, self._loss, self._random = latency_s, loss, random.Random(seed)
        self._waiting: deque[tuple[float, Any]] = deque()
        self.sent = self.lost = 0

    def put(self, now: float, item: Any) -> None:
        """Send a packet at the time `now` [s]."""
        self.sent += 1
        if self._random.random() < self._loss:
            self.lost += 1
        else:
            self._waiting.append((now + self._latency_s, item))

    def take(self, now: float) -> list[Any]:
        """Return the packets that have arrived at the time `now` [s], in their order of sending."""
        found = []
        while self._waiting and self._waiting[0][0] <= now:
            found.append(self._waiting.popleft()[1])
        return found


class Server:
    """Real-time loop that steps a robot, sends its states and applies commands."""

    def __init__(self, robot: SimulatedRobot, latency_s: float = 0.0, loss: float = 0.0, seed: int = 1) -> None:
        """Open a free port of this machine. Each direction delays packets by `latency_s` [s] and loses a share `loss`."""
        self.robot = robot
        self.poses: list[np.ndarray] = []
        """Recorded poses (1 + nq,): time [s] and MuJoCo's generalised positions."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self._out, self._in = Link(latency_s, loss, seed), Link(latency_s, loss, seed + 1)
        self._client: tuple[str, int] | None = None
        self._sources: dict[str, np.ndarray | None] = {}
        self._sequence = self._newest = 0
        self._told: float | None = None
        self._gone = False
        self.skipped_s = 0.0
        """Sum of the lags behind real time that the simulation skipped [s]."""

    def run(self, seconds: float) -> dict[str, float | bool]:
        """Run until the client says goodbye, but at most for `seconds`. Return the robot's report and the counts of packets.
        The simulated time stands still until the first command has arrived.
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
                if self.robot.data.time - self._told > HOLD_S:  # commands have stopped
                    self.robot.asked[1] = 0.0
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
                data, client = self._socket.recvfrom(udp.LARGEST)
            except OSError:  # there are no more packets, or the client has closed its socket
                break
            kind, sequence, body = udp.open_packet(data) or (None, 0, b"")
            if kind == udp.HELLO:
                with suppress(ValueError, KeyError, TypeError, AttributeError, OSError):  # unknown senders may send anything
                    self._sources = udp.unpack_sources(body)
                    if client != self._client:
                        self._newest = 0
                    self._client = client  # this client receives the states from now on
                    self._socket.sendto(udp.packet(udp.FACTS, 0, udp.pack_facts(self.robot.facts)), client)
            elif client == self._client and kind == udp.BYE:  # BYE is never lost on purpose, so that the run always ends
                self._gone = True
            elif client == self._client and kind == udp.COMMAND:
                self._in.put(now, (sequence, body))
        for sequence, body in self._in.take(now):
            with suppress(ValueError):
                _, asked = udp.unpack_command(body)
                if sequence > self._newest and asked.shape == self.robot.asked.shape:  # newer than the last command
                    self._newest, self.robot.asked, self._told = sequence, asked, self.robot.data.time

    def _send_state(self, now: float, sources: dict[str, np.ndarray | None]) -> None:
        self._sequence += 1
        self._out.put(now, udp.packet(udp.STATE, self._sequence, udp.pack_state(self.robot.state(sources))))

    def _deliver(self, now: float) -> None:
        for data in self._out.take(now):
            if self._client is not None:
                with suppress(OSError):  # the client may have closed its socket
                    self._socket.sendto(data, self._client)
