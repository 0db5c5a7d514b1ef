"""What of a task is saved: the progress of its curricula in every checkpoint, and all of its state beside the newest."""

from typing import Any

import torch
from torch import Tensor

from legged.envs.randomized import RandomizedTask
from legged.mdp.nan_guard import NanGuard
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.mdp.rewards import Rewards
from legged.state import load_state, state_of, take


class SavedTask(RandomizedTask):
    """The half of a task that takes and gives its state."""

    rewards: Rewards
    nan_guard: NanGuard
    observation_groups: dict[str, ObservationGroup]
    observation_terms: ObservationTerms

    def progress(self) -> dict[str, Any]:
        """Return how far the curricula have got: what every checkpoint holds, whatever the number of environments."""
        grown = self.randomization.progress()
        return {"randomization": grown} if grown else {}

    def load_progress(self, progress: dict[str, Any]) -> None:
        """Go on from there; to be followed by `reset`."""
        self.randomization.load_progress(progress.get("randomization", {}))

    def parts(self) -> dict[str, Any]:
        """Return what has a state of its own (`STATE`), by name. A subclass adds its own."""
        return {
            "faults": self.nan_guard,
            "randomization": self.randomization,
            "rewards": self.rewards,
            **{f"observations_{name}": group for name, group in self.observation_groups.items()},
            **(sensors.parts() if (sensors := self.observation_terms.errors) is not None else {}),
        }

    def state_dict(self) -> dict[str, Any]:
        """Return copies of everything that the next step is a function of, beside the actions and torch's random numbers."""
        return {
            "physics": {name: tensor.clone() for name, tensor in self.physics.state_tensors().items()},
            "task": {name: tensor.clone() for name, tensor in self._own_tensors().items()},
            **{name: state_of(part) for name, part in self.parts().items()},
        }

    @torch.no_grad()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put the task back into a saved state; the next step is then the one that would have followed.

        Raises:
            StateError: it is of another number of environments, or of another task; nothing should be used then.
        """
        try:
            for name, part in self.parts().items():
                load_state(part, state.get(name, {}))
            take(self._own_tensors(), state.get("task", {}), type(self).__name__)
        finally:
            self.apply_randomization()  # what is drawn and what the engine has must not part
        self.physics.load_state(state.get("physics", {}))

    def _own_tensors(self) -> dict[str, Tensor]:
        """Return the task's own tensors of a row per environment, a subclass' among them; not those that are the parts' or
        the physics'.
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
