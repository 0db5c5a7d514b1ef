"""Final observations of episodes. Watchers copy tensors at the end of each step, before episodes are reset."""

from typing import Protocol, TypeVar

import torch

from legged.envs.base_task import BaseTask
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.physics import Physics


class StepWatcher(Protocol):
    """Watcher of a task. Each step calls `take` after rewards are computed and before any environment is reset, pushed or
    given a new command.
    """

    def take(self) -> None:
        """Copy tensors of the task. A CUDA graph captures this method with the step, so the host must not read tensors, and
        buffers must keep their addresses.
        """


Watcher = TypeVar("Watcher", bound=StepWatcher)


class FinalStep:
    """Observations and state of every environment in the last step, after rewards were computed and before any environment
    was reset, pushed or given a new command.
    """

    def __init__(self, terms: ObservationTerms, groups: dict[str, ObservationGroup], physics: Physics) -> None:
        """Allocate copies of a task's observation groups and of the state of its physics."""
        self._terms, self._groups, self._physics = terms, groups, physics
        self.observations = {name: torch.zeros_like(group.buffer) for name, group in groups.items()}
        """Group -> final observation, (N, history * width)."""
        self.qpos, self.qvel = torch.zeros_like(physics.qpos), torch.zeros_like(physics.qvel)
        """(N, nq) and (N, nv) generalised positions and velocities."""

    def take(self) -> None:
        """Copy observations and state. For this the observation terms are evaluated once more."""
        self._terms.evaluate()
        for name, group in self._groups.items():
            group.preview(self.observations[name])
        self.qpos.copy_(self._physics.qpos)
        self.qvel.copy_(self._physics.qvel)


def keep_final_step(task: BaseTask, graph: bool = True) -> FinalStep:
    """Attach a `FinalStep` to a task and return it. `watch_steps` describes the arguments and errors."""
    return watch_steps(task, FinalStep(task.observation_terms, task.observation_groups, task.physics), graph)


def watch_steps(task: BaseTask, watcher: Watcher, graph: bool = True) -> Watcher:
    """Attach `watcher` to a task and return `watcher`. From now on every step calls `watcher.take`. All episodes and
    curricula are reset. With `graph`, the step with the watcher is captured on a GPU, or checked on the CPU.

    Raises:
        TermError: the step cannot be captured.
    """
    task.step_watcher = watcher.take
    task._build_graph(graph and (task.physics.capturable or task.physics.device.type == "cpu"))
    return watcher
