"""Run by test_gpu_graph: captures one after the other what the guard allows, then what only a recording finds.

Prints a line for each before it is tried, and `all done` in the end.
"""

import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS.parent), str(TESTS), str(TESTS / "graph")]

import pytest  # noqa: E402
import test_guard  # noqa: E402
import torch  # noqa: E402
from devices import CUDA  # noqa: E402
from torch.utils._pytree import tree_leaves  # noqa: E402

from legged.errors import TermError  # noqa: E402
from legged.graph.step_graph import StepGraph, calling  # noqa: E402

DEVICE = torch.device(CUDA)


def onto_the_gpu() -> None:
    """Let the cases of test_guard work on tensors of the GPU, and mean it where they name a device."""
    for name, value in vars(test_guard).items():
        if isinstance(value, torch.Tensor):
            setattr(test_guard, name, value.to(DEVICE))
    test_guard.CPU = DEVICE


def check(name: str) -> None:
    """Capture a case of the guard, and compare three replays with what it gives without a graph."""
    case = test_guard.ALLOWED[name]
    torch.manual_seed(0)
    expected = [tree_leaves(case()) for _ in range(3)]
    kept = [value.clone() if isinstance(value, torch.Tensor) else value for value in expected[0]]

    def step() -> None:
        for mine, now in zip(kept, tree_leaves(case()), strict=True):
            if isinstance(mine, torch.Tensor):
                mine.copy_(now)
            else:
                assert mine == now

    graph = StepGraph(step, DEVICE, enabled=True)
    assert graph.captured
    torch.manual_seed(0)
    for wanted in expected:
        graph()
        for mine, value in zip(kept, wanted, strict=True):
            torch.testing.assert_close(mine, value, rtol=0.0, atol=0.0)


def late() -> None:
    """Check that a term is named of which only the recording shows that it waits for the host."""
    value = torch.ones(3, device=DEVICE)

    def step() -> None:
        with calling("_reward_late"):
            value[0].item()

    with pytest.raises(TermError, match="_reward_late: ") as error:
        StepGraph(step, DEVICE, enabled=True, rehearse=lambda: None)
    assert "--no-graph" in "".join(error.value.__notes__)


if __name__ == "__main__":
    onto_the_gpu()
    for name in test_guard.ALLOWED:
        print(name, flush=True)
        check(name)
    print("late", flush=True)
    late()
    print("all done", flush=True)
