"""Velocity tracking measured over a grid of held commands: the numbers behind `legged.tools.evaluate`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from math import ceil
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config.schema import TerrainConfig
from legged.envs import LeggedRobot
from legged.terrain import Terrain, TileSpec

GRAVITY = 9.81
ROUGH_SPAWN = 2.0
"""On rough ground robots start at most this far from the middle, in x and in y, so that they meet different bumps [m]."""
SLOWEST = 0.1
"""Cost of transport is not defined for robots slower than this [m/s]."""


@dataclass(frozen=True)
class Grid:
    """Commands (vx, vy [m/s], yaw rate [rad/s]): all combinations, each held by some robots for some time."""

    vx: Sequence[float]
    vy: Sequence[float]
    yaw: Sequence[float]
    robots: int = 16
    """Robots a cell."""
    hold_s: float = 4.0
    """Time a command is held [s]."""
    settle_s: float = 1.0
    """Part of it, from the start, that is not measured [s]."""

    @property
    def cells(self) -> np.ndarray:
        """(C, 3) commands."""
        return np.array(list(product(self.vx, self.vy, self.yaw)), dtype=float)

    @property
    def num_envs(self) -> int:
        return len(self.vx) * len(self.vy) * len(self.yaw) * self.robots


@torch.inference_mode()
def measure(task: LeggedRobot, act: Callable[[TensorDict], Tensor], grid: Grid) -> dict[str, Any]:
    """Run the grid on a task of grid.num_envs robots; returns plain numbers and lists, one entry a cell in "cells".

    A robot that falls counts as a fall and is measured up to its fall. Errors are instantaneous, per control step.
    `contact_overflows` counts the robots and steps in which contacts were lost for want of memory.
    """
    cells = grid.cells
    device = torch.device(task.device)
    commands = torch.tensor(cells, dtype=torch.float32, device=device).repeat_interleave(grid.robots, dim=0)
    task.reset()
    observations = task.hold_commands(commands)
    sums, overflows = _Sums(task), Overflows()
    alive = torch.ones(task.num_envs, dtype=torch.bool, device=device)
    settle, steps = round(grid.settle_s / task.dt), round(grid.hold_s / task.dt)
    for step in range(steps):
        observations, _, _, extras = task.step(act(observations))
        overflows.add(extras)
        alive &= ~task.terminated_buf
        if step >= settle:
            sums.add(task, alive)
    fell = (~alive).float()
    result = summarize(task, grid, cells, sums, fell, (steps - settle) * task.dt)
    return {**result, "contact_overflows": overflows.total(task)}


class Overflows:
    """Contacts that were lost for want of memory: robots times control steps. The task's own count begins anew with every
    rollout that it logs.
    """

    NAME = "Metrics/contact_overflows"

    def __init__(self) -> None:
        self._logged: list[Tensor] = []

    def add(self, extras: dict[str, Any]) -> None:
        """Keep what a step returned, if it closed a rollout."""
        if "log" in extras:
            self._logged.append(extras["log"][self.NAME])

    def total(self, task: LeggedRobot) -> int:
        """All since the task was reset; to be asked once."""
        return int(sum(self._logged, task.statistics.flush()[self.NAME]))


def rough_ground(cfg: TerrainConfig, seed: int) -> Terrain:
    """One level tile with bumps of up to 5 cm, on which all robots of a grid start; the configuration says how large it
    is (see `rough_side`).
    """
    return Terrain.of_tiles([[TileSpec("rough_slope_up", 0.0)]], cfg, np.random.default_rng(seed))


def rough_side(grid: Grid) -> float:
    """Side of a tile that nobody leaves while it holds its command [m]: 20 m for 1.4 m/s and 4 s."""
    fastest = float(np.linalg.norm(grid.cells[:, :2], axis=1).max())
    return 2.0 * ceil(ROUGH_SPAWN + fastest * grid.hold_s + 1.5)


class _Sums:
    """Sums per robot over the measured steps in which it stood."""

    NAMES = ("steps", "lin", "ang", "power", "positive_power", "speed", "height", "collision")

    def __init__(self, task: LeggedRobot) -> None:
        device = torch.device(task.device)
        self.values = {name: torch.zeros(task.num_envs, device=device) for name in self.NAMES}
        feet = len(task.robot.feet_indices)
        self.values |= {name: torch.zeros(task.num_envs, feet, device=device) for name in ("stance", "touch_downs")}

    def add(self, task: LeggedRobot, alive: Tensor) -> None:
        error = task.commands[:, :2] - task.base_lin_vel[:, :2]
        power = task.torques * task.dof_vel
        collision = task.contact_forces[:, task.penalised_indices].norm(dim=2) > 1.0
        now = {
            "steps": torch.ones_like(alive, dtype=torch.float32),
            "lin": error.square().sum(dim=1),
            "ang": (task.commands[:, 2] - task.base_ang_vel[:, 2]).square(),
            "power": power.abs().sum(dim=1),
            "positive_power": power.clamp(min=0.0).sum(dim=1),
            "speed": task.base_lin_vel[:, :2].norm(dim=1),
            "height": task.base_pos[:, 2] - task.height_scan.ground,
            "collision": collision.any(dim=1).float(),
            "stance": (task.contact_forces[:, task.feet_indices, 2] > 1.0).float(),
            "touch_downs": task.contacts.first_contact.float(),
        }
        for name, value in now.items():
            mask = alive if value.dim() == 1 else alive.unsqueeze(1)
            self.values[name] += torch.where(mask, value, 0.0)


def summarize(
    task: LeggedRobot, grid: Grid, cells: np.ndarray, sums: _Sums, fell: Tensor, measured_s: float
) -> dict[str, Any]:
    """Cell by cell, and over the grid."""

    def per_cell(name: str) -> np.ndarray:
        values = sums.values[name].double().cpu().numpy()
        return values.reshape(len(cells), grid.robots, *values.shape[1:]).sum(axis=1)

    counted = per_cell("steps")
    steps = np.maximum(counted, 1.0)
    # A cell in which every robot fell before it was measured has no error; 0 would look perfect.
    lin, ang = (np.where(counted > 0, np.sqrt(per_cell(name) / steps), np.nan) for name in ("lin", "ang"))
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
        {"command": cells[i].tolist(), **{name: _number(column[i]) for name, column in columns.items()}}
        for i in range(len(cells))
    ]
    reference = int(np.argmin(np.linalg.norm(cells - [0.5, 0.0, 0.0], axis=1)))
    return {
        "grid": {"vx": list(grid.vx), "vy": list(grid.vy), "yaw": list(grid.yaw)},
        "robots_per_cell": grid.robots,
        "hold_s": grid.hold_s,
        "measured_s": measured_s,
        "rmse_lin": _mean_and_worst(lin, cells),
        "rmse_ang": _mean_and_worst(ang, cells),
        "falls": float(falls.mean()),
        **{name: _number(float(np.nanmean(values))) if moving.any() else None for name, values in transport.items()},
        "gait": rows[reference],
        "cells": rows,
    }


def _mean_and_worst(values: np.ndarray, cells: np.ndarray) -> dict[str, Any]:
    """Over the cells that have a value; null if none has."""
    if np.isnan(values).all():
        return {"mean": None, "worst": None, "worst_cell": None}
    worst = int(np.nanargmax(values))
    return {"mean": float(np.nanmean(values)), "worst": float(values[worst]), "worst_cell": cells[worst].tolist()}


def _number(value: float) -> float | None:
    """A float that JSON can hold; what is not defined is null."""
    return float(value) if np.isfinite(value) else None
