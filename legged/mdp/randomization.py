"""What differs from world to world, drawn at the start, at resets or at intervals; and legged_gym's pushes."""

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from legged.config.randomization import DrawConfig, Range, draw_of
from legged.config.schema import LeggedDomainRandConfig
from legged.math import masked_set_, uniform
from legged.mdp.draws import Draws
from legged.mdp.uniform_numbers import Drawn, UniformNumbers
from legged.physics import FIELDS, MODEL_FIELDS, Physics

if TYPE_CHECKING:
    from legged.physics.warp.task_kernels import TaskKernels

VARIANTS = 1024
"""Models among which worlds choose where masses, inertias or armatures are drawn again: constants are derived from them when
they are drawn, which is not done within a step."""


class Moment:
    """Columns that are drawn again at the same moments: when episodes begin, or at intervals."""

    def __init__(self, columns: list[int], draws: Draws | None, interval: int, num_envs: int, device: torch.device) -> None:
        """Draw `columns` by `draws`, or if None, by choosing a variant; every `interval` steps, or with 0 at resets."""
        self.draws, self.interval = draws, interval
        self.columns = torch.tensor(columns, device=device)
        self.steps_left = torch.zeros(num_envs, device=device)
        """(N,) control steps until the next draw, of an interval; the first ones are spread over a whole interval."""
        if interval:
            self.steps_left.random_(1, interval + 1)
        self.even: Drawn

    def due(self, reset: Tensor) -> Tensor:
        """Return the worlds (N,) that draw now, where episodes begin in those of `reset` (N,)."""
        if not self.interval:
            return reset
        self.steps_left.sub_(1.0)
        due = self.steps_left <= 0.0
        masked_set_(self.steps_left, due, float(self.interval))
        return due


class Randomization:
    """Draws properties of the model and of the control law, a number per world and field, or one for each row of it."""

    STATE: tuple[str, ...] = ("drawn",)

    def __init__(self, ranges: Mapping[str, Range | DrawConfig], num_envs: int, device: torch.device) -> None:
        """Draw from `ranges`: field of `physics.FIELDS` -> lowest and highest value, or how it is drawn."""
        self.draws = {name: draw_of(entry) for name, entry in ranges.items()}
        """Field -> how it is drawn."""
        self.columns = {name: slice(k, k + 1) for k, name in enumerate(ranges)}
        """Field -> where in `drawn` its numbers are."""
        self.drawn = torch.zeros(num_envs, len(ranges), device=device)
        """(N, V) what each world has of each field, in the order of the ranges."""
        for column, (name, entry) in enumerate(ranges.items()):
            if isinstance(entry, DrawConfig):
                self.drawn[:, column] = self._draws([name]).at_once(num_envs)[:, 0]
            else:
                self.drawn[:, column] = uniform(*entry, (num_envs,), device)
        again = [name for name, draw in self.draws.items() if draw.when != "start"]
        self.redrawn = tuple(again)
        """Fields that are drawn again within steps."""
        self.chosen_fields = tuple(name for name in again if FIELDS[name].derived)
        """Those of them from which constants are derived, of which worlds choose a variant of all together."""
        self._moments: list[Moment] = []
        if again:
            self.steps = torch.zeros((), device=device)
            """Control steps since training began, by which ranges grow."""
            self.STATE = ("drawn", "steps")

    def _draws(self, names: Collection[str], widths: Mapping[str, int] | None = None) -> Draws:
        """Return what draws the columns of some fields."""
        wide = [name for name in names for _ in range((widths or {}).get(name, 1))]
        neutral = [FIELDS[name].neutral for name in wide]
        return Draws([self.draws[name] for name in wide], neutral, self.drawn.device)

    def widen(self, rows: Mapping[str, int]) -> None:
        """Draw numbers for each row of the fields that ask for it, now that it is known how many `rows` they have."""
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
            """(K, W) numbers of the fields of which worlds choose, by variant."""
            self.chosen = torch.randint(VARIANTS, (len(self.drawn),), device=self.drawn.device)
            """(N,) the variant of each world."""
            self._take_chosen(torch.ones_like(self.chosen, dtype=torch.bool))
            self.STATE = (*self.STATE, "variants", "chosen")

    def is_each(self, name: str) -> bool:
        """Whether a field has a number for each row."""
        each = self.draws[name].each
        return FIELDS[name].each if each is None else each

    def _of(self, name: str) -> Tensor:
        """Return the columns of a field, (N, 1) or (N, rows), a view."""
        return self.drawn[:, self.columns[name]]

    @property
    def fields(self) -> dict[str, Tensor]:
        """What is randomised, and what was drawn for it: (N,), or (N, rows)."""
        return {name: self._of(name) if self.is_each(name) else self._of(name)[:, 0] for name in self.draws}

    def apply(self, physics: Physics) -> None:
        """Give the physics what was drawn, at start-up and when a state was put back."""
        for field, values in self.fields.items():
            if field in MODEL_FIELDS and field not in self.chosen_fields:
                physics.randomize(field, values)
        if self.chosen_fields:
            widths = [self.columns[name].stop - self.columns[name].start for name in self.chosen_fields]
            physics.set_variants(dict(zip(self.chosen_fields, self.variants.split(widths, dim=1), strict=True)))
            physics.choose_variants(torch.ones_like(self.chosen, dtype=torch.bool), self.chosen)

    def prepare(self, physics: Physics, numbers: UniformNumbers, dt: float, steps_per_iteration: int) -> None:
        """Prepare for draws within steps of `dt` [s], from `numbers`; nothing is done where there are none."""
        self._steps_per_iteration = steps_per_iteration
        groups: dict[tuple[float, bool], list[str]] = {}
        for name in self.redrawn:
            draw = self.draws[name]
            interval = draw.interval_s if draw.when == "interval" else 0.0
            groups.setdefault((interval, name in self.chosen_fields), []).append(name)
        for (seconds, chooses), names in groups.items():
            steps = max(1, round(seconds / dt)) if seconds else 0
            columns = [c for name in names for c in range(self.columns[name].start, self.columns[name].stop)]
            widths = {name: self.columns[name].stop - self.columns[name].start for name in names}
            draws = None if chooses else self._draws(names, widths)
            moment = Moment(columns, draws, steps, len(self.drawn), self.drawn.device)  # type: ignore[arg-type]
            moment.even = numbers.between(0.0, float(VARIANTS), 1) if draws is None else draws.ask(numbers)
            self._moments.append(moment)
        for number, moment in enumerate(self._moments):
            setattr(self, f"_steps_left_{number}", moment.steps_left)
            self.STATE = (*self.STATE, f"_steps_left_{number}")
        model_fields = [name for name in self.redrawn if name in MODEL_FIELDS and name not in self.chosen_fields]
        if model_fields:
            known = {n: c for n, c in self.columns.items() if n in MODEL_FIELDS and n not in self.chosen_fields}
            physics.prepare_redraws(self.drawn, known, model_fields)
        self._writes_model = bool(model_fields)

    def redraw(self, physics: Physics, reset: Tensor) -> None:
        """Draw again what is due, within a step, where episodes begin in the worlds of `reset` (N,)."""
        any_due: Tensor | None = None
        for moment in self._moments:
            due = moment.due(reset)
            if moment.draws is None:
                new = moment.even.values[:, 0].long().clamp_(max=VARIANTS - 1)
                masked_set_(self.chosen, due, new)
                self._take_chosen(due)
                physics.choose_variants(due, self.chosen)
                continue
            values = moment.draws.values(moment.even.values, self.steps, self._steps_per_iteration)
            old = self.drawn.index_select(1, moment.columns)
            self.drawn.index_copy_(1, moment.columns, torch.where(due.unsqueeze(1), values, old))
            any_due = due if any_due is None else any_due | due
        if any_due is not None and self._writes_model:
            physics.redraw(any_due)
        if self._moments:
            self.steps.add_(1.0)

    def _take_chosen(self, mask: Tensor) -> None:
        """Note what the variants of the worlds of `mask` (N,) have of each field."""
        found = self.variants.index_select(0, self.chosen)
        start = 0
        for name in self.chosen_fields:
            width = self.columns[name].stop - self.columns[name].start
            masked_set_(self._of(name), mask, found[:, start : start + width])
            start += width

    def progress(self) -> dict[str, Tensor]:
        """Return how far ranges have grown, whatever the number of worlds; empty if none does."""
        return {"steps": self.steps.clone()} if any(draw.grow[1] > 0.0 for draw in self.draws.values()) else {}

    def load_progress(self, progress: Mapping[str, Tensor]) -> None:
        """Go on from there."""
        if "steps" in progress and self.redrawn:
            self.steps.copy_(progress["steps"])


class RobotRandomization(Randomization):
    """Randomization with the friction and the base mass of a legged robot."""

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
        self.STATE = ("friction", "added_mass", *self.STATE)

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
