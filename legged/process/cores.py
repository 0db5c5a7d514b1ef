"""Number of cores that this process may use."""

import math
import os
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
"""Folder in which Linux states the limits of groups of processes."""


def available_cores() -> int:
    """Return the number of cores that this process may use: those in its affinity mask, limited by its cgroup's CPU quota."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    share = quota(CGROUPS, Path("/proc/self/cgroup"))
    return max(1, math.ceil(min(allowed, share)))


def quota(root: Path, membership: Path) -> float:
    """Return the smallest CPU quota of this process's cgroups, in cores; infinite if none has a quota. The file `membership`
    lists the cgroups, and their folders are below `root`.
    """
    try:
        groups = [line.split(":", 2) for line in membership.read_text().splitlines()]
    except OSError:
        return math.inf
    shares = [math.inf]
    for _, controllers, name in (group for group in groups if len(group) == 3):
        if controllers in ("", "cpu", "cpu,cpuacct"):
            top = root / controllers if controllers else root
            group = top / name.strip("/")
            shares += [_share(folder) for folder in (group, *group.parents) if folder.is_relative_to(top)]
    return min(shares)


def _share(folder: Path) -> float:
    """Return the CPU quota of one cgroup, in cores, from its file cpu.max (v2) or its files cpu.cfs_* (v1)."""
    try:
        if (folder / "cpu.max").is_file():
            most, period = (folder / "cpu.max").read_text().split()
        else:
            most, period = ((folder / f"cpu.cfs_{what}_us").read_text() for what in ("quota", "period"))
        return math.inf if most == "max" or int(most) <= 0 else int(most) / int(period)
    except (OSError, ValueError):
        return math.inf
