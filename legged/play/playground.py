"""The ground of `play`: a few tiles of chosen types and sizes, with a place for every robot."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from legged.config import LeggedConfig
from legged.envs import LeggedRobot
from legged.errors import ConfigError
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec, check_terrain, terrain_type, tile_size

DIFFICULTIES = (0.5, 0.8)
"""Difficulties of the tiles on which robots start, and of the next tiles."""
COLUMNS = 4
"""Tiles side by side of a single type; tiles of random types differ."""
SETTING: tuple[tuple[str, Any], ...] = (
    ("terrain.border_size", 3.0),
    ("terrain.spawn_range", 0.3),
    ("init_state.yaw", [0.0, 0.0]),
)
"""Overrides: a narrow border, starts near the middle of tiles, facing along x; later overrides may replace them."""
ROWS_NEEDED = 128
"""Constraint rows that a robot on steps needs in mujoco-warp."""


@dataclass(frozen=True)
class Playground:
    """Two rows of tiles, each column of one type. Robots start in the middle of tiles in the first row and walk along x into
    the second row.
    """

    rows: tuple[tuple[TileSpec, ...], tuple[TileSpec, ...]]
    order: tuple[int, ...]
    """Columns in the order in which robots are placed, the most important first."""

    @classmethod
    def of(cls, cfg: LeggedConfig, name: str | None, difficulty: float | None) -> "Playground | None":
        """Return the playground of --terrain and --difficulty: COLUMNS tiles of the type `name`, or else one of each type of
        the task; None for a task on a plane.

        Raises:
            ConfigError: the type or the difficulty does not exist.
        """
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
            """Return the size of a tile; without a given difficulty it is the training's, if that is fixed."""
            if difficulty is None:
                return tile_size(cfg.terrain, kind, usual)
            return TERRAIN_TYPES[kind].sized(difficulty, cfg.terrain.scale)

        front, back = (tuple(TileSpec(kind, size(kind, usual)) for kind in columns) for usual in DIFFICULTIES)
        return cls((front, back), tuple(order))

    def changes(self, cfg: LeggedConfig) -> list[tuple[str, Any]]:
        """Return overrides that put a task of configuration `cfg` on this ground, with unchanged observations."""
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

    def build(self, cfg: LeggedConfig) -> Terrain:
        """Return the terrain with the tile size of `cfg`, which includes the changes above.

        Raises:
            ConfigError: the tiles are too small.
        """
        check_terrain(cfg.terrain, cfg.origins)
        return Terrain.of_tiles(self.rows, cfg.terrain, np.random.default_rng(cfg.env.seed))

    def columns(self, num_envs: int, shift: int = 0) -> list[int]:
        """Return the column of each robot; `shift` moves all robots on in `order`."""
        return [self.order[(i + shift) % len(self.order)] for i in range(num_envs)]

    def place(self, task: LeggedRobot, shift: int = 0) -> None:
        """Assign every robot its tile for the next episodes."""
        assert task.terrain_curriculum is not None, "the task stands on a plane"
        columns = torch.tensor(self.columns(task.num_envs, shift), device=task.device)  # type: ignore[arg-type]
        task.terrain_curriculum.place_at(torch.zeros_like(columns), columns)

    def label(self, terrain: Terrain, base_pos: Sequence[float]) -> str:
        """Return the name of the tile below or nearest to `base_pos` (x, y, ...): 'stairs_up, step height 0.194 m'."""
        tiles = np.round((np.array(base_pos[:2]) - terrain.origins[0, 0, :2]) / terrain.tile_size)
        row, column = np.clip(tiles, 0, np.array(terrain.origins.shape[:2]) - 1).astype(int)
        return label(self.rows[row][column].type, [self.rows[row][column].size])

    def labels(self) -> dict[str, str]:
        """Return type -> its name with all its sizes."""
        sizes: dict[str, dict[float, None]] = {}  # in order, each once
        for spec in (*self.rows[0], *self.rows[1]):
            sizes.setdefault(spec.type, {})[spec.size] = None
        return {kind: label(kind, list(own)) for kind, own in sizes.items()}


def label(kind: str, sizes: Sequence[float]) -> str:
    """Return the name of tiles of one type and some sizes: 'stairs_up, step height 0.14 to 0.194 m'."""
    info = TERRAIN_TYPES[kind]
    return kind if kind == "flat" else f"{kind}, {info.what} {info.text(*sizes)}"
