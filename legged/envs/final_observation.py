"""What looks at a step before episodes that end in it begin anew, and one that does: it keeps the last step of an episode for
those who learn from it.
"""

from typing import TYPE_CHECKING, Protocol, TypeVar

import torch

from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.physics import Physics

if TYPE_CHECKING:
    from legged.envs.base_task import BaseTask


class StepWatcher(Protocol):
    """Looks at every environment in each step when its reward has been judged, before any is reset, pushed or given a new
    command.
    """

    def take(self) -> None:
        """Copy what is wanted of it: within the captured step, so without host reads or new addresses."""


Watcher = TypeVar("Watcher", bound=StepWatcher)


class FinalStep:
    """What every environment was like in the last step when its reward was judged, before any was reset, pushed or given a
    new command.
    """

    def __init__(self, terms: ObservationTerms, groups: dict[str, ObservationGroup], physics: Physics) -> None:
        """For the observation groups of a task and its physics."""
        self._terms, self._groups, self._physics = terms, groups, physics
        self.observations = {name: torch.zeros_like(group.buffer) for name, group in groups.items()}
        """By group what it would have shown, (N, history * width)."""
        self.qpos, self.qvel = torch.zeros_like(physics.qpos), torch.zeros_like(physics.qvel)
        """(N, nq) and (N, nv) generalised positions and velocities."""

    def take(self) -> None:
        """Observe the environments as they are now, in the middle of a step: terms are evaluated once more."""
        self._terms.evaluate()
        for name, group in self._groups.items():
            group.preview(self.observations[name])
        self.qpos.copy_(self._physics.qpos)
        self.qvel.copy_(self._physics.qvel)


def keep_final_step(task: "BaseTask", graph: bool = True) -> FinalStep:
    """Let a task keep the last step of its episodes from now on, and return where it does. Otherwise as `watch_steps`."""
    return watch_steps(task, FinalStep(task.observation_terms, task.observation_groups, task.physics), graph)


def watch_steps(task: "BaseTask", watcher: Watcher, graph: bool = True) -> Watcher:
    """Let `watcher` look at every step of a task from now on, and return it. All episodes begin anew. With `graph` the step
    is captured (again, if the task was built with a graph), or checked on the CPU, as at its start.

    Raises:
        TermError: the step cannot be captured.
    """
    task.step_watcher = watcher
    task._build_graph(graph and (task.physics.capturable or task.physics.device.type == "cpu"))
    return watcher
