"""How a policy crosses into other engines: the same commands in every engine and solver."""

import json
import time
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from legged.config import override
from legged.errors import RunError
from legged.evaluation.engines import ENGINES
from legged.evaluation.result_file import changes_of
from legged.evaluation.velocity_grid import Grid
from legged.evaluation.velocity_tracking import measure_tracking, ready_to_track
from legged.figures import COLORS, figure
from legged.physics import engine_name
from legged.policies.restore import TrainedPolicy
from legged.process.paths import make_folder, relative, write_text

EVERYWHERE = "all"
"""The value of --physics that asks for this."""


def cross(
    policy: TrainedPolicy, grid: Grid, asked: list[tuple[str, Any]], device: torch.device, graph: bool, folder: Path
) -> int:
    """Measure, print and draw; crossing.json in `folder` is written anew after every engine. Return the exit code.

    Engines run on `device`, the C engine on the CPU. `asked` is what the command line changes beside the engine.
    """
    make_folder(folder)
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
            write_text(path, json.dumps(result, indent=1, allow_nan=False))
            failure = None
        except RunError as error:  # what is measured is shown all the same, and the disk may have room again by then
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
    """Return one engine's figures. Speed is that of the whole evaluation loop, without start-up and compilation."""
    name = engine_name(override(policy.cfg, asked).sim, device)
    print(f"{name}: {grid.size_text}", flush=True)
    task, act = ready_to_track(policy, grid, asked, device, graph)
    start = time.perf_counter()
    figures = measure_tracking(task, act, grid)
    seconds = time.perf_counter() - start
    return {
        "physics": name,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "rmse_lin": figures["rmse_lin"]["mean"],
        "rmse_ang": figures["rmse_ang"]["mean"],
        "falls": figures["falls"],
        "cost_of_transport": figures["cost_of_transport"],
        "base_height": figures["gait"]["base_height"],
        "contact_overflows": figures["contact_overflows"],
        "steps_per_s": grid.num_envs * round(grid.hold_s / task.dt) / seconds,
    }


def crossing_table(result: dict[str, Any]) -> Table:
    """Return a line an engine; an engine in which every robot fell before it was measured has no errors."""
    cells = len(result["grid"]["vx"]) * len(result["grid"]["vy"]) * len(result["grid"]["yaw"])
    title = f"{result['task']} ({result['checkpoint']}): {cells} commands x {result['robots_per_cell']} robots"
    table = Table(title=escape(title), title_justify="left")
    table.add_column("engine", no_wrap=True)
    for head in ("velocity RMSE", "yaw rate RMSE", "falls", "cost of\ntransport", "base height", "lost\ncontacts", "steps/s"):
        table.add_column(head, justify="right")

    def number(value: float | None, form: str) -> str:
        return "none" if value is None else form.format(value)

    for row in result["engines"]:
        table.add_row(
            row["physics"],
            number(row["rmse_lin"], "{:.3f} m/s"),
            number(row["rmse_ang"], "{:.3f} rad/s"),
            f"{100 * row['falls']:.1f} %",
            number(row["cost_of_transport"], "{:.2f}"),
            number(row["base_height"], "{:.3f} m"),
            str(row["contact_overflows"]),
            f"{row['steps_per_s']:,.0f}",
        )
    return table


def draw_crossing(result: dict[str, Any], path: Path) -> None:
    """Draw bars, an engine each: errors, falls, speed."""
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
