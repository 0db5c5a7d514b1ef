"""Evaluation of legged robots: errors on a grid of commands and success over difficulty."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from legged.config import LeggedConfig, override
from legged.evaluation.episodes import header
from legged.evaluation.overflows import warn_of_overflows
from legged.evaluation.result_file import device_name, file_name, kept_success, kept_tracking, tracking_of, write_result
from legged.evaluation.success import success_over_difficulty
from legged.evaluation.success_report import draw_success, print_success, with_other_engines
from legged.evaluation.tracking_report import draw_tracking, print_tracking
from legged.evaluation.velocity_grid import Grid
from legged.evaluation.velocity_tracking import measure_tracking, ready_to_track
from legged.physics import engine_name
from legged.policies.restore import TrainedPolicy
from legged.process.paths import relative
from legged.terrain import BUMPS


def evaluate_following(
    policy: TrainedPolicy,
    grid: Grid | None,
    sizes: Mapping[str, Sequence[float]],
    robots: int,
    asked: list[tuple[str, Any]],
    device: torch.device,
    graph: bool,
    folder: Path,
    where: str = "sim.physics",
) -> int:
    """Measure tracking on the grid, if there is one, and success at all `sizes` of each terrain type with `robots` robots for
    each size. Print tables, then write evaluation_<physics>.json and .png and success_<physics>.png into `folder`. Return the
    exit code. The file keeps a part that is not measured now if that part belongs to the same checkpoint. `where` names the
    setting of the engine in errors.

    Raises:
        RunError: a file can't be written.
    """
    start = time.perf_counter()
    cfg = policy.cfg
    assert isinstance(cfg, LeggedConfig), "the task has no velocity commands"
    engine = engine_name(override(cfg, asked).sim, device, where)
    head = header(policy, engine, device_name(device), asked)
    tracking, lost = ({}, 0) if grid is None else _tracking(policy, grid, asked, device, graph)
    success = success_over_difficulty(policy, sizes, robots, asked, device, graph) if sizes else None
    # Results are printed first, so that a full disk cannot lose them.
    shown = {**head, **tracking_of(tracking), "ground": "on rough ground, " if "rough" in tracking else ""}
    if tracking:
        print_tracking(shown)
        warn_of_overflows("tracking", lost)
    if success is not None:
        print_success(success)
        warn_of_overflows("success", success["contact_overflows"])
    path = folder / file_name(engine)
    result = {
        **head,
        "wall_s": time.perf_counter() - start,
        **(tracking or kept_tracking(path, head)),
        **(kept_success(path, head) if success is None else {"success": success}),
    }
    write_result(path, result)
    written = [path]
    if tracking:
        written.append(path.with_suffix(".png"))
        draw_tracking(shown, written[-1])
    if success is not None:
        written.append(folder / f"success_{engine}.png")
        draw_success(with_other_engines(result, path), written[-1])
    print(f"written: {', '.join(relative(one) for one in written)}")
    return 0


def _tracking(
    policy: TrainedPolicy, grid: Grid, asked: list[tuple[str, Any]], device: torch.device, graph: bool
) -> tuple[dict[str, Any], int]:
    """Return the errors over the grid, under 'rough' for a task with terrain, and the number of contacts that were lost."""
    task, act = ready_to_track(policy, grid, asked, device, graph)
    figures = measure_tracking(task, act, grid)
    lost = figures.pop("contact_overflows")
    if policy.cfg.terrain.mesh_type == "plane":  # type: ignore[attr-defined]
        return figures, lost
    return {"rough": {"bumps": BUMPS * task.cfg.terrain.scale, **figures, "contact_overflows": lost}}, lost
