"""The errors of a policy on the grid of commands, as a table and as heat maps."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from legged.evaluation.tables import screen_table
from legged.evaluation.velocity_grid import AXES
from legged.figures import figure

GAIT = (
    ("duty factor", "duty_factor", 1.0, "{:.2f}"),
    ("steps per second and foot", "steps_per_s", 1.0, "{:.2f}"),
    ("base height", "base_height", 1.0, "{:.3f} m"),
    ("thigh or shank contact", "thigh_contact", 100.0, "{:.2f} % of steps"),
)
"""Label, name in a cell, factor, format; null where every robot fell before it was measured."""


def print_tracking(result: dict[str, Any]) -> None:
    """Print the figures over the grid, and the gait at 0.5 m/s."""
    lin, ang, gait = result["rmse_lin"], result["rmse_ang"], result["gait"]
    title = f"{result['task']} ({result['checkpoint']}) in {result['physics']}"
    if result["ground"]:
        title += f", on level ground with bumps of up to {100 * result['bumps']:.2g} cm"
    rows: list[list[str]] = []
    cells = f"{len(result['cells'])} cells x {result['robots_per_cell']} robots x {result['measured_s']:.0f} s"
    for name, unit, errors in (("velocity", "m/s", lin), ("yaw rate", "rad/s", ang)):
        if errors["mean"] is None:
            rows.append([f"{name} RMSE", "none", "every robot fell before it was measured"])
            continue
        rows.append([f"{name} RMSE, mean", f"{errors['mean']:.3f} {unit}", cells])
        rows.append([f"{name} RMSE, worst cell", f"{errors['worst']:.3f} {unit}", _command(errors["worst_cell"])])
    for name, error in result.get("estimates", {}).items():
        value = "none" if error["rmse"] is None else f"{error['rmse']:.3f} {error['unit'] or ''}".rstrip()
        rows.append([f"estimated {name.replace('_', ' ')} RMSE", value, "over all cells"])
    rows.append(["falls", f"{100 * result['falls']:.2f} %", "of the robots, within the hold"])
    if result["cost_of_transport"] is not None:
        rows.append(["cost of transport", f"{result['cost_of_transport']:.2f}", "sum |torque * speed| / (weight * speed)"])
    at = _command(gait["command"])
    for label, name, factor, form in GAIT:
        value = gait[name]
        rows.append([label, "none" if value is None else form.format(factor * value), at])
    Console(width=110).print(screen_table(title, ("measure", "value", "where"), rows, left=(0, 2)))


def _command(cell: list[float]) -> str:
    return f"at vx {cell[0]:g}, vy {cell[1]:g} m/s, yaw {cell[2]:g} rad/s"


PANELS = (("rmse_lin", 2, "vy", "velocity RMSE [m/s]"), ("rmse_ang", 1, "yaw", "yaw rate RMSE [rad/s]"))
"""Heat maps: figure of a cell, axis over which its mean is taken, axis that goes up, title."""


def grid_means(result: dict[str, Any], name: str, over: int) -> np.ndarray:
    """Return the mean of a figure over axis `over` of the command grid, (values of vx, values of the other command); NaN for
    cells in which every robot fell early.
    """
    shape = tuple(len(result["grid"][axis]) for axis in AXES)
    values = np.array([cell[name] for cell in result["cells"]], dtype=float).reshape(shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # mean of no values
        return np.nanmean(values, axis=over)


def draw_tracking(result: dict[str, Any], path: Path) -> None:
    """Draw heat maps: for each (vx, vy) and each (vx, yaw), the mean over the third command."""
    grid = result["grid"]
    with figure(path, (10.0, 4.2), columns=2) as (drawn, axes):
        for axis, (name, over, other, label) in zip(axes[0], PANELS, strict=True):
            values = grid_means(result, name, over)
            image = axis.imshow(values.T, origin="lower", aspect="auto", cmap="viridis_r", vmin=0.0)
            axis.set_xticks(range(len(grid["vx"])), [f"{v:g}" for v in grid["vx"]])
            axis.set_yticks(range(len(grid[other])), [f"{v:g}" for v in grid[other]])
            axis.set_xlabel(f"commanded vx [{AXES['vx']}]")
            axis.set_ylabel(f"commanded {other} [{AXES[other]}]")
            largest = np.max(values, where=np.isfinite(values), initial=0.0)  # mean of no values, where all robots fell
            for (i, j), value in np.ndenumerate(values):
                dark = value > 0.6 * largest
                axis.text(i, j, f"{value:.2f}", ha="center", va="center", color="white" if dark else "black")
            drawn.colorbar(image, ax=axis, label=label)
        drawn.suptitle(f"{result['task']} in {result['physics']}, {result['ground']}falls {100 * result['falls']:.1f} %")
