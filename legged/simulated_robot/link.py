"""A link that is as bad as one asks for: packets come late, or not at all."""

import random
from collections import deque


class Link:
    """One direction of a link: packets go in, and come out `latency_s` later, if they are not lost."""

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
        """Return what has come out by the time `now` [s], in the order in which it went in."""
        found = []
        while self._waiting and self._waiting[0][0] <= now:
            found.append(self._waiting.popleft()[1])
        return found
