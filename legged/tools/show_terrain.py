"""What robots walk on: `python -m legged.tools.show_terrain --task anymal_c [--types stairs_up,obstacles --difficulty 0.7]`.

Writes terrain_map.png, the heights seen from above, and terrain.png, one tile of each type with a robot on it.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image

from legged.commandline.arguments import add_task_arguments, import_and_check, overrides
from legged.commandline.command import run_main
from legged.config import TaskConfig
from legged.config.schema import TerrainConfig
from legged.errors import ConfigError, suggest
from legged.process.paths import make_folder, ready_to_write, relative, replacing
from legged.registry import task_config
from legged.rendering.terrain_picture import Place, render
from legged.robots.robot import load_robot
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec, check_terrain

MARGIN = 2.0
"""Border that is shown around the tiles [m]."""


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(prog="show_terrain", description=__doc__)
    add_task_arguments(parser)
    parser.add_argument("--types", help="types side by side instead of the task's own grid, e.g. stairs_up,gap")
    parser.add_argument("--difficulty", type=float, default=0.5, help="of the tiles in the picture, 0 to 1")
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for the two PNG files")
    args = parser.parse_intermixed_args(argv)
    import_and_check(args)
    if not 0.0 <= args.difficulty <= 1.0:
        raise ConfigError(f"--difficulty: must be between 0 and 1, got {args.difficulty:g}")
    cfg = task_config(args.task, overrides(args), on_cpu=True)
    ready_to_write(args.out)
    if args.types is None:
        if cfg.terrain.mesh_type == "plane":
            raise ConfigError(
                f"{args.task}: stands on a plane (terrain.mesh_type), there is no terrain to show; --types shows types of"
                " your choice"
            )
        check_terrain(cfg.terrain, cfg.origins)
        terrain = Terrain.build(cfg.terrain, cfg.env.seed)
        types: Sequence[str] = terrain.type_names
        levels = [f"{row / cfg.terrain.num_rows:g}" if cfg.terrain.curriculum else "" for row in range(cfg.terrain.num_rows)]
    else:
        types = chosen_types(args.types)
        sizes = replace(cfg.terrain, mesh_type="height_map", num_rows=1, num_cols=len(types), max_init_terrain_level=0)
        check_terrain(replace(sizes, proportions=dict.fromkeys(types, 1.0 / len(types))), cfg.origins)
        terrain = tiles(cfg.terrain, [types[::-1]], args.difficulty, cfg.env.seed)  # the map's first column is the rightmost
        levels = [f"{args.difficulty:g}"]
    make_folder(args.out)
    map_path, picture_path = args.out / "terrain_map.png", args.out / "terrain.png"
    with replacing(map_path) as part:
        draw_map(terrain, levels, part)
    with replacing(picture_path) as part:
        Image.fromarray(picture(cfg, types, args.difficulty)).save(part, format="PNG")
    print(f"written: {relative(map_path)}, {relative(picture_path)}")
    return 0


def chosen_types(text: str) -> list[str]:
    """'gap,pit' -> ['gap', 'pit'].

    Raises:
        ConfigError: one of them is no type, or comes twice.
    """
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in TERRAIN_TYPES:
            raise ConfigError(f"--types: there is no terrain type '{name}'{suggest(name, TERRAIN_TYPES)}")
        if names.count(name) > 1:
            raise ConfigError(f"--types: '{name}' is given twice")
    return names


def tiles(cfg: TerrainConfig, rows: Sequence[Sequence[str]], difficulty: float, seed: int) -> Terrain:
    """A terrain of the given types (R, C), all equally difficult, with a narrow border."""
    specs = [[TileSpec(name, TERRAIN_TYPES[name].size(difficulty)) for name in row] for row in rows]
    return Terrain.of_tiles(specs, replace(cfg, border_size=MARGIN), np.random.default_rng(seed))


def picture(cfg: TaskConfig, types: Sequence[str], difficulty: float) -> np.ndarray:
    """(height, width, 3) uint8: one tile of each type, in rows to be read from the upper left corner, with their names."""
    count = len(types)
    columns = count if count <= 3 else -(-count // 2) if count <= 8 else 4
    rows = -(-count // columns)
    # The camera looks along x: the first row is the farthest, the first column the leftmost.
    at = [(rows - 1 - i // columns, columns - 1 - i % columns) for i in range(count)]
    names = [["flat"] * columns for _ in range(rows)]
    for name, (r, c) in zip(types, at, strict=True):
        names[r][c] = name
    terrain = tiles(cfg.terrain, names, difficulty, cfg.env.seed)
    places = []
    for name, (r, c) in zip(types, at, strict=True):
        kind = TERRAIN_TYPES[name]
        size = (
            f"{kind.size(difficulty):.0f} degrees" if kind.unit == "degrees" else f"{kind.size(difficulty):.2g} {kind.unit}"
        )
        places.append(Place(r, c, name if name == "flat" else f"{name}, {size}"))
    return render(terrain, places, load_robot(cfg.robot))


def draw_map(terrain: Terrain, levels: Sequence[str], path: Path) -> None:
    """The heights from above, x upward and so y to the left, with tiles, their types and `levels` (R,), and origins."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import AsinhNorm, LightSource

    ground = terrain.height_map
    rows, columns = terrain.origins.shape[:2]
    length, width = terrain.tile_size
    hidden = round(max(0.0, terrain.border - MARGIN) / ground.cell)
    shown = slice(hidden, ground.heights.shape[0] - hidden), slice(hidden, ground.heights.shape[1] - hidden)
    # Seen with x upward and y to the left; the light comes from the upper left.
    heights = ground.heights[shown][::-1, ::-1]
    largest = max(float(np.abs(heights).max()), 0.05)
    # Low steps are to be seen beside high ones: about linear up to 0.25 m, logarithmic above.
    scale, colours = AsinhNorm(linear_width=0.25, vmin=-largest, vmax=largest), plt.get_cmap("RdYlBu_r")
    light = LightSource(azdeg=315, altdeg=45)
    shaded = light.shade(heights, colours, blend_mode="soft", norm=scale, vert_exag=2.0, dx=ground.cell, dy=ground.cell)
    half_x, half_y = (0.5 * n * ground.cell for n in heights.shape)

    across = 11.0
    high = min(max(across * half_x / half_y, 2.0), 12.0) + 1.2
    figure, axis = plt.subplots(figsize=(across, high), layout="constrained")
    axis.imshow(shaded, extent=(half_y, -half_y, -half_x, half_x), interpolation="antialiased")
    ends_x, ends_y = (np.arange(n + 1) * s - 0.5 * n * s for n, s in ((rows, length), (columns, width)))
    axis.hlines(ends_x, ends_y[0], ends_y[-1], color="black", linewidth=0.5, alpha=0.5)
    axis.vlines(ends_y, ends_x[0], ends_x[-1], color="black", linewidth=0.5, alpha=0.5)
    axis.plot(terrain.origins[..., 1].ravel(), terrain.origins[..., 0].ravel(), "k+", markersize=4, label="robots start here")
    axis.set_xlabel("y [m]")
    axis.set_ylabel("x [m]")

    top = axis.secondary_xaxis("top")
    groups = [[c for c in range(columns) if terrain.types[c] == name] for name in dict.fromkeys(terrain.types)]
    middles = [0.5 * (ends_y[group[0]] + ends_y[group[-1] + 1]) for group in groups]
    top.set_xticks(middles, [terrain.types[group[0]] for group in groups])
    top.tick_params(length=0)
    for label, group in zip(top.get_xticklabels(), groups, strict=True):
        if 0.75 * across * len(group) / columns < 0.09 * len(label.get_text()):  # wider than its columns
            label.set(rotation=30, ha="left")
    right = axis.secondary_yaxis("right")
    right.set_yticks(0.5 * (ends_x[1:] + ends_x[:-1]), levels)
    right.tick_params(length=0)
    if any(levels):
        right.set_ylabel("difficulty")
    axis.legend(loc="upper left", bbox_to_anchor=(0.0, -0.05), fontsize="small", frameon=False)
    bar = figure.colorbar(ScalarMappable(scale, colours), ax=axis, label="height [m]", shrink=0.8, aspect=30)
    bar.set_ticks([h for h in (-2.0, -1.0, -0.5, -0.2, -0.1, 0.0, 0.1, 0.2, 0.5, 1.0, 2.0) if abs(h) <= largest])
    bar.ax.yaxis.set_major_formatter("{x:g}")
    bar.ax.minorticks_off()
    figure.savefig(path, dpi=130, format="png", bbox_inches="tight")
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
