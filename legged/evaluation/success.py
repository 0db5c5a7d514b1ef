"""Success over difficulty: the share of robots that walk out of tiles of each terrain type, over their size.

Sizes and commands are those of Rudin et al. (arXiv 2109.11978), Fig. 5. Robots start in the middle of a tile and keep their
heading; commands are 0.75 m/s forward and up to 0.1 m/s sideways. Sizes go beyond those of training. `Scores` defines
success. These numbers hold for a robot half a metre high: lengths scale with `terrain.scale`, velocities with its square root
(constant Froude number).
"""

import gc
from collections.abc import Callable, Mapping, Sequence
from math import sqrt
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config import LeggedConfig, override
from legged.envs import LeggedRobot
from legged.errors import ConfigError
from legged.evaluation.intervals import wilson
from legged.evaluation.overflows import Overflows
from legged.evaluation.tiles import cell_for, on_terrain, tiles_of_sizes
from legged.evaluation.velocity_grid import read_range, spaced
from legged.math import uniform, yaw_of
from legged.policies.restore import TrainedPolicy, restore, undisturbed
from legged.terrain import METRES, TERRAIN_TYPES, hardest_difficulty, terrain_types, tile_size

TILE = 8.0
"""Side of a tile [m]."""
DISTANCE = 4.0
"""Distance from the start that counts as success [m]: half a tile."""
TIME_S = 20.0
"""Time limit for this distance [s]."""
FORWARD, SIDEWAYS = 0.75, 0.1
"""Commanded velocity: forward, and the largest to either side [m/s]."""
SPAWN_RANGE = 0.1
"""Robots start at most this far from the middle of their tile, in x and in y, so that their starts differ [m]."""
OF_STEPS = (
    *("stairs_up", "stairs_down", "step", "obstacles"),
    *("narrow_stairs_up", "narrow_stairs_down", "dense_blocks", "kerbs", "rubble"),
)
"""Types that are measured by the height of their steps."""
SIZES: dict[str, tuple[float, ...]] = {
    **dict.fromkeys(("slope_up", "slope_down"), (5.0, 10.0, 15.0, 20.0, 22.0, 25.0, 30.0, 35.0)),
    **dict.fromkeys(("rough_slope_up", "rough_slope_down"), (5.0, 10.0, 15.0, 20.0, 25.0)),
    **dict.fromkeys(OF_STEPS, tuple(round(0.05 + 0.025 * i, 3) for i in range(11))),
    "waves": (0.05, 0.1, 0.15, 0.2, 0.25, 0.3),
    "gap": (0.2, 0.4, 0.6, 0.8, 1.0, 1.2),
    "pit": (0.1, 0.2, 0.4, 0.6, 0.8, 1.0),
    "stepping_stones": (0.2, 0.3, 0.45, 0.75, 1.05, 1.35),
    "flat": (0.0,),
}
"""Type -> all sizes that are measured, in the type's unit."""
FEWER: dict[str, tuple[float, ...]] = {
    **dict.fromkeys(("slope_up", "slope_down"), (10.0, 20.0, 25.0, 30.0)),
    **dict.fromkeys(("rough_slope_up", "rough_slope_down"), (10.0, 20.0, 25.0)),
    **dict.fromkeys(OF_STEPS, (0.05, 0.1, 0.15, 0.2, 0.25, 0.3)),
}
"""Type -> the sizes that are measured without `--full`, where they are fewer."""
SMALLEST = 0.001
"""Smallest size [m] or [degrees]."""
MOST_SIZES = 100
"""Most sizes of one type; all their tiles lie in one map."""
TYPES_HELP = (
    "terrain types to cross, with sizes of your own if you like: stairs_up,kerbs=0.17,stairs_down=0.2:0.3:0.05; those of the"
    " training by default"
)

OPEN, REACHED, FELL, STUCK = range(4)
"""Outcomes of a robot."""


class Scores:
    """The first event of each of N robots: it gets far enough from its start, it falls (the task terminates it), or its time
    is up, by this clock or by a time-out of the task. Later events do not count.
    """

    def __init__(self, start: Tensor, distance: float = DISTANCE) -> None:
        """Take robots that stand at `start` (N, 2 or more), world frame [m], and have to get `distance` away [m]."""
        self._start, self._distance = start[:, :2].clone(), distance
        self.outcome = torch.full((len(start),), OPEN, device=start.device)
        """(N,) OPEN, REACHED, FELL or STUCK."""
        self.time_s = torch.zeros(len(start), device=start.device)
        """(N,) time of the event [s]."""

    def update(self, time_s: float, base_pos: Tensor, terminated: Tensor, timed_out: Tensor) -> None:
        """Update the outcomes after a control step that ends at `time_s` [s]: bases at (N, 3), failures (N,), time-outs of
        the task (N,).
        """
        waiting = self.outcome == OPEN
        # A robot whose episode ended in this step is back at its start already, so its position does not count.
        reached = waiting & ~(terminated | timed_out) & ((base_pos[:, :2] - self._start).norm(dim=1) >= self._distance)
        self.time_s.masked_fill_(reached | (waiting & (terminated | timed_out)), time_s)
        self.outcome.masked_fill_(waiting & timed_out, STUCK)
        self.outcome.masked_fill_(waiting & terminated, FELL)
        self.outcome.masked_fill_(reached, REACHED)

    def finish(self) -> None:
        """Mark the robots without an event as stuck."""
        waiting = self.outcome == OPEN
        self.outcome.masked_fill_(waiting, STUCK)
        self.time_s.masked_fill_(waiting, TIME_S)

    @property
    def done(self) -> bool:
        """True if every robot has an outcome."""
        return not bool((self.outcome == OPEN).any())


# ---- sizes and tiles --------------------------------------------------------------------------------------------------


def sizes_of(name: str, full: bool, scale: float = 1.0) -> tuple[float, ...]:
    """Return the sizes of a type on ground of that scale, in its unit, in ascending order."""
    kind = TERRAIN_TYPES[name]
    found = SIZES.get(name) if full else FEWER.get(name, SIZES.get(name))
    # A type that is not listed has the sizes of training and one step more.
    found = found or tuple(sorted(kind.size(d) for d in (0.2, 0.4, 0.6, 0.8, 1.0, 1.2)))
    return found if kind.unit != METRES or scale == 1.0 else tuple(round(size * scale, 6) for size in found)


def chosen_sizes(cfg: LeggedConfig, asked: str | None, full: bool, scale: float) -> dict[str, tuple[float, ...]]:
    """Return type -> sizes in its unit, in ascending order: for the types in the comma-separated list `asked`, else for those
    of the training (none on a plane).

    A type of the list may name its sizes: 'stairs_up=0.25', 'kerbs=0.1:0.2:0.05'. Other types have the sizes of `sizes_of` on
    ground of that `scale`.

    Raises:
        ConfigError: a type is unknown or comes twice, a size is out of bounds, or the policy cannot see terrain.
    """
    if asked is None:
        return {name: sizes_of(name, full, scale) for name in trained_to(cfg) if name != "flat"}
    entries = [[part.strip() for part in entry.partition("=")] for entry in asked.split(",")]
    terrain_types("--types", ",".join(name for name, _, _ in entries))
    if cfg.terrain.mesh_type == "plane" and "heights" in cfg.observations.groups["actor"].terms:
        raise ConfigError(f"--types: '{cfg.task}' was trained on a plane: to its policy 'heights' means nothing")
    return {name: _named_sizes(name, text) if given else sizes_of(name, full, scale) for name, given, text in entries}


def _named_sizes(name: str, text: str) -> tuple[float, ...]:
    """Return the named sizes of a type, '0.25' or '0.1:0.2:0.05', in its unit."""
    flag, kind = f"--types: {name}", TERRAIN_TYPES[name]
    low, high, step = read_range(flag, text, f"{name}=0.1:0.2:0.05")
    if not SMALLEST <= low <= high <= kind.largest:
        raise ConfigError(f"{flag}: sizes are at least {SMALLEST:g} and at most {kind.largest:g} {kind.unit}, got '{text}'")
    return tuple(spaced(flag, text, low, high, step, "sizes", MOST_SIZES))


def trained_to(cfg: LeggedConfig) -> dict[str, float]:
    """Return type -> its size in the hardest row of the training, in its unit; empty for a plane."""
    terrain = cfg.terrain
    if terrain.mesh_type == "plane":
        return {}
    hardest = hardest_difficulty(terrain)
    return {name: tile_size(terrain, name, hardest) for name, share in terrain.proportions.items() if share > 0.0}


def to_run_out(cfg: LeggedConfig, num_envs: int) -> list[tuple[str, Any]]:
    """Return overrides for a task of robots that walk out of tiles along their initial heading."""
    return [
        *undisturbed(num_envs, TIME_S),
        *on_terrain(cfg, TILE * cfg.terrain.scale, SPAWN_RANGE * cfg.terrain.scale),
        ("observations.add_noise", cfg.observations.add_noise),
        ("observations.height_map.lost", 0.0),
        ("commands.heading_command", True),
        ("init_state.yaw", [-np.pi, np.pi]),
    ]


def place(task: LeggedRobot, robots: int) -> None:
    """Put the first `robots` robots on the tiles of the first size, the next on those of the second, ..."""
    assert task.terrain is not None
    assert task.terrain_curriculum is not None
    variants = (task.terrain.origins.shape[1] + 1) // 2
    index = torch.arange(task.num_envs, device=task.device)
    task.terrain_curriculum.place_at(2 * (index // robots), 2 * (index % robots % variants))


@torch.inference_mode()
def measure_success(
    task: LeggedRobot, act: Callable[[TensorDict], Tensor], sizes: Sequence[float], robots: int
) -> tuple[list[dict[str, Any]], int]:
    """Run one type on a task with `robots` robots for each size on `tiles_of_sizes`; return its points, and how often a robot
    lost contacts in a control step because memory was full.
    """
    scores, lost = run_out(task, act, robots)
    outcomes, times = scores.outcome.view(-1, robots).cpu(), scores.time_s.view(-1, robots).cpu()
    return [point(size, *of_size) for size, *of_size in zip(sizes, outcomes, times, strict=True)], lost


@torch.inference_mode()
def run_out(task: LeggedRobot, act: Callable[[TensorDict], Tensor], robots: int) -> tuple[Scores, int]:
    """Let all robots walk out of their tiles, `robots` of them on each kind of tile; return their scores, and how often a
    robot lost contacts.
    """
    place(task, robots)
    task.reset()
    commands = torch.zeros(task.num_envs, 3, device=task.device)
    scale = task.cfg.terrain.scale
    commands[:, 0] = FORWARD * sqrt(scale)
    commands[:, 1] = uniform(-SIDEWAYS, SIDEWAYS, (task.num_envs,), torch.device(task.device)) * sqrt(scale)
    observations = task.hold_commands(commands, yaw_of(task.base_quat))
    scores, overflows = Scores(task.base_pos, DISTANCE * scale), Overflows()
    for step in range(1, round(TIME_S / task.dt) + 1):
        observations, _, _, extras = task.step(act(observations))
        overflows.add(extras)
        scores.update(step * task.dt, task.base_pos, task.terminated_buf, task.time_out_buf)
        if scores.done:
            break
    scores.finish()
    return scores, overflows.total(task)


def point(size: float, outcomes: Tensor, times: Tensor) -> dict[str, Any]:
    """Return the figures of the robots of one size, from their outcomes (n,) and times (n,) [s]."""
    reached = outcomes == REACHED
    trials, successes = len(outcomes), int(reached.sum())
    low, high = wilson(successes, trials)
    return {
        "size": size,
        "robots": trials,
        "successes": successes,
        "share": successes / trials,
        "low": low,
        "high": high,
        "fell": int((outcomes == FELL).sum()),
        "stuck": int((outcomes == STUCK).sum()),
        "mean_time_s": float(times[reached].mean()) if successes else None,
    }


def success_over_difficulty(
    policy: TrainedPolicy,
    sizes: Mapping[str, Sequence[float]],
    robots: int,
    changes: Sequence[tuple[str, Any]],
    device: torch.device,
    graph: bool = True,
) -> dict[str, Any]:
    """Measure all `sizes` of each type with `robots` robots each, and print a line for each type; `changes` to the
    configuration come after those of the measurement. Return plain numbers and lists.
    """
    assert isinstance(policy.cfg, LeggedConfig), "the task follows no commands"
    cfg: Any = override(policy.cfg, changes)  # another scale asks for other lengths
    trained, scale = trained_to(policy.cfg), cfg.terrain.scale
    found: dict[str, Any] = {}
    lost = 0
    for name, of_type in sizes.items():
        cell = ("terrain.horizontal_scale", cell_for(name, cfg.terrain))
        own = [*to_run_out(cfg, robots * len(of_type)), *changes, cell]
        points, overflows = _on_type(policy, name, of_type, robots, own, device, graph)
        lost += overflows
        kind = TERRAIN_TYPES[name]
        found[name] = {"unit": kind.unit, "what": kind.what, "trained_to": trained.get(name), "points": points}
        reached, count = sum(entry["successes"] for entry in points), robots * len(of_type)
        count_of_sizes = f"{len(of_type)} size{'s' if len(of_type) > 1 else ''}"
        print(f"{name}: {count_of_sizes} x {robots} robots, {100 * reached / count:.0f} % got out", flush=True)
    return {
        "definition": {
            "distance_m": DISTANCE * scale,
            "time_s": TIME_S,
            "vx": FORWARD * sqrt(scale),
            "vy": [-SIDEWAYS * sqrt(scale), SIDEWAYS * sqrt(scale)],
            "interval": "Wilson 95 %",
        },
        "robots_per_point": robots,
        "contact_overflows": lost,
        "types": found,
    }


def _on_type(
    policy: TrainedPolicy,
    name: str,
    sizes: Sequence[float],
    robots: int,
    changes: Sequence[tuple[str, Any]],
    device: torch.device,
    graph: bool,
) -> tuple[list[dict[str, Any]], int]:
    """Build the task for one type and measure; after the call nothing refers to the task."""
    cfg: Any = override(policy.cfg, changes)
    terrain = tiles_of_sizes(name, sizes, cfg.terrain, cfg.env.seed)
    gc.collect()  # the task before this one is in a reference cycle, and a GPU may not hold two
    task, act = restore(policy, changes, device, graph, terrain)
    return measure_success(task, act, sizes, robots)
