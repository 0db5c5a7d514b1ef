"""Measure, print and draw the tracking errors of a policy over a grid of constant velocity commands."""

import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from tensordict import TensorDict
from torch import Tensor

from legged.config import LeggedConfig, override
from legged.config.networks import ESTIMATED
from legged.envs import BaseTask, LeggedRobot
from legged.envs.marks import unit_of
from legged.evaluation.measurement import Overflows, Setting
from legged.evaluation.tiles import ROUGH_SPAWN, on_terrain, rough_ground, rough_side
from legged.evaluation.velocity_grid import AXES, Grid, mean_and_worst, number_or_null
from legged.figures import figure
from legged.learning.estimator import EstimatingModel, EstimationErrors
from legged.mdp.tracking_error import velocity_error, yaw_rate_error
from legged.policies.actor import Actor
from legged.policies.episodes import Policy
from legged.policies.restore import restore, undisturbed
from legged.tables import screen_table
from legged.terrain import Terrain

GRAVITY = 9.81
GOLDEN = 0.6180339887498949
"""Golden ratio minus 1: its multiples, taken modulo 1, are spread evenly."""
SLOWEST = 0.1
"""Smallest mean speed for which a cost of transport is computed [m/s]."""
BASE = {"height": "m", "pitch": "rad"}
"""Commands besides the velocity, and their units."""
GAIT = (
    ("duty factor", "duty_factor", 1.0, "{:.2f}"),
    ("steps per second and foot", "steps_per_s", 1.0, "{:.2f}"),
    ("base height", "base_height", 1.0, "{:.3f} m"),
    ("thigh or shank contact", "thigh_contact", 100.0, "{:.2f} % of steps"),
)
"""Figures of the gait: label in the table, name in a cell's result, factor and format."""
PANELS = (("rmse_lin", 2, "vy", "velocity RMSE [m/s]"), ("rmse_ang", 1, "yaw", "yaw rate RMSE [rad/s]"))
"""Heat maps: name of the drawn error, index of the command that is averaged out, command on the vertical axis, title."""


def ready_to_track(setting: Setting, grid: Grid) -> tuple[LeggedRobot, Actor]:
    """Build a task with grid.num_envs robots, and the policy. If the task has terrain, the robots stand on level ground with
    bumps, otherwise on a plane.
    """
    changes, terrain = place_to_track(setting.cfg, grid, setting.asked)
    if terrain is not None:
        print(f"tracking on rough ground: {grid.size_text}", flush=True)
    return restore(setting.policy, changes, setting.device, setting.graph, terrain)


def place_to_track(
    cfg: LeggedConfig, grid: Grid, asked: list[tuple[str, Any]]
) -> tuple[list[tuple[str, Any]], Terrain | None]:
    """Return the overrides and the terrain for a task of grid.num_envs undisturbed robots. The overrides end with `asked`.
    The terrain is level ground with bumps, or None for a task on a plane.
    """
    changes = undisturbed(cfg, grid.num_envs, grid.hold_s)
    if cfg.terrain.mesh_type == "plane":
        return [*changes, *asked], None
    changes += [*on_terrain(cfg, rough_side(grid), ROUGH_SPAWN), *asked]
    rough = override(cfg, changes)
    return changes, rough_ground(rough.terrain, rough.env.seed)


@torch.inference_mode()
def measure_tracking(task: LeggedRobot, act: Policy, grid: Grid) -> dict[str, Any]:
    """Measure a policy on the grid in a task of grid.num_envs robots. Return the figures as numbers and lists for a JSON
    file; "cells" has an entry for each cell.

    A robot is measured until its episode ends by a fall or a time-out. Errors are those at the end of each control step. The
    cost of transport uses the power in the last physics step of each control step, which is lower than the mean over all
    physics steps. `contact_overflows` counts how often a robot lost contacts in a control step, because memory was full.
    `estimates` holds the errors of the policy's estimator, if it has one. In a task that commands heights and pitches of the
    base, the robots of a cell have different ones, and `rmse_height` [m] and `rmse_pitch` [rad] are their errors.
    """
    network = getattr(act, "network", None)
    estimated = EstimationErrors(task.observation_groups[ESTIMATED]) if isinstance(network, EstimatingModel) else None

    def read(observations: TensorDict) -> dict[str, Tensor]:
        if estimated is None:
            return _now(task)
        estimates = network.estimate(observations)  # type: ignore[union-attr]
        return {**_now(task), "estimates": estimated.squares(estimates, observations[ESTIMATED])}

    commands = torch.tensor(grid.cells, dtype=torch.float32, device=torch.device(task.device))
    commands = commands.repeat_interleave(grid.robots, dim=0)
    sums, fell, lost = hold(task, act, commands, grid.settle_s, grid.hold_s, read, postures(task, grid))
    measured_s = (round(grid.hold_s / task.dt) - round(grid.settle_s / task.dt)) * task.dt
    found = _summary(task, grid, sums, fell, measured_s)
    if estimated is not None:
        found["estimates"] = estimation_errors(type(task), estimated.names, sums["estimates"], sums["steps"])
    return {**found, "contact_overflows": lost}


@torch.inference_mode()
def hold(
    task: LeggedRobot,
    act: Policy,
    commands: Tensor,
    settle_s: float,
    hold_s: float,
    read: Callable[[TensorDict], dict[str, Tensor]],
    base: Tensor | None = None,
) -> tuple[dict[str, Tensor], Tensor, int]:
    """Let robots follow constant commands (N, 3) for `hold_s` [s], with the heights and pitches `base` (N, 2) of
    `hold_commands`. From `settle_s` [s] on, `read` is called with the observations after each control step and returns name
    -> quantity (N, ...).

    Return the sums of these quantities over each robot's first episode, flags (N,) of the robots that fell in this episode,
    and the number of control steps with lost contacts, summed over robots. The sum "steps" (N,) counts the summed steps.
    """
    task.reset()
    observations = task.hold_commands(commands, base=base)
    alive = torch.ones(task.num_envs, dtype=torch.bool, device=commands.device)
    fell, overflows = torch.zeros_like(alive), Overflows()
    sums: dict[str, Tensor] = {}
    for step in range(max(1, round(hold_s / task.dt))):
        observations, _, _, extras = task.step(act(observations))
        overflows.add(extras)
        fell |= alive & task.terminated_buf
        alive &= ~task.reset_buf
        if step >= round(settle_s / task.dt):
            for name, value in {"steps": alive.float(), **read(observations)}.items():
                counted = torch.where(alive if value.dim() == 1 else alive.unsqueeze(1), value, 0.0)
                sums[name] = sums[name] + counted if name in sums else counted
    return sums, fell, overflows.total(task)


def _now(task: LeggedRobot) -> dict[str, Tensor]:
    """Return name -> quantity, (N,) or (N, feet), after a control step. `hold` sums each quantity over steps."""
    power, height = task.torques * task.dof_vel, task.base_pos[:, 2] - task.height_scan.ground
    collision = task.contact_forces[:, task.penalised_indices].norm(dim=2) > task.contacts.force
    return {
        "lin": velocity_error(task.commands, task.base_lin_vel),
        "ang": yaw_rate_error(task.commands, task.base_ang_vel),
        "power": power.abs().sum(dim=1),
        "positive_power": power.clamp(min=0.0).sum(dim=1),
        "speed": task.base_lin_vel[:, :2].norm(dim=1),
        "height": height,
        "collision": collision.any(dim=1).float(),
        "stance": (task.contact_forces[:, task.feet_indices, 2] > task.contacts.force).float(),
        "touch_downs": task.contacts.first_contact.float(),
        "height_error": (height - task.base_commands[:, 0]).square(),
        "pitch_error": (task.pitch_gravity[:, 0].clamp(-1.0, 1.0).asin() - task.base_commands[:, 1]).square(),
    }


def postures(task: LeggedRobot, grid: Grid) -> Tensor | None:
    """Return heights [m] and pitches [rad] of the bases, (N, 2), which within each cell are spread evenly over the task's
    ranges; None if the task does not command them.
    """
    if task.base_sampler.ranges is None:
        return None
    index = np.arange(grid.robots)
    shares = np.stack([(index + 0.5) / grid.robots, (index * GOLDEN + 0.5) % 1.0], axis=1)
    low, high = np.array(task.base_sampler.ranges).T
    return torch.tensor(np.tile(low + shares * (high - low), (grid.num_cells, 1)), device=task.device).float()


def _summary(task: LeggedRobot, grid: Grid, sums: dict[str, Tensor], fell: Tensor, measured_s: float) -> dict[str, Any]:
    """Return the figures of each cell and of the whole grid. Figures without a measured robot are None."""
    cells = grid.cells

    def per_cell(values: Tensor) -> np.ndarray:
        return values.double().cpu().numpy().reshape(len(cells), grid.robots, *values.shape[1:])

    total = {name: per_cell(values).sum(axis=1) for name, values in sums.items()}
    # A cell whose robots all fell before the measurement has figures of NaN, because an error of 0 would look perfect.
    steps = np.where(total["steps"] > 0, total["steps"], np.nan)
    lin, ang = (np.sqrt(total[name] / steps) for name in ("lin", "ang"))
    base = {f"rmse_{name}": np.sqrt(total[f"{name}_error"] / steps) for name in BASE} if task.base_sampler.ranges else {}
    speed = total["speed"] / steps
    weight = task.robot.mass * GRAVITY
    moving = speed > SLOWEST
    transport = {
        name: np.where(moving, total[source] / steps / (weight * np.maximum(speed, SLOWEST)), np.nan)
        for name, source in (("cost_of_transport", "power"), ("positive_cost_of_transport", "positive_power"))
    }
    falls = per_cell(fell).mean(axis=1)
    columns = {
        "rmse_lin": lin,
        "rmse_ang": ang,
        **base,
        "falls": falls,
        **transport,
        "duty_factor": (total["stance"] / steps[:, None]).mean(axis=1),
        "steps_per_s": (total["touch_downs"] / (steps * task.dt)[:, None]).mean(axis=1),
        "base_height": total["height"] / steps,
        "thigh_contact": total["collision"] / steps,
        "speed": speed,
    }
    rows = [
        {"command": cells[i].tolist(), **{name: number_or_null(column[i]) for name, column in columns.items()}}
        for i in range(len(cells))
    ]
    reference = int(np.argmin(np.linalg.norm(cells - [0.5, 0.0, 0.0], axis=1)))
    return {
        "grid": grid.axes,
        "robots_per_cell": grid.robots,
        "hold_s": grid.hold_s,
        "measured_s": measured_s,
        "rmse_lin": mean_and_worst(lin, cells),
        "rmse_ang": mean_and_worst(ang, cells),
        **{name: mean_and_worst(errors, cells) for name, errors in base.items()},
        "falls": float(falls.mean()),
        **{name: number_or_null(float(np.nanmean(values))) if moving.any() else None for name, values in transport.items()},
        "gait": rows[reference],
        "cells": rows,
    }


def estimation_errors(
    kind: type[BaseTask], names: Sequence[str], squares: Tensor, steps: Tensor
) -> dict[str, dict[str, Any]]:
    """Return name of an estimated term -> `rmse` and `unit`. `rmse` is the root mean square error over all robots and steps,
    or None if no step was measured. `squares` (N, terms) are sums of squared errors over the `steps` (N,) of each robot.
    """
    count = float(steps.double().sum())
    means = (squares.double().sum(dim=0) / max(count, 1.0)).tolist()
    errors = {name: math.sqrt(mean) if count else None for name, mean in zip(names, means, strict=True)}
    return {name: {"rmse": error, "unit": unit_of(getattr(kind, f"_obs_{name}"))} for name, error in errors.items()}


def print_tracking(result: dict[str, Any]) -> None:
    """Print a table of the figures over the grid, and of the gait at the command nearest to 0.5 m/s forward."""
    lin, ang, gait = result["rmse_lin"], result["rmse_ang"], result["gait"]
    title = f"{result['task']} ({result['checkpoint']}) in {result['physics']}"
    if result["ground"]:
        title += f", on level ground with bumps of up to {100 * result['bumps']:.2g} cm"
    rows: list[list[str]] = []
    cells = f"{len(result['cells'])} cells x {result['robots_per_cell']} robots x {result['measured_s']:.0f} s"
    base = [(name, unit, result[f"rmse_{name}"]) for name, unit in BASE.items() if f"rmse_{name}" in result]
    for name, unit, errors in (("velocity", "m/s", lin), ("yaw rate", "rad/s", ang), *base):
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


def grid_means(result: dict[str, Any], name: str, over: int) -> np.ndarray:
    """Return the mean of the figure `name` over the command with index `over`. The first axis of the means is
    vx, the second is the remaining command. A mean is NaN where all robots fell before the measurement.
    """
    shape = tuple(len(result["grid"][axis]) for axis in AXES)
    values = np.array([cell[name] for cell in result["cells"]], dtype=float).reshape(shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # numpy warns if all values of a mean are NaN
        return np.nanmean(values, axis=over)


def draw_tracking(result: dict[str, Any], path: Path) -> None:
    """Draw heat maps of velocity errors over (vx, vy) and yaw rate errors over (vx, yaw). The other command is averaged."""
    grid = result["grid"]
    with figure(path, (10.0, 4.2), columns=2) as (drawn, axes):
        for axis, (name, over, other, label) in zip(axes[0], PANELS, strict=True):
            values = grid_means(result, name, over)
            image = axis.imshow(values.T, origin="lower", aspect="auto", cmap="viridis_r", vmin=0.0)
            axis.set_xticks(range(len(grid["vx"])), [f"{v:g}" for v in grid["vx"]])
            axis.set_yticks(range(len(grid[other])), [f"{v:g}" for v in grid[other]])
            axis.set_xlabel(f"commanded vx [{AXES['vx']}]")
            axis.set_ylabel(f"commanded {other} [{AXES[other]}]")
            largest = np.max(values, where=np.isfinite(values), initial=0.0)  # values are NaN where all robots fell early
            for (i, j), value in np.ndenumerate(values):
                dark = value > 0.6 * largest
                axis.text(i, j, f"{value:.2f}", ha="center", va="center", color="white" if dark else "black")
            drawn.colorbar(image, ax=axis, label=label)
        drawn.suptitle(f"{result['task']} in {result['physics']}, {result['ground']}falls {100 * result['falls']:.1f} %")
