"""What a replay of a CUDA graph would freeze: counters, random numbers of the host, tensors made anew in every step."""

import random
from collections import deque

import numpy as np
import pytest
import torch

from legged.errors import TermError
from legged.graph.guard import HostReadError, calling
from legged.graph.step_graph import StepGraph

CPU = torch.device("cpu")


@pytest.fixture(params=[False, True], ids=["plain", "inference"])
def inference(request):
    """Operators reach a dispatch mode in other pieces in inference mode."""
    with torch.inference_mode(request.param):
        yield


COUNTS = {"calls": 0}


class Task:
    """A stand-in: a step that calls one term."""

    def __init__(self):
        COUNTS["calls"] = 0
        self.foo = torch.ones(4)
        self.out = torch.zeros(4)
        self.last_foo = torch.zeros(4)
        self.table = {"last": torch.zeros(4)}
        self.steps = deque([torch.zeros(4)], maxlen=2)
        self.n, self.mode, self.numbers, self.array = 3, "walk", [1], np.zeros(2)
        self.generator = np.random.default_rng(0)

    def step(self) -> None:
        self.foo.add_(1.0)
        with calling("_reward_mine"):
            self.out.copy_(self.term())

    def term(self) -> torch.Tensor:
        return self.foo

    def grown(self) -> torch.Tensor:
        change = self.foo - self.last_foo
        self.last_foo = self.foo.clone()
        return change


class Counts(Task):
    def term(self):
        self.n += 1
        return self.foo


class Schedules(Task):
    def term(self):
        self.n += 1
        return self.foo * (2.0 if self.n > 1000 else 1.0)


class ChangesMode(Task):
    def term(self):
        self.mode = "run" if self.mode == "walk" else "walk"
        return self.foo


class Appends(Task):
    def term(self):
        self.numbers.append(1)
        return self.foo


class WritesArray(Task):
    def term(self):
        self.array[0] += 1.0
        return self.foo


class DrawsByNumpy(Task):
    def term(self):
        return self.foo * np.random.rand()


class DrawsByPython(Task):
    def term(self):
        return self.foo * (0.0 if random.random() < 0.5 else 1.0)


class DrawsByItsGenerator(Task):
    def term(self):
        return self.foo * float(self.generator.random())


class CountsElsewhere(Task):
    def term(self):
        COUNTS["calls"] += 1
        return self.foo * COUNTS["calls"]


class CountsInATensor(Task):
    def term(self):
        COUNTS["calls"] += 1
        return self.foo * torch.tensor(float(COUNTS["calls"]), device=CPU)


class FillsWithACount(Task):
    def term(self):
        COUNTS["calls"] += 1
        value = self.foo.clone()
        value[0] = float(COUNTS["calls"])
        return value


class Rebinds(Task):
    def term(self):
        return self.grown()


class RebindsInATable(Task):
    def term(self):
        change = self.foo - self.table["last"]
        self.table["last"] = self.foo.clone()
        return change


class KeepsSteps(Task):
    def term(self):
        change = self.foo - self.steps[0]
        self.steps.append(self.foo.clone())
        return change


class SwapsBuffers(Task):
    def term(self):
        self.last_foo, self.out = self.out, self.last_foo
        self.out.copy_(self.foo)
        return self.foo - self.last_foo


class WritesHalf(Task):
    """Only a part of what it made anew is written before it is read."""

    def term(self):
        self.last_foo[:2].copy_(self.foo[:2])
        change = self.foo - self.last_foo
        self.last_foo = self.foo * 2.0
        return change


FROZEN = {
    SwapsBuffers: r"reads self\.\w+, but the previous step read another tensor",
    WritesHalf: r"reads self\.last_foo, but the previous step read another tensor",
    Counts: r"self\.n changed from 5 to 6",
    Schedules: r"self\.n changed from 5 to 6",
    ChangesMode: r"self\.mode changed from 'walk' to 'run'",
    Appends: r"self\.numbers changed",
    WritesArray: r"self\.array changed",
    DrawsByNumpy: r"draws from np\.random",
    DrawsByPython: "draws from Python's random",
    DrawsByItsGenerator: "calls mul",
    CountsElsewhere: r"calls mul\(3\) where the previous step called mul\(2\)",
    CountsInATensor: "numbers that differ from the previous step's",
    FillsWithACount: "calls ",
    Rebinds: r"reads self\.last_foo, but the previous step read another tensor there.*self\.last_foo\.copy_",
    RebindsInATable: r"reads self\.table, but the previous step read another",
    KeepsSteps: r"reads self\.steps, but the previous step read another",
}


@pytest.mark.parametrize("task", FROZEN, ids=lambda task: task.__name__)
def test_what_a_replay_would_freeze_is_refused_by_the_terms_name(task):
    with pytest.raises(TermError, match=FROZEN[task]) as error:
        StepGraph(task().step, CPU, enabled=True)
    assert str(error.value).startswith("_reward_mine: ")
    step = StepGraph(task().step, CPU, enabled=False)  # --no-graph runs it
    for _ in range(4):
        step()


def test_what_changes_outside_all_terms_is_refused_too():
    class CountsInItsStep(Task):
        def step(self):
            super().step()
            self.n += 1

    with pytest.raises(HostReadError, match=r"self\.n changed from 5 to 6"):
        StepGraph(CountsInItsStep().step, CPU, enabled=True)


class WritesInPlace(Task):
    def term(self):
        change = self.foo - self.last_foo
        self.last_foo.copy_(self.foo)
        return change


class LeavesForOthers(Task):
    """A tensor of this step that is read later in it, or outside."""

    def term(self):
        self.grown_foo = self.foo * 2.0
        return self.grown_foo + 1.0


class SetsUpOnce(Task):
    """Buffers and flags that the first step makes."""

    def term(self):
        if not hasattr(self, "buffer"):
            self.buffer = torch.zeros(4, device=CPU)
            self.n = 0
        self.buffer += self.foo
        return self.buffer


class NamesAView(Task):
    """The same memory under a new object."""

    def term(self):
        if hasattr(self, "view"):
            self.foo.mul_(1.0 + 0.0 * self.view.sum())
        self.view = self.foo[1:]
        return self.foo


class OverwritesAndRebinds(Task):
    """What was there before is written over before it is read, as forks do with `reset_buf`."""

    def term(self):
        torch.add(self.foo, 1.0, out=self.out)
        self.last_foo.copy_(self.foo)
        self.out = self.out + self.last_foo
        self.last_foo = self.foo * 2.0
        return self.foo


class CallsAScript(Task):
    """TorchScript optimises after its first runs."""

    def term(self):
        return scripted(self.foo, 2.0)


@torch.jit.script
def scripted(x: torch.Tensor, factor: float) -> torch.Tensor:
    return torch.clamp(x * factor + 1.0, 0.0, 10.0).square()


HARMLESS = [Task, WritesInPlace, LeavesForOthers, SetsUpOnce, NamesAView, OverwritesAndRebinds, CallsAScript]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("task", HARMLESS, ids=lambda task: task.__name__)
@pytest.mark.usefixtures("inference")
def test_what_a_replay_does_right_passes(task):
    StepGraph(task().step, CPU, enabled=True)()
