"""Only the cores that a process may use are counted."""

import math
import os
import subprocess
import sys

import pytest

from legged.process.cores import available_cores, quota


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux says where a process may run")
def test_only_the_cores_that_a_process_may_run_on_are_counted():
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert available_cores() == 1
    finally:
        os.sched_setaffinity(0, before)
    assert 1 <= available_cores() <= len(before)


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, math.inf),
        ({"a/b/cpu.max": "max 100000\n"}, math.inf),
        ({"a/b/cpu.max": "150000 100000\n"}, 1.5),
        ({"a/b/cpu.max": "400000 100000\n", "a/cpu.max": "50000 100000\n"}, 0.5),
        ({"cpu.max": "300000 100000\n"}, 3.0),
        ({"cpu/a/b/cpu.cfs_quota_us": "250000\n", "cpu/a/b/cpu.cfs_period_us": "100000\n"}, 2.5),
        ({"cpu/a/b/cpu.cfs_quota_us": "-1\n", "cpu/a/b/cpu.cfs_period_us": "100000\n"}, math.inf),
        ({"a/b/cpu.max": "nonsense\n"}, math.inf),
    ],
)
def test_a_group_s_share_of_time_is_the_smallest_up_to_the_root(tmp_path, files, cores):
    for name, text in files.items():
        path = tmp_path / "root" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    old = any(name.startswith("cpu/") for name in files)
    (tmp_path / "groups").write_text("4:memory:/x\n3:cpu:/a/b\n" if old else "0::/a/b\n")
    assert quota(tmp_path / "root", tmp_path / "groups") == cores


def test_without_groups_nothing_is_limited(tmp_path):
    assert quota(tmp_path, tmp_path / "missing") == math.inf


@pytest.mark.slow
@pytest.mark.parametrize(("given", "found"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_threads_wait_without_spinning_unless_the_user_says_otherwise(given, found):
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {"OMP_WAIT_POLICY": given} if given else {}
    code = "import legged, os; print(os.environ['OMP_WAIT_POLICY'])"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == found
