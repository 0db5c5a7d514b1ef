"""Tiles of terrain. A small NumPy function makes each type. Names and sizes mostly follow legged_gym (arXiv 2109.11978).

Every generator takes a `Tile` of zeros and a size (in metres or degrees) that depends on the difficulty. The generator fills
in the heights of the cells [m]. Robots start in the middle and walk outward, so `stairs_up` has its platform at the bottom.

Lengths that do not depend on the difficulty (treads, platforms, bumps, blocks) are for a robot that stands half a metre
high. They are multiplied by the tile's `scale`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import atan, degrees, radians, tan

import numpy as np

from legged.errors import ConfigError, suggest

HOLE_DEPTH = 1.0
"""Depth of gaps and of the space between stepping stones: more than a leg's length [m]."""
TREAD = 0.31
"""Width of a step of stairs [m]."""
SMALLEST_BLOCK = 1.0
"""Shortest side of an obstacle [m]."""
JOINT = 0.1
"""Gap between two stepping stones [m]."""
WAVE = 2.0
"""Wavelength of waves [m]."""
BUMPS = 0.05
"""Largest height and depth of the bumps of rough ground [m]."""
LEDGE = 1.0
"""Width of the top of a single step, from its rise to its fall [m]."""
NARROW_TREAD = 0.28
"""Width of a step of narrow stairs, such as stairs in a house [m]."""
KERB, KERB_SPACING = 0.2, 1.0
"""Width of a kerb, and distance between the beginnings of two kerbs [m]."""
BLOCK_SIDES = (0.3, 0.8)
"""Shortest and longest side of the blocks of dense ground [m]."""
GRID = 0.45
"""Side of the squares of a random grid [m]."""
STONE_SIDES = (0.2, 0.5)
"""Shortest and longest side of a stone of rubble [m]."""
NARROWEST_DITCH = 0.5
"""Largest edge of a cell on tiles of the type `gap` [m]. The ditch on these tiles is up to 1 m wide."""


@dataclass(frozen=True)
class Tile:
    """Rectangle of square cells. `heights` (length, width) has a height for each cell [m], x along the first axis."""

    heights: np.ndarray
    cell: float
    """Edge of a cell [m]."""
    rng: np.random.Generator
    """Source of all randomness of the tile."""
    scale: float = 1.0
    """Factor by which the lengths of the terrain type are multiplied."""
    tread: float | None = None
    """Width of a step of stairs [m]; None for the type's own width. The scale does not multiply this width."""

    def cells(self, metres: float) -> int:
        """Multiply a length [m] by the tile's scale, and return the number of whole cells in it. A cell that is incomplete by
        a rounding error counts as whole, because scales and cells are rounded to six digits.
        """
        return int(metres * self.scale / self.cell + 1e-3)

    def from_centre(self) -> np.ndarray:
        """Return the distance of each cell (length, width) from the tile's centre, as the larger of |x| and |y| [m]."""
        x, y = (np.abs(np.arange(n) - 0.5 * (n - 1)) * self.cell for n in self.heights.shape)
        return np.maximum(x[:, None], y[None, :])

    def middle(self, side: float) -> tuple[slice, slice]:
        """Return the cells of a centred square with sides of `side` [m] times the scale, cut off at the tile's edge."""
        spans = []
        for n in self.heights.shape:
            first = max(0, (n - self.cells(side)) // 2)
            spans.append(slice(first, n - first))
        return spans[0], spans[1]


def slope(tile: Tile, degrees_up: float, platform: float = 3.0) -> None:
    """Make a pyramid with its foot at the tile's edge and a flat top. A negative angle makes a hollow with a flat bottom."""
    distance = 0.5 * min(tile.heights.shape) * tile.cell - tile.from_centre()
    edge = 0.5 * (min(tile.heights.shape) * tile.cell - platform * tile.scale)
    tile.heights[:] = tan(radians(degrees_up)) * np.clip(distance, 0.0, edge)


def rough_slope(tile: Tile, degrees_up: float, platform: float = 3.0) -> None:
    """Make a pyramid with the `bumps` of rough ground."""
    slope(tile, degrees_up, platform)
    tile.heights[:] += bumps(tile, BUMPS)


def bumps(tile: Tile, amplitude: float, step: float = 0.005, spacing: float = 0.2) -> np.ndarray:
    """Return the heights (length, width) of rough ground [m]. Points that are `spacing` apart have random heights from
    -amplitude to amplitude in steps of `step`. Heights between these points are interpolated linearly.
    """
    levels = tile.scale * np.arange(-amplitude, amplitude + 0.5 * step, step)
    every = max(1, tile.cells(spacing))
    counts = [n // every + 2 for n in tile.heights.shape]
    lattice = tile.rng.choice(levels, counts)
    x, y = (np.arange(n) / every for n in tile.heights.shape)
    along = np.array([np.interp(x, np.arange(counts[0]), column) for column in lattice.T]).T
    return np.array([np.interp(y, np.arange(counts[1]), row) for row in along])


def stairs(tile: Tile, riser: float, platform: float = 3.0, tread: float = TREAD) -> None:
    """Make rings of steps that rise to a platform in the middle, or fall to it if `riser` is negative. Steps are as wide as
    the tile's tread or, if this is None, as `tread`. The width is cut to whole cells.
    """
    width = max(1, tile.cells(tread if tile.tread is None else tile.tread / tile.scale))
    across = tile.cells(platform)
    first = 0
    while min(tile.heights.shape) - 2 * first > across:
        first += width
        tile.heights[first : tile.heights.shape[0] - first, first : tile.heights.shape[1] - first] += riser


def step(tile: Tile, height: float, platform: float = 3.0, ledge: float = LEDGE) -> None:
    """Make a raised ring around the platform. On the way outward it is one step up and, after the ledge, one step down."""
    along = max(1, tile.cells(ledge)) * tile.cell / tile.scale  # the ledge is cut to whole cells
    outer, inner = tile.middle(platform + 2.0 * along), tile.middle(platform)
    tile.heights[outer] = height
    tile.heights[inner] = 0.0


def obstacles(tile: Tile, height: float, platform: float = 3.0, count: int = 20) -> None:
    """Make rectangular blocks and pits, anywhere but in the middle. Their sides are 1, 1.4 or 1.8 m long. Heights and depths
    are `height` or half of it.
    """
    rows, columns = tile.heights.shape
    sides = [max(1, tile.cells(0.1 * tenths)) for tenths in range(10, 20, 4)]
    for _ in range(count):
        length, width = tile.rng.choice(sides, 2)
        x = tile.rng.integers(0, max(1, rows - length))
        y = tile.rng.integers(0, max(1, columns - width))
        tile.heights[x : x + length, y : y + width] = height * tile.rng.choice([-1.0, -0.5, 0.5, 1.0])
    tile.heights[tile.middle(platform)] = 0.0


def stepping_stones(tile: Tile, stone: float, platform: float = 4.0, gap: float = JOINT) -> None:
    """Make square stones of side `stone` with gaps around them. Rows of stones are shifted against each other at random."""
    side, between = max(1, tile.cells(stone / tile.scale)), max(1, tile.cells(gap))
    rows, columns = tile.heights.shape
    tile.heights[:] = -HOLE_DEPTH * tile.scale
    for x in range(0, rows, side + between):
        for y in range(-int(tile.rng.integers(0, side)), columns, side + between):
            tile.heights[x : x + side, max(0, y) : max(0, y + side)] = 0.0
    tile.heights[tile.middle(platform)] = 0.0


def gap(tile: Tile, width: float, platform: float = 3.0) -> None:
    """Make a ditch around the platform."""
    across = tile.cells(width / tile.scale) * tile.cell / tile.scale  # the ditch is cut to whole cells
    tile.heights[tile.middle(platform + 2.0 * across)] = -HOLE_DEPTH * tile.scale
    tile.heights[tile.middle(platform)] = 0.0


def pit(tile: Tile, depth: float, platform: float = 4.0) -> None:
    """Make a square hole in which robots start."""
    tile.heights[tile.middle(platform)] = -depth


def waves(tile: Tile, amplitude: float, length: float = WAVE) -> None:
    """Make sine waves along x and y with heights from -amplitude to amplitude. They fade out towards the tile's edge."""
    x, y = ((np.arange(n) + 0.5) * tile.cell / tile.scale for n in tile.heights.shape)
    pattern = np.sin(2.0 * np.pi * x[:, None] / length) + np.sin(2.0 * np.pi * y[None, :] / length)
    inside = 0.5 * min(tile.heights.shape) * tile.cell - tile.from_centre()
    fade = np.clip(inside / (0.5 * length * tile.scale), 0.0, 1.0)
    tile.heights[:] = 0.5 * amplitude * pattern * fade


def dense_blocks(tile: Tile, height: float, platform: float = 2.0, cover: float = 1.2) -> None:
    """Stack overlapping blocks on the whole tile except its middle.

    Sides are drawn from BLOCK_SIDES. Tops are at 0, 1, 2, 3 or 4 quarters of `height`. Where blocks overlap, the later one
    counts. The sum of the blocks' areas is `cover` times the area of the tile. At the default `cover`, a robot meets a
    face of up to `height` every few steps, and hardly ever a level stretch as long as itself.
    """
    rows, columns = tile.heights.shape
    left = cover * rows * columns
    while left > 0.0:
        length, width = (max(1, tile.cells(side)) for side in tile.rng.uniform(*BLOCK_SIDES, 2))
        x, y = (int(tile.rng.integers(-side // 2, n)) for side, n in ((length, rows), (width, columns)))
        tile.heights[max(0, x) : x + length, max(0, y) : y + width] = 0.25 * height * tile.rng.integers(0, 5)
        left -= length * width
    tile.heights[tile.middle(platform)] = 0.0


def random_grid(tile: Tile, height: float, platform: float = 2.0, side: float = GRID) -> None:
    """Cover the tile with a grid of squares, as Isaac Lab's random grid does. Each square is at -1/2, -1/4, 0, 1/4 or 1/2 of
    `height`. Steps up and down follow each other more closely than on stairs and obstacles, in no regular order.
    """
    across = max(1, tile.cells(side))
    rows, columns = (-(-n // across) for n in tile.heights.shape)
    heights = 0.25 * height * tile.rng.integers(-2, 3, (rows, columns))
    tile.heights[:] = heights.repeat(across, 0).repeat(across, 1)[: tile.heights.shape[0], : tile.heights.shape[1]]
    tile.heights[tile.middle(platform)] = 0.0


def kerbs(tile: Tile, height: float, platform: float = 2.0, width: float = KERB, spacing: float = KERB_SPACING) -> None:
    """Make rings of kerbs on level ground around the platform, at distances of `spacing` [m]."""
    across, every, inner = max(1, tile.cells(width)), max(2, tile.cells(spacing)), tile.cells(platform)
    rows, columns = tile.heights.shape
    innermost = max(0, (min(rows, columns) - inner) // 2) - across
    for first in sorted(range(innermost, -1, -every)):  # from the edge inward, because each ring clears the ground inside it
        last = first + across
        tile.heights[first : rows - first, first : columns - first] = height
        tile.heights[last : rows - last, last : columns - last] = 0.0


def rubble(tile: Tile, height: float, platform: float = 2.0, cover: float = 2.0) -> None:
    """Cover the tile except its middle with slabs of stone.

    Sides are drawn from STONE_SIDES, directions are random, and tops are at 1, 2, 3 or 4 quarters of `height`. Where stones
    overlap, the higher one counts. The sum of the stones' areas is `cover` times the area of the tile. Faces are ragged,
    because cells are square. Few tops are large enough for a whole foot.
    """
    rows, columns = tile.heights.shape
    step = tile.cell / tile.scale
    x, y = np.meshgrid((np.arange(rows) + 0.5) * step, (np.arange(columns) + 0.5) * step, indexing="ij")
    left = cover * rows * columns * step**2
    while left > 0.0:
        length, width = tile.rng.uniform(*STONE_SIDES, 2)
        turn, dx, dy = tile.rng.uniform(0.0, np.pi), *(one - tile.rng.uniform(0.0, one.max()) for one in (x, y))
        along, across = np.cos(turn) * dx + np.sin(turn) * dy, np.cos(turn) * dy - np.sin(turn) * dx
        inside = (np.abs(along) < 0.5 * length) & (np.abs(across) < 0.5 * width)
        tile.heights[inside] = np.maximum(tile.heights[inside], 0.25 * height * tile.rng.integers(1, 5))
        left -= length * width
    tile.heights[tile.middle(platform)] = 0.0


def flat(tile: Tile, size: float = 0.0) -> None:
    """Leave the ground level at every difficulty."""


@dataclass(frozen=True)
class TerrainType:
    """Type of tile: its generator, and the meaning of its difficulty."""

    generate: Callable[[Tile, float], None]
    """Generator, called with a tile and a size in `unit`."""
    size: Callable[[float], float]
    """Difficulty -> size at scale 1, in `unit`. Training begins at difficulty 0. The hardest of N rows has 1 - 1/N."""
    unit: str
    what: str
    """Name of the size, such as "step height"."""
    stepped: bool
    """True if the type consists of steps with vertical faces instead of slopes."""
    regular: bool = True
    """True if all tiles of a size are the same, with no random part."""
    platform: float = 3.0
    """Side of the level square in the middle at scale 1 [m]."""
    finest: tuple[float, str] | None = None
    """Length [m] and name of the smallest part of a tile of scale 1; cells must not be larger than this part."""
    exact: bool = False
    """True if the length of the smallest part must be a whole number of cells, because rounding it would change the ground.
    Evaluations use cells that divide this length."""

    def sized(self, difficulty: float, scale: float) -> float:
        """Return the size at a difficulty, in `unit`. The size is multiplied by `scale`, the scale of the tiles, unless it is
        an angle.
        """
        return self.size(difficulty) * (scale if self.unit == METRES else 1.0)

    @property
    def largest(self) -> float:
        """Largest allowed size, in `unit`."""
        return STEEPEST if self.unit == DEGREES else LARGEST

    def text(self, *sizes: float) -> str:
        """Return sizes as text, with three digits or in whole degrees: '0.194 m', '11 to 18 degrees'."""
        return f"{' to '.join(f'{size:.0f}' if self.unit == DEGREES else f'{size:.3g}' for size in sizes)} {self.unit}"


METRES, DEGREES = "m", "degrees"
LARGEST, STEEPEST = 100.0, 80.0
"""Largest size [m] and largest angle [degrees]; a slope of 90 degrees would be an endless wall."""


def _angle(difficulty: float) -> float:
    """Return the angle [degrees] of a slope whose rise over run is 0.4 * difficulty."""
    return degrees(atan(0.4 * difficulty))


def _riser(difficulty: float) -> float:
    return 0.05 + 0.18 * difficulty


OF_WAVES, OF_STAIRS = (WAVE / 4, "quarter of a wave"), (TREAD, "tread of a step")
OF_LEDGE = (LEDGE, "ledge of a step")
OF_BLOCKS, OF_STONES = (SMALLEST_BLOCK, "side of a block"), (JOINT, "gap between two stones")
OF_NARROW_STAIRS, OF_KERB = (NARROW_TREAD, "tread of a narrow step"), (KERB, "width of a kerb")
OF_GRID = (GRID, "side of a square")
OF_DENSE_BLOCKS, OF_RUBBLE = (BLOCK_SIDES[0], "side of a block"), (STONE_SIDES[0], "side of a stone")
OF_DITCH = (NARROWEST_DITCH, "width of a ditch")


def narrow_stairs(up: float) -> TerrainType:
    """Return a type of stairs with treads as in a house. The platform is at the top, or at the bottom if `up` is -1."""
    return TerrainType(
        lambda tile, size: stairs(tile, up * size, tread=NARROW_TREAD),
        _riser,
        METRES,
        "step height",
        stepped=True,
        finest=OF_NARROW_STAIRS,
        exact=True,
    )


TERRAIN_TYPES: dict[str, TerrainType] = {
    "flat": TerrainType(flat, lambda d: 0.0, METRES, "height", stepped=False, platform=0.0),
    "slope_up": TerrainType(lambda t, s: slope(t, -s), _angle, DEGREES, "angle", stepped=False),
    "slope_down": TerrainType(slope, _angle, DEGREES, "angle", stepped=False),
    "rough_slope_up": TerrainType(lambda t, s: rough_slope(t, -s), _angle, DEGREES, "angle", stepped=False, regular=False),
    "rough_slope_down": TerrainType(rough_slope, _angle, DEGREES, "angle", stepped=False, regular=False),
    "waves": TerrainType(waves, lambda d: 0.2 * d, METRES, "amplitude", stepped=False, platform=0.0, finest=OF_WAVES),
    "stairs_up": TerrainType(lambda t, s: stairs(t, -s), _riser, METRES, "step height", stepped=True, finest=OF_STAIRS),
    "stairs_down": TerrainType(stairs, _riser, METRES, "step height", stepped=True, finest=OF_STAIRS),
    "step": TerrainType(step, _riser, METRES, "height", stepped=True, platform=3.0 + 2.0 * LEDGE, finest=OF_LEDGE),
    "obstacles": TerrainType(
        obstacles, lambda d: 0.05 + 0.2 * d, METRES, "height", stepped=True, regular=False, finest=OF_BLOCKS
    ),
    "random_grid": TerrainType(
        random_grid, lambda d: 0.05 + 0.2 * d, METRES, "height", stepped=True, regular=False, platform=2.0, finest=OF_GRID
    ),
    "stepping_stones": TerrainType(
        stepping_stones,
        lambda d: 1.5 * (1.05 - d),
        METRES,
        "stone size",
        stepped=True,
        regular=False,
        platform=4.0,
        finest=OF_STONES,
    ),
    "narrow_stairs_up": narrow_stairs(-1.0),
    "narrow_stairs_down": narrow_stairs(1.0),
    "dense_blocks": TerrainType(
        dense_blocks,
        lambda d: 0.05 + 0.2 * d,
        METRES,
        "height",
        stepped=True,
        regular=False,
        platform=2.0,
        finest=OF_DENSE_BLOCKS,
    ),
    "kerbs": TerrainType(kerbs, _riser, METRES, "height", stepped=True, platform=2.0 + 2.0 * KERB, finest=OF_KERB),
    "rubble": TerrainType(
        rubble, lambda d: 0.05 + 0.2 * d, METRES, "height", stepped=True, regular=False, platform=2.0, finest=OF_RUBBLE
    ),
    "gap": TerrainType(gap, lambda d: 1.0 * d, METRES, "width", stepped=True, finest=OF_DITCH),
    "pit": TerrainType(pit, lambda d: 1.0 * d, METRES, "depth", stepped=True, platform=4.0),
}
"""Name in `terrain.proportions` -> terrain type."""


def terrain_type(name: str, where: str) -> TerrainType:
    """Return the terrain type `name`. `where` is the place of the name, for the error.

    Raises:
        ConfigError: there is no type of that name.
    """
    if name not in TERRAIN_TYPES:
        raise ConfigError(f"{where}: there is no terrain type '{name}'{suggest(name, TERRAIN_TYPES)}")
    return TERRAIN_TYPES[name]


def terrain_types(flag: str, text: str) -> list[str]:
    """Return the names in `text`, the comma-separated value of `flag`: 'gap, pit' -> ['gap', 'pit'].

    Raises:
        ConfigError: a name is not a type, or is given twice.
    """
    names = [name.strip() for name in text.split(",")]
    for name in names:
        terrain_type(name, flag)
        if names.count(name) > 1:
            raise ConfigError(f"{flag}: '{name}' is given twice")
    return names
