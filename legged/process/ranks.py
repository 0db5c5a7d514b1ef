"""Rank of this process in a training on several GPUs, from the environment that torchrun sets."""

import os
from dataclasses import dataclass

from legged.errors import ConfigError


@dataclass(frozen=True)
class Ranks:
    """Rank of this process among the processes that train together, one process for each GPU."""

    rank: int = 0
    """Number of this process. Process 0 logs, prints and saves."""
    local_rank: int = 0
    """Number of this process among those on its machine; also the number of its GPU."""
    count: int = 1
    """Number of processes."""
    local_count: int = 1
    """Number of processes on this machine."""

    @classmethod
    def now(cls) -> "Ranks":
        """Return the ranks in the environment, or those of a single process if the environment has none.

        Raises:
            ConfigError: the environment has impossible values.
        """
        rank, local_rank = _whole("RANK", 0, 0), _whole("LOCAL_RANK", 0, 0)
        count, local_count = _whole("WORLD_SIZE", 1, 1), _whole("LOCAL_WORLD_SIZE", 1, 1)
        if count == 1:
            return cls()
        for name, value, end in (("RANK", rank, count), ("LOCAL_RANK", local_rank, local_count)):
            if value >= end:
                raise ConfigError(f"{name}: must be below {end}, the number of processes, got {value}; torchrun sets {name}")
        return cls(rank, local_rank, count, local_count)

    @property
    def several(self) -> bool:
        """True if there are several processes."""
        return self.count > 1

    @property
    def first(self) -> bool:
        """True if this is the process that logs, prints and saves."""
        return self.rank == 0


def _whole(name: str, default: int, least: int) -> int:
    """Return the whole number in the environment variable `name`, or `default` if the variable is missing or empty."""
    text = os.environ.get(name, "").strip()
    if not text:
        return default
    if not (text.isdecimal() and int(text) >= least):
        raise ConfigError(f"{name}: the environment says '{text}'; expected a whole number of at least {least}, or nothing")
    return int(text)
