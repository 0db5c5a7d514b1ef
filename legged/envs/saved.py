"""State of a task for checkpoints. Every checkpoint holds the progress of curricula. For the newest checkpoint, a separate
file holds the full state of the simulation.
"""

from typing import Any

import torch
from torch import Tensor

from legged.envs.randomized import RandomizedTask
from legged.mdp.nan_guard import NanGuard
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.mdp.rewards import Rewards
from legged.state import load_state, state_of, take


class SavedTask(RandomizedTask):
    """Mixin of BaseTask that saves and loads its state."""

    rewards: Rewards
    nan_guard: NanGuard
    observation_groups: dict[str, ObservationGroup]
    observation_terms: ObservationTerms

    def progress(self) -> dict[str, Any]:
        """Return the progress of curricula, which every checkpoint holds. Any number of environments can load it."""
        grown = self.randomization.progress()
        return {"randomization": grown} if grown else {}

    def load_progress(self, progress: dict[str, Any]) -> None:
        """Continue from the progress of a checkpoint. Call `reset` afterwards."""
        self.randomization.load_progress(progress.get("randomization", {}))

    def parts(self) -> dict[str, Any]:
        """Return name in saved states -> part of the task. A part's `STATE` lists the tensors that are saved. A subclass adds
        its own parts.
        """
        return {
            "faults": self.nan_guard,
            "randomization": self.randomization,
            "rewards": self.rewards,
            **{f"observations_{name}": group for name, group in self.observation_groups.items()},
            **(errors.parts() if (errors := self.observation_terms.errors) is not None else {}),
        }

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the simulation's tensors. The next step follows from these, the actions and the state of torch's
        random generator, which is not included.
        """
        return {
            "physics": {name: tensor.clone() for name, tensor in self.physics.state_tensors().items()},
            "task": {name: tensor.clone() for name, tensor in self._own_tensors().items()},
            **{name: state_of(part) for name, part in self.parts().items()},
        }

    @torch.no_grad()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a saved state. With the same actions and random numbers, the next steps equal those after the save.

        Raises:
            StateError: the state belongs to another task or another number of environments. The task may be partly
                overwritten then and must not be used.
        """
        try:
            for name, part in self.parts().items():
                load_state(part, state.get(name, {}))
            take(self._own_tensors(), state.get("task", {}), type(self).__name__)
        finally:
            self.apply_randomization()  # engine and `randomization` must agree even after an error
        self.physics.load_state(state.get("physics", {}))

    def _own_tensors(self) -> dict[str, Tensor]:
        """Return, by name, the attributes of the task that are tensors with N rows. Tensors that belong to a part or to the
        physics are left out.
        """
        owners = [self.physics, self.physics.robot_state, *self.parts().values()]
        others = [*self.physics.state_tensors().values()]
        others += [value for owner in owners if owner is not None for value in vars(owner).values()]
        known = {tensor.untyped_storage().data_ptr() for tensor in others if isinstance(tensor, Tensor)}
        return {
            name: tensor
            for name, tensor in vars(self).items()
            if isinstance(tensor, Tensor)
            and tensor.shape[:1] == (self.num_envs,)
            and tensor.untyped_storage().data_ptr() not in known
        }
