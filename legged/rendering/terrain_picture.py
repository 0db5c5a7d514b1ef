"""Pictures of terrain: tiles with a robot for scale, and a map of the heights."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from itertools import product
from pathlib import Path

import mujoco
import numpy as np

from legged.config import RobotConfig
from legged.config.robot import TerrainConfig
from legged.figures import figure, import_matplotlib
from legged.rendering.camera import Camera, frame, labels
from legged.rendering.scene import SHOWN_DEPTH, add_painted_terrain, add_robots, add_sky
from legged.robots.robot import Robot, load_robot
from legged.robots.stance import lowest_point
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec, tile_size

MARGIN = 2.0
"""Width of the visible border around the tiles [m]."""
WIDTH = 1600
"""Width of a picture [pixels]. The height follows from the terrain's proportions."""
AZIMUTH, ELEVATION = 14.0, -35.0
"""The camera looks along x and down, a little from the side [degrees]."""
FILLED = 0.96
"""Share of the picture that the terrain fills."""
SUN = np.array([0.39, -0.54, -0.75])
"""Direction of the light. It comes from the left, so that the risers in view are lit, but less than the treads."""
FIELD_OF_VIEW = 30.0
"""Vertical field of view of the camera [degrees]."""


def tiles(cfg: TerrainConfig, rows: Sequence[Sequence[str]], difficulty: float, seed: int) -> Terrain:
    """Return a terrain with tiles of the types in `rows` (R, C), all of the same `difficulty`, and a narrow border."""
    specs = [[TileSpec(name, tile_size(cfg, name, difficulty)) for name in row] for row in rows]
    return Terrain.of_tiles(specs, replace(cfg, border_size=MARGIN), np.random.default_rng(seed))


def picture_of_types(cfg: RobotConfig, types: Sequence[str], difficulty: float) -> np.ndarray:
    """Return a picture (height, width, 3) uint8 of one labelled tile for each terrain type. A robot stands on each tile. The
    tiles run row by row from the upper left corner.

    Raises:
        RunError: this machine cannot render.
    """
    count = len(types)
    columns = count if count <= 3 else -(-count // 2) if count <= 8 else 4
    rows = -(-count // columns)
    # The camera looks along x, so the tile with the largest row and column numbers is in the picture's upper left corner.
    places = {(rows - 1 - i // columns, columns - 1 - i % columns): name for i, name in enumerate(types)}
    names = [[places.get((r, c), "flat") for c in range(columns)] for r in range(rows)]
    terrain, robot = tiles(cfg.terrain, names, difficulty, cfg.env.seed), load_robot(cfg.robot)
    sizes = {name: TERRAIN_TYPES[name].text(tile_size(cfg.terrain, name, difficulty)) for name in types}
    texts = [name if name == "flat" else f"{name}, {sizes[name]}" for name in types]

    x, y = (0.5 * side for side in terrain.height_map.size)
    bottom = float(terrain.height_map.corners.min()) - SHOWN_DEPTH
    outline = np.array(list(product((-x, x), (-y, y), (bottom, 0.5))))
    reach = FILLED * float(np.tan(0.5 * np.radians(FIELD_OF_VIEW)))
    _, _, (across, up) = frame(outline, (reach, reach), AZIMUTH, ELEVATION)
    height = int(WIDTH * np.clip(up / across, 0.3, 0.8))
    with closing(Camera(_model(terrain, robot, count, height), WIDTH, height)) as camera:
        camera.view.azimuth, camera.view.elevation = AZIMUTH, ELEVATION
        shape = (reach * WIDTH / height, reach)
        camera.view.lookat[:], camera.view.distance, _ = frame(outline, shape, AZIMUTH, ELEVATION)
        _pose(camera.model, camera.data, terrain.origins[tuple(zip(*places, strict=True))], robot)
        camera.update()
        at = camera.pixels(np.array([_label_at(terrain, *place) for place in places]))
        return labels(camera.render(), texts, at)


def _model(terrain: Terrain, robot: Robot, count: int, height: int) -> mujoco.MjModel:
    """Return a model of a terrain and `count` copies of a robot, for pictures of WIDTH x `height` [pixels]."""
    scene = mujoco.MjSpec()
    add_sky(scene)
    look = scene.visual
    look.global_.offwidth, look.global_.offheight, look.global_.fovy = WIDTH, height, FIELD_OF_VIEW
    look.quality.shadowsize, look.quality.offsamples = 8192, 8
    look.headlight.ambient, look.headlight.diffuse, look.headlight.specular = [0.42] * 3, [0.12] * 3, [0.0] * 3
    extent = 0.5 * float(np.hypot(*terrain.height_map.size))
    scene.stat.extent, scene.stat.center = extent, [0, 0, 0]
    look.map.znear, look.map.zfar, look.map.shadowclip = 0.2, 6.0, 1.2
    scene.worldbody.add_light(
        pos=-2.0 * extent * SUN,  # only things at distances from znear to zfar from the light cast shadows
        dir=SUN,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.62] * 3,
        specular=[0.0] * 3,
        castshadow=True,
    )
    add_painted_terrain(scene, terrain)
    add_robots(scene, robot, count)
    return scene.compile()


def _pose(model: mujoco.MjModel, data: mujoco.MjData, origins: np.ndarray, robot: Robot) -> None:
    """Put each robot at its tile's origin (N, 3) [m], facing the camera, with the lowest foot on the ground."""
    states = data.qpos.reshape(len(origins), len(robot.default_qpos))
    states[:] = robot.default_qpos
    states[:, :3] = origins
    states[:, 3:7] = [np.cos(np.radians(110.0)), 0.0, 0.0, np.sin(np.radians(110.0))]
    mujoco.mj_kinematics(model, data)
    for i, origin in enumerate(origins):
        feet = [model.geom(f"{i}/{name}").id for shapes in robot.feet_shapes for name in shapes]
        states[i, 2] += origin[2] - min(lowest_point(model, data, foot) for foot in feet)


def _label_at(terrain: Terrain, row: int, col: int) -> np.ndarray:
    """Return the position (3,) of a tile's label [m]: behind a tile of the farthest row, at the near edge of other tiles."""
    x, y, _ = terrain.origins[row, col]
    if row == len(terrain.origins) - 1 > 0:
        return np.array([x + 0.5 * (terrain.tile_size[0] + terrain.border), y, 0.0])
    aside = 0.5 * terrain.border if row == 0 else 0.0
    return np.array([x - 0.5 * terrain.tile_size[0] - aside, y, 0.0])


def draw_map(terrain: Terrain, levels: Sequence[str], path: Path) -> None:
    """Write a map of a terrain's heights and tiles to `path`; `levels` (R,) are texts with the difficulties of tile rows."""
    import_matplotlib()
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import AsinhNorm, LightSource

    ground = terrain.height_map
    rows, columns = terrain.origins.shape[:2]
    length, width = terrain.tile_size
    hidden = round(max(0.0, terrain.border - MARGIN) / ground.cell)
    shown = slice(hidden, ground.heights.shape[0] - hidden), slice(hidden, ground.heights.shape[1] - hidden)
    # On the map, x points upward and y to the left. The light comes from the upper left.
    heights = ground.heights[shown][::-1, ::-1]
    largest = max(float(np.abs(heights).max()), 0.05)
    # The colour scale is linear up to about 0.25 m and logarithmic above, so that low steps are visible next to high ones.
    scale, colors = AsinhNorm(linear_width=0.25, vmin=-largest, vmax=largest), colormaps["RdYlBu_r"]
    light = LightSource(azdeg=315, altdeg=45)
    shaded = light.shade(heights, colors, blend_mode="soft", norm=scale, vert_exag=2.0, dx=ground.cell, dy=ground.cell)
    half_x, half_y = (0.5 * n * ground.cell for n in heights.shape)
    across = 11.0
    high = min(max(across * half_x / half_y, 2.0), 12.0) + 1.2
    with figure(path, (across, high), dpi=130, bbox_inches="tight") as (drawn, axes):
        axis = axes[0, 0]
        axis.imshow(shaded, extent=(half_y, -half_y, -half_x, half_x), interpolation="antialiased")
        ends_x, ends_y = (np.arange(n + 1) * s - 0.5 * n * s for n, s in ((rows, length), (columns, width)))
        axis.hlines(ends_x, ends_y[0], ends_y[-1], color="black", linewidth=0.5, alpha=0.5)
        axis.vlines(ends_y, ends_x[0], ends_x[-1], color="black", linewidth=0.5, alpha=0.5)
        x, y, _ = terrain.origins.reshape(-1, 3).T
        axis.plot(y, x, "k+", markersize=4, label="robots start here")
        axis.set(xlabel="y [m]", ylabel="x [m]")
        top = axis.secondary_xaxis("top")
        groups = [[c for c in range(columns) if terrain.types[c] == name] for name in dict.fromkeys(terrain.types)]
        middles = [0.5 * (ends_y[group[0]] + ends_y[group[-1] + 1]) for group in groups]
        top.set_xticks(middles, [terrain.types[group[0]] for group in groups])
        top.tick_params(length=0)
        for label, group in zip(top.get_xticklabels(), groups, strict=True):
            if 0.75 * across * len(group) / columns < 0.09 * len(label.get_text()):  # the label is wider than its columns
                label.set(rotation=30, ha="left")
        right = axis.secondary_yaxis("right")
        right.set_yticks(0.5 * (ends_x[1:] + ends_x[:-1]), levels)
        right.tick_params(length=0)
        if any(levels):
            right.set_ylabel("difficulty")
        axis.legend(loc="upper left", bbox_to_anchor=(0.0, -0.05), fontsize="small", frameon=False)
        bar = drawn.colorbar(ScalarMappable(scale, colors), ax=axis, label="height [m]", shrink=0.8, aspect=30)
        bar.set_ticks([h for h in (-2.0, -1.0, -0.5, -0.2, -0.1, 0.0, 0.1, 0.2, 0.5, 1.0, 2.0) if abs(h) <= largest])
        bar.ax.yaxis.set_major_formatter("{x:g}")
        bar.ax.minorticks_off()
