"""Tiles of terrain as a camera sees them, each with a robot that gives the scale."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from legged.config import LeggedConfig
from legged.config.schema import TerrainConfig
from legged.rendering.camera import Camera
from legged.rendering.framing import frame
from legged.rendering.paint import SHOWN_DEPTH, add_painted_terrain
from legged.rendering.scene import add_robots, add_sky
from legged.rendering.text import labels
from legged.robots.robot import Robot, load_robot
from legged.robots.stance import lowest_point
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec, tile_size

MARGIN = 2.0
"""Border that is shown around the tiles [m]."""
AZIMUTH, ELEVATION = 14.0, -35.0
"""The camera looks along x and down, a little from the side [degrees]."""
FILLED = 0.96
"""Share of the picture that the terrain fills."""
SUN = np.array([0.39, -0.54, -0.75])
"""Direction of its light: from the left, so that risers which face the camera are lit, if less than treads."""
FIELD_OF_VIEW = 30.0
"""What the camera sees, from bottom to top [degrees]."""


@dataclass(frozen=True)
class Place:
    """A tile on which a robot stands, and what is written beside it."""

    row: int
    col: int
    label: str


def tiles(cfg: TerrainConfig, rows: Sequence[Sequence[str]], difficulty: float, seed: int) -> Terrain:
    """Build a terrain of the given types (R, C), all equally difficult, with a narrow border."""
    specs = [[TileSpec(name, tile_size(cfg, name, difficulty)) for name in row] for row in rows]
    return Terrain.of_tiles(specs, replace(cfg, border_size=MARGIN), np.random.default_rng(seed))


def picture_of_types(cfg: LeggedConfig, types: Sequence[str], difficulty: float) -> np.ndarray:
    """Return (height, width, 3) uint8: a tile of each type, with its name, in rows to be read from the upper left corner.

    Raises:
        RunError: nothing can be rendered here.
    """
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
        places.append(
            Place(r, c, name if name == "flat" else f"{name}, {kind.text(tile_size(cfg.terrain, name, difficulty))}")
        )
    return render(terrain, places, load_robot(cfg.robot))


def render(terrain: Terrain, places: Sequence[Place], robot: Robot, width: int = 1600) -> np.ndarray:
    """Return (height, width, 3) uint8: the terrain seen along x from above, a robot in its default pose at each place.

    The height of the picture is what the terrain fills.

    Raises:
        RunError: nothing can be rendered here.
    """
    outline = _outline(terrain)
    reach = FILLED * float(np.tan(0.5 * np.radians(FIELD_OF_VIEW)))
    _, _, (across, up) = frame(outline, (reach, reach), AZIMUTH, ELEVATION)
    height = int(width * np.clip(up / across, 0.3, 0.8))
    camera = Camera(_model(terrain, places, robot, width, height), width, height)
    view = camera.view
    view.azimuth, view.elevation = AZIMUTH, ELEVATION
    view.lookat[:], view.distance, _ = frame(outline, (reach * width / height, reach), AZIMUTH, ELEVATION)
    _pose(camera.model, camera.data, terrain, places, robot)
    try:
        camera.update()
        at = camera.pixels(np.array([_label_at(terrain, place) for place in places]))
        return labels(camera.render(), [place.label for place in places], at)
    finally:
        camera.close()


def _model(terrain: Terrain, places: Sequence[Place], robot: Robot, width: int, height: int) -> mujoco.MjModel:
    """Compile the scene, with the robots in the order of `places`; for drawing, not for simulating."""
    scene = mujoco.MjSpec()
    add_sky(scene)
    half_x, half_y = (0.5 * side for side in terrain.height_map.size)
    look = scene.visual
    look.global_.offwidth, look.global_.offheight, look.global_.fovy = width, height, FIELD_OF_VIEW
    look.quality.shadowsize, look.quality.offsamples = 8192, 8
    look.headlight.ambient, look.headlight.diffuse, look.headlight.specular = [0.42] * 3, [0.12] * 3, [0.0] * 3
    extent = float(np.hypot(half_x, half_y))
    scene.stat.extent, scene.stat.center = extent, [0, 0, 0]
    look.map.znear, look.map.zfar, look.map.shadowclip = 0.2, 6.0, 1.2
    scene.worldbody.add_light(
        pos=-2.0 * extent * SUN,  # shadows are cast only within znear and zfar from here
        dir=SUN,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.62] * 3,
        specular=[0.0] * 3,
        castshadow=True,
    )
    add_painted_terrain(scene, terrain)
    add_robots(scene, robot, len(places))
    return scene.compile()


def _pose(model: mujoco.MjModel, data: mujoco.MjData, terrain: Terrain, places: Sequence[Place], robot: Robot) -> None:
    """Put each robot on the middle of its tile, its lowest foot on the ground, facing the camera."""
    states = data.qpos.reshape(len(places), len(robot.default_qpos))
    states[:] = robot.default_qpos
    for i, place in enumerate(places):
        states[i, :3] = terrain.origins[place.row, place.col]
        states[i, 3:7] = [np.cos(np.radians(110.0)), 0.0, 0.0, np.sin(np.radians(110.0))]
    mujoco.mj_kinematics(model, data)
    for i in range(len(places)):
        feet = [model.geom(f"{i}/{name}").id for shapes in robot.feet_shapes for name in shapes]
        low = min(lowest_point(model, data, foot) for foot in feet)
        states[i, 2] += terrain.origins[places[i].row, places[i].col, 2] - low


def _outline(terrain: Terrain) -> np.ndarray:
    """Return (8, 3) the corners of the tiles and of what stands on them [m]."""
    x, y = (0.5 * side for side in terrain.height_map.size)
    bottom = float(terrain.height_map.corners.min()) - SHOWN_DEPTH
    return np.array([[sx * x, sy * y, z] for sx in (-1, 1) for sy in (-1, 1) for z in (bottom, 0.5)])


def _label_at(terrain: Terrain, place: Place) -> np.ndarray:
    """Return (3,) a place on the border behind the farthest tiles, on the near edge of the others [m]."""
    x, y, _ = terrain.origins[place.row, place.col]
    last = len(terrain.origins) - 1
    if place.row == last > 0:
        return np.array([x + 0.5 * (terrain.tile_size[0] + terrain.border), y, 0.0])
    aside = 0.5 * terrain.border if place.row == 0 else 0.0
    return np.array([x - 0.5 * terrain.tile_size[0] - aside, y, 0.0])
