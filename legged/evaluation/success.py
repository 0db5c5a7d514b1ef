"""Success against difficulty: from how hard a tile of each terrain type a policy still walks out.

The sweep and its commands are those of Rudin et al. (arXiv 2109.11978), Fig. 5: robots start in the middle of a tile, are
asked for 0.75 m/s forward and up to 0.1 m/s sideways, and keep their heading; sizes go on beyond those of training. What
counts as success is defined by `Scores`.
"""

import gc
from collections.abc import Callable, Sequence
from math import sqrt
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config import TaskConfig, override
from legged.config.schema import TerrainConfig
from legged.envs import LeggedRobot
from legged.errors import ConfigError, suggest
from legged.evaluation.velocity_grid import Overflows
from legged.math import uniform, yaw_of
from legged.policies.restore import TrainedPolicy, restore, undisturbed
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec

TILE = 8.0
"""Side of a tile [m]."""
DISTANCE = 4.0
"""How far from its start a robot must get [m]: half a tile."""
TIME_S = 20.0
"""Time it has for that [s]."""
FORWARD, SIDEWAYS = 0.75, 0.1
"""Velocity asked for: forward, and the largest to either side [m/s]."""
SPAWN_RANGE = 0.1
"""Robots start at most this far from the middle of their tile, in x and in y, so that no two starts are the same [m]."""
BORDER = 3.0
"""Level ground around the outer tiles [m]."""
VARIANTS = 16
"""Different tiles of each size, among which its robots are shared out, of types that are drawn at random: some tiles have
an easy way out, and the interval of a share knows of robots only."""
REGULAR = {"flat", "slope_up", "slope_down", "waves", "stairs_up", "stairs_down", "gap", "pit"}
"""Types of which all tiles of a size are the same; one is enough."""

SIZES: dict[str, tuple[float, ...]] = {
    **dict.fromkeys(("slope_up", "slope_down"), (5.0, 10.0, 15.0, 20.0, 22.0, 25.0, 30.0, 35.0)),
    **dict.fromkeys(("rough_slope_up", "rough_slope_down"), (5.0, 10.0, 15.0, 20.0, 25.0)),
    **dict.fromkeys(("stairs_up", "stairs_down", "obstacles"), tuple(round(0.05 + 0.025 * i, 3) for i in range(11))),
    "waves": (0.05, 0.1, 0.15, 0.2, 0.25, 0.3),
    "gap": (0.2, 0.4, 0.6, 0.8, 1.0, 1.2),
    "pit": (0.1, 0.2, 0.4, 0.6, 0.8, 1.0),
    "stepping_stones": (0.2, 0.3, 0.45, 0.75, 1.05, 1.35),
    "flat": (0.0,),
}
"""Type -> sizes of the full sweep, in the type's unit."""
FEWER: dict[str, tuple[float, ...]] = {
    **dict.fromkeys(("slope_up", "slope_down"), (10.0, 20.0, 25.0, 30.0)),
    **dict.fromkeys(("rough_slope_up", "rough_slope_down"), (10.0, 20.0, 25.0)),
    **dict.fromkeys(("stairs_up", "stairs_down", "obstacles"), (0.05, 0.1, 0.15, 0.2, 0.25, 0.3)),
}
"""Those of the short one, where they are fewer."""

Z95 = 1.959964
"""Standard normal quantile that leaves 2.5 % above it."""
OPEN, REACHED, FELL, STUCK = range(4)
"""What has become of a robot."""


class Scores:
    """The first thing that happens to each of N robots: it gets DISTANCE away from its start, it falls (the task terminates
    it), or its time is up. What it does after that, or after the reset that follows a fall, does not count.
    """

    def __init__(self, start: Tensor) -> None:
        """`start` (N, 2 or more) is where the robots stand, world frame [m]."""
        self._start = start[:, :2].clone()
        self.outcome = torch.full((len(start),), OPEN, device=start.device)
        """(N,) OPEN, REACHED, FELL or STUCK."""
        self.time_s = torch.zeros(len(start), device=start.device)
        """(N,) when it happened [s]."""

    def update(self, time_s: float, base_pos: Tensor, terminated: Tensor) -> None:
        """Judge a control step that ends at `time_s`: bases at (N, 3), failures (N,)."""
        waiting = self.outcome == OPEN
        fell = waiting & terminated
        # A robot that fell in this step has been put back to its start already: its position says nothing.
        reached = waiting & ~terminated & ((base_pos[:, :2] - self._start).norm(dim=1) >= DISTANCE)
        self.outcome.masked_fill_(fell, FELL)
        self.outcome.masked_fill_(reached, REACHED)
        self.time_s.masked_fill_(fell | reached, time_s)

    def finish(self) -> None:
        """Time is up for those that are left."""
        waiting = self.outcome == OPEN
        self.outcome.masked_fill_(waiting, STUCK)
        self.time_s.masked_fill_(waiting, TIME_S)

    @property
    def done(self) -> bool:
        """Whether something has happened to everyone."""
        return not bool((self.outcome == OPEN).any())


def wilson(successes: int, trials: int, z: float = Z95) -> tuple[float, float]:
    """Wilson's score interval of a share (E. B. Wilson 1927): never outside [0, 1], never empty at 0 or 100 %."""
    share, scale = successes / trials, 1.0 + z**2 / trials
    middle = (share + 0.5 * z**2 / trials) / scale
    half = z / scale * sqrt(share * (1.0 - share) / trials + 0.25 * z**2 / trials**2)
    return max(0.0, middle - half), min(1.0, middle + half)


# ---- what is measured ------------------------------------------------------------------------------------------------


def sizes_of(name: str, full: bool) -> tuple[float, ...]:
    """Sizes that are swept of a type, growing, in its unit."""
    found = SIZES.get(name) if full else FEWER.get(name, SIZES.get(name))
    # Of a type that is not listed, what training could hold and one step more.
    return found or tuple(sorted(TERRAIN_TYPES[name].size(d) for d in (0.2, 0.4, 0.6, 0.8, 1.0, 1.2)))


def chosen_types(cfg: TaskConfig, asked: str | None) -> list[str]:
    """The types in the comma-separated list `asked`, else those the task was trained on (none on a plane).

    Raises:
        ConfigError: an unknown type, or a policy that cannot see terrain.
    """
    if asked is None:
        return [name for name in trained_to(cfg) if name != "flat"]
    names = list(dict.fromkeys(part.strip() for part in asked.split(",")))
    for name in names:
        if name not in TERRAIN_TYPES:
            raise ConfigError(f"--types: there is no terrain type '{name}'{suggest(name, TERRAIN_TYPES)}")
    if cfg.terrain.mesh_type == "plane" and "heights" in cfg.observations.actor:
        raise ConfigError(f"--types: '{cfg.task}' was trained on a plane: to its policy 'heights' means nothing")
    return names


def trained_to(cfg: TaskConfig) -> dict[str, float]:
    """Type -> its size in the hardest row of the training, in its unit; empty for a plane."""
    terrain = cfg.terrain
    if terrain.mesh_type == "plane":
        return {}
    hardest = (terrain.num_rows - 1) / terrain.num_rows if terrain.curriculum else 0.9  # as Terrain.build
    return {name: TERRAIN_TYPES[name].size(hardest) for name, share in terrain.proportions.items() if share > 0.0}


def on_terrain(cfg: TaskConfig, side: float, spawn_range: float) -> list[tuple[str, Any]]:
    """Overrides for a task on tiles of our own, with sides of `side` [m]; what the policy sees stays as trained."""
    changes: list[tuple[str, Any]] = [
        ("terrain.mesh_type", "height_map"),
        ("terrain.curriculum", False),
        ("terrain.terrain_length", side),
        ("terrain.terrain_width", side),
        ("terrain.border_size", BORDER),
        ("terrain.spawn_range", spawn_range),
    ]
    if cfg.terrain.mesh_type == "plane":  # its proportions are not checked, and may be none
        unused = dict.fromkeys(cfg.terrain.proportions, 0.0)
        changes.append(("terrain.proportions", {**unused, "flat": 1.0}))
    return changes


def tiles(name: str, sizes: Sequence[float], cfg: TerrainConfig, seed: int) -> Terrain:
    """The tiles of every size: size i in row 2 i, variant k in column 2 k. Between them is level ground, so that nobody
    steps onto another size before it has left its own.
    """
    variants = 1 if name in REGULAR else VARIANTS
    rows = [[TileSpec("flat", 0.0)] * (2 * variants - 1) for _ in range(2 * len(sizes) - 1)]
    for i, size in enumerate(sizes):
        rows[2 * i][::2] = [TileSpec(name, size)] * variants
    return Terrain.of_tiles(rows, cfg, np.random.default_rng(seed))


def place(task: LeggedRobot, robots: int) -> None:
    """Put the first `robots` robots on the tiles of the first size, the next on those of the second, ..."""
    assert task.terrain is not None
    assert task.terrain_curriculum is not None
    variants = (task.terrain.origins.shape[1] + 1) // 2
    index = torch.arange(task.num_envs, device=task.device)
    task.terrain_curriculum.place_at(2 * (index // robots), 2 * (index % robots % variants))


@torch.inference_mode()
def measure(
    task: LeggedRobot, act: Callable[[TensorDict], Tensor], sizes: Sequence[float], robots: int
) -> tuple[list[dict[str, Any]], int]:
    """Run one type on a task with `robots` robots for each size on `tiles`; returns its points, and how many times a
    robot lost contacts in a control step for want of memory.
    """
    place(task, robots)
    task.reset()
    commands = torch.zeros(task.num_envs, 3, device=task.device)
    commands[:, 0] = FORWARD
    commands[:, 1] = uniform(-SIDEWAYS, SIDEWAYS, (task.num_envs,), torch.device(task.device))
    observations = task.hold_commands(commands, yaw_of(task.base_quat))
    scores, overflows = Scores(task.base_pos), Overflows()
    for step in range(1, round(TIME_S / task.dt) + 1):
        observations, _, _, extras = task.step(act(observations))
        overflows.add(extras)
        scores.update(step * task.dt, task.base_pos, task.terminated_buf)
        if scores.done:
            break
    scores.finish()
    outcomes, times = scores.outcome.view(-1, robots).cpu(), scores.time_s.view(-1, robots).cpu()
    points = [point(size, *of_size) for size, *of_size in zip(sizes, outcomes, times, strict=True)]
    return points, overflows.total(task)


def point(size: float, outcomes: Tensor, times: Tensor) -> dict[str, Any]:
    """The figures of the robots of one size: what became of them (n,), and when (n,) [s]."""
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


def sweep(
    policy: TrainedPolicy,
    names: Sequence[str],
    robots: int,
    full: bool,
    changes: Sequence[tuple[str, Any]],
    device: torch.device,
    graph: bool = True,
    tell: Callable[[str], None] = print,
) -> dict[str, Any]:
    """The points of all `names`, `robots` robots each; `changes` to the configuration come after our own, and `tell` gets
    a line about each type. Plain numbers and lists.
    """
    trained = trained_to(policy.cfg)
    found: dict[str, Any] = {}
    lost = 0
    for name in names:
        sizes = sizes_of(name, full)
        own = [
            *undisturbed(robots * len(sizes), TIME_S),
            *on_terrain(policy.cfg, TILE, SPAWN_RANGE),
            ("observations.add_noise", policy.cfg.observations.add_noise),
            ("commands.heading_command", True),
            ("init_state.yaw", [-np.pi, np.pi]),
            *changes,
        ]
        points, overflows = _on_type(policy, name, sizes, robots, own, device, graph)
        lost += overflows
        kind = TERRAIN_TYPES[name]
        found[name] = {"unit": kind.unit, "what": kind.what, "trained_to": trained.get(name), "points": points}
        reached, count = sum(entry["successes"] for entry in points), robots * len(sizes)
        tell(f"{name}: {len(sizes)} sizes x {robots} robots, {100 * reached / count:.0f} % got out")
    return {
        "definition": {
            "distance_m": DISTANCE,
            "time_s": TIME_S,
            "vx": FORWARD,
            "vy": [-SIDEWAYS, SIDEWAYS],
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
    """Build the task for one type and measure; a function of its own, so that nothing refers to it afterwards."""
    cfg = override(policy.cfg, changes)
    terrain = tiles(name, sizes, cfg.terrain, cfg.env.seed)
    gc.collect()  # the task before this one lives in a cycle of references; two need not fit on a GPU
    task, runner = restore(policy, changes, device, graph, terrain)
    return measure(task, runner.get_inference_policy(str(device)), sizes, robots)
