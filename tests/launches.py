"""Counts what a control step would launch on a GPU, on a machine without one."""

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

import warp as wp
from torch.utils._python_dispatch import TorchDispatchMode

from legged.mdp.kernels.task import TaskKernels

NO_LAUNCH = ("detach", "empty", "empty_strided", "empty_like", "new_empty", "lift_fresh", "alias", "_unsafe_view")
OURS = (*(f"legged.mdp.kernels.{of}" for of in ("task", "actuator", "network", "random")), "add_velocities")
"""Kernels that stand for torch's launches: their module, or their name."""


class Launches(TorchDispatchMode):
    """Operators of torch that are no views, and kernels of ours in their place, by the part of the step that asks."""

    def __init__(self) -> None:
        super().__init__()
        self.by_part: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not func.is_view and func._schema.name.removeprefix("aten::") not in NO_LAUNCH:
            self.note(sys._getframe(1))
        return func(*args, **(kwargs or {}))

    def note(self, frame: FrameType | None) -> None:
        """Count one for the method that the task's step called."""
        below = ""
        while frame is not None and frame.f_code.co_name != "_step":
            if frame.f_globals.get("__name__", "").startswith("legged.envs"):
                below = frame.f_code.co_name
            frame = frame.f_back
        self.by_part[below] += 1


@contextmanager
def counting() -> Iterator[Counter[str]]:
    """Count in the block; physics engines' own launches are left out. What a `TaskKernels` launches counts once, also where
    it has kept the launch of a step before.
    """
    launch, by_launcher, launches = wp.launch, TaskKernels.launch, Launches()

    def noted(kernel: Any, *args: Any, **kwargs: Any) -> Any:
        if kernel.module.name in OURS or kernel.key in OURS:
            launches.note(sys._getframe(1))
        return launch(kernel, *args, **kwargs)

    def noted_once(launcher: TaskKernels, kernel: Any, *args: Any, **kwargs: Any) -> None:
        launches.note(sys._getframe(1))
        wp.launch = launch
        try:
            by_launcher(launcher, kernel, *args, **kwargs)
        finally:
            wp.launch = noted

    wp.launch, TaskKernels.launch = noted, noted_once  # type: ignore[method-assign]
    try:
        with launches:
            yield launches.by_part
    finally:
        wp.launch, TaskKernels.launch = launch, by_launcher  # type: ignore[method-assign]
