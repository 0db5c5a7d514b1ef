"""Evaluation of a policy in every engine and solver, with the same commands."""

import time
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from legged.config import override
from legged.errors import RunError
from legged.evaluation.engines import ENGINES
from legged.evaluation.result_file import changes_of, device_name, write_result
from legged.evaluation.tables import screen_table
from legged.evaluation.velocity_grid import Grid
from legged.evaluation.velocity_tracking import measure_tracking, ready_to_track
from legged.figures import COLORS, figure
from legged.physics import engine_name
from legged.policies.restore import TrainedPolicy
from legged.process.paths import relative

EVERYWHERE = "all"
"""Value of --physics for all engines."""


def cross(
    policy: TrainedPolicy, grid: Grid, asked: list[tuple[str, Any]], device: torch.device, graph: bool, folder: Path
) -> int:
    """Measure, print and draw; crossing.json in `folder` is written after every engine. Return the exit code.

    Engines run on `device`, the C engine on the CPU. `asked` holds the other overrides of the command line.
    """
    path = folder / "crossing.json"
    failure: RunError | None = None
    result: dict[str, Any] = {
        "task": policy.cfg.task,
        "checkpoint": policy.checkpoint.name,
        **({"changes": changes} if (changes := changes_of(asked)) else {}),
        "grid": grid.axes,
        "robots_per_cell": grid.robots,
        "engines": [],
    }
    for name, engine in ENGINES.items():
        where = torch.device("cpu") if name == "mujoco" else device
        result["engines"].append(_measured(policy, grid, [*asked, *engine.overrides], where, graph))
        try:
            write_result(path, result)
            failure = None
        except RunError as error:  # the table is still printed, and the disk may have room later
            failure = error
    Console(width=110).print(crossing_table(result))
    if failure is not None:
        raise failure
    draw_crossing(result, path.with_suffix(".png"))
    print(f"written: {relative(path)}, {relative(path.with_suffix('.png'))}")
    return 0


def _measured(
    policy: TrainedPolicy, grid: Grid, asked: list[tuple[str, Any]], device: torch.device, graph: bool
) -> dict[str, Any]:
    """Return the figures of one engine; steps/s is that of the evaluation loop, without start-up and compilation."""
    name = engine_name(override(policy.cfg, asked).sim, device)
    print(f"{name}: {grid.size_text}", flush=True)
    task, act = ready_to_track(policy, grid, asked, device, graph)
    start = time.perf_counter()
    figures = measure_tracking(task, act, grid)
    seconds = time.perf_counter() - start
    return {
        "physics": name,
        "device": device_name(device),
        "rmse_lin": figures["rmse_lin"]["mean"],
        "rmse_ang": figures["rmse_ang"]["mean"],
        "falls": figures["falls"],
        "cost_of_transport": figures["cost_of_transport"],
        "base_height": figures["gait"]["base_height"],
        "contact_overflows": figures["contact_overflows"],
        "steps_per_s": grid.num_envs * round(grid.hold_s / task.dt) / seconds,
    }


def crossing_table(result: dict[str, Any]) -> Table:
    """Return a table with one line for each engine. An engine in which every robot fell early has no errors."""
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
    """Draw bars, one for each engine: errors, falls, speed."""
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
