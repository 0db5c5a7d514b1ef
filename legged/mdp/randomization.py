"""Domain randomisation: properties drawn per world at the start, at resets or at intervals; and legged_gym's pushes."""

from collections.abc import Collection, Mapping
from itertools import accumulate

import torch
from torch import Tensor

from legged.config.randomization import DrawConfig, Range, draw_of
from legged.config.robot import RobotDomainRandConfig
from legged.math import masked_set_, uniform
from legged.mdp.distributions import Distributions
from legged.mdp.kernels import Kernels
from legged.mdp.random_pool import RandomPool
from legged.physics import FIELDS, Physics

VARIANTS = 1024
"""Number of variants of the model from which worlds choose if masses, inertias or armatures have `when: reset` or `interval`.
MuJoCo derives constants from these fields, which is impossible within a step. So all variants are drawn at the start, and
their constants are derived then."""


class Randomization:
    """Random properties of the model and of the control law. In each world, a field has one number, or one for each of its
    rows (joints, bodies or shapes).
    """

    STATE: tuple[str, ...] = ("drawn",)

    def __init__(self, ranges: Mapping[str, Range | DrawConfig], num_envs: int, device: torch.device) -> None:
        """Draw one number per world and field. `ranges` maps a field of `physics.FIELDS` to its lowest and highest value, or
        to its distribution.
        """
        self.draws = {name: draw_of(entry) for name, entry in ranges.items()}
        """Field -> its distribution, and when new values are drawn."""
        self.columns = {name: slice(k, k + 1) for k, name in enumerate(ranges)}
        """Field -> its columns in `drawn`."""
        self.drawn = torch.zeros(num_envs, len(ranges), device=device)
        """(N, V) current values of each world, by field in the order of the ranges."""
        for column, (name, entry) in enumerate(ranges.items()):
            if isinstance(entry, DrawConfig):
                self.drawn[:, column] = self._draws([name]).at_once(num_envs)[:, 0]
            else:
                self.drawn[:, column] = uniform(*entry, (num_envs,), device)
        again = [name for name, draw in self.draws.items() if draw.when != "start"]
        self.redrawn = tuple(again)
        """Fields with `when: reset` or `interval`, which change within steps."""
        self.chosen_fields = tuple(name for name in again if FIELDS[name].derived)
        """Fields among `redrawn` from which MuJoCo derives constants. A variant holds values of all these fields."""
        if again:
            self.steps = torch.zeros((), device=device)
            """() control steps since training began, which determine how far ranges have widened."""
            self.STATE = ("drawn", "steps")

    def _draws(self, names: Collection[str], widths: Mapping[str, int] | None = None, pace: int = 1) -> Distributions:
        """Return the distributions of the fields `names`. `widths` has the number of columns of each field; a missing entry
        means 1. `pace` is the number of control steps in a training iteration.
        """
        wide = [name for name in names for _ in range((widths or {}).get(name, 1))]
        neutral = [FIELDS[name].neutral for name in wide]
        return Distributions([self.draws[name] for name in wide], neutral, self.drawn.device, pace)

    def widen(self, rows: Mapping[str, int]) -> None:
        """Draw a number for each row of the fields with `each`, and the variants of `chosen_fields`. `rows` has the number of
        rows by field, which is known once the model is built.
        """
        widths = {name: rows[name] if self.is_each(name) else 1 for name in self.draws}
        if any(self.is_each(name) for name in widths) or self.chosen_fields:
            parts, start = [], 0
            for name, width in widths.items():
                parts.append(self._of(name) if width == 1 else self._draws([name], widths).at_once(len(self.drawn)))
                self.columns[name] = slice(start, start + width)
                start += width
            self.drawn = torch.cat(parts, dim=1)
        if self.chosen_fields:
            self.variants = self._draws(self.chosen_fields, widths).at_once(VARIANTS)
            """(K, W) numbers of `chosen_fields`, by variant."""
            self.chosen = torch.randint(VARIANTS, (len(self.drawn),), device=self.drawn.device)
            """(N,) index of each world's variant."""
            found, start = self.variants[self.chosen], 0
            for name in self.chosen_fields:
                self._of(name).copy_(found[:, start : start + widths[name]])
                start += widths[name]
            self._given: Tensor | None = None
            self.STATE = (*self.STATE, "variants", "chosen")

    def is_each(self, name: str) -> bool:
        """Return whether a field has a number for each row."""
        each = self.draws[name].each
        return FIELDS[name].each if each is None else each

    def _of(self, name: str) -> Tensor:
        """Return a view of the columns of a field, (N, 1) or (N, rows)."""
        return self.drawn[:, self.columns[name]]

    @property
    def fields(self) -> dict[str, Tensor]:
        """Randomised fields and their current values, (N,) or (N, rows) each."""
        return {name: self._of(name) if self.is_each(name) else self._of(name)[:, 0] for name in self.draws}

    def apply(self, physics: Physics) -> None:
        """Write the drawn values into the physics. The task calls this at the start, and after a saved state was loaded."""
        for field, values in self.fields.items():
            if FIELDS[field].changes and field not in self.chosen_fields:
                physics.randomize(field, values)
        if self.chosen_fields:
            # `set_variants` derives constants, which is slow, so it is called only if the variants have changed.
            if self._given is None or not torch.equal(self._given, self.variants):
                widths = [self.columns[name].stop - self.columns[name].start for name in self.chosen_fields]
                physics.set_variants(dict(zip(self.chosen_fields, self.variants.split(widths, dim=1), strict=True)))
                self._given = self.variants.clone()
            physics.choose_variants(torch.ones_like(self.chosen, dtype=torch.bool), self.chosen)

    def prepare(
        self,
        physics: Physics,
        numbers: RandomPool,
        dt: float,
        steps_per_iteration: int,
        kernels: Kernels | None = None,
    ) -> None:
        """Allocate buffers for draws during training, and reserve random numbers in the pool `numbers`. `dt` is the control
        step [s]. Does nothing if all fields are drawn only once, at the start.
        """
        if not self.redrawn:
            return
        device, worlds = self.drawn.device, len(self.drawn)
        own = [name for name in self.redrawn if name not in self.chosen_fields]
        widths = {name: columns.stop - columns.start for name, columns in self.columns.items()}
        self._own = self._draws(own, widths, steps_per_iteration) if own else None
        self._even = self._own.ask(numbers) if self._own is not None else None
        self._choice = numbers.between(0.0, float(VARIANTS), 1) if self.chosen_fields else None
        self._new_chosen = torch.zeros(worlds, dtype=torch.long, device=device)
        # `order` lists the fields of the new values; `place` is each column's index among these values. `moment` says when a
        # column gets new values: 0 means never, 1 means at resets, and 2 + k means every `intervals[k]` seconds.
        intervals = sorted({self.draws[name].interval_s for name in self.redrawn if self.draws[name].when == "interval"})
        order, place, moment = [*own, *self.chosen_fields], [], []
        starts = dict(zip(order, accumulate((widths[name] for name in order), initial=0), strict=False))
        for name, draw in self.draws.items():
            kind = 0 if draw.when == "start" else 1 if draw.when == "reset" else 2 + intervals.index(draw.interval_s)
            for k in range(widths[name]):
                place.append(starts[name] + k if kind else 0)
                moment.append(kind)
        self._place, self._moment = (torch.tensor(values, device=device) for values in (place, moment))
        self._fresh = torch.zeros_like(self.drawn)
        self._due = torch.zeros(worlds, 2 + len(intervals), dtype=torch.bool, device=device)
        self._any_due, self._chosen_due = torch.zeros(2, worlds, dtype=torch.bool, device=device)
        self._kernels = kernels
        self._interval = torch.tensor([float(max(1, round(each / dt))) for each in intervals], device=device)
        self.steps_left = torch.floor(torch.rand(worlds, len(intervals), device=device) * self._interval) + 1.0
        """(N, I) control steps until the next draw of each of I intervals. The first draws are spread over a whole
        interval.
        """
        self.STATE = (*self.STATE, "steps_left")
        self._chosen, self._chosen_at = self._new_chosen, 0
        if self.chosen_fields:
            self._chosen = self.chosen
            draw = self.draws[self.chosen_fields[0]]
            self._chosen_at = 1 if draw.when == "reset" else 2 + intervals.index(draw.interval_s)
        known = {n: c for n, c in self.columns.items() if FIELDS[n].changes and n not in self.chosen_fields}
        self._of_model = [name for name in own if FIELDS[name].changes]
        if self._of_model:
            physics.prepare_redraws(self.drawn, known, self._of_model)

    def draw(self) -> None:
        """Draw new values for every world. `redraw` applies them to the worlds that are due. This runs in parallel with other
        parts of the step.
        """
        if not self.redrawn:
            return
        parts = []
        if self._own is not None and self._even is not None:
            parts.append(self._own.values(self._even.values, self.steps))
        if self._choice is not None:
            self._new_chosen.copy_(self._choice.values[:, 0]).clamp_(max=VARIANTS - 1)
            parts.append(self.variants.index_select(0, self._new_chosen))
        torch.index_select(torch.cat(parts, dim=1), 1, self._place, out=self._fresh)

    def redraw(self, reset: Tensor) -> None:
        """Copy into `drawn` the values that `draw` drew, for worlds of `reset` (N,), whose episodes begin, and for worlds
        whose interval has elapsed. This runs within a step.
        """
        if self._kernels is not None:
            found = (self.steps_left, self._due, self._any_due, self.steps.view(1))
            choice = (self._chosen_at, self._new_chosen, self._chosen, self._chosen_due)
            self._kernels.launch("find_moments", len(reset), reset, self._interval, *found, *choice)
            self._kernels.launch("take_fresh", tuple(self.drawn.shape), self._due, self._moment, self._fresh, self.drawn)
        else:
            self._find_moments(reset)
            torch.where(self._due.index_select(1, self._moment), self._fresh, self.drawn, out=self.drawn)
            if self.chosen_fields:
                self._chosen_due.copy_(self._due[:, self._chosen_at])
                masked_set_(self.chosen, self._chosen_due, self._new_chosen)

    def rewrite(self, physics: Physics) -> None:
        """Write into the physics the values that `redraw` has changed. This runs within a step."""
        if self.chosen_fields:
            physics.choose_variants(self._chosen_due, self.chosen)
        if self._of_model:
            physics.redraw(self._any_due)

    def _find_moments(self, reset: Tensor) -> None:
        """Mark in `_due` the worlds of `reset` (N,) and the worlds whose interval has elapsed. Add 1 to `steps`."""
        self._due[:, 1].copy_(reset)
        if len(self._interval):
            self.steps_left.sub_(1.0)
            due = torch.le(self.steps_left, 0.0, out=self._due[:, 2:])
            torch.where(due, self._interval, self.steps_left, out=self.steps_left)
        torch.any(self._due, dim=1, out=self._any_due)
        self.steps.add_(1.0)

    def progress(self) -> dict[str, Tensor]:
        """Return the number of control steps since training began; {} if no range widens."""
        return {"steps": self.steps.clone()} if any(draw.grow[1] > 0.0 for draw in self.draws.values()) else {}

    def load_progress(self, progress: Mapping[str, Tensor]) -> None:
        """Continue from the number of control steps in `progress`."""
        if "steps" in progress and self.redrawn:
            self.steps.copy_(progress["steps"])


class RobotRandomization(Randomization):
    """Randomisation of a legged robot, with legged_gym's settings for friction and base mass."""

    def __init__(
        self,
        cfg: RobotDomainRandConfig,
        num_envs: int,
        device: torch.device,
    ) -> None:
        """Draw friction (one of `friction_buckets` values) and the mass added to the base, even if they are switched off.
        Then draw the properties of `cfg.ranges`. An entry for friction or added_base_mass there takes precedence.
        """
        low, high = cfg.friction_range
        buckets = uniform(low, high, (cfg.friction_buckets,), device)
        self.cfg = cfg
        self.friction = buckets[torch.randint(cfg.friction_buckets, (num_envs,), device=device)]
        """(N,) friction of each robot's shapes; used with randomize_friction."""
        self.added_mass = uniform(*cfg.added_mass_range, (num_envs,), device)
        """(N,) mass added to each base [kg]; used with randomize_base_mass."""
        super().__init__(cfg.ranges, num_envs, device)
        self.STATE = ("friction", "added_mass", *self.STATE)

    @property
    def fields(self) -> dict[str, Tensor]:
        drawn = {"friction": self.friction} if self.cfg.randomize_friction else {}
        if self.cfg.randomize_base_mass:
            drawn["added_base_mass"] = self.added_mass
        return drawn | super().fields


class Pushes:
    """Pushes of legged_gym: at intervals, each robot's base gets a random horizontal velocity."""

    STATE = ("push_time_left",)

    def __init__(
        self,
        cfg: RobotDomainRandConfig,
        num_envs: int,
        dt: float,
        device: torch.device,
        numbers: RandomPool | None = None,
    ) -> None:
        """Draw the times of the first pushes, between 0 and one interval. `dt` is the control step [s]. Velocities are drawn
        from the pool `numbers`.
        """
        self.cfg, self.dt = cfg, dt
        self.push_time_left = uniform(0.0, cfg.push_interval_s, (num_envs,), device)
        """(N,) time until the next push [s]."""
        self.numbers = numbers or RandomPool(num_envs, device)
        self._velocity = self.numbers.between(-cfg.max_push_vel_xy, cfg.max_push_vel_xy, 2)

    def push(self, physics: Physics, mask: Tensor) -> None:
        """Push the robots in `mask` (N,) that are due: their base gets the drawn horizontal velocity, in the world frame."""
        if not self.cfg.push_robots:
            return
        self.push_time_left.sub_(self.dt)
        due = (self.push_time_left <= 0.5 * self.dt) & mask
        physics.push(due, self._velocity.values - physics.qvel[:, :2])
        masked_set_(self.push_time_left, due, self.cfg.push_interval_s)
