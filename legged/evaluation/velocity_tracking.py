"""Errors of a policy that follows velocity commands, over a grid of constant ones."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config import LeggedConfig, override
from legged.envs import LeggedRobot
from legged.evaluation.estimation import EstimateMeter
from legged.evaluation.overflows import Overflows
from legged.evaluation.tiles import ROUGH_SPAWN, on_terrain, rough_ground, rough_side
from legged.evaluation.velocity_grid import Grid, mean_and_worst, number_or_null
from legged.mdp.tracking_error import velocity_error, yaw_rate_error
from legged.policies.actor import Actor
from legged.policies.restore import TrainedPolicy, restore, undisturbed
from legged.terrain import Terrain

GRAVITY = 9.81
SLOWEST = 0.1
"""Cost of transport is not defined for robots slower than this [m/s]."""


def ready_to_track(
    policy: TrainedPolicy, grid: Grid, asked: list[tuple[str, Any]], device: torch.device, graph: bool
) -> tuple[LeggedRobot, Actor]:
    """Build a task of grid.num_envs robots and the policy that acts in it; `asked` holds the overrides of the command line.

    The task stands on a plane or, if it has terrain, on bumpy level ground.
    """
    assert isinstance(policy.cfg, LeggedConfig), "the task follows no commands"
    changes, terrain = place_to_track(policy.cfg, grid, asked)
    if terrain is not None:
        print(f"tracking on rough ground: {grid.size_text}", flush=True)
    return restore(policy, changes, device, graph, terrain)


def place_to_track(
    cfg: LeggedConfig, grid: Grid, asked: list[tuple[str, Any]]
) -> tuple[list[tuple[str, Any]], Terrain | None]:
    """Return overrides, with `asked`, for a task of grid.num_envs undisturbed robots, and its bumpy level ground; None for
    the plane of a task without terrain.
    """
    changes = undisturbed(grid.num_envs, grid.hold_s)
    if cfg.terrain.mesh_type == "plane":
        return [*changes, *asked], None
    changes += [*on_terrain(cfg, rough_side(grid), ROUGH_SPAWN), *asked]
    rough: Any = override(cfg, changes)
    return changes, rough_ground(rough.terrain, rough.env.seed)


@torch.inference_mode()
def measure_tracking(task: LeggedRobot, act: Callable[[TensorDict], Tensor], grid: Grid) -> dict[str, Any]:
    """Run the grid on a task of grid.num_envs robots; return plain numbers and lists, with one entry for each cell in
    "cells".

    A robot is measured until it falls or its episode ends by a time-out. Errors are those at the ends of control steps. The
    power of the cost of transport is that of the last physics step of each control step, which is lower than the mean over
    all physics steps. `contact_overflows` counts robots times steps that lost contacts because memory was full; `estimates`
    holds the errors of a policy with an estimator.
    """
    cells = grid.cells
    device = torch.device(task.device)
    commands = torch.tensor(cells, dtype=torch.float32, device=device).repeat_interleave(grid.robots, dim=0)
    task.reset()
    observations = task.hold_commands(commands)
    sums, overflows, estimates = _Sums(task), Overflows(), EstimateMeter(task, act)
    alive = torch.ones(task.num_envs, dtype=torch.bool, device=device)
    fell = torch.zeros_like(alive)
    settle, steps = round(grid.settle_s / task.dt), round(grid.hold_s / task.dt)
    for step in range(steps):
        observations, _, _, extras = task.step(act(observations))
        overflows.add(extras)
        fell |= alive & task.terminated_buf
        alive &= ~task.reset_buf
        if step >= settle:
            sums.add(task, alive)
            estimates.add(observations, alive)
    result = summarize(task, grid, cells, sums, fell.float(), (steps - settle) * task.dt)
    return {**result, **estimates.found(), "contact_overflows": overflows.total(task)}


class _Sums:
    """Sums per robot over the measured steps of its first episode."""

    NAMES = ("steps", "lin", "ang", "power", "positive_power", "speed", "height", "collision")

    def __init__(self, task: LeggedRobot) -> None:
        device = torch.device(task.device)
        self.values = {name: torch.zeros(task.num_envs, device=device) for name in self.NAMES}
        feet = len(task.robot.feet_indices)
        self.values |= {name: torch.zeros(task.num_envs, feet, device=device) for name in ("stance", "touch_downs")}

    def add(self, task: LeggedRobot, alive: Tensor) -> None:
        power = task.torques * task.dof_vel
        collision = task.contact_forces[:, task.penalised_indices].norm(dim=2) > task.contacts.force
        now = {
            "steps": torch.ones_like(alive, dtype=torch.float32),
            "lin": velocity_error(task.commands, task.base_lin_vel),
            "ang": yaw_rate_error(task.commands, task.base_ang_vel),
            "power": power.abs().sum(dim=1),
            "positive_power": power.clamp(min=0.0).sum(dim=1),
            "speed": task.base_lin_vel[:, :2].norm(dim=1),
            "height": task.base_pos[:, 2] - task.height_scan.ground,
            "collision": collision.any(dim=1).float(),
            "stance": (task.contact_forces[:, task.feet_indices, 2] > task.contacts.force).float(),
            "touch_downs": task.contacts.first_contact.float(),
        }
        for name, value in now.items():
            mask = alive if value.dim() == 1 else alive.unsqueeze(1)
            self.values[name] += torch.where(mask, value, 0.0)


def summarize(
    task: LeggedRobot, grid: Grid, cells: np.ndarray, sums: _Sums, fell: Tensor, measured_s: float
) -> dict[str, Any]:
    """Return the figures cell by cell, and over the grid; null where no robot was left to be measured."""

    def per_cell(name: str) -> np.ndarray:
        values = sums.values[name].double().cpu().numpy()
        return values.reshape(len(cells), grid.robots, *values.shape[1:]).sum(axis=1)

    counted = per_cell("steps")
    # A cell in which every robot fell before it was measured has neither errors nor a gait; 0 would look perfect.
    steps = np.where(counted > 0, counted, np.nan)
    lin, ang = (np.sqrt(per_cell(name) / steps) for name in ("lin", "ang"))
    speed = per_cell("speed") / steps
    weight = task.robot.mass * GRAVITY
    moving = speed > SLOWEST
    transport = {
        name: np.where(moving, per_cell(source) / steps / (weight * np.maximum(speed, SLOWEST)), np.nan)
        for name, source in (("cost_of_transport", "power"), ("positive_cost_of_transport", "positive_power"))
    }
    falls = fell.double().cpu().numpy().reshape(len(cells), grid.robots).mean(axis=1)
    seconds = steps * task.dt
    columns = {
        "rmse_lin": lin,
        "rmse_ang": ang,
        "falls": falls,
        **transport,
        "duty_factor": (per_cell("stance") / steps[:, None]).mean(axis=1),
        "steps_per_s": (per_cell("touch_downs") / seconds[:, None]).mean(axis=1),
        "base_height": per_cell("height") / steps,
        "thigh_contact": per_cell("collision") / steps,
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
        "falls": float(falls.mean()),
        **{name: number_or_null(float(np.nanmean(values))) if moving.any() else None for name, values in transport.items()},
        "gait": rows[reference],
        "cells": rows,
    }
