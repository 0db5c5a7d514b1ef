"""Kicks of the base and forces on bodies, each robot at its own moments."""

import torch
from torch import Tensor

from legged.config.schema import DrawConfig, ForceConfig, KickConfig, LeggedDomainRandConfig
from legged.math import masked_set_, uniform
from legged.mdp.draws import Draws
from legged.mdp.uniform_numbers import UniformNumbers
from legged.physics import Physics

AXES = ("x", "y", "z")
TURNS = ("roll", "pitch", "yaw")


def _draws(cfg: KickConfig | ForceConfig, names: tuple[str, ...], times: tuple[str, ...], device: torch.device) -> Draws:
    """Return what draws the components `names` of a disturbance, which may grow, then its `times`, which do not."""
    columns = [DrawConfig(range=getattr(cfg, name), grow=cfg.grow) for name in names]
    columns += [DrawConfig(range=getattr(cfg, name)) for name in times]
    return Draws(columns, [0.0] * len(names) + [getattr(cfg, name)[0] for name in times], device)


class Kicks:
    """Changes of the base's velocity now and then."""

    def __init__(self, cfg: KickConfig, num_envs: int, dt: float, device: torch.device, numbers: UniformNumbers) -> None:
        """Spread the first kicks over a whole interval; `dt` is the control step [s]."""
        self._dt = dt
        self._draws = _draws(cfg, (*AXES, *TURNS), ("interval_s",), device)
        self._even = self._draws.ask(numbers)
        self.time_left = uniform(0.0, cfg.interval_s[1], (num_envs,), device)
        """(N,) time until the next kick [s]."""

    def act(self, physics: Physics, mask: Tensor, steps: Tensor, steps_per_iteration: int) -> None:
        """Kick the robots of `mask` (N,) that are due, after so many `steps` of training."""
        drawn = self._draws.values(self._even.values, steps, steps_per_iteration)
        self.time_left.sub_(self._dt)
        due = (self.time_left <= 0.5 * self._dt) & mask
        physics.push(due, drawn[:, :6].contiguous())
        masked_set_(self.time_left, due, drawn[:, 6])


class Forces:
    """A force on one body for a time, now and then."""

    def __init__(
        self, cfg: ForceConfig, body: int, num_envs: int, dt: float, device: torch.device, numbers: UniformNumbers
    ) -> None:
        """Push the `body` of that number in the model; spread the first pushes over a whole interval."""
        self._dt, self._body = dt, body
        self._draws = _draws(cfg, AXES, ("interval_s", "duration_s"), device)
        self._even = self._draws.ask(numbers)
        self.time_left = uniform(0.0, cfg.interval_s[1], (num_envs,), device)
        """(N,) time until the next push begins [s]."""
        self.pushing_left = torch.zeros(num_envs, device=device)
        """(N,) time that the push now lasts on [s]."""
        self.force = torch.zeros(num_envs, 3, device=device)
        """(N, 3) force now, world frame [N]."""

    def act(self, physics: Physics, mask: Tensor, steps: Tensor, steps_per_iteration: int) -> None:
        """Begin and end pushes, after so many `steps` of training; those of robots that are not in `mask` (N,) end."""
        assert physics.forces is not None
        drawn = self._draws.values(self._even.values, steps, steps_per_iteration)
        half = 0.5 * self._dt
        self.pushing_left.sub_(self._dt)
        over = (self.pushing_left <= half) | ~mask
        masked_set_(self.force, over, 0.0)
        masked_set_(self.pushing_left, over, 0.0)
        self.time_left.sub_(self._dt)
        due = (self.time_left <= half) & mask
        masked_set_(self.force, due, drawn[:, :3])
        masked_set_(self.pushing_left, due, drawn[:, 4].clamp(min=self._dt))
        masked_set_(self.time_left, due, drawn[:, 3] + drawn[:, 4])
        physics.forces[:, self._body, :3] += self.force


class Disturbances:
    """All kicks and forces of a task."""

    def __init__(
        self,
        cfg: LeggedDomainRandConfig,
        physics: Physics,
        num_envs: int,
        dt: float,
        steps_per_iteration: int,
        device: torch.device,
        numbers: UniformNumbers,
    ) -> None:
        """Make those that `cfg` names; `dt` is the control step [s]."""
        self._steps_per_iteration = steps_per_iteration
        self._kicks = [Kicks(kick, num_envs, dt, device, numbers) for kick in cfg.kicks.values()]
        self.forces = {
            name: Forces(force, body_number(physics, force.body), num_envs, dt, device, numbers)
            for name, force in cfg.forces.items()
        }
        """Name -> force that acts on a body."""
        self.STATE: tuple[str, ...] = ()
        """Names of the tensors that are saved: none where there is nothing."""
        if self._kicks or self.forces:
            self.steps = torch.zeros((), device=device)
            """Control steps since training began, by which they grow."""
            self.STATE = ("steps",)
        for part in (*self._kicks, *self.forces.values()):
            for name, value in vars(part).items():
                if isinstance(value, Tensor):
                    own = f"{name}_{len(self.STATE)}"
                    setattr(self, own, value)
                    self.STATE = (*self.STATE, own)

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Disturb the robots of `mask` (N,), whose episodes go on; nothing is launched where there is nothing."""
        if not self.STATE:
            return
        for kick in self._kicks:
            kick.act(physics, mask, self.steps, self._steps_per_iteration)
        if self.forces:
            assert physics.forces is not None
            physics.forces.zero_()
        for force in self.forces.values():
            force.act(physics, mask, self.steps, self._steps_per_iteration)
        self.steps.add_(1.0)

    def progress(self) -> dict[str, Tensor]:
        """Return how far they have grown; empty where there are none."""
        return {"steps": self.steps.clone()} if self.STATE else {}

    def load_progress(self, progress: dict[str, Tensor]) -> None:
        """Go on from there."""
        if "steps" in progress and self.STATE:
            self.steps.copy_(progress["steps"])


def body_number(physics: Physics, name: str) -> int:
    """Return the number of a body in the physics' model; without a name that of the floating base."""
    return int(physics.model.jnt_bodyid[0]) if not name else int(physics.model.body(name).id)
