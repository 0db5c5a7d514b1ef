"""Final observations of episodes. Watchers copy tensors at the end of each step, before episodes are reset."""

from collections.abc import Callable

import torch

from legged.envs.base_task import BaseTask
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.physics import Physics


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
    """Let a task keep the final step of its episodes. `watch_steps` describes the argument `graph` and the errors."""
    kept = FinalStep(task.observation_terms, task.observation_groups, task.physics)
    watch_steps(task, kept.take, graph)
    return kept


def watch_steps(task: BaseTask, take: Callable[[], None], graph: bool = True) -> None:
    """Let every step of a task call `take`, after rewards are computed and before any environment is reset, pushed or given a
    new command. All episodes and curricula are reset now. With `graph`, the step is captured on a GPU, or checked on the CPU.
    The graph includes `take`, so the host must not read tensors in it, and its buffers must keep their addresses.

    Raises:
        TermError: the step cannot be captured.
    """
    task.step_watcher = take
    task._build_graph(graph and (task.physics.capturable or task.physics.device.type == "cpu"))
