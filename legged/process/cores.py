"""How many cores this process may use."""

import math
import os
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
"""Where Linux says what a group of processes may use."""


def available_cores() -> int:
    """Count the cores that this process may use: those that it may run on, and no more than its group's share of time."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    share = quota(CGROUPS, Path("/proc/self/cgroup"))
    return max(1, math.ceil(min(allowed, share)))


def quota(root: Path, membership: Path) -> float:
    """Return the cores' worth of time that the groups of this process may use, the smallest of theirs; infinite where nothing
    is said. `membership` lists the groups, whose folders lie below `root`.
    """
    try:
        groups = [line.split(":", 2) for line in membership.read_text().splitlines()]
    except OSError:
        return math.inf
    smallest = math.inf
    for _, controllers, name in (group for group in groups if len(group) == 3):
        if controllers not in ("", "cpu", "cpu,cpuacct"):
            continue
        top = root / controllers if controllers else root
        group = top / name.strip("/")
        for folder in (group, *group.parents):
            smallest = min(smallest, _share(folder))
            if folder == top:
                break
    return smallest


def _share(folder: Path) -> float:
    """Return the cores' worth of time that one group may use: cpu.max of cgroup v2, cpu.cfs_* of v1."""
    try:
        if (folder / "cpu.max").is_file():
            most, period = (folder / "cpu.max").read_text().split()
        else:
            most, period = ((folder / f"cpu.cfs_{what}_us").read_text() for what in ("quota", "period"))
        return math.inf if most == "max" or int(most) <= 0 else int(most) / int(period)
    except (OSError, ValueError):
        return math.inf
