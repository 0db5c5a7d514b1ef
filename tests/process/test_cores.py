"""Which cores are used: those that are allowed, and one alone where the others are busy."""

import math
import os
import subprocess
import sys

import pytest
import torch
from helpers import small_task

from legged.learning.captured import CapturedRunner
from legged.learning.rollout import Rollout
from legged.learning.update_threads import LOOK_AGAIN, UpdateThreads
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


class Machine:
    """A made-up clock and machine: an update takes so long with one thread, and so long with two."""

    def __init__(self, one: float, two: float) -> None:
        self.now, self.times = 0.0, {1: one, 2: two}
        self.threads = UpdateThreads(2, lambda: self.now)

    def updates(self, count: int) -> list[int]:
        used = []
        for _ in range(count):
            used.append(self.threads.count)
            with self.threads.use():
                self.now += self.times[torch.get_num_threads()]
        return used


def test_alone_one_thread_is_tried_once():
    assert Machine(one=1.0, two=0.6).updates(50) == [2, 1, *[2] * 48]


def test_beside_a_busy_neighbour_one_thread_is_used_and_two_are_tried_now_and_then():
    used = Machine(one=1.0, two=3.0).updates(1 + 3 * (LOOK_AGAIN + 1))
    assert used == [2, *[1] * LOOK_AGAIN, 2, *[1] * LOOK_AGAIN, 2, *[1] * LOOK_AGAIN, 2]


def test_a_neighbour_that_comes_and_goes_is_noticed():
    machine = Machine(one=1.0, two=0.6)
    machine.updates(10)
    machine.times[2] = 2.0
    assert machine.updates(3) == [2, 1, 1]
    machine.times[2] = 0.6
    used = machine.updates(2 * LOOK_AGAIN)
    assert 2 in used
    assert used[used.index(2) :] == [2] * len(used[used.index(2) :])


def test_threads_are_put_back_also_after_an_error():
    before = torch.get_num_threads()
    threads, used = UpdateThreads(3), []

    def fail() -> None:
        used.append(torch.get_num_threads())
        raise ValueError("mine")

    with pytest.raises(ValueError, match="mine"), threads.use():
        fail()
    assert used == [3]
    assert torch.get_num_threads() == before
    assert threads.count == 3


@pytest.mark.slow
def test_an_update_gives_the_same_numbers_with_any_number_of_threads():
    """So that the choice, which depends on the neighbours, does not decide what is learned."""
    found = []
    for threads in (1, 2, 3):
        torch.manual_seed(0)
        task = small_task(("train.runner.num_steps_per_env", 24), num_envs=256)
        torch.manual_seed(0)
        runner = CapturedRunner(task)
        Rollout(task, runner.alg).collect()
        torch.set_num_threads(threads)
        runner.alg.learn(2)
        torch.set_num_threads(1)
        found.append([parameter.detach().clone() for parameter in runner.alg.actor.parameters()])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))
