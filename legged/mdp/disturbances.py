"""Disturbances: kicks of the base and forces on bodies, at random intervals for each robot."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from legged.config.randomization import DrawConfig, ForceConfig, KickConfig
from legged.config.robot import RobotDomainRandConfig
from legged.math import masked_set_, uniform
from legged.mdp.distributions import Distributions
from legged.mdp.random_pool import RandomPool
from legged.physics import Physics

if TYPE_CHECKING:
    from legged.mdp.kernels.task import TaskKernels

AXES = ("x", "y", "z")
TURNS = ("roll", "pitch", "yaw")


def _columns(
    cfg: KickConfig | ForceConfig, names: tuple[str, ...], times: tuple[str, ...]
) -> tuple[list[DrawConfig], list[float]]:
    """Return the distribution of each random column of a disturbance, and the value that each range starts from. The first
    columns are the components `names`, whose ranges may widen from 0. The last columns are `times`, with constant ranges.
    """
    columns = [DrawConfig(range=getattr(cfg, name), grow=cfg.grow) for name in names]
    columns += [DrawConfig(range=getattr(cfg, name)) for name in times]
    return columns, [0.0] * len(names) + [getattr(cfg, name)[0] for name in times]


class Kicks:
    """Kicks: sudden changes of the base's velocity at random intervals."""

    STATE = ("time_left",)
    WIDTH = 7
    """Number of random columns of a kick: 6 for the change of velocity, 1 for the time until the next kick."""

    def __init__(self, cfg: KickConfig, dt: float, time_left: Tensor) -> None:
        """Draw the times of the first kicks, between 0 and the longest interval. `dt` is the control step [s]; `time_left`
        (N,) is written in place.
        """
        self.columns, self.start = _columns(cfg, (*AXES, *TURNS), ("interval_s",))
        """Distribution of each random column, and the value that its range starts from."""
        self._dt = dt
        self.time_left = time_left
        """(N,) time until the next kick [s]."""
        time_left.copy_(uniform(0.0, cfg.interval_s[1], (len(time_left),), time_left.device))

    def take(self, drawn: Tensor) -> None:
        """Use the tensor `drawn` (N, 7), which holds each robot's next kick: the change of velocity [m/s, rad/s], and the
        interval between this kick and the one after it [s].
        """
        self.velocity, self._next = drawn[:, :6], drawn[:, 6]

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Kick the robots that are due, but only robots in `mask` (N,)."""
        self.time_left.sub_(self._dt)
        due = (self.time_left <= 0.5 * self._dt) & mask
        physics.push(due, self.velocity)
        masked_set_(self.time_left, due, self._next)


class Forces:
    """Pushes: a force on one body for a duration, at random intervals."""

    STATE = ("left", "force")
    WIDTH = 5
    """Number of random columns of a push: 3 for the force, 1 for the interval, 1 for the duration."""

    def __init__(self, cfg: ForceConfig, body: int, dt: float, left: Tensor, force: Tensor) -> None:
        """Push the body with index `body` in the model. The first pushes begin at random times within the longest interval.
        `dt` is the control step [s]; `left` (N, 2) and `force` (N, 3) are written in place.
        """
        self.columns, self.start = _columns(cfg, AXES, ("interval_s", "duration_s"))
        """Distribution of each random column, and the value that its range starts from."""
        self._dt, self.body = dt, body
        self.left, self.force = left, force
        """`left` (N, 2): time until the current push ends, and time until the next push begins [s]. `force` (N, 3): force of
        the current push in the world frame [N], or 0."""
        left[:, 1] = uniform(0.0, cfg.interval_s[1], (len(left),), left.device)

    def take(self, drawn: Tensor) -> None:
        """Use the tensor `drawn` (N, 5), which holds each robot's next push: its force [N], interval [s] and duration [s]."""
        self.drawn = drawn

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Begin the pushes that are due. End the pushes whose time is over, and every push on a robot outside `mask` (N,)."""
        assert physics.forces is not None
        self.left.sub_(self._dt)
        passed = self.left <= 0.5 * self._dt
        due = passed[:, 1] & mask
        self.force.masked_fill_((passed[:, 0] | ~mask).unsqueeze(1), 0.0)
        masked_set_(self.force, due, self.drawn[:, :3])
        lasting = self.drawn[:, 4].clamp(min=self._dt)
        masked_set_(self.left, due, torch.stack([lasting, self.drawn[:, 3] + lasting], dim=1))
        physics.forces[:, self.body, :3].add_(self.force)


class Disturbances:
    """All kicks and forces of a task. Their values are columns of common tensors, so that one kernel launch handles all."""

    def __init__(
        self,
        cfg: RobotDomainRandConfig,
        physics: Physics,
        dt: float,
        steps_per_iteration: int,
        numbers: RandomPool,
        kernels: "TaskKernels | None" = None,
    ) -> None:
        """Build the kicks and forces that `cfg` names. `dt` is the control step [s]. `steps_per_iteration`, the number of
        control steps in a training iteration, converts `grow` [iterations] to control steps. Random numbers come from the
        pool `numbers`.
        """
        self._dt, self._kernels = dt, kernels
        num_envs, device = numbers.num_envs, numbers.device
        self._time_left = torch.zeros(num_envs, len(cfg.kicks), device=device)
        self._left = torch.zeros(num_envs, 2 * len(cfg.forces), device=device)
        self._force = torch.zeros(num_envs, 3 * len(cfg.forces), device=device)
        self.kicks = {name: Kicks(kick, dt, self._time_left[:, k]) for k, (name, kick) in enumerate(cfg.kicks.items())}
        """Name -> kicks of the base."""
        self.forces = {
            name: Forces(
                force,
                body_number(physics, force.body),
                dt,
                self._left[:, 2 * k : 2 * k + 2],
                self._force[:, 3 * k : 3 * k + 3],
            )
            for k, (name, force) in enumerate(cfg.forces.items())
        }
        """Name -> force that acts on a body."""
        self.STATE: tuple[str, ...] = ()
        """Names of the tensors that are saved; empty without disturbances."""
        self._all: tuple[Kicks | Forces, ...] = (*self.kicks.values(), *self.forces.values())
        if not self._all:
            return
        self.steps = torch.zeros((), device=device)
        """() control steps since training began, which determine how far ranges have widened."""
        self.STATE = ("steps",)
        for k, part in enumerate(self._all):
            for name in part.STATE:
                setattr(self, f"{name}_{k}", getattr(part, name))
                self.STATE = (*self.STATE, f"{name}_{k}")
        columns = [column for part in self._all for column in part.columns]
        start = [value for part in self._all for value in part.start]
        self._draws = Distributions(columns, start, device, steps_per_iteration, within=False)
        self._even = self._draws.ask(numbers)
        self._drawn = torch.zeros(num_envs, len(columns), device=device)
        for part, drawn in zip(self._all, self._drawn.split([part.WIDTH for part in self._all], dim=1), strict=True):
            part.take(drawn)
        self._bodies = torch.tensor([force.body for force in self.forces.values()], dtype=torch.int32, device=device)
        self._due = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._velocity = torch.zeros(num_envs, 6, device=device)
        self._no_forces = torch.zeros(num_envs, 0, 6, device=device)

    def draw(self) -> None:
        """Draw the next disturbances of every robot. This runs in parallel with other parts of the step, and does nothing if
        there are no disturbances.
        """
        if self._all:
            self._draws.write(self._even.values, self.steps, self._drawn, self._kernels)

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Apply all disturbances that are due. They affect only robots in `mask` (N,), whose episodes continue."""
        if not self._all:
            return
        if self._kernels is not None:
            forces = self._no_forces if physics.forces is None else physics.forces
            state = (self._time_left, self._left, self._force, self.steps.view(1))
            found = (self._due, self._velocity, forces)
            self._kernels.disturb(mask, self._drawn, self._dt, 0.5 * self._dt, self._bodies, *state, *found)
            if self.kicks:
                physics.push(self._due, self._velocity)
            return
        if self.forces:
            assert physics.forces is not None
            physics.forces.zero_()
        for part in self._all:
            part.act(physics, mask)
        self.steps.add_(1.0)

    def end(self, physics: Physics) -> None:
        """End all pushes. The task calls this outside a step, when all robots begin a new episode."""
        if physics.forces is not None:
            physics.forces.zero_()
        for force in self.forces.values():
            force.force.zero_()

    def progress(self) -> dict[str, Tensor]:
        """Return the number of control steps since training began; {} if there are no disturbances."""
        return {"steps": self.steps.clone()} if self._all else {}

    def load_progress(self, progress: dict[str, Tensor]) -> None:
        """Continue from the number of control steps in `progress`."""
        if "steps" in progress and self._all:
            self.steps.copy_(progress["steps"])


def body_number(physics: Physics, name: str) -> int:
    """Return the index of a body in the physics' model. An empty name means the floating base."""
    return int(physics.model.jnt_bodyid[0]) if not name else int(physics.model.body(name).id)
