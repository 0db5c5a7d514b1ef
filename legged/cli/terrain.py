"""`legged terrain`: pictures of a task's terrain."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from PIL import Image

from legged.commandline.arguments import TASK, overrides, register_given
from legged.commandline.command import sub_command
from legged.config import has_robot
from legged.deploy.command_parser import argument
from legged.errors import ConfigError
from legged.process.paths import make_folder, ready_to_write, relative, replacing
from legged.registry import task_config
from legged.rendering.terrain_picture import draw_map, picture_of_types, tiles
from legged.terrain import Terrain, check_terrain, terrain_types


@sub_command(
    "legged terrain anymal_c",
    "legged terrain anymal_c --types gap,pit,waves --difficulty 0.7",
    arguments=(
        *TASK,
        argument("--types", help="terrain types to show side by side instead of the task's grid, e.g. stairs_up,gap"),
        argument("--difficulty", type=float, default=0.5, help="difficulty of the tiles in terrain.png, 0 to 1"),
        argument("--out", type=Path, default=Path("."), help="folder for the two PNG files"),
    ),
)
def terrain(args: argparse.Namespace) -> int:
    """Draw a task's terrain: `legged terrain anymal_c`.

    terrain_map.png shows the whole grid of tiles from above. terrain.png shows one tile of each type with a robot on it. With
    `--types` both pictures show tiles of the given types, at the given `--difficulty`.
    """
    register_given(args, "task")
    if not 0.0 <= args.difficulty <= 1.0:
        raise ConfigError(f"--difficulty: must be between 0 and 1, got {args.difficulty:g}")
    cfg = task_config(args.task, overrides(args), on_cpu=True)
    if not has_robot(cfg):
        raise ConfigError(f"TASK: '{args.task}' has no terrain to show, because its ground is part of its model")
    ready_to_write(args.out)
    if args.types is None:
        if cfg.terrain.mesh_type == "plane":
            raise ConfigError(
                f"{args.task}: has no terrain to show, because its ground is a plane (terrain.mesh_type); name"
                " types to show with --types"
            )
        grid = Terrain.build(cfg.terrain, cfg.env.seed)
        types: Sequence[str] = grid.type_names
        levels = [f"{row / cfg.terrain.num_rows:g}" if cfg.terrain.curriculum else "" for row in range(cfg.terrain.num_rows)]
    else:
        types = terrain_types("--types", args.types)
        sizes = replace(cfg.terrain, mesh_type="height_map", num_rows=1, num_cols=len(types), max_init_terrain_level=0)
        check_terrain(replace(sizes, proportions=dict.fromkeys(types, 1.0 / len(types))), cfg.origins)
        # On the map, the first column of the grid is on the right. So the order of the types is reversed.
        grid = tiles(cfg.terrain, [types[::-1]], args.difficulty, cfg.env.seed)
        levels = [f"{args.difficulty:g}"]
    make_folder(args.out)
    map_path, picture_path = args.out / "terrain_map.png", args.out / "terrain.png"
    draw_map(grid, levels, map_path)
    with replacing(picture_path) as part:
        Image.fromarray(picture_of_types(cfg, types, args.difficulty)).save(part, format="PNG")
    print(f"written: {relative(map_path)}, {relative(picture_path)}")
    return 0
