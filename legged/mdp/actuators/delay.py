"""Delay of joint targets."""

import math

import torch
from torch import Tensor

from legged.math import masked_set_
from legged.mdp.actuators.model import ActuatorModel, Motors


class Delay(ActuatorModel):
    """Targets of N robots with D joints, on their way to the control law.

    A target is set once per control step. The target reaches the control law after the robot's delay, a number of physics
    steps. Until the first target arrives, joints have the target of action 0.
    """

    def __init__(self, motors: Motors) -> None:
        """Set all targets to those of action 0. Delays are drawn from the pool `motors.numbers`."""
        cfg, self.decimation, self._rest = motors.cfg, motors.decimation, motors.rest
        low, high = cfg.delay
        self.shortest, self.longest = low, high
        """Shortest and longest delay, in physics steps."""
        kept = 1 + math.ceil(high / motors.decimation)
        self.kept = self._rest().expand(kept, motors.num_envs, motors.robot.num_dof).clone()
        """(K, N, D) targets of the last K control steps, newest first."""
        self.newest = self.kept[0]
        """(N, D) target of this control step, which the control law writes."""
        self.steps = torch.full((motors.num_envs,), high, dtype=torch.int32, device=motors.device)
        """(N,) delay of each robot, in physics steps."""
        self._varies = cfg.delay_varies and low < high
        self._drawn = motors.numbers.between(float(low), float(high + 1), 1) if low < high else None
        self.age = 0
        """Number of physics steps since the newest target was set."""

    def advance(self) -> None:
        """Shift the targets by one control step. Afterwards the new target must be written to `newest`."""
        if len(self.kept) > 1:
            self.kept[1:].copy_(self.kept[:-1].clone())
        self.age = 0

    def targets(self, targets: Tensor) -> Tensor:
        if not self.longest:
            return targets
        late = (self.steps - self.age).clamp_(min=0) + (self.decimation - 1)
        back = torch.div(late, self.decimation, rounding_mode="floor").long()
        return self.kept.gather(0, back.view(1, -1, 1).expand(1, *self.newest.shape))[0]

    def reset(self, mask: Tensor) -> None:
        """Draw new delays for the robots in `mask` (N,); with delay_varies, for all robots. Set the targets of the robots in
        `mask` to those of action 0.
        """
        if self._drawn is not None:
            drawn = self._drawn.values[:, 0].clamp(max=float(self.longest)).int()
            if self._varies:  # limited, so that no older target replaces one that has arrived
                latest = (torch.div(self.steps, self.decimation, rounding_mode="floor") + 1) * self.decimation
                torch.where(mask, drawn, torch.minimum(drawn, latest), out=self.steps)
            else:
                masked_set_(self.steps, mask, drawn)
        if self.longest:
            torch.where(mask.view(1, -1, 1), self._rest(), self.kept, out=self.kept)

    def describe(self, joint: int) -> str:
        return f"delay {self.shortest} to {self.longest} physics steps" if self.longest else ""
