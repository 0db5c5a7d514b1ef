"""Ground of a task: tiles of many types and difficulties in one height map."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legged.config.origins import Origins
from legged.config.robot import TerrainConfig
from legged.errors import ConfigError
from legged.terrain.generators import TERRAIN_TYPES, Tile, terrain_type
from legged.terrain.height_map import HeightMap

SPAWN_SQUARE = 2.0
"""Side of the square in the middle of a tile, if `scale` is 1 [m]. Robots start at the height of its highest point."""
EDGE = 1.0
"""Width of a strip along the inside of the map's edge [m]. A robot in this strip counts as having left the map."""
WITHOUT_CURRICULUM = (0.5, 0.75, 0.9)
"""Difficulties of a terrain without a curriculum. Each row gets one of them at random."""
MOST_TILES = 10_000
"""Largest number of tiles in a terrain. The tiles are generated one after the other, which takes time."""
MOST_CELLS = 2**24
"""Largest number of cells. The height scan computes cell numbers in float32, which is exact up to this number."""


@dataclass(frozen=True)
class TileSpec:
    """Type and size of one tile."""

    type: str
    size: float
    """Size of the type's features, such as the height of a step or the angle of a slope [m or degrees]."""
    tread: float | None = None
    """Width of a step of stairs [m]. None: the default width of the type."""


@dataclass(frozen=True)
class Terrain:
    """R x C tiles with a level border, centred on the world's origin. x increases with the row, y with the column."""

    height_map: HeightMap
    types: tuple[str, ...]
    """(C,) type of each column."""
    origins: np.ndarray
    """(R, C, 3) middle of each tile, world frame [m]. z is the height of the ground on which robots start."""
    tile_size: tuple[float, float]
    """Extent of a tile along x and y [m]."""
    border: float
    """Width of the level ground around the tiles [m]."""

    @classmethod
    def build(cls, cfg: TerrainConfig, seed: int) -> "Terrain":
        """Return the terrain for training. Each type gets its share of columns. In a curriculum, later rows are harder."""
        columns = column_types(cfg.proportions, cfg.num_cols)
        rng = np.random.default_rng(seed)
        rows = []
        for row in range(cfg.num_rows):
            d = row / cfg.num_rows if cfg.curriculum else float(rng.choice(WITHOUT_CURRICULUM))
            rows.append([TileSpec(name, tile_size(cfg, name, d)) for name in columns])
        return cls.of_tiles(rows, cfg, rng)

    @classmethod
    def of_tiles(cls, rows: Sequence[Sequence[TileSpec]], cfg: TerrainConfig, rng: np.random.Generator) -> "Terrain":
        """Return a terrain of the given tiles. Of `cfg`, only the lengths, `scale` and `slope_threshold` are used."""
        cell = cfg.horizontal_scale
        length, width, border = (round(x / cell) for x in (cfg.terrain_length, cfg.terrain_width, cfg.border_size))
        count = (len(rows), len(rows[0]))
        shape = (count[0] * length + 2 * border, count[1] * width + 2 * border)
        heights = np.zeros(shape)
        steepest = np.full(shape, np.inf)
        origin = (-0.5 * shape[0] * cell, -0.5 * shape[1] * cell)
        origins = np.zeros((*count, 3))
        for r, row in enumerate(rows):
            for c, spec in enumerate(row):
                kind = TERRAIN_TYPES[spec.type]
                tile = Tile(np.zeros((length, width)), cell, rng, cfg.scale, spec.tread)
                kind.generate(tile, spec.size)
                x, y = border + r * length, border + c * width
                heights[x : x + length, y : y + width] = tile.heights
                if kind.stepped:
                    steepest[x : x + length, y : y + width] = cfg.slope_threshold
                origins[r, c] = (
                    origin[0] + (x + 0.5 * length) * cell,
                    origin[1] + (y + 0.5 * width) * cell,
                    tile.heights[tile.middle(SPAWN_SQUARE)].max(),
                )
        return cls(
            height_map=HeightMap.of(heights, cell, origin, steepest),
            types=tuple(spec.type for spec in rows[0]),
            origins=origins,
            tile_size=(length * cell, width * cell),
            border=border * cell,
        )

    @cached_property
    def type_names(self) -> tuple[str, ...]:
        """Types, each once, in the order of the columns."""
        return tuple(dict.fromkeys(self.types))

    @property
    def reach(self) -> tuple[float, float]:
        """|x| and |y| beyond which a robot has left the map [m]."""
        x, y = self.height_map.size
        return 0.5 * x - EDGE, 0.5 * y - EDGE


def tile_size(cfg: TerrainConfig, name: str, difficulty: float) -> float:
    """Return the size of the features of type `name` (such as a step height) at a difficulty [m or degrees]."""
    asked, kind = cfg.sizes.get(name), TERRAIN_TYPES[name]
    if asked is None:
        return kind.sized(difficulty, cfg.scale)
    if not isinstance(asked, tuple):
        return asked
    gets_smaller = kind.sized(1.0, cfg.scale) < kind.sized(0.0, cfg.scale)  # stepping stones get smaller with difficulty
    easier, harder = asked[::-1] if gets_smaller else asked
    return easier + (harder - easier) * difficulty


def hardest_difficulty(cfg: TerrainConfig) -> float:
    """Return the difficulty of the hardest row that `Terrain.build` makes, from 0 to 1."""
    return (cfg.num_rows - 1) / cfg.num_rows if cfg.curriculum else max(WITHOUT_CURRICULUM)


def column_types(proportions: dict[str, float], num_cols: int) -> list[str]:
    """Return the type of each column. Each type takes its share of the interval from 0 to 1, in the order of `proportions`. A
    column has the type in which its middle lies.
    """
    names = [name for name, share in proportions.items() if share > 0.0]
    ends = np.cumsum([proportions[name] for name in names])
    middles = (np.arange(num_cols) + 0.5) / num_cols
    return [names[min(int(np.searchsorted(ends, m)), len(names) - 1)] for m in middles]


def check_terrain(cfg: TerrainConfig, origins: Origins) -> None:
    """Check all values of a terrain's configuration.

    Raises:
        ConfigError: a value is wrong. The message names the field, any other field that contradicts it, and the
            sources of both (from `origins`).
    """
    if cfg.mesh_type == "plane":
        return

    def error(field: str, text: str) -> ConfigError:
        return origins.error(f"terrain.{field}", text)

    def among(field: str) -> str:
        return f"{field} = {getattr(cfg, field)} ({origins.of(f'terrain.{field}')})"

    for name, share in cfg.proportions.items():
        terrain_type(name, origins.where(f"terrain.proportions.{name}"))
        if share < 0.0:
            raise error(f"proportions.{name}", f"must be at least 0, got {share}")
    total = sum(cfg.proportions.values())
    if abs(total - 1.0) > 1e-6:
        listed = ", ".join(f"{name} {share:g}" for name, share in cfg.proportions.items())
        raise error("proportions", f"must sum to 1, got {total:g} ({listed})")
    for name, asked in cfg.sizes.items():
        kind = terrain_type(name, origins.where(f"terrain.sizes.{name}"))
        size = max(asked) if isinstance(asked, tuple) else asked
        if size > kind.largest:
            raise error(f"sizes.{name}", f"must be at most {kind.largest:g} {kind.unit}, got {size:g}")
    found = column_types(cfg.proportions, cfg.num_cols)
    side = min(cfg.terrain_length, cfg.terrain_width)
    for name, share in cfg.proportions.items():
        if share <= 0.0:
            continue
        kind, asked_by = TERRAIN_TYPES[name], f"proportions.{name}: {origins.of(f'terrain.proportions.{name}')}"
        if name not in found:
            few = f"a share of {share:g} is less than one column ({among('num_cols')})"
            raise error(f"proportions.{name}", f"{few}; ask for more columns or leave the type out")
        if kind.finest is not None and cfg.horizontal_scale > (finest := kind.finest[0] * cfg.scale) * (1.0 + 1e-6):
            coarse = f"cells of {cfg.horizontal_scale:g} m are larger than the {kind.finest[1]} of '{name}', {finest:g} m"
            raise error("horizontal_scale", f"{coarse} ({asked_by})")
        if side <= (platform := kind.platform * cfg.scale):
            tile = f"a tile of {cfg.terrain_length:g} x {cfg.terrain_width:g} m (terrain_length, terrain_width)"
            short = "terrain_length" if side == cfg.terrain_length else "terrain_width"
            raise error(short, f"{tile} is not larger than the platform of '{name}', {platform:g} m ({asked_by})")
    if cfg.max_init_terrain_level >= cfg.num_rows:
        raise error("max_init_terrain_level", f"must be below {among('num_rows')}, got {cfg.max_init_terrain_level}")
    if cfg.spawn_range >= 0.5 * side:
        start = f"robots would start up to {cfg.spawn_range:g} m from the middle of their tile"
        tile = f"the tile, whose shorter side is {side:g} m ({among('terrain_length')}, {among('terrain_width')})"
        raise error("spawn_range", f"{start}. That is outside {tile}")
    if cfg.border_size < 2.0 * EDGE:
        raise error("border_size", f"must be at least {2.0 * EDGE:g}, got {cfg.border_size:g}")
    square = SPAWN_SQUARE * cfg.scale
    if cfg.horizontal_scale > min(side, square):
        limit = f"a tile of {side:g} m" if side < square else f"the {square:g} m square in which robots start"
        raise error("horizontal_scale", f"cells of {cfg.horizontal_scale:g} m are larger than {limit}")
    if (tiles := cfg.num_rows * cfg.num_cols) > MOST_TILES:
        product = f"{among('num_rows')} times {among('num_cols')}"
        raise error("num_rows", f"{product} are {tiles:,} tiles, but at most {MOST_TILES:,} are allowed")
    lengths = (cfg.num_rows * cfg.terrain_length, cfg.num_cols * cfg.terrain_width)
    x, y = (length + 2.0 * cfg.border_size for length in lengths)
    cells = x * y / cfg.horizontal_scale**2
    if cells > MOST_CELLS:
        area = f"{x:g} x {y:g} m in cells of {cfg.horizontal_scale:g} m are {cells:,.0f} cells"
        raise error(
            "horizontal_scale", f"{area}, but at most {MOST_CELLS:,} are allowed; ask for larger cells or fewer tiles"
        )
