"""Forces of contacts between two groups of shapes."""

import torch
from torch import Tensor

from legged.mdp.sensors.sensor import Sensor


class ContactForces(Sensor):
    """Forces of contacts between two groups of shapes, for N robots and each of the K physics steps of a control step. The
    force of a step is that of its strongest single contact. `RobotTask.contact_groups` names the groups.
    """

    def __init__(self, forces: Tensor) -> None:
        """Read `forces`, a tensor of `Physics.group_forces`, which the engine updates in every physics step."""
        self.forces = forces
        """(N, K) forces [N], the last step first; zero after a reset."""

    @property
    def largest(self) -> Tensor:
        """(N,) largest force in the control step [N]."""
        return self.forces.amax(dim=1)

    def steps_above(self, force: float) -> Tensor:
        """Return the number of physics steps in which the force was above `force` [N], (N,) float32."""
        return (self.forces > force).sum(dim=1, dtype=torch.float32)

    def update(self) -> None:
        """Do nothing: `forces` is always up to date."""
