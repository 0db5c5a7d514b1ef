"""Terrain in pictures: ground coloured by its height, so that steps show without shadows."""

import mujoco
import numpy as np

from legged.physics.scene.terrain_geoms import SAME, add_terrain
from legged.terrain import Terrain

SHOWN_DEPTH = 0.6
"""Ground that is shown below the lowest point [m]."""
LOW, MIDDLE, HIGH = np.array([[0.42, 0.52, 0.58], [0.80, 0.77, 0.70], [0.78, 0.58, 0.42]])
"""Colours of the deepest, the level and the highest ground."""
FAR = 100.0
"""How far from its middle the ground goes on, or a fifth farther than a terrain that is larger [m]."""
CHECKER = 0.94, 1.0
"""Brightness of dark and of light squares."""
SQUARE = 0.5
"""Their side [m]."""
GROUND = "terrain_checker"
LEVEL_RANGE = 0.9
"""Heights, up and down, over which the colours change, or more where the ground is higher [m]."""


def add_painted_terrain(scene: mujoco.MjSpec, terrain: Terrain, checkered: bool = False) -> None:
    """Add a terrain that is seen and not touched, coloured by height. With `checkered` level ground and slopes are, so
    that one sees a camera move over them; steps are not, which would make a frame a third dearer.
    """
    span, lowest = LEVEL_RANGE, float(terrain.height_map.corners.min())
    if checkered:
        dark, light = ([grey] * 3 for grey in CHECKER)
        builtin = mujoco.mjtBuiltin.mjBUILTIN_CHECKER
        kind = mujoco.mjtTexture.mjTEXTURE_2D
        scene.add_texture(name=GROUND, type=kind, builtin=builtin, rgb1=dark, rgb2=light, width=256, height=256)
        material = scene.add_material(name=GROUND, specular=0.0, texuniform=True, texrepeat=[0.5 / SQUARE, 0.5 / SQUARE])
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = GROUND
        span = max(span, float(np.abs(terrain.height_map.corners).max()))
    for geom in add_terrain(scene, terrain, collide=False, depth=SHOWN_DEPTH):
        _paint(scene, geom, span, lowest, terrain.height_map.cell if checkered else None)


def add_horizon(scene: mujoco.MjSpec, terrain: Terrain) -> None:
    """Let the level ground around a checkered terrain go on to the horizon."""
    x, y = (0.5 * side for side in terrain.height_map.size)
    far = max(FAR, 1.2 * x, 1.2 * y)
    half = 0.5 * (far - x), 0.5 * (far - y)
    for sign in (-1.0, 1.0):
        for place, size in (
            ((sign * (x + half[0]), 0.0), (half[0], far)),
            ((0.0, sign * (y + half[1])), (x, half[1])),
        ):
            scene.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[*place, -0.5 * SHOWN_DEPTH],
                size=[*size, 0.5 * SHOWN_DEPTH],
                rgba=[*MIDDLE, 1.0],
                material=GROUND,
                contype=0,
                conaffinity=0,
            )


def _paint(scene: mujoco.MjSpec, geom: mujoco.MjsGeom, span: float, lowest: float, cell: float | None) -> None:
    """Colour by height, up and down to `span` [m]: one colour a box, a texture on a height field, whose points below the
    `lowest` ground are sunk and not seen. With the distance `cell` between the points of height fields [m], checkered.
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
    pixels = (255 * colors).astype(np.uint8)
    scene.add_texture(
        name=geom.name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=shape.ncol,
        height=shape.nrow,
        nchannel=3,
        data=pixels.ravel().tolist(),
    )
    material = scene.add_material(name=geom.name, specular=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = geom.name
    geom.material = geom.name


def _spread(heights: np.ndarray, sunk: np.ndarray) -> np.ndarray:
    """Return heights (X, Y) in which points that are `sunk` have the mean of those around them that are not, or of all: a
    texture is blurred, and their colour, that of the deepest ground, would run into what is seen.
    """
    if not sunk.any():
        return heights
    seen = np.pad(~sunk, 1)
    padded = np.where(seen, np.pad(heights, 1), 0.0)
    x, y = heights.shape
    around = [(slice(i, i + x), slice(j, j + y)) for i in range(3) for j in range(3)]
    count = sum(seen[at].astype(int) for at in around)
    total = sum(padded[at] for at in around)
    beside = np.where(count > 0, total / np.maximum(count, 1), heights[~sunk].mean())
    return np.where(sunk, beside, heights)


def color(heights: np.ndarray, span: float = LEVEL_RANGE) -> np.ndarray:
    """Return (..., 3) colours between 0 and 1 of heights [m], which change up and down to `span` [m]."""
    t = np.clip(heights / span, -1.0, 1.0)
    return np.stack([np.interp(t, (-1.0, 0.0, 1.0), stops) for stops in np.array([LOW, MIDDLE, HIGH]).T], axis=-1)
