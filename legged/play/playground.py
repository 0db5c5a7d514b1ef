"""The ground of `play`: a few terrain tiles of chosen types and sizes, to which robots are assigned."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from legged.config import RobotConfig, TaskConfig, has_robot
from legged.envs import RobotTask
from legged.errors import ConfigError
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec, check_terrain, terrain_type, tile_size

DIFFICULTIES = (0.5, 0.8)
"""Default difficulties of the tiles on which robots start, and of the tiles behind them."""
COLUMNS = 4
"""Number of tiles side by side if a single type is chosen. Tiles of types with random shapes differ from each other."""
SETTING: tuple[tuple[str, Any], ...] = (
    ("terrain.border_size", 3.0),
    ("terrain.spawn_range", 0.3),
    ("init_state.yaw", [0.0, 0.0]),
)
"""Overrides for a narrow border and for robots that start near the middle of a tile and face along x. Overrides of the user
come later and replace these.
"""
ROWS_NEEDED = 128
"""Number of constraint rows that a robot on steps needs in mujoco-warp."""


@dataclass(frozen=True)
class Playground:
    """Two rows of tiles, with one terrain type in each column. Robots start in the middle of a tile in the first row and walk
    along x into the second row.
    """

    rows: tuple[tuple[TileSpec, ...], tuple[TileSpec, ...]]
    order: tuple[int, ...]
    """Indices of the columns in the order in which robots are placed on them."""

    @classmethod
    def of(cls, cfg: TaskConfig, name: str | None, difficulty: float | None) -> "Playground | None":
        """Return the playground for --terrain (`name`) and --difficulty. It has COLUMNS columns of the type `name`. Without
        `name` it has one column for each terrain type of the task. Return None without `name` for a task on a plane, and
        for a task without a robot.

        Raises:
            ConfigError: the type or the difficulty does not exist, or the task has no ground to choose.
        """
        if not has_robot(cfg):
            for flag, given in (("terrain", name), ("difficulty", difficulty)):
                if given is not None:
                    raise ConfigError(f"--{flag}: '{cfg.task}' has no terrain to choose; its model contains the ground")
            return None
        if difficulty is not None and not 0.0 <= difficulty <= 1.0:
            raise ConfigError(f"--difficulty: must be between 0 and 1, got {difficulty:g}")
        if name is not None:
            terrain_type(name, "--terrain")
            columns = [name] * COLUMNS
            order = sorted(range(COLUMNS), key=lambda c: abs(c - 0.5 * (COLUMNS - 1)))
        elif cfg.terrain.mesh_type == "plane":
            if difficulty is not None:
                raise ConfigError(f"--difficulty: {cfg.task} stands on a plane; name a type with --terrain")
            return None
        else:
            check_terrain(cfg.terrain, cfg.origins)
            shares = cfg.terrain.proportions
            columns = [kind for kind, share in shares.items() if share > 0.0]
            order = sorted(range(len(columns)), key=lambda c: -shares[columns[c]])

        def size(kind: str, usual: float) -> float:
            """Return a tile's size at `difficulty`. If that is None, return the task's size at the difficulty `usual`."""
            if difficulty is None:
                return tile_size(cfg.terrain, kind, usual)
            return TERRAIN_TYPES[kind].sized(difficulty, cfg.terrain.scale)

        front, back = (tuple(TileSpec(kind, size(kind, usual)) for kind in columns) for usual in DIFFICULTIES)
        return cls((front, back), tuple(order))

    def changes(self, cfg: RobotConfig) -> list[tuple[str, Any]]:
        """Return overrides that put a task with the configuration `cfg` on this ground; observations stay as trained."""
        kinds = {spec.type for spec in self.rows[0]}
        shares = dict.fromkeys(cfg.terrain.proportions, 0.0) | {spec.type: 1.0 / len(kinds) for spec in self.rows[0]}
        return [
            ("terrain.mesh_type", "height_map"),
            ("terrain.curriculum", False),
            ("terrain.proportions", shares),
            ("terrain.num_rows", len(self.rows)),
            ("terrain.num_cols", len(self.rows[0])),
            ("terrain.max_init_terrain_level", 0),
            ("sim.nconmax", max(cfg.sim.nconmax, ROWS_NEEDED // 4)),
            ("sim.njmax", max(cfg.sim.njmax, ROWS_NEEDED)),
        ]

    def build(self, cfg: RobotConfig) -> Terrain:
        """Return the terrain. `cfg` is the configuration with the overrides of `changes`; it sets the length of a tile.

        Raises:
            ConfigError: the tiles are too small.
        """
        check_terrain(cfg.terrain, cfg.origins)
        return Terrain.of_tiles(self.rows, cfg.terrain, np.random.default_rng(cfg.env.seed))

    def columns(self, num_envs: int, shift: int = 0) -> list[int]:
        """Return the column index of each robot. All robots move on by `shift` places in `order`."""
        return [self.order[(i + shift) % len(self.order)] for i in range(num_envs)]

    def place(self, task: RobotTask, shift: int = 0) -> None:
        """Assign every robot its tile for the next episodes."""
        assert task.terrain_curriculum is not None, "the task stands on a plane"
        columns = torch.tensor(self.columns(task.num_envs, shift), device=task.device)  # type: ignore[arg-type]
        task.terrain_curriculum.place_at(torch.zeros_like(columns), columns)

    def label(self, terrain: Terrain, base_pos: Sequence[float]) -> str:
        """Return the name of the tile below or nearest to `base_pos` (x, y, ...), e.g. 'stairs_up, step height 0.194 m'."""
        tiles = np.round((np.array(base_pos[:2]) - terrain.origins[0, 0, :2]) / terrain.tile_size)
        row, column = np.clip(tiles, 0, np.array(terrain.origins.shape[:2]) - 1).astype(int)
        return label(self.rows[row][column].type, [self.rows[row][column].size])

    def labels(self) -> dict[str, str]:
        """Return terrain type -> text of the function `label`, with the sizes of all tiles of the type."""
        sizes: dict[str, dict[float, None]] = {}  # an ordered set of sizes for each type
        for spec in (*self.rows[0], *self.rows[1]):
            sizes.setdefault(spec.type, {})[spec.size] = None
        return {kind: label(kind, list(own)) for kind, own in sizes.items()}


def label(kind: str, sizes: Sequence[float]) -> str:
    """Return a text for tiles of one type with these sizes, such as 'stairs_up, step height 0.14 to 0.194 m'."""
    info = TERRAIN_TYPES[kind]
    return kind if kind == "flat" else f"{kind}, {info.what} {info.text(*sizes)}"
