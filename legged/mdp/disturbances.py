"""Kicks of the base and forces on bodies, each robot at its own moments."""

import torch
from torch import Tensor

from legged.config.schema import DrawConfig, ForceConfig, KickConfig, LeggedDomainRandConfig
from legged.math import masked_set_, uniform
from legged.mdp.distributions import Distributions
from legged.mdp.random_pool import RandomPool
from legged.physics import Physics

AXES = ("x", "y", "z")
TURNS = ("roll", "pitch", "yaw")


def _columns(
    cfg: KickConfig | ForceConfig, names: tuple[str, ...], times: tuple[str, ...]
) -> tuple[list[DrawConfig], list[float]]:
    """Return how the components `names` of a disturbance, which may grow, and then its `times`, which do not, are drawn; and
    from what they grow.
    """
    columns = [DrawConfig(range=getattr(cfg, name), grow=cfg.grow) for name in names]
    columns += [DrawConfig(range=getattr(cfg, name)) for name in times]
    return columns, [0.0] * len(names) + [getattr(cfg, name)[0] for name in times]


class Kicks:
    """Changes of the base's velocity now and then."""

    STATE = ("time_left",)
    WIDTH = 7
    """Numbers that are drawn for one: the change, and the time until the next."""

    def __init__(self, cfg: KickConfig, dt: float, time_left: Tensor) -> None:
        """Spread the first kicks over a whole interval; `dt` is the control step [s]."""
        self.columns, self.start = _columns(cfg, (*AXES, *TURNS), ("interval_s",))
        """How its numbers are drawn, and from what they grow."""
        self._dt = dt
        self.time_left = time_left
        """(N,) time until the next kick [s]."""
        time_left.copy_(uniform(0.0, cfg.interval_s[1], (len(time_left),), time_left.device))

    def take(self, drawn: Tensor) -> None:
        """Let `drawn` (N, 7) be what is drawn for each robot: of its next kick the velocity and the interval after it."""
        self.velocity, self._next = drawn[:, :6], drawn[:, 6]

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Kick the robots of `mask` (N,) that are due."""
        self.time_left.sub_(self._dt)
        due = (self.time_left <= 0.5 * self._dt) & mask
        physics.push(due, self.velocity)
        masked_set_(self.time_left, due, self._next)


class Forces:
    """A force on one body for a time, now and then."""

    STATE = ("left", "force")
    WIDTH = 5
    """Numbers that are drawn for one: the force, the interval and the duration."""

    def __init__(self, cfg: ForceConfig, body: int, dt: float, left: Tensor, force: Tensor) -> None:
        """Push the `body` of that number in the model; spread the first pushes over a whole interval."""
        self.columns, self.start = _columns(cfg, AXES, ("interval_s", "duration_s"))
        """How its numbers are drawn, and from what they grow."""
        self._dt, self.body = dt, body
        self.left, self.force = left, force
        """(N, 2) time that the push now lasts on, and until the next one begins [s]; (N, 3) force now, world frame [N]."""
        left[:, 1] = uniform(0.0, cfg.interval_s[1], (len(left),), left.device)

    def take(self, drawn: Tensor) -> None:
        """Let `drawn` (N, 5) be what is drawn for each robot: of its next push the force, the interval and the duration."""
        self.drawn = drawn

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Begin and end pushes; those of robots that are not in `mask` (N,) end."""
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
    """All kicks and forces of a task, whose numbers lie side by side, so that one launch can be for all of them."""

    def __init__(
        self,
        cfg: LeggedDomainRandConfig,
        physics: Physics,
        dt: float,
        steps_per_iteration: int,
        numbers: RandomPool,
    ) -> None:
        """Make those that `cfg` names; `dt` is the control step [s]. Numbers that they draw are of `numbers`."""
        self._dt, self._kernels = dt, physics.kernels
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
        """Names of the tensors that are saved: none where there is nothing."""
        self._all: tuple[Kicks | Forces, ...] = (*self.kicks.values(), *self.forces.values())
        if not self._all:
            return
        self.steps = torch.zeros((), device=device)
        """Control steps since training began, by which they grow."""
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
        """Draw a disturbance of each kind for every robot. Runs beside the step; nothing is launched where there is none."""
        if self._all:
            self._draws.write(self._even.values, self.steps, self._drawn, self._kernels)

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Disturb the robots of `mask` (N,), whose episodes go on."""
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
