"""Kicks of the base and forces on bodies, each robot at its own moments."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from legged.config.schema import DrawConfig, ForceConfig, KickConfig, LeggedDomainRandConfig
from legged.math import masked_set_, uniform
from legged.mdp.draws import Draws
from legged.mdp.uniform_numbers import UniformNumbers
from legged.physics import Physics

if TYPE_CHECKING:
    from legged.physics.warp.task_kernels import TaskKernels

AXES = ("x", "y", "z")
TURNS = ("roll", "pitch", "yaw")


def _draws(
    cfg: KickConfig | ForceConfig, names: tuple[str, ...], times: tuple[str, ...], numbers: UniformNumbers, pace: int
) -> Draws:
    """Return what draws the components `names` of a disturbance, which may grow, then its `times`, which do not."""
    columns = [DrawConfig(range=getattr(cfg, name), grow=cfg.grow) for name in names]
    columns += [DrawConfig(range=getattr(cfg, name)) for name in times]
    start = [0.0] * len(names) + [getattr(cfg, name)[0] for name in times]
    return Draws(columns, start, numbers.device, pace, within=False)


class Kicks:
    """Changes of the base's velocity now and then."""

    STATE = ("time_left",)

    def __init__(self, cfg: KickConfig, dt: float, pace: int, numbers: UniformNumbers, kernels: "TaskKernels | None") -> None:
        """Spread the first kicks over a whole interval; `dt` is the control step [s], and an iteration has `pace`
        of them.
        """
        self._dt, self._kernels = dt, kernels
        num_envs, device = numbers.num_envs, numbers.device
        self._draws = _draws(cfg, (*AXES, *TURNS), ("interval_s",), numbers, pace)
        self._even = self._draws.ask(numbers)
        self.time_left = uniform(0.0, cfg.interval_s[1], (num_envs,), device)
        """(N,) time until the next kick [s]."""
        self._drawn = torch.zeros(num_envs, 7, device=device)
        self._velocity, self._next = self._drawn[:, :6], self._drawn[:, 6]
        self._due = torch.zeros(num_envs, dtype=torch.bool, device=device)

    def draw(self, steps: Tensor) -> None:
        """Draw a kick for every robot, after so many `steps` of training. Runs beside the step."""
        self._draws.write(self._even.values, steps, self._drawn, self._kernels)

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Kick the robots of `mask` (N,) that are due."""
        if physics.kernels is not None:
            physics.kernels.find_kicks(mask, self._next, self._dt, 0.5 * self._dt, self.time_left, self._due)
            physics.push(self._due, self._velocity)
            return
        self.time_left.sub_(self._dt)
        due = (self.time_left <= 0.5 * self._dt) & mask
        physics.push(due, self._velocity)
        masked_set_(self.time_left, due, self._next)


class Forces:
    """A force on one body for a time, now and then."""

    STATE = ("left", "force")

    def __init__(
        self,
        cfg: ForceConfig,
        body: int,
        dt: float,
        pace: int,
        numbers: UniformNumbers,
        kernels: "TaskKernels | None",
    ) -> None:
        """Push the `body` of that number in the model; spread the first pushes over a whole interval."""
        self._dt, self._body, self._kernels = dt, body, kernels
        num_envs, device = numbers.num_envs, numbers.device
        self._draws = _draws(cfg, AXES, ("interval_s", "duration_s"), numbers, pace)
        self._even = self._draws.ask(numbers)
        self.left = torch.zeros(num_envs, 2, device=device)
        """(N, 2) time that the push now lasts on, and until the next one begins [s]."""
        self.left[:, 1] = uniform(0.0, cfg.interval_s[1], (num_envs,), device)
        self.force = torch.zeros(num_envs, 3, device=device)
        """(N, 3) force now, world frame [N]."""
        self._drawn = torch.zeros(num_envs, 5, device=device)
        """(N, 5) of the next push its force, the interval and how long it lasts."""

    def draw(self, steps: Tensor) -> None:
        """Draw a push for every robot, after so many `steps` of training. Runs beside the step."""
        self._draws.write(self._even.values, steps, self._drawn, self._kernels)

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Begin and end pushes; those of robots that are not in `mask` (N,) end."""
        assert physics.forces is not None
        on_body = physics.forces[:, self._body, :3]
        if physics.kernels is not None:
            moment = (self._dt, 0.5 * self._dt)
            physics.kernels.push_bodies(mask, self._drawn, *moment, self.left, self.force, on_body)
            return
        self.left.sub_(self._dt)
        passed = self.left <= 0.5 * self._dt
        due = passed[:, 1] & mask
        self.force.masked_fill_((passed[:, 0] | ~mask).unsqueeze(1), 0.0)
        masked_set_(self.force, due, self._drawn[:, :3])
        lasting = self._drawn[:, 4].clamp(min=self._dt)
        masked_set_(self.left, due, torch.stack([lasting, self._drawn[:, 3] + lasting], dim=1))
        on_body.add_(self.force)


class Disturbances:
    """All kicks and forces of a task."""

    def __init__(
        self,
        cfg: LeggedDomainRandConfig,
        physics: Physics,
        dt: float,
        steps_per_iteration: int,
        numbers: UniformNumbers,
    ) -> None:
        """Make those that `cfg` names; `dt` is the control step [s]. Numbers that they draw are of `numbers`."""
        self.kicks = {
            name: Kicks(kick, dt, steps_per_iteration, numbers, physics.kernels) for name, kick in cfg.kicks.items()
        }
        """Name -> kicks of the base."""
        self.forces = {
            name: Forces(force, body_number(physics, force.body), dt, steps_per_iteration, numbers, physics.kernels)
            for name, force in cfg.forces.items()
        }
        """Name -> force that acts on a body."""
        self.STATE: tuple[str, ...] = ()
        """Names of the tensors that are saved: none where there is nothing."""
        self._all: tuple[Kicks | Forces, ...] = (*self.kicks.values(), *self.forces.values())
        if self._all:
            self.steps = torch.zeros((), device=numbers.device)
            """Control steps since training began, by which they grow."""
            self.STATE = ("steps",)
        for k, part in enumerate(self._all):
            for name in part.STATE:
                setattr(self, f"{name}_{k}", getattr(part, name))
                self.STATE = (*self.STATE, f"{name}_{k}")

    def draw(self) -> None:
        """Draw a disturbance of each kind for every robot. Runs beside the step; nothing is launched where there is none."""
        for part in self._all:
            part.draw(self.steps)

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Disturb the robots of `mask` (N,), whose episodes go on."""
        if self.forces:
            assert physics.forces is not None
            physics.forces.zero_()
        for part in self._all:
            part.act(physics, mask)
        if self._all:
            self.steps.add_(1.0)

    def end(self, physics: Physics) -> None:
        """Let go of all robots: episodes begin anew in each of them, outside of a step."""
        if physics.forces is not None:
            physics.forces.zero_()
        for force in self.forces.values():
            force.force.zero_()

    def progress(self) -> dict[str, Tensor]:
        """Return how far they have grown; empty where there are none."""
        return {"steps": self.steps.clone()} if self._all else {}

    def load_progress(self, progress: dict[str, Tensor]) -> None:
        """Go on from there."""
        if "steps" in progress and self._all:
            self.steps.copy_(progress["steps"])


def body_number(physics: Physics, name: str) -> int:
    """Return the number of a body in the physics' model; without a name that of the floating base."""
    return int(physics.model.jnt_bodyid[0]) if not name else int(physics.model.body(name).id)
