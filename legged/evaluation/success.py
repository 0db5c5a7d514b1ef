"""Measure, print and draw success over difficulty: the share of robots that walk out of the tiles of each terrain type.

Sizes and commands are those of Rudin et al. (arXiv 2109.11978), Fig. 5; the largest sizes are harder than those of training.
Robots start in the middle of a tile and keep their heading, with commands of 0.75 m/s forward and up to 0.1 m/s sideways.
`Scores` defines success. The numbers in this file are for a robot half a metre high. For other robots, lengths are multiplied
by `terrain.scale` and velocities by its square root (constant Froude number).
"""

import gc
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain, product
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from legged.config import LeggedConfig, override
from legged.config.dotted import value_at
from legged.envs import LeggedRobot
from legged.errors import ConfigError
from legged.evaluation.engines import ENGINES, by_engine, engine_of
from legged.evaluation.intervals import wilson
from legged.evaluation.json_forms import ANY, NUMBER, check_form
from legged.evaluation.measurement import Overflows, Setting
from legged.evaluation.reports.charts import Chart, Line, draw_charts
from legged.evaluation.result_file import HEAD, POINT, TYPE, file_name
from legged.evaluation.tiles import cell_for, on_terrain, tiles_of_sizes
from legged.evaluation.velocity_grid import read_range, spaced
from legged.math import uniform, yaw_of
from legged.policies.episodes import Policy
from legged.policies.restore import restore, undisturbed
from legged.tables import screen_table
from legged.terrain import METRES, TERRAIN_TYPES, hardest_difficulty, terrain_types, tile_size

TILE = 8.0
"""Side of a tile [m]."""
DISTANCE = 4.0
"""Distance from its start that a robot must reach to succeed [m]: half a tile."""
TIME_S = 20.0
"""Time limit for DISTANCE [s]."""
FORWARD, SIDEWAYS = 0.75, 0.1
"""Commanded forward velocity, and the largest commanded velocity to either side [m/s]."""
SPAWN_RANGE = 0.1
"""Largest distance of a robot's start from the middle of its tile, in x and in y [m]."""
OF_STEPS = (
    *("stairs_up", "stairs_down", "step", "obstacles"),
    *("narrow_stairs_up", "narrow_stairs_down", "dense_blocks", "kerbs", "rubble"),
)
"""Terrain types whose size is the height of their steps."""
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
"""Terrain type -> sizes that are measured with `--full`, in the type's unit."""
FEWER: dict[str, tuple[float, ...]] = {
    **dict.fromkeys(("slope_up", "slope_down"), (10.0, 20.0, 25.0, 30.0)),
    **dict.fromkeys(("rough_slope_up", "rough_slope_down"), (10.0, 20.0, 25.0)),
    **dict.fromkeys(OF_STEPS, (0.05, 0.1, 0.15, 0.2, 0.25, 0.3)),
}
"""Terrain type -> sizes that are measured without `--full`, in the type's unit. Types without an entry use SIZES."""
SMALLEST = 0.001
"""Smallest size that a user can choose, in the type's unit."""
MOST_SIZES = 100
"""Largest number of sizes of a type. It is limited because the tiles of all these sizes are in one height map."""
TYPES_HELP = (
    "terrain types to cross, by default those of the training; a size or a range of sizes may follow a type, e.g."
    " stairs_up,kerbs=0.17,stairs_down=0.2:0.3:0.05"
)

REACHED, FELL, STUCK = range(3)
"""Outcomes of a robot."""
PANELS = {
    "stairs": ("stairs_up", "stairs_down"),
    "narrow stairs": ("narrow_stairs_up", "narrow_stairs_down"),
    "obstacles": ("obstacles",),
    "slopes": ("slope_up", "slope_down"),
    "rough slopes": ("rough_slope_up", "rough_slope_down"),
}
"""Title of a panel -> terrain types that share it; every other type has its own panel."""


class Scores:
    """Outcomes of N robots. A robot's first event decides: the robot is far enough from its start (REACHED), the task ends
    its episode as a failure (FELL), or time is up (STUCK). Time is up after TIME_S or at a time-out of the task.
    """

    def __init__(self, start: Tensor, distance: float = DISTANCE) -> None:
        """Robots start at `start` (N, 2 or more), world frame [m], and succeed at `distance` [m] from their own start."""
        self._start, self._distance = start[:, :2].clone(), distance
        self._open = torch.ones(len(start), dtype=torch.bool, device=start.device)
        self.outcome = torch.full((len(start),), STUCK, device=start.device)
        """(N,) REACHED, FELL or STUCK. Robots that have had no event yet count as STUCK."""
        self.time_s = torch.full((len(start),), TIME_S, device=start.device)
        """(N,) time of the event [s]; TIME_S without an event."""

    def update(self, time_s: float, base_pos: Tensor, terminated: Tensor, timed_out: Tensor) -> None:
        """Update the outcomes after the control step that ends at `time_s` [s]. `base_pos` (N, 3) is in the world frame [m];
        `terminated` and `timed_out` (N,) are flags of the robots whose episodes ended in this step.
        """
        # A robot whose episode ended in this step has already been reset to its start, so its position does not count.
        ended = terminated | timed_out
        reached = self._open & ~ended & ((base_pos[:, :2] - self._start).norm(dim=1) >= self._distance)
        self.outcome.masked_fill_(reached, REACHED)
        self.outcome.masked_fill_(self._open & terminated, FELL)
        self.time_s.masked_fill_(reached | (self._open & ended), time_s)
        self._open &= ~(reached | ended)

    @property
    def done(self) -> bool:
        """True if every robot has had its first event."""
        return not bool(self._open.any())


# ---- sizes and tiles --------------------------------------------------------------------------------------------------


def sizes_of(name: str, full: bool, scale: float = 1.0) -> tuple[float, ...]:
    """Return a terrain type's sizes in its unit, in ascending order. `full` means `--full`, `scale` is `terrain.scale`."""
    kind = TERRAIN_TYPES[name]
    found = SIZES.get(name) if full else FEWER.get(name, SIZES.get(name))
    # A type without a list is measured at the sizes of these difficulties; 1.2 is harder than training, which ends at 1.
    found = found or tuple(sorted(kind.size(d) for d in (0.2, 0.4, 0.6, 0.8, 1.0, 1.2)))
    return found if kind.unit != METRES or scale == 1.0 else tuple(round(size * scale, 6) for size in found)


def chosen_sizes(cfg: LeggedConfig, asked: str | None, full: bool, scale: float) -> dict[str, tuple[float, ...]]:
    """Return terrain type -> sizes in its unit, in ascending order. The types are those in the comma-separated list `asked`.
    Without a list they are those of the training; a training on a plane has no terrain types.

    Sizes may follow a type in the list: 'stairs_up=0.25', 'kerbs=0.1:0.2:0.05'. Without them, `sizes_of` gives the sizes.

    Raises:
        ConfigError: a type is unknown or comes twice, a size is out of bounds, or the policy cannot see terrain.
    """
    if asked is None:
        return {name: sizes_of(name, full, scale) for name in trained_to(cfg) if name != "flat"}
    entries = [[part.strip() for part in entry.partition("=")] for entry in asked.split(",")]
    terrain_types("--types", ",".join(name for name, _, _ in entries))
    if cfg.terrain.mesh_type == "plane" and "heights" in cfg.observations.groups["actor"].terms:
        raise ConfigError(f"--types: '{cfg.task}' was trained on a plane, so its policy has not learned to use 'heights'")
    return {name: _named_sizes(name, text) if given else sizes_of(name, full, scale) for name, given, text in entries}


def _named_sizes(name: str, text: str) -> tuple[float, ...]:
    """Return the sizes that a `text` like '0.25' or '0.1:0.2:0.05' lists, in the unit of the terrain type `name`."""
    flag, kind = f"--types: {name}", TERRAIN_TYPES[name]
    given = low, high, _ = read_range(flag, text, f"{name}=0.1:0.2:0.05")
    if not SMALLEST <= low <= high <= kind.largest:
        raise ConfigError(f"{flag}: sizes are at least {SMALLEST:g} and at most {kind.largest:g} {kind.unit}, got '{text}'")
    return tuple(spaced(flag, text, given, "sizes", MOST_SIZES))


def trained_to(cfg: LeggedConfig) -> dict[str, float]:
    """Return terrain type -> its size in the training's hardest row of tiles, in the type's unit; {} for a plane."""
    terrain = cfg.terrain
    if terrain.mesh_type == "plane":
        return {}
    hardest = hardest_difficulty(terrain)
    return {name: tile_size(terrain, name, hardest) for name, share in terrain.proportions.items() if share > 0.0}


def to_run_out(cfg: LeggedConfig, num_envs: int) -> list[tuple[str, Any]]:
    """Return overrides for a task in which robots walk out of their tiles and keep their initial heading."""
    return [
        *undisturbed(cfg, num_envs, TIME_S),
        *on_terrain(cfg, TILE * cfg.terrain.scale, SPAWN_RANGE * cfg.terrain.scale),
        ("observations.add_noise", cfg.observations.add_noise),
        ("observations.height_map.lost", 0.0),
        ("commands.heading_command", True),
        ("init_state.yaw", [-np.pi, np.pi]),
    ]


def place(task: LeggedRobot, robots: int) -> None:
    """Put the first `robots` robots on the tiles of the first size, the next `robots` on those of the second, and so on."""
    assert task.terrain is not None
    assert task.terrain_curriculum is not None
    variants = (task.terrain.origins.shape[1] + 1) // 2
    index = torch.arange(task.num_envs, device=task.device)
    task.terrain_curriculum.place_at(2 * (index // robots), 2 * (index % robots % variants))


def measure_success(task: LeggedRobot, act: Policy, sizes: Sequence[float], robots: int) -> tuple[list[dict[str, Any]], int]:
    """Measure success on one terrain type, with `robots` robots for each of the `sizes`. The task's terrain comes
    from `tiles_of_sizes`. Return the figures of each size, and the number of steps with lost contacts (see `run_out`).
    """
    scores, lost = run_out(task, act, robots)
    outcomes, times = scores.outcome.view(-1, robots).cpu(), scores.time_s.view(-1, robots).cpu()
    return [point(size, *of_size) for size, *of_size in zip(sizes, outcomes, times, strict=True)], lost


@torch.inference_mode()
def run_out(task: LeggedRobot, act: Policy, robots: int) -> tuple[Scores, int]:
    """Let all robots walk out of their tiles, with `robots` robots for each size. Return their scores, and the
    number of control steps in which a robot lost contacts because memory was full, summed over robots.
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
    return scores, overflows.total(task)


def point(size: float, outcomes: Tensor, times: Tensor) -> dict[str, Any]:
    """Return the figures for one size, from the `outcomes` (n,) and `times` (n,) [s] of its robots."""
    reached, fell = outcomes == REACHED, int((outcomes == FELL).sum())
    return {
        "size": size,
        **share_of(reached, fell),
        "stuck": int((outcomes == STUCK).sum()),
        "mean_time_s": float(times[reached].mean()) if reached.any() else None,
    }


def share_of(successful: Tensor, fell: int) -> dict[str, Any]:
    """Return the share of successful robots, with interval and counts, from flags `successful` (n,) and the count `fell`."""
    trials, successes = len(successful), int(successful.sum())
    low, high = wilson(successes, trials)
    share = successes / trials
    return {"robots": trials, "successes": successes, "share": share, "low": low, "high": high, "fell": fell}


def success_over_difficulty(setting: Setting, sizes: Mapping[str, Sequence[float]], robots: int) -> dict[str, Any]:
    """Measure success for all `sizes` of each terrain type, with `robots` robots for each size. Print a line for each type.
    Return the part "success" of a result.
    """
    cfg = setting.cfg  # overrides may change terrain.scale, and with it all lengths
    trained, scale = trained_to(setting.policy.cfg), cfg.terrain.scale  # type: ignore[arg-type]
    found: dict[str, Any] = {}
    lost = 0
    for name, of_type in sizes.items():
        cell = ("terrain.horizontal_scale", cell_for(name, cfg.terrain))
        changes = [*to_run_out(cfg, robots * len(of_type)), *setting.asked, cell]
        points, overflows = _on_type(setting, name, of_type, robots, changes)
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
    setting: Setting, name: str, sizes: Sequence[float], robots: int, changes: Sequence[tuple[str, Any]]
) -> tuple[list[dict[str, Any]], int]:
    """Build the task for one terrain type and measure success. The task is not returned, so its memory can be freed."""
    cfg: Any = override(setting.policy.cfg, changes)
    terrain = tiles_of_sizes(name, sizes, cfg.terrain, cfg.env.seed)
    gc.collect()  # the previous task is in a reference cycle, and a GPU may not have the memory for two tasks
    task, act = restore(setting.policy, changes, setting.device, setting.graph, terrain)
    return measure_success(task, act, sizes, robots)


# ---- table and curves ------------------------------------------------------------------------------------------------


def print_success(success: dict[str, Any]) -> None:
    """Print a table with a line for each terrain type and size. Sizes that are harder than in training are marked with *."""
    rule, beyond = success["definition"], False
    title = f"success: {rule['distance_m']:.3g} m from the start within {rule['time_s']:g} s, asked for {rule['vx']:.3g} m/s"
    rows: list[list[str] | None] = []
    for name, entry in success["types"].items():
        for i, point in enumerate(entry["points"]):
            mark = is_beyond(name, point["size"], entry["trained_to"])
            beyond |= mark
            time_s = point["mean_time_s"]
            row = [name if i == 0 else "", f"{point['size']:.3g} {entry['unit']}{' *' if mark else '  '}"]
            row.append(f"{point['successes']}/{point['robots']} = {100 * point['share']:.0f} %")
            row += [f"{100 * point['low']:.0f} to {100 * point['high']:.0f} %", str(point["fell"]), str(point["stuck"])]
            rows.append([*row, "" if time_s is None else f"{time_s:.1f} s"])
        rows.append(None)
    heads = ("terrain", "size", "success", "95 % interval", "fell", "stuck", "time to success")
    Console(width=110).print(screen_table(title, heads, rows))
    if beyond:
        print("* harder than in training")


def is_beyond(name: str, size: float, trained_to: float | None) -> bool:
    """Return whether a size is harder than `trained_to`, the training's hardest size. A `trained_to` of None gives False."""
    if trained_to is None:
        return False
    kind = TERRAIN_TYPES[name]
    grows = kind.size(1.0) >= kind.size(0.0)  # small stepping stones are harder than large ones
    return size > trained_to + 1e-9 if grows else size < trained_to - 1e-9


def with_other_engines(result: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    """Return `result` and the results of other engines, which are read from evaluation_<physics>.json in the folder of
    `path`. Results of another checkpoint or with other changed fields are left out.
    """
    found = [result]
    drawn = {"types": {ANY: {**TYPE, "points": [{**POINT, "low": NUMBER, "high": NUMBER}]}}, "robots_per_point": NUMBER}
    for engine in ENGINES.keys() - {result["physics"]}:
        with suppress(OSError, ValueError):  # a file that is absent or damaged is left out
            saved = json.loads(path.with_name(file_name(engine)).read_text(encoding="utf-8"))
            check_form(saved, {**HEAD, "success": drawn}, str(path))
            same = {**{key: result.get(key) for key in ("task", "checkpoint", "changes")}, "physics": engine}
            found += [saved] if all(saved.get(key) == value for key, value in same.items()) else []
    return list(by_engine(found).values())


def draw_success(results: list[dict[str, Any]], path: Path) -> None:
    """Draw success and its intervals over size into a PNG file. A panel (see `panels_of`) has a line for each terrain type
    and engine.
    """
    rule, robots = results[0]["success"]["definition"], results[0]["success"]["robots_per_point"]
    reached = f"get {rule['distance_m']:.3g} m from their start within {rule['time_s']:g} s"
    draw_charts(success_charts(results), path, f"{results[0]['task']}: robots that {reached}\n{robots} robots a point")


def success_charts(results: Sequence[dict[str, Any]]) -> list[Chart]:
    """Return a chart of success over size for each panel of `panels_of`, with a line for each terrain type and engine."""
    found = []
    for title, types in panels_of([name for result in results for name in types_in(result)]).items():
        lines = []
        for name, result in product(types, results):
            if entry := types_in(result).get(name):
                words = [name.replace("_", " ")] if len(types) > 1 else []
                words += [engine_of(result["physics"]).label] if len(results) > 1 else []
                lines.append((entry, success_line(", ".join(words), entry)))
        found.append(success_chart(title, lines))
    return found


def types_in(result: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return terrain type -> its measurements; an empty mapping if success on terrain was not measured."""
    return value_at(result, "success.types") or {}


def success_line(label: str, entry: dict[str, Any]) -> Line:
    """Return the line of success over size for one terrain type. A band shows the intervals if `entry` has them."""
    points = sorted(entry["points"], key=lambda point: point["size"])
    banded = all(isinstance(point.get(key), int | float) for point in points for key in ("low", "high"))
    keys = ("size", "share", "low", "high") if banded else ("size", "share")
    size, share, *band = (np.array([point[key] for point in points], dtype=float) for key in keys)
    return Line(label, size, share, (band[0], band[1]) if band else None, markers=True)


def success_chart(title: str, lines: Sequence[tuple[dict[str, Any], Line]]) -> Chart:
    """Return the chart of success over size. `lines` holds pairs: the entry of a terrain type in a result, and its curve. A
    dotted line marks the hardest size of the training. If these sizes differ, a label at each dotted line names its curves.
    """
    ends: dict[float, list[str]] = {}
    for entry, line in lines:
        if entry["trained_to"] is not None:
            ends.setdefault(float(entry["trained_to"]), []).append(line.name)
    label = "hardest of training"
    walls = tuple((f"{label}: {', '.join(names)}" if len(ends) > 1 else label, end) for end, names in ends.items())
    what, unit = lines[0][0]["what"], lines[0][0]["unit"]
    drawn = [line for _, line in lines]
    return Chart(f"success: {title}", f"{what} [{unit}]", drawn, unit=what, percent=True, walls=walls)


def panels_of(names: list[str]) -> dict[str, tuple[str, ...]]:
    """Return title of a panel -> its terrain types, for the types in `names`. Related types share a panel, as in PANELS."""
    there = dict.fromkeys(names)
    shared = {title: tuple(name for name in types if name in there) for title, types in PANELS.items()}
    alone = [name for name in there if name not in chain.from_iterable(PANELS.values())]
    return {title: types for title, types in shared.items() if types} | {name.replace("_", " "): (name,) for name in alone}
