"""Which of a training's processes this one is; torchrun says so in the environment."""

import os
from dataclasses import dataclass

from legged.errors import ConfigError


@dataclass(frozen=True)
class Ranks:
    """The place of this process among those that train together, one for each GPU."""

    rank: int = 0
    """Number of this process; number 0 logs, prints and saves."""
    local_rank: int = 0
    """Its number on this machine, and that of its GPU."""
    count: int = 1
    """Processes in all."""
    local_count: int = 1
    """Processes on this machine."""

    @classmethod
    def now(cls) -> "Ranks":
        """Return what the environment says; one process, where it says nothing.

        Raises:
            ConfigError: it says something that can't be.
        """
        rank, local_rank = _whole("RANK", 0, 0), _whole("LOCAL_RANK", 0, 0)
        count, local_count = _whole("WORLD_SIZE", 1, 1), _whole("LOCAL_WORLD_SIZE", 1, 1)
        if count == 1:
            return cls()
        for name, value, end in (("RANK", rank, count), ("LOCAL_RANK", local_rank, local_count)):
            if value >= end:
                raise ConfigError(f"{name}: must be below {end}, the number of processes, got {value}; torchrun sets it")
        return cls(rank, local_rank, count, local_count)

    @property
    def several(self) -> bool:
        """Whether there are others."""
        return self.count > 1

    @property
    def first(self) -> bool:
        """Whether this is the process that logs, prints and saves."""
        return self.rank == 0


def _whole(name: str, default: int, least: int) -> int:
    """Return a whole number in the environment; one that is empty says nothing."""
    text = os.environ.get(name, "").strip()
    if not text:
        return default
    if not (text.isdecimal() and int(text) >= least):
        raise ConfigError(f"{name}: the environment says '{text}'; a whole number of at least {least} is allowed, or nothing")
    return int(text)
