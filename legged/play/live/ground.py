"""The task that a live view simulates: a few undisturbed robots on the chosen ground."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from legged.config import LeggedConfig, TaskConfig, override
from legged.envs import BaseTask
from legged.errors import ConfigError
from legged.play.playground import SETTING, Playground
from legged.policies.restore import undisturbed
from legged.registry import make_task, task_class
from legged.terrain import TERRAIN_TYPES

OWN, PLANE = "the task's own", "plane"
"""Grounds without a chosen type: tiles of each type of the task, or a plane."""
HOURS_S = 36000.0
"""Length of an episode of robots that follow commands, so long that it does not end [s]."""
APART = 1.0
"""Largest distance from the middle of a tile at which robots that share it start, times the scale of the terrain [m]."""


@dataclass(frozen=True)
class ChosenGround:
    """A chosen ground."""

    kind: str
    """OWN, PLANE or a type of terrain."""
    difficulty: float | None = None
    """Difficulty of all tiles, 0 to 1; None for the difficulties of `play`."""


def grounds_of(cfg: TaskConfig) -> list[str]:
    """Return the kinds of ground that can be chosen, the task's own first. A model with its own floor and a task whose
    terrain is a single tile have only one.
    """
    if not isinstance(cfg, LeggedConfig):
        return [OWN]
    on_plane = cfg.terrain.mesh_type == "plane"
    if not on_plane and cfg.terrain.num_rows * cfg.terrain.num_cols == 1:
        return [OWN]
    return [PLANE if on_plane else OWN, *TERRAIN_TYPES]


def check_ground(cfg: TaskConfig, kind: str | None, difficulty: float | None) -> ChosenGround:
    """Return the ground of --terrain and --difficulty.

    Raises:
        ConfigError: the type or the difficulty does not exist, or the task has a single ground.
    """
    kinds = grounds_of(cfg)
    if len(kinds) == 1:
        for flag, given in (("terrain", kind), ("difficulty", difficulty)):
            if given is not None:
                raise ConfigError(f"--{flag}: '{cfg.task}' has no terrain to choose; it has one of its own")
        return ChosenGround(kinds[0])
    assert isinstance(cfg, LeggedConfig)
    Playground.of(cfg, kind, difficulty)
    return ChosenGround(kinds[0] if kind is None else kind, difficulty)


def changes_for(cfg: TaskConfig, num_envs: int, asked: Sequence[tuple[str, Any]]) -> list[tuple[str, Any]]:
    """Return overrides for that many robots, undisturbed except for the overrides in `asked`."""
    if isinstance(cfg, LeggedConfig):
        keep_length = len(grounds_of(cfg)) == 1  # the episode ends at the edge of the tile, or a little before
        seconds = cfg.env.episode_length_s - 10.0 if keep_length else HOURS_S
        return [*undisturbed(num_envs, seconds), *asked, ("env.num_envs", num_envs)]
    return [("observations.add_noise", False), *asked, ("env.num_envs", num_envs)]


def build(
    cfg: TaskConfig,
    changes: Sequence[tuple[str, Any]],
    ground: ChosenGround,
    device: torch.device,
    graph: bool = False,
) -> tuple[BaseTask, Playground | None]:
    """Build the task of configuration `cfg` with `changes` on a ground. Return it with the playground that assigns the
    robots' tiles, or None if the ground has no tiles.

    Raises:
        ConfigError: the configuration cannot be built, or tiles are too small.
    """
    nominal = cfg.trained()
    few_robots_do = ("train.algorithm.num_mini_batches", 1)  # nothing is trained
    changed = override(nominal, [*changes, few_robots_do])
    if not isinstance(changed, LeggedConfig) or ground.kind == PLANE or len(grounds_of(cfg)) == 1:
        task_class(changed.task).check(changed)
        return make_task(changed, device, graph), None
    kind = None if ground.kind == OWN else ground.kind
    playground = Playground.of(changed, kind, ground.difficulty)
    assert playground is not None
    setting: list[tuple[str, Any]] = [*SETTING]
    if changed.env.num_envs > len(playground.order):
        side = min(changed.terrain.terrain_length, changed.terrain.terrain_width)
        setting.append(("terrain.spawn_range", min(APART * changed.terrain.scale, 0.2 * side)))
    final: LeggedConfig = override(nominal, [*setting, *changes, few_robots_do, *playground.changes(changed)])  # type: ignore[assignment]
    terrain = playground.build(final)
    task_class(final.task).check(final)
    return make_task(final, device, graph, terrain), playground
