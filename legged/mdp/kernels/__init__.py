"""Warp kernels of formulas in `legged.mdp`. Only tasks on an engine in Warp import the other modules of this folder."""

from typing import Protocol

from torch import Tensor

from legged.physics import Physics


class Kernels(Protocol):
    """Launches the kernels of this folder (`TaskKernels`)."""

    def launch(self, name: str, dim: int | tuple[int, ...], *arguments: Tensor | float) -> None:
        """Launch the kernel called `name`. Array arguments are torch tensors; vectors are tensors (..., 3)."""


def task_kernels(physics: Physics) -> Kernels | None:
    """Return the kernels for a task on an engine, or None if the engine does not use Warp."""
    if physics.on_device is None:
        return None
    from legged.mdp.kernels.task import TaskKernels

    return TaskKernels(physics.on_device)


def name_module() -> None:
    """Launch one kernel of task.py, so that the dry run of `compile_ahead` finds the file's Warp module."""
    import warp

    from legged.mdp.kernels.task import hold_joints

    warp.launch(hold_joints, dim=1)
