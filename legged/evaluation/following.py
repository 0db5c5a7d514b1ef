"""Evaluations of robots that follow commands: tracking, success on terrain, tracking in all engines, all checkpoints."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from legged.errors import ConfigError, RunError
from legged.evaluation.engines import ENGINES
from legged.evaluation.measurement import Setting, warn_of_overflows
from legged.evaluation.result_file import device_name, file_name, kept_parts, tracking_of, write_result
from legged.evaluation.success import draw_success, print_success, success_over_difficulty, with_other_engines
from legged.evaluation.velocity_grid import Grid
from legged.evaluation.velocity_tracking import draw_tracking, measure_tracking, print_tracking, ready_to_track
from legged.figures import COLORS, figure
from legged.learning.checkpoint import read_checkpoint
from legged.learning.run_folder import checkpoints
from legged.process.paths import relative
from legged.tables import screen_table
from legged.terrain import BUMPS

EVERYWHERE = "all"
"""Value of --physics that stands for all engines."""
WALKING_RMSE = 0.15
"""Default velocity RMSE below which a policy counts as walking [m/s]."""
WALKING_FALLS = 0.01
"""Default share of falls below which a policy counts as walking."""


def evaluate_following(
    setting: Setting, grid: Grid | None, sizes: Mapping[str, Sequence[float]] | None = None, robots: int = 0
) -> int:
    """Measure tracking on the commands of `grid`, unless it is None. Measure success on terrain, unless `sizes` (terrain type
    -> sizes) is empty, with `robots` robots for each size. Print tables, write evaluation_<physics>.json and .png and
    success_<physics>.png, and return the exit code. If tracking or success is not measured, its older values stay in the
    JSON file, provided that they are for the same checkpoint.

    Raises:
        RunError: a file can't be written.
    """
    start = time.perf_counter()
    head = {**setting.head, **setting.changes}
    tracking: dict[str, Any] = {}
    if grid is not None:
        task, act = ready_to_track(setting, grid)
        tracking = measure_tracking(task, act, grid)
        if setting.cfg.terrain.mesh_type != "plane":
            tracking = {"rough": {"bumps": BUMPS * task.cfg.terrain.scale, **tracking}}
        del task, act  # a GPU may not have the memory for two tasks
    success = success_over_difficulty(setting, sizes, robots) if sizes else None
    # Results are printed before files are written, so that they are not lost if the disk is full.
    shown = {**head, **tracking_of(tracking), "ground": "on rough ground, " if "rough" in tracking else ""}
    if tracking:
        print_tracking(shown)
        warn_of_overflows("tracking", shown["contact_overflows"])
        tracking.pop("contact_overflows", None)  # the file holds this count only for rough ground
    if success is not None:
        print_success(success)
        warn_of_overflows("success", success["contact_overflows"])
    path = setting.folder / file_name(setting.engine)
    wall_s, kept = time.perf_counter() - start, kept_parts(path, head)
    kept_success = kept.pop("success", None)
    with_success = {} if success is None and kept_success is None else {"success": success or kept_success}
    result = {**head, "wall_s": wall_s, **(tracking or kept), **with_success}
    write_result(path, result)
    written = [path]
    if tracking:
        written.append(path.with_suffix(".png"))
        draw_tracking(shown, written[-1])
    if success is not None:
        written.append(setting.folder / f"success_{setting.engine}.png")
        draw_success(with_other_engines(result, path), written[-1])
    print(f"written: {', '.join(relative(one) for one in written)}")
    return 0


# ---- all engines -----------------------------------------------------------------------------------------------------


def cross(setting: Setting, grid: Grid) -> int:
    """Measure tracking on the grid in every engine; the C engine runs on the CPU. Write crossing.json after each engine. At
    the end print and draw the results, and return the exit code.
    """
    path, failure = setting.folder / "crossing.json", None
    result: dict[str, Any] = {
        "task": setting.policy.cfg.task,
        "checkpoint": setting.policy.checkpoint.name,
        **setting.changes,
        "grid": grid.axes,
        "robots_per_cell": grid.robots,
        "engines": [],
    }
    for name, engine in ENGINES.items():
        device = torch.device("cpu") if name == "mujoco" else setting.device
        there = replace(setting, device=device, overrides=[*setting.overrides, *engine.overrides])
        result["engines"].append(_measured(there, grid))
        try:
            write_result(path, result)
            failure = None
        except RunError as error:  # go on: the table can still be printed, and the disk may have room later
            failure = error
    Console(width=110).print(crossing_table(result))
    if failure is not None:
        raise failure
    draw_crossing(result, path.with_suffix(".png"))
    print(f"written: {relative(path)}, {relative(path.with_suffix('.png'))}")
    return 0


def _measured(setting: Setting, grid: Grid) -> dict[str, Any]:
    """Return the figures of one engine. The time for `steps_per_s` does not include start-up and compilation."""
    print(f"{setting.engine}: {grid.size_text}", flush=True)
    task, act = ready_to_track(setting, grid)
    start = time.perf_counter()
    figures = measure_tracking(task, act, grid)
    seconds = time.perf_counter() - start
    return {
        "physics": setting.engine,
        "device": device_name(setting.device),
        "rmse_lin": figures["rmse_lin"]["mean"],
        "rmse_ang": figures["rmse_ang"]["mean"],
        "falls": figures["falls"],
        "cost_of_transport": figures["cost_of_transport"],
        "base_height": figures["gait"]["base_height"],
        "contact_overflows": figures["contact_overflows"],
        "steps_per_s": grid.num_envs * round(grid.hold_s / task.dt) / seconds,
    }


def crossing_table(result: dict[str, Any]) -> Table:
    """Return a table with one line for each engine. If all robots fell before the measurement, the errors are "none"."""
    cells = len(result["grid"]["vx"]) * len(result["grid"]["vy"]) * len(result["grid"]["yaw"])
    title = f"{result['task']} ({result['checkpoint']}): {cells} commands x {result['robots_per_cell']} robots"
    forms = {"rmse_lin": "{:.3f} m/s", "rmse_ang": "{:.3f} rad/s", "falls": "{:.1f} %"}
    forms |= {"cost_of_transport": "{:.2f}", "base_height": "{:.3f} m", "contact_overflows": "{}", "steps_per_s": "{:,.0f}"}
    rows = [
        [row["physics"], *("none" if row[key] is None else form.format(row[key]) for key, form in forms.items())]
        for row in ({**row, "falls": 100 * row["falls"]} for row in result["engines"])
    ]
    heads = ("velocity RMSE", "yaw rate RMSE", "falls", "cost of\ntransport", "base height", "lost\ncontacts", "steps/s")
    return screen_table(title, ("engine", *heads), rows)


def draw_crossing(result: dict[str, Any], path: Path) -> None:
    """Draw bar charts of errors, falls and simulation speed, with one bar for each engine."""
    rows = result["engines"]
    names = [row["physics"] for row in rows]
    panels = (
        ("rmse_lin", 1.0, "velocity RMSE [m/s]", "{:.3f}"),
        ("rmse_ang", 1.0, "yaw rate RMSE [rad/s]", "{:.3f}"),
        ("falls", 100.0, "falls [% of robots]", "{:.1f}"),
        ("steps_per_s", 1.0, "control steps per second", "{:,.0f}"),
    )
    with figure(path, (13.0, 0.6 + 0.42 * len(rows)), columns=len(panels), share_y=True) as (drawn, axes):
        for axis, (key, factor, label, form) in zip(axes[0], panels, strict=True):
            values = [None if row[key] is None else factor * row[key] for row in rows]
            bars = axis.barh(names, [value or 0.0 for value in values], color=COLORS[0])
            axis.bar_label(bars, ["none" if value is None else form.format(value) for value in values], padding=3, fontsize=8)
            axis.set_xlim(0.0, 1.3 * max([value for value in values if value], default=1.0))
            axis.set_xlabel(label)
            axis.spines[["top", "right"]].set_visible(False)
        axes[0, 0].invert_yaxis()
        axes[0, 3].set_xscale("log")
        axes[0, 3].set_xlim(1.0, None)
        drawn.suptitle(f"{result['task']} in every engine")


# ---- all checkpoints -------------------------------------------------------------------------------------------------


def evaluate_all_checkpoints(setting: Setting, grid: Grid, rmse: float = WALKING_RMSE, falls: float = WALKING_FALLS) -> int:
    """Measure on the grid all checkpoints in the policy's folder. Print a line for each checkpoint, and which one walks
    first. A policy walks if its mean velocity RMSE is below `rmse` [m/s] and its share of falls is below `falls`. Write
    time_to_walk.json; return the exit code.

    The time of a checkpoint is the wall time [s] from the start of the training process, before its imports, until the
    checkpoint was written.

    Raises:
        ConfigError: a checkpoint does not hold its time. In this case nothing is measured.
        RunError: the file can't be written.
    """
    there: dict[Path, float] = {}
    for path in checkpoints(setting.policy.folder).values():
        written_s = (read_checkpoint(path).get("infos") or {}).get("wall_s")
        if not isinstance(written_s, int | float):
            raise ConfigError(f"{relative(path)}: does not hold the time at which it was written")
        there[path] = float(written_s)
    task, act = ready_to_track(setting, grid)
    rows: list[dict[str, Any]] = []
    lost = 0
    heads = ("iteration", 9), ("seconds", 8), ("velocity RMSE [m/s]", 20), ("yaw rate RMSE [rad/s]", 22), ("falls [%]", 10)
    print(" ".join(f"{head:>{width}}" for head, width in heads), flush=True)
    for path, seconds in there.items():
        iteration = act.load(path)
        figures = measure_tracking(task, act, grid)
        lost += figures["contact_overflows"]
        errors = {name: figures[name]["mean"] for name in ("rmse_lin", "rmse_ang")}
        rows.append({"iteration": iteration, "wall_s": seconds, **errors, "falls": figures["falls"]})
        lin, ang = (float("nan") if error is None else error for error in errors.values())
        print(f"{iteration:9} {seconds:8.1f} {lin:20.3f} {ang:22.3f} {100 * figures['falls']:10.2f}", flush=True)
    first = next((row for row in rows if walks(row, rmse, falls)), None)
    when = f"after {first['wall_s']:.1f} s, {first['iteration']} iterations" if first else "never"
    print(f"velocity RMSE < {rmse:g} m/s, falls < {100 * falls:g} %: {when}", flush=True)
    warn_of_overflows("tracking", lost)
    path = setting.folder / "time_to_walk.json"
    result = {
        "task": task.cfg.task,
        "physics": setting.engine,
        **setting.changes,
        "grid": grid.axes,
        "robots_per_cell": grid.robots,
        "rmse": rmse,
        "share_of_falls": falls,
        "first": first,
        "checkpoints": rows,
        "contact_overflows": lost,
    }
    write_result(path, result)
    print(f"written: {relative(path)}")
    return 0


def walks(row: dict[str, Any], rmse: float, falls: float) -> bool:
    """Return whether a checkpoint's velocity RMSE and share of falls are below their limits; False if all its robots fell."""
    return row["rmse_lin"] is not None and row["rmse_lin"] < rmse and row["falls"] < falls
