"""The ground that play shows: a few tiles of chosen types and sizes, in which every robot has its place."""

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
"""Difficulty of the tiles on which robots start, and of those behind them, which they reach."""
COLUMNS = 4
"""Tiles side by side where there is only one type; those of random types differ."""
SETTING: tuple[tuple[str, Any], ...] = (
    ("terrain.border_size", 3.0),
    ("terrain.spawn_range", 0.3),
    ("init_state.yaw", [0.0, 0.0]),
)
"""Overrides that others may follow: little ground around the tiles, starts near their middle, facing along x."""
ROWS_NEEDED = 128
"""Constraint rows that a robot on steps needs in mujoco-warp."""


@dataclass(frozen=True)
class Playground:
    """Two rows of tiles, each column of one type. Robots start in the middle of the first row's and walk along x, out of
    their tile and into the one behind it.
    """

    rows: tuple[tuple[TileSpec, ...], tuple[TileSpec, ...]]
    order: tuple[int, ...]
    """Columns in the order in which robots are put there: those worth seeing first."""

    @classmethod
    def of(cls, cfg: LeggedConfig, name: str | None, difficulty: float | None) -> "Playground | None":
        """Return what --terrain and --difficulty ask for: COLUMNS tiles of the type `name`, else one of each of the task's
        own types; None for a task on a plane.

        Raises:
            ConfigError: no such type, or no such difficulty.
        """
        if difficulty is not None and not 0.0 <= difficulty <= 1.0:
            raise ConfigError(f"--difficulty: must be between 0 and 1, got {difficulty:g}")
        if name is not None:
            terrain_type(name, "--terrain")
        if name is None and cfg.terrain.mesh_type == "plane":
            if difficulty is not None:
                raise ConfigError(f"--difficulty: {cfg.task} stands on a plane; name a type with --terrain")
            return None
        columns: Sequence[str]
        if name is None:
            check_terrain(cfg.terrain, cfg.origins)
            shares = cfg.terrain.proportions
            columns = [kind for kind, share in shares.items() if share > 0.0]
            order = sorted(range(len(columns)), key=lambda c: -shares[columns[c]])
        else:
            columns = [name] * COLUMNS
            order = sorted(range(COLUMNS), key=lambda c: abs(c - 0.5 * (COLUMNS - 1)))

        def size_of(kind: str, d: float) -> float:
            """Return the size of the training, where that is fixed and nobody asks for another."""
            return tile_size(cfg.terrain, kind, d) if difficulty is None else TERRAIN_TYPES[kind].sized(d, cfg.terrain.scale)

        front, back = (
            tuple(TileSpec(kind, size_of(kind, d)) for kind in columns)
            for d in (DIFFICULTIES if difficulty is None else (difficulty, difficulty))
        )
        return cls((front, back), tuple(order))

    @property
    def types(self) -> list[str]:
        """Return the types there are, each once."""
        return list(dict.fromkeys(spec.type for spec in self.rows[0]))

    def changes(self, cfg: LeggedConfig) -> list[tuple[str, Any]]:
        """Return overrides under which a task of configuration `cfg` stands on this ground; what its policy sees stays."""
        shares = dict.fromkeys(cfg.terrain.proportions, 0.0) | dict.fromkeys(self.types, 1.0 / len(self.types))
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
        """Build the terrain; `cfg`, with the changes above, says how large tiles are.

        Raises:
            ConfigError: too small.
        """
        check_terrain(cfg.terrain, cfg.origins)
        return Terrain.of_tiles(self.rows, cfg.terrain, np.random.default_rng(cfg.env.seed))

    def columns(self, num_envs: int, shift: int = 0) -> list[int]:
        """Return the column of each of that many robots; `shift` moves all on to the next ones in `order`."""
        return [self.order[(i + shift) % len(self.order)] for i in range(num_envs)]

    def place(self, task: LeggedRobot, shift: int = 0) -> None:
        """Give every robot its tile, where its next episodes begin."""
        assert task.terrain_curriculum is not None, "the task stands on a plane"
        columns = torch.tensor(self.columns(task.num_envs, shift), device=task.device)  # type: ignore[arg-type]
        task.terrain_curriculum.place_at(torch.zeros_like(columns), columns)

    def label(self, terrain: Terrain, base_pos: Sequence[float]) -> str:
        """Name the tile below `base_pos` (x, y, ...), or the nearest one: 'stairs_up, step height 0.194 m'."""
        first = terrain.origins[0, 0]
        r, c = (
            int(np.clip(np.round((base_pos[axis] - first[axis]) / terrain.tile_size[axis]), 0, count - 1))
            for axis, count in enumerate(terrain.origins.shape[:2])
        )
        return label(self.rows[r][c].type, [self.rows[r][c].size])

    def labels(self) -> dict[str, str]:
        """Return type -> its name with the sizes there are of it."""
        return {
            kind: label(kind, list(dict.fromkeys(spec.size for row in self.rows for spec in row if spec.type == kind)))
            for kind in self.types
        }


def label(kind: str, sizes: Sequence[float]) -> str:
    """Name tiles of one type and some sizes: 'stairs_up, step height 0.14 to 0.194 m'."""
    info = TERRAIN_TYPES[kind]
    return kind if kind == "flat" else f"{kind}, {info.what} {info.text(*sizes)}"
