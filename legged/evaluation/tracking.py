"""A policy in the task it is measured in: what evaluating in one engine and in all of them share."""

from typing import Any

import torch

from legged.config import override
from legged.envs import LeggedRobot
from legged.evaluation.success import on_terrain
from legged.evaluation.velocity_grid import ROUGH_SPAWN, Grid, rough_ground, rough_side
from legged.learning.runner import Runner
from legged.policies.restore import TrainedPolicy, restore, undisturbed


def ready_to_track(
    policy: TrainedPolicy, grid: Grid, asked: list[tuple[str, Any]], device: torch.device, graph: bool
) -> tuple[LeggedRobot, Runner]:
    """A task of grid.num_envs robots and a runner that holds the policy; `asked` is what the command line changes.

    On a plane or, for tasks with terrain, on bumpy level ground.
    """
    changes = undisturbed(grid.num_envs, grid.hold_s)
    terrain = None
    if policy.cfg.terrain.mesh_type == "plane":
        changes += asked
    else:
        changes += [*on_terrain(policy.cfg, rough_side(grid), ROUGH_SPAWN), *asked]
        cfg = override(policy.cfg, changes)
        terrain = rough_ground(cfg.terrain, cfg.env.seed)
        tell(f"tracking on rough ground: {len(grid.cells)} commands x {grid.robots} robots")
    return restore(policy, changes, device, graph, terrain)


def tell(line: str) -> None:
    """Show how far a long evaluation is, at once."""
    print(line, flush=True)
