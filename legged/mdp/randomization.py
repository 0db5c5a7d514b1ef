"""What differs from robot to robot, and pushes."""

import torch
from torch import Tensor

from legged.config.schema import DomainRandConfig
from legged.math import masked_set_, uniform
from legged.physics import Physics, RandomizedField


class Randomization:
    """Draws friction and mass once, and pushes each robot at its own moments."""

    STATE = ("friction", "added_mass", "push_time_left")

    def __init__(self, cfg: DomainRandConfig, num_envs: int, dt: float, device: torch.device) -> None:
        """`dt` is the control step [s]. The first pushes are spread over a whole interval."""
        self.cfg, self.dt, self.device = cfg, dt, device
        low, high = cfg.friction_range
        buckets = uniform(low, high, (cfg.friction_buckets,), device)
        self.friction = buckets[torch.randint(cfg.friction_buckets, (num_envs,), device=device)]
        """(N,) friction of each robot's shapes, if randomised."""
        self.added_mass = uniform(*cfg.added_mass_range, (num_envs,), device)
        """(N,) mass added to each base [kg], if randomised."""
        self.push_time_left = uniform(0.0, cfg.push_interval_s, (num_envs,), device)
        """(N,) time until the next push [s]."""
        self._push_velocity = torch.zeros(num_envs, 2, device=device)

    @property
    def fields(self) -> dict[RandomizedField, Tensor]:
        """What is randomised of the physics, and what was drawn for it."""
        drawn: dict[RandomizedField, Tensor] = {}
        if self.cfg.randomize_friction:
            drawn["friction"] = self.friction
        if self.cfg.randomize_base_mass:
            drawn["added_base_mass"] = self.added_mass
        return drawn

    def apply(self, physics: Physics) -> None:
        """Give the physics what was drawn, at start-up."""
        for field, values in self.fields.items():
            physics.randomize(field, values)

    def draw(self) -> None:
        """Draw a push for every robot, for those that `push` finds due."""
        reach = self.cfg.max_push_vel_xy
        self._push_velocity.uniform_(-reach, reach)

    def push(self, physics: Physics, mask: Tensor) -> None:
        """Set the base's horizontal velocity, world frame, of the robots in `mask` (N,) that are due."""
        if not self.cfg.push_robots:
            return
        self.push_time_left.sub_(self.dt)
        due = (self.push_time_left <= 0.5 * self.dt) & mask
        physics.push(due, self._push_velocity - physics.state.base_lin_vel_w[:, :2])
        masked_set_(self.push_time_left, due, self.cfg.push_interval_s)
