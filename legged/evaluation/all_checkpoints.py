"""All checkpoints of a run, evaluated in the order they were written, and the first of them that walks."""

from pathlib import Path
from typing import Any

import torch

from legged.errors import ConfigError
from legged.evaluation.overflows import warn_of_overflows
from legged.evaluation.result_file import changes_of, write_result
from legged.evaluation.velocity_grid import Grid
from legged.evaluation.velocity_tracking import measure_tracking, ready_to_track
from legged.learning.checkpoint import read_checkpoint
from legged.learning.run_folder import checkpoints
from legged.physics import engine_name
from legged.policies.restore import TrainedPolicy
from legged.process.paths import relative

WALKING_RMSE = 0.15
"""Largest velocity RMSE of a robot that walks, by default [m/s]."""
WALKING_FALLS = 0.01
"""Largest share of falls of a robot that walks, by default."""
LARGEST_RMSE = 100.0
"""Largest velocity RMSE that --rmse accepts [m/s]."""


def check_limits(rmse: float, falls: float) -> None:
    """Check the limits --rmse and --falls.

    Raises:
        ConfigError: a limit is out of bounds.
    """
    for flag, value, most in (("--rmse", rmse, LARGEST_RMSE), ("--falls", falls, 1.0)):
        if not value > 0:
            raise ConfigError(f"{flag}: must be above 0, got {value}")
        if value > most:
            raise ConfigError(f"{flag}: must be at most {most:g}, got {value}")


def evaluate_all_checkpoints(
    policy: TrainedPolicy,
    grid: Grid,
    asked: list[tuple[str, Any]],
    device: torch.device,
    graph: bool,
    folder: Path,
    rmse: float = WALKING_RMSE,
    falls: float = WALKING_FALLS,
) -> int:
    """Measure every checkpoint in the policy's folder on the grid, print a line for each, and name the first that walks: with
    a mean velocity RMSE below `rmse` [m/s] and a share of falls below `falls`. Write time_to_walk.json into `folder`; return
    the exit code.

    Seconds are wall time from the start of the process that wrote the checkpoint, imports and all.

    Raises:
        ConfigError: a checkpoint holds no time; nothing is measured then.
        RunError: the file can't be written.
    """
    there = {path: _written_at(path) for path in checkpoints(policy.folder).values()}
    task, act = ready_to_track(policy, grid, asked, device, graph)
    rows: list[dict[str, Any]] = []
    lost = 0
    print(
        f"{'iteration':>9} {'seconds':>8} {'velocity RMSE [m/s]':>20} {'yaw rate RMSE [rad/s]':>22} {'falls [%]':>10}",
        flush=True,
    )
    for path, seconds in there.items():
        iterations = act.load(path)
        figures = measure_tracking(task, act, grid)
        lost += figures["contact_overflows"]
        row = {
            "iteration": iterations,
            "wall_s": seconds,
            "rmse_lin": figures["rmse_lin"]["mean"],
            "rmse_ang": figures["rmse_ang"]["mean"],
            "falls": figures["falls"],
        }
        rows.append(row)
        errors = [float("nan") if row[name] is None else row[name] for name in ("rmse_lin", "rmse_ang")]
        line = f"{row['iteration']:9} {seconds:8.1f} {errors[0]:20.3f} {errors[1]:22.3f} {100 * row['falls']:10.2f}"
        print(line, flush=True)
    first = next((row for row in rows if walks(row, rmse, falls)), None)
    limits = f"velocity RMSE < {rmse:g} m/s, falls < {100 * falls:g} %"
    print(
        f"{limits}: " + (f"after {first['wall_s']:.1f} s, {first['iteration']} iterations" if first else "never"), flush=True
    )
    warn_of_overflows("tracking", lost)
    path = folder / "time_to_walk.json"
    engine, changes = engine_name(task.cfg.sim, device), changes_of(asked)
    result = {
        "task": task.cfg.task,
        "physics": engine,
        **({"changes": changes} if changes else {}),
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


def _written_at(path: Path) -> float:
    """Return the time at which a checkpoint was written, since the start of its process [s].

    Raises:
        ConfigError: the checkpoint holds no time.
    """
    seconds = (read_checkpoint(path).get("infos") or {}).get("wall_s")
    if not isinstance(seconds, int | float):
        raise ConfigError(f"{relative(path)}: says nothing of the time it was written at")
    return float(seconds)


def walks(row: dict[str, Any], rmse: float, falls: float) -> bool:
    """Return whether a checkpoint walks; a checkpoint whose robots all fell has no error."""
    return row["rmse_lin"] is not None and row["rmse_lin"] < rmse and row["falls"] < falls
