"""What differs from world to world, and pushes."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from legged.config.schema import LeggedDomainRandConfig
from legged.math import masked_set_, uniform
from legged.mdp.uniform_numbers import UniformNumbers
from legged.physics import Physics

if TYPE_CHECKING:
    from legged.physics.warp.task_kernels import TaskKernels


class Randomization:
    """Draws properties of the model once, a number per world and field."""

    STATE: tuple[str, ...] = ("drawn",)

    def __init__(self, ranges: Mapping[str, Sequence[float]], num_envs: int, device: torch.device) -> None:
        """Draw uniformly from `ranges`: field of `physics.FIELDS` -> lowest and highest value."""
        self._names = tuple(ranges)
        self.drawn = torch.zeros(num_envs, len(self._names), device=device)
        """(N, F) what was drawn for each field, in the order of the ranges."""
        for column, (low, high) in enumerate(ranges.values()):
            self.drawn[:, column] = uniform(low, high, (num_envs,), device)

    @property
    def fields(self) -> dict[str, Tensor]:
        """What is randomised of the physics, and what was drawn for it, (N,) each."""
        return {name: self.drawn[:, column] for column, name in enumerate(self._names)}

    def apply(self, physics: Physics) -> None:
        """Give the physics what was drawn, at start-up and when a state was put back."""
        for field, values in self.fields.items():
            physics.randomize(field, values)


class RobotRandomization(Randomization):
    """Randomization with the friction and the base mass of a legged robot."""

    STATE = ("friction", "added_mass", "drawn")

    def __init__(
        self,
        cfg: LeggedDomainRandConfig,
        num_envs: int,
        device: torch.device,
    ) -> None:
        """Draw friction from `friction_buckets` values and a mass, also where they are switched off, then from `cfg.ranges`,
        which take the place of both.
        """
        low, high = cfg.friction_range
        buckets = uniform(low, high, (cfg.friction_buckets,), device)
        self.cfg = cfg
        self.friction = buckets[torch.randint(cfg.friction_buckets, (num_envs,), device=device)]
        """(N,) friction of each robot's shapes, if randomised."""
        self.added_mass = uniform(*cfg.added_mass_range, (num_envs,), device)
        """(N,) mass added to each base [kg], if randomised."""
        super().__init__(cfg.ranges, num_envs, device)

    @property
    def fields(self) -> dict[str, Tensor]:
        drawn = {"friction": self.friction} if self.cfg.randomize_friction else {}
        if self.cfg.randomize_base_mass:
            drawn["added_base_mass"] = self.added_mass
        return drawn | super().fields


class Pushes:
    """Pushes each robot now and then, at its own moments."""

    STATE = ("push_time_left",)

    def __init__(
        self,
        cfg: LeggedDomainRandConfig,
        num_envs: int,
        dt: float,
        device: torch.device,
        kernels: "TaskKernels | None" = None,
        numbers: UniformNumbers | None = None,
    ) -> None:
        """Spread the first pushes over a whole interval; `dt` is the control step [s]."""
        self.cfg, self.dt, self._kernels = cfg, dt, kernels
        self.push_time_left = uniform(0.0, cfg.push_interval_s, (num_envs,), device)
        """(N,) time until the next push [s]."""
        self.numbers = numbers or UniformNumbers(num_envs, device)
        self._velocity = self.numbers.between(-cfg.max_push_vel_xy, cfg.max_push_vel_xy, 2)
        self._due = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._delta = torch.zeros(num_envs, 2, device=device)

    def push(self, physics: Physics, mask: Tensor) -> None:
        """Set the base's horizontal velocity, world frame, of the robots in `mask` (N,) that are due, to one just drawn."""
        if not self.cfg.push_robots:
            return
        if self._kernels is not None:
            times = (self.dt, 0.5 * self.dt, self.cfg.push_interval_s)
            found = (self.push_time_left, self._due, self._delta)
            self._kernels.find_pushes(mask, self._velocity.values, physics.qvel, *times, *found)
            physics.push(self._due, self._delta)
            return
        self.push_time_left.sub_(self.dt)
        due = (self.push_time_left <= 0.5 * self.dt) & mask
        physics.push(due, self._velocity.values - physics.qvel[:, :2])
        masked_set_(self.push_time_left, due, self.cfg.push_interval_s)
