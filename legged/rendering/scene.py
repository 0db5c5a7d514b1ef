"""Scenes that are drawn and not simulated: robots on a floor or a terrain, under a sky.

Terrain is coloured by its height, so that steps are visible without shadows.
"""

import mujoco
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from legged.physics.scene.terrain_geoms import SAME, add_terrain
from legged.robots.importing.convert import robot_spec_of
from legged.robots.robot import Robot
from legged.terrain import Terrain

SHOWN_DEPTH = 0.6
"""Thickness of the drawn ground below the lowest point [m]."""
LOW, MIDDLE, HIGH = np.array([[0.42, 0.52, 0.58], [0.80, 0.77, 0.70], [0.78, 0.58, 0.42]])
"""Colours of the lowest ground, of ground at height 0, and of the highest ground."""
FAR = 100.0
"""Smallest distance from the middle of a terrain to the end of the level ground around it [m]."""
CHECKER = 0.94, 1.0
"""Brightness of the dark and of the light squares of checkered ground."""
SQUARE = 0.5
"""Side of a square of checkered ground [m]."""
GROUND = "terrain_checker"
LEVEL_RANGE = 0.9
"""Heights between minus and plus this value differ in colour [m]. On checkered terrain the range includes all heights."""


def add_sky(scene: mujoco.MjSpec) -> None:
    """Add a pale blue sky, white at the horizon."""
    scene.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.76, 0.90],
        rgb2=[0.94, 0.96, 0.98],
        width=256,
        height=1536,
    )


def display_model(robot: Robot, count: int, width: int, height: int, terrain: Terrain | None = None) -> mujoco.MjModel:
    """Return a model of `count` robots on a checkered plane or `terrain`, for pictures of `width` x `height` [pixels]."""
    scene = mujoco.MjSpec()
    look = scene.visual
    look.global_.offwidth, look.global_.offheight = width, height
    look.quality.shadowsize = look.quality.offsamples = 0  # 0 makes rendering without a GPU ten times faster
    look.map.zfar = 60
    scene.stat.extent, scene.stat.center = 4.0, [0, 0, 0.4]
    add_sky(scene)
    if terrain is None:
        add_checker(scene, "ground", [0.80, 0.82, 0.84], [0.70, 0.73, 0.76], 512).texrepeat = [1, 1]
        scene.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], material="ground")
        sunlight, ambient, headlight, sun = [-0.3, 0.35, -1], 0.45, 0.5, 0.5
    else:
        add_painted_terrain(scene, terrain, checkered=True)
        add_horizon(scene, terrain)
        # Most light comes from behind the camera, on the left, so that treads, risers and flanks differ in brightness.
        sunlight, ambient, headlight, sun = [0.3, -0.35, -0.9], 0.42, 0.12, 0.62
    look.headlight.ambient, look.headlight.diffuse = [ambient] * 3, [headlight] * 3
    kind = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    scene.worldbody.add_light(pos=[0, 0, 20], dir=sunlight, type=kind, diffuse=[sun] * 3)
    add_robots(scene, robot, count)
    return scene.compile()


def add_robots(scene: mujoco.MjSpec, robot: Robot, count: int) -> None:
    """Add copies of a robot with the name prefixes 0/, 1/, ..."""
    for i in range(count):
        frame = scene.worldbody.add_frame()
        scene.attach(robot_spec_of(robot.model_path, drawn=True), prefix=f"{i}/", frame=frame)


def add_checker(scene: mujoco.MjSpec, name: str, one: list[float], other: list[float], side: int) -> mujoco.MjsMaterial:
    """Add a checkered material of two colours and return it. Its texture is `side` pixels wide and high."""
    kind, builtin = mujoco.mjtTexture.mjTEXTURE_2D, mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    scene.add_texture(name=name, type=kind, builtin=builtin, rgb1=one, rgb2=other, width=side, height=side)
    material = scene.add_material(name=name, texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    return material


def add_painted_terrain(scene: mujoco.MjSpec, terrain: Terrain, checkered: bool = False) -> None:
    """Add a terrain without collisions, coloured by height. With `checkered`, level ground and slopes are checkered, so that
    a camera's motion is visible. Steps are plain, because checkered steps would make rendering a third slower.
    """
    span, lowest = LEVEL_RANGE, float(terrain.height_map.corners.min())
    if checkered:
        dark, light = ([grey] * 3 for grey in CHECKER)
        material = add_checker(scene, GROUND, dark, light, 256)
        material.specular, material.texrepeat = 0.0, [0.5 / SQUARE, 0.5 / SQUARE]
        span = max(span, float(np.abs(terrain.height_map.corners).max()))
    for geom in add_terrain(scene, terrain, collide=False, depth=SHOWN_DEPTH):
        _paint(scene, geom, span, lowest, terrain.height_map.cell if checkered else None)


def add_horizon(scene: mujoco.MjSpec, terrain: Terrain) -> None:
    """Add level ground from the edges of a checkered terrain to the horizon."""
    x, y = (0.5 * side for side in terrain.height_map.size)
    far = max(FAR, 1.2 * x, 1.2 * y)
    half = 0.5 * (far - x), 0.5 * (far - y)
    box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "rgba": [*MIDDLE, 1.0], "material": GROUND, "contype": 0, "conaffinity": 0}
    for sign in (-1.0, 1.0):
        for place, size in (
            ((sign * (x + half[0]), 0.0), (half[0], far)),
            ((0.0, sign * (y + half[1])), (x, half[1])),
        ):
            scene.worldbody.add_geom(pos=[*place, -0.5 * SHOWN_DEPTH], size=[*size, 0.5 * SHOWN_DEPTH], **box)


def _paint(scene: mujoco.MjSpec, geom: mujoco.MjsGeom, span: float, lowest: float, cell: float | None) -> None:
    """Colour a box, or the texture of a height field, by height. Colours change from -`span` to `span` [m]. Points of a
    height field below `lowest` [m] count as hidden. With `cell`, the side of a terrain cell [m], the ground is checkered.
    """
    if geom.type == mujoco.mjtGeom.mjGEOM_BOX:
        top = geom.pos[2] + geom.size[2]
        geom.rgba = [*color(np.array(top), span), 1.0]
        if cell is not None and abs(top) < SAME:
            geom.material = GROUND
        return
    shape = scene.hfield(geom.hfieldname)
    heights = geom.pos[2] + shape.size[2] * np.array(shape.userdata).reshape(shape.nrow, shape.ncol)
    colors = color(_spread(heights, heights < lowest - SAME), span)
    if cell is not None:
        rows, columns = (np.arange(n) * cell // SQUARE for n in heights.shape)
        colors = colors * np.where((rows[:, None] + columns) % 2 > 0, *CHECKER)[:, :, None]
    kind, pixels = mujoco.mjtTexture.mjTEXTURE_2D, (255 * colors).astype(np.uint8).ravel().tolist()
    scene.add_texture(name=geom.name, type=kind, width=shape.ncol, height=shape.nrow, nchannel=3, data=pixels)
    material = scene.add_material(name=geom.name, specular=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = geom.name
    geom.material = geom.name


def _spread(heights: np.ndarray, sunk: np.ndarray) -> np.ndarray:
    """Return heights (X, Y) in which each hidden point (`sunk`) has the mean height of its visible neighbours, or of all
    visible points if it has no visible neighbour. This is needed because textures are blurred: colours of hidden points
    affect the edges of visible ground.
    """
    if not sunk.any():
        return heights
    seen = np.pad(~sunk, 1)
    padded = np.where(seen, np.pad(heights, 1), 0.0)
    count, total = (sliding_window_view(values, (3, 3)).sum(axis=(2, 3)) for values in (seen, padded))
    beside = np.where(count > 0, total / np.maximum(count, 1), heights[~sunk].mean())
    return np.where(sunk, beside, heights)


def color(heights: np.ndarray, span: float = LEVEL_RANGE) -> np.ndarray:
    """Return colours (..., 3), 0 to 1, of heights (...) [m]. Colours change between heights of -`span` and `span` [m]."""
    t = np.clip(heights / span, -1.0, 1.0)
    return np.stack([np.interp(t, (-1.0, 0.0, 1.0), stops) for stops in np.array([LOW, MIDDLE, HIGH]).T], axis=-1)
