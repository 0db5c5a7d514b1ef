"""Which of a training's processes this one is; torchrun says so in the environment."""

import os
from dataclasses import dataclass


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
        """As the environment says; one process, where it says nothing."""
        names = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")
        values = [int(os.environ.get(name, default)) for name, default in zip(names, (0, 0, 1, 1), strict=True)]
        return cls(*values) if values[2] > 1 else cls()

    @property
    def several(self) -> bool:
        """Whether there are others."""
        return self.count > 1

    @property
    def first(self) -> bool:
        """Whether this is the process that logs, prints and saves."""
        return self.rank == 0
